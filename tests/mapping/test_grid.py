import math

import numpy as np
import pytest
import torch
from scipy.sparse import csr_matrix

from sphereorient.mapping import joint
from sphereorient.mapping.grid import (
    NormalMatrix,
    SplineTable,
    blur_matrix,
    coefficients_blur_rad,
    look_up,
    map_sums,
    map_table,
    paint_tie,
    sharpened,
    solve_map,
    stiffness,
    texel_weights,
)
from sphereorient.mapping.joint import LinearSystem
from sphereorient.sphere.texture import map_directions, random_directions, random_texture, sample_spline, texel_areas


def test_a_look_up_is_the_spline_of_the_room_sphere(rng):
    texture = torch.rand(16, 32, generator=rng, dtype=torch.float64)
    poles = torch.tensor([[0.0, 1e-6, 1.0], [1e-6, 0.0, -1.0], [-1.0, -1e-9, 0.3]], dtype=torch.float64)
    direction = torch.cat([random_directions(500, rng), torch.nn.functional.normalize(poles, dim=-1)])
    torch.testing.assert_close(look_up(texture, direction), sample_spline(texture, direction))
    place, weight = texel_weights(direction, 16)
    torch.testing.assert_close(weight.sum(-1), torch.ones(len(direction), dtype=torch.float64))
    assert place.min() >= 0
    assert place.max() < 512


def test_the_slope_of_a_look_up_is_its_derivative(rng):
    texture = torch.rand(16, 32, generator=rng, dtype=torch.float64)
    direction = random_directions(200, rng).requires_grad_()
    sample_spline(texture, direction).sum().backward()
    value, slope = SplineTable(texture, 0.0).sample(direction.detach().T[None])
    expected = direction.grad - (direction.grad * direction.detach()).sum(-1, keepdim=True) * direction.detach()
    torch.testing.assert_close(slope[0].T, expected, atol=1e-8, rtol=1e-6)
    torch.testing.assert_close(value[0], sample_spline(texture, direction.detach()))


@pytest.mark.slow
def test_a_table_of_a_map_is_its_spline(rng):
    texture = random_texture("blobs", 1, 32)
    table = map_table(texture, 0.05)
    direction = random_directions(500, rng).float()
    value, slope = table.sample(direction.T[None])
    exact, exact_slope = SplineTable(texture, 0.05).sample(direction.T[None])
    assert (value - exact).abs().max() < 0.02
    assert (slope - exact_slope).norm(dim=1).mean() < 0.05 * exact_slope.norm(dim=1).mean()


def test_areas_make_the_whole_sphere():
    assert math.isclose(float(texel_areas(12).sum()), 4 * math.pi, rel_tol=1e-12)


def test_stiffness_is_the_integral_of_the_squared_slope():
    height = 96
    z = map_directions(height)[..., 2].reshape(-1).numpy()
    matrix = stiffness(height)
    # The slope of z = sin(latitude) is cos(latitude): its square's integral is 8 pi / 3.
    assert math.isclose(z @ (matrix @ z), 8 * math.pi / 3, rel_tol=0.01)
    assert np.abs(matrix @ np.ones(len(z))).max() < 1e-9


def test_the_map_is_that_of_a_brute_force_least_squares(rng):
    height, count, smooth = 6, 400, 0.7
    direction = random_directions(count, rng)
    value = torch.rand(count, generator=rng, dtype=torch.float64)
    weight = torch.rand(count, generator=rng, dtype=torch.float64)
    normal, right = map_sums(direction, value, weight, height)
    got = solve_map(normal, right, height, smooth, 2000)
    look = torch.stack([look_up(unit.reshape(height, -1), direction) for unit in torch.eye(72, dtype=torch.float64)], 1)
    ties = torch.from_numpy(stiffness(height).toarray())
    size, turned = torch.linalg.eigh(ties)
    root = (smooth * size.clamp_min(0)).sqrt()[:, None] * turned.T
    rows = torch.cat([weight.sqrt()[:, None] * look, root])
    values = torch.cat([weight.sqrt() * value, torch.zeros(72, dtype=torch.float64)])
    expected = torch.linalg.lstsq(rows, values[:, None], driver="gelsd").solution[:, 0]
    torch.testing.assert_close(got.reshape(-1), expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("fixed", [False, True])
def test_a_joint_step_is_that_of_a_brute_force_least_squares(rng, fixed, monkeypatch):
    monkeypatch.setattr(joint, "LONGEST_SHARE", 1e3)
    monkeypatch.setattr(joint, "STEPS", 4000)
    height, instants, cameras, places, smooth = 4, 3, 2, 200, 0.5
    texels, disks = 2 * height * height, instants * cameras
    look = torch.randn(disks, places, texels, generator=rng)
    look = look * (torch.rand(look.shape, generator=rng) < 0.2)
    by_pose = torch.randn(disks, 6, places, generator=rng)
    light, _ = torch.linalg.qr(torch.randn(disks, places, 2, generator=rng))
    residual = torch.randn(disks, places, generator=rng)
    texture = torch.rand(height, 2 * height, generator=rng)
    jacobian = csr_matrix(look.reshape(-1, texels).numpy())
    part = LinearSystem(by_texel=jacobian, by_pose=by_pose, by_light=light.mT, residual=residual)
    use = torch.ones(instants, cameras, dtype=torch.bool)
    step = joint.joint_step([part], use, texture, smooth, 1.0, fixed)
    # Dense: poses, then texels, then a light of each disk's own.
    width = 6 * instants + texels + 2 * disks
    rows = torch.zeros(disks, places, width, dtype=torch.float64)
    for k in range(disks):
        start = 6 * (k // cameras)
        rows[k, :, start : start + 6] = by_pose[k].T.double()
        rows[k, :, 6 * instants : 6 * instants + texels] = look[k].double()
        at = 6 * instants + texels + 2 * k
        rows[k, :, at : at + 2] = light[k].double()
    rows = rows.reshape(-1, width)
    if fixed:
        share = torch.zeros(width, width - 3 * instants + 3, dtype=torch.float64)
        for n in range(instants):
            share[6 * n : 6 * n + 3, 3 * n : 3 * n + 3] = torch.eye(3)
            share[6 * n + 3 : 6 * n + 6, 3 * instants : 3 * instants + 3] = torch.eye(3)
        share[6 * instants :, 3 * instants + 3 :] = torch.eye(width - 6 * instants)
    else:
        share = torch.eye(width, dtype=torch.float64)
    ties = torch.zeros(width, width, dtype=torch.float64)
    paint = slice(6 * instants, 6 * instants + texels)
    ties[paint, paint] = smooth * torch.from_numpy(stiffness(height).toarray())
    pull = rows.T @ residual.double().reshape(-1)
    pull[paint] -= ties[paint, paint] @ texture.double().reshape(-1)
    solution = share @ torch.linalg.solve(share.T @ (rows.T @ rows + ties) @ share, share.T @ pull)
    torch.testing.assert_close(step.reshape(-1), solution[: 6 * instants], atol=2e-3, rtol=2e-3)


BLUR_RAD, ROWS = 0.08, 48
EVERYWHERE = map_directions(ROWS).reshape(-1, 3)


def readings(paint, sigma, seed):
    """Return the normal equations of the blurred map from one noisy reading of each texel of blurred paint."""
    noise = torch.randn(len(EVERYWHERE), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    blurred = blur_matrix(EVERYWHERE, coefficients_blur_rad(BLUR_RAD, ROWS), ROWS) @ paint.reshape(-1).numpy()
    place, weight = texel_weights(EVERYWHERE, ROWS)
    start = np.arange(0, place.numel() + 1, 16)
    reads = csr_matrix((weight.reshape(-1).numpy(), place.reshape(-1).numpy(), start), (len(noise), len(noise)))
    return NormalMatrix(reads / sigma), reads.T @ ((reads @ blurred + sigma * noise.numpy()) / sigma**2)


def off(found, paint):
    """Return the rms difference of two maps over the sphere."""
    difference = look_up(found, EVERYWHERE) - look_up(paint, EVERYWHERE)
    area = texel_areas(ROWS).reshape(-1)
    return float(((area * difference.square()).sum() / area.sum()).sqrt())


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.003, 0.03, 0.3])
def test_sharpening_is_bounded_by_what_noise_allows(sigma):
    """The weight found from edges of the blurred map is near the best one, for any noise."""
    paint = random_texture("patches", 5, ROWS).double()
    normal, right = readings(paint, sigma, 6)
    blurred = torch.from_numpy(blur_matrix(EVERYWHERE, BLUR_RAD, ROWS) @ paint.reshape(-1).numpy()).reshape(ROWS, -1)
    tie, nothing = paint_tie(blurred.float(), BLUR_RAD), torch.zeros(ROWS, 2 * ROWS)
    at, *others = (
        off(sharpened(normal, right, BLUR_RAD, f * tie, nothing), paint) for f in (1.0, 1e-3, 0.1, 10.0, 1e3)
    )
    assert at < 1.25 * min(others)
    assert at < off(blurred, paint) or sigma > 0.1


@pytest.mark.slow
def test_noise_does_not_change_paint_that_is_expected():
    paint = random_texture("patches", 5, ROWS).double()
    normal, right = readings(paint, 0.3, 6)
    tie = paint_tie(paint.float(), BLUR_RAD)
    free, tied = (sharpened(normal, right, BLUR_RAD, tie, known) for known in (torch.zeros(ROWS, 2 * ROWS), paint))
    assert off(tied, paint) < 0.5 * off(free, paint)
    # Paint that the pictures show clearly replaces even expected paint that is rotated by a right angle.
    normal, right = readings(paint, 0.003, 6)
    turned = sharpened(normal, right, BLUR_RAD, tie, paint.roll(ROWS // 2, 1))
    assert off(turned, paint) < 0.3 * off(paint.roll(ROWS // 2, 1), paint)


def test_a_blur_leaves_even_paint_as_it_is(rng):
    rows = blur_matrix(random_directions(50, rng), 0.1, 12)
    np.testing.assert_allclose(rows @ np.full(288, 0.7), 0.7, rtol=1e-6)
