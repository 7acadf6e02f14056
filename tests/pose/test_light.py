import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import assert_close
from refine_examples import (
    BEHIND,
    OPTICS_PX,
    Rig,
    balls,
    cut,
    fitted,
    model_of,
    noisy,
    refined,
    rig_of,
    share_pictures,
)
from torch import Tensor

from sphereorient import so3
from sphereorient.pose.lights.disk import DiskLight, light_basis, light_columns, light_sums, no_glints, solved_light
from sphereorient.pose.model import FIRST, SphereView, even_light, leaning
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import PoseStart
from sphereorient.pose.residuals import noise_curve
from sphereorient.pose.view import sphere_view
from sphereorient.sphere.view import polynomials
from sphereorient.synth.degrade import blurred

NOISE = torch.tensor([[4.0, 0.05, 0.001, 0.0]])  # grey levels^2 and so on


def disk_places(count: int, radius: float = 1.0, seed: int = 1) -> Tensor:
    """Places (1, 2, count), even over the disk."""
    rng = torch.Generator().manual_seed(seed)
    r = radius * torch.rand(count, generator=rng).sqrt()
    angle = 2 * math.pi * torch.rand(count, generator=rng)
    return torch.stack([r * angle.cos(), r * angle.sin()])[None]


def looked_up(light: DiskLight, across: Tensor) -> tuple[Tensor, Tensor]:
    """Difference and black of maps of the disk at places (L, 2, P)."""
    return light.at(SimpleNamespace(across=across), None)


def lamp(across: Tensor, camera: int) -> tuple[Tensor, Tensor]:
    """White less black paint and black paint (L, P) under a lamp from the side, another for each camera."""
    x, y = across.unbind(-2)
    depth = (1 - x * x - y * y).clamp_min(0).sqrt()
    side = 0.4 if camera == 0 else -0.5
    return 90 + 60 * depth + 50 * side * x - 20 * y, 12 + 18 * depth - 10 * side * y + 6 * x * y


def test_polynomials_are_all_monomials_up_to_their_order():
    x, y = 2.0, 3.0
    values = polynomials(torch.tensor([[[x], [y]]]), 3)[0, :, 0].tolist()
    assert sorted(values) == sorted(x**i * y**j for i in range(4) for j in range(4) if i + j <= 3)
    # A lower order's are the first of a higher one's: shading takes the first ones of a longer list.
    assert values[:6] == polynomials(torch.tensor([[[x], [y]]]), 2)[0, :, 0].tolist()
    assert values[0] == 1


@pytest.mark.parametrize("shape", [(), (0,), (1,), (2, 1, 3)])
def test_functions_at_any_leading_shape(shape):
    across = disk_places(5 * math.prod(shape))[0].reshape(2, *shape, 5).movedim(0, -2)
    whole = light_basis(across)
    assert whole.shape == (*shape, 25, 5)
    flat, one_by_one = across.reshape(-1, 2, 5), whole.reshape(-1, 25, 5)
    for place, expected in zip(flat, one_by_one, strict=True):
        assert_close(light_basis(place), expected, atol=1e-7)


def test_beyond_the_limb_and_on_it_the_functions_are_finite_and_so_are_their_slopes():
    across = torch.tensor([[[0.0, 0.6, 1.0, 1.2], [0.0, 0.8, 0.0, -0.4]]])
    assert light_basis(across).isfinite().all()


def test_maps_that_are_looked_up_are_the_sums_of_functions():
    rng = torch.Generator().manual_seed(5)
    light = DiskLight(
        difference=50 * torch.randn(2, 25, generator=rng),
        black=20 * torch.randn(2, 25, generator=rng),
        noise=NOISE.repeat(2, 1),
        glints=no_glints(2),
        **even_light(2),
        known=True,
    )
    across = torch.cat([disk_places(3000, 0.98, seed) for seed in range(4)])
    basis = light_basis(across)
    for got, coefficients in zip(looked_up(light, across), (light.difference, light.black), strict=True):
        expected = torch.stack([coefficients[k % 2] @ basis[k] for k in range(4)])
        # A cell is 1/128 of a radius wide, and by the limb the depth changes over several of them.
        error = (got - expected) / expected.std()
        assert error.square().mean().sqrt() < 0.02
        assert error.abs()[across.norm(dim=1) < 0.9].max() < 0.04
        # The other camera's map is another.
        assert (got[:1] - expected[1:2]).std() > 0.5 * expected.std()


def test_a_lamp_is_looked_up_to_a_grey_level():
    across = disk_places(5000, 0.98)
    difference, black = maps_of(*lamp_coefficients())
    none = {"glints": no_glints(1), **even_light(1)}
    light = DiskLight(difference=difference[None], black=black[None], noise=NOISE, **none, known=True)
    for got, expected in zip(looked_up(light, across), lamp(across, 0), strict=True):
        assert (got - expected)[across.norm(dim=1) < 0.9].abs().max() < 1.0
        assert (got - expected).square().mean().sqrt() < 0.4


@cache
def lamp_coefficients() -> tuple[Tensor, Tensor]:
    across = disk_places(4000)
    basis = light_basis(across)[0].double()
    return tuple(
        torch.linalg.lstsq(basis.T, part[0, :, None].double(), driver="gels").solution[:, 0] for part in lamp(across, 0)
    )


def maps_of(*coefficients: Tensor) -> tuple[Tensor, ...]:
    return tuple(part.float() for part in coefficients)


def test_unknown_light_is_one_and_nothing_everywhere():
    light = DiskLight.unknown(3, NOISE.repeat(3, 1))
    assert not light.known
    difference, black = looked_up(light, disk_places(500, 1.2).repeat(6, 1, 1))
    assert (difference == 1).all()
    assert (black == 0).all()
    assert difference.shape == (6, 500)


@cache
def views() -> tuple[Pixels, SphereView]:
    """Eight disks of one camera, at their poses."""
    rig = rig_of(40.0, ("pinhole",))
    X, R = balls(8, 2)
    pixels = cut(rig, torch.zeros(8, 1, 100, 100), X)
    return pixels, sphere_view(pixels, X, R, model_of(rig.table("patches")))


def lit(pixels: Pixels, view: SphereView, camera: int = 0) -> Tensor:
    difference, black = lamp(view.across, camera)
    return view.coverage * (view.paint * difference + black) + (1 - view.coverage) * pixels.behind


@pytest.mark.parametrize("sigma", [0.0, 4.0])
def test_planted_maps_are_found_again(sigma):
    pixels, view = views()
    rng = torch.Generator().manual_seed(3)
    grey = lit(pixels, view) + sigma * torch.randn(view.paint.shape, generator=rng)
    precision = torch.full_like(grey, 1 / 16)
    normal, right = light_sums(light_columns(view), view, replace(pixels, grey=grey), precision)
    assert normal.dtype == right.dtype == torch.float64
    difference, black = solved_light(normal.sum(0)[None], right.sum(0)[None]).chunk(2, dim=-1)
    across = disk_places(3000, 0.95)
    basis = light_basis(across)[0]
    for got, expected in zip((difference, black), lamp(across, 0), strict=True):
        error = (got[0] @ basis) - expected[0]
        assert error.square().mean().sqrt() < 0.15 + 0.25 * sigma
        assert error.abs().max() < 1.0 + 1.5 * sigma


def test_pixels_without_weight_do_not_count():
    pixels, view = views()
    grey, precision = lit(pixels, view), torch.ones_like(view.paint)
    spoilt = grey.clone()
    spoilt[:, 5::7] = 1e4
    precision[:, 5::7] = 0
    one = light_sums(light_columns(view), view, replace(pixels, grey=grey), precision)
    other = light_sums(light_columns(view), view, replace(pixels, grey=spoilt), precision)
    for a, b in zip(one, other, strict=True):
        assert a.equal(b)


def test_a_disk_that_shows_white_paint_only_leaves_small_maps():
    # The pictures do not determine the difference from black: the ridge shares the light; the sum is right.
    pixels, view = views()
    view = replace(view, paint=torch.ones_like(view.paint))
    grey = lit(pixels, view)
    normal, right = light_sums(light_columns(view), view, replace(pixels, grey=grey), torch.ones_like(grey))
    difference, black = solved_light(normal.sum(0)[None], right.sum(0)[None]).chunk(2, dim=-1)
    across = disk_places(2000, 0.9)
    basis = light_basis(across)[0]
    assert difference.isfinite().all()
    error = (difference[0] + black[0]) @ basis - sum(lamp(across, 0))[0]
    assert error.abs().max() < 1.0


@pytest.mark.parametrize(
    "planted", [(9.0, 0.0, 0.0, 0.0), (4.0, 0.3, 0.0, 0.0), (2.0, 0.05, 0.002, 0.0), (3.0, 0.0, 0.0, 2e-5)]
)
def test_a_noise_curve_is_found_again(planted):
    rng = torch.Generator().manual_seed(7)
    model = 10 + 190 * torch.rand(200_000, generator=rng)
    a, b, c, d = planted
    variance = a + b * model + c * model**2 + d * model**3
    residual = variance.sqrt() * torch.randn(model.shape, generator=rng)
    found = noise_curve(model, residual, torch.ones(len(model), dtype=torch.bool))
    assert found.shape == (4,)
    assert (found >= 0).all()
    at = torch.linspace(20, 190, 18)
    got = found[0] + found[1] * at + found[2] * at**2 + found[3] * at**3
    expected = a + b * at + c * at**2 + d * at**3
    assert (got / expected - 1).abs().max() < 0.08


def test_a_few_wild_residuals_do_not_change_the_curve():
    rng = torch.Generator().manual_seed(7)
    model, inside = 10 + 190 * torch.rand(50_000, generator=rng), torch.ones(50_000, dtype=torch.bool)
    residual = 3 * torch.randn(model.shape, generator=rng)
    residual[::40] = 200
    found = noise_curve(model, residual, inside)
    at_100 = float(found @ torch.tensor([1.0, 1e2, 1e4, 1e6]))
    assert at_100 == pytest.approx(9, rel=0.12)


def test_pixels_outside_do_not_count_for_noise():
    rng = torch.Generator().manual_seed(7)
    model, inside = 200 * torch.rand(20_000, generator=rng), torch.ones(20_000, dtype=torch.bool)
    residual = 3 * torch.randn(model.shape, generator=rng)
    expected = noise_curve(model[::2], residual[::2], inside[::2])
    inside[1::2] = False
    residual[1::2] = torch.nan
    assert noise_curve(model, residual, inside).equal(expected)


@pytest.mark.parametrize(("count", "expected"), [(0, 1.0), (100, 25.0)])
def test_few_pixels_give_one_variance_only(count, expected):
    residual = 5 * torch.tensor([1.0, -1.0]).repeat(count // 2)
    found = noise_curve(torch.linspace(10, 200, count), residual, torch.ones(count, dtype=torch.bool))
    assert found.tolist() == [expected, 0, 0, 0]


def test_light_and_noise_of_two_cameras_are_learnt_from_fitted_pictures():
    rig = rig_of(48.0)
    X, R = balls(12, 4)
    pixels = cut(rig, lamp_pictures(rig, X, R), X)
    use = torch.ones(12, 2, dtype=torch.bool)
    fit = fitted(rig, "patches", pixels, X, R, 5.0, shading=FIRST)
    model = model_of(rig.table("patches"), 5.0, FIRST)
    light = model.light.learnt(pixels, fit, use, model)
    assert light.known
    across = disk_places(3000, 0.9).repeat(2, 1, 1)
    for k, part in enumerate(looked_up(light, across)):
        for camera in range(2):
            error = part[camera] - lamp(across[camera], camera)[k]
            assert error.square().mean().sqrt() < 2.0
            other = part[camera] - lamp(across[camera], 1 - camera)[k]
            assert other.square().mean().sqrt() > 3.0
    at = torch.tensor([1.0, 80.0, 80.0**2, 80.0**3])
    for noise in light.noise:
        assert float(noise @ at) == pytest.approx(25, rel=0.2)
    # One camera's bad disks, not in use, change nothing.
    some = use.clone()
    some[6:, 1] = False
    grey = pixels.grey.clone()
    grey[13::2] = 255 - grey[13::2]
    fewer, spoilt = (model.light.learnt(shown, fit, some, model) for shown in (pixels, replace(pixels, grey=grey)))
    for name in ("difference", "black", "noise"):
        assert_close(getattr(spoilt, name), getattr(fewer, name), atol=1e-6)
    assert not fewer.noise[1].equal(light.noise[1])


def test_light_is_hardly_bent_by_the_errors_of_poses_that_were_found_without_it():
    """Light at given poses leaves half of the error that all poses share, and six more rounds are needed."""
    rig = rig_of(48.0)
    X, R = balls(24, 4)
    pixels = cut(rig, lamp_pictures(rig, X, R, 1.0), X)
    use = torch.ones(24, 2, dtype=torch.bool)
    fit, model = fitted(rig, "patches", pixels, X, R, 1.0), model_of(rig.table("patches"), 1.0)
    true = replace(fit, position_lab_mm=X, R_lab_body=R)
    lit, exact = (
        refined(pixels, PoseStart(X, R, use), replace(model, light=model.light.learnt(pixels, at, use, model)))
        for at in (fit, true)
    )
    before, after = (so3.log(one.R_lab_body @ exact.R_lab_body.mT).mean(0).norm() for one in (fit, lit))
    assert after < 0.35 * before


def lamp_pictures(rig: Rig, X: Tensor, R: Tensor, sigma: float = 5.0) -> Tensor:
    """Pictures under a lamp for each camera, (B, C, H, W): the optics blur what is lit."""
    paint, filled = share_pictures(rig, "patches", X, R, blur_px=0.0)
    pictures = []
    for c, camera in enumerate(rig.cameras):
        height, width = paint.shape[-2:]
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        across = (torch.stack([u, v]) - camera.project(X)[:, :, None, None]) / (0.5 * rig.diameter_px)
        across = across / across.norm(dim=1, keepdim=True).clamp_min(1.0)
        difference, black = (part.reshape(-1, height, width) for part in lamp(across.flatten(2), c))
        pictures.append(BEHIND * (1 - filled[:, c]) + black * filled[:, c] + difference * paint[:, c])
    return noisy(blurred(torch.stack(pictures, dim=1).float(), OPTICS_PX), sigma, 6)


def a_view(across: Tensor, blur: float = 0.1) -> SphereView:
    """Grey paint of slope 0.3 per radius to the right on one disk of radius 7 mm, at places (2, P)."""
    count = across.shape[1]
    none = torch.zeros(1, 3, count, dtype=torch.float64)
    by_position = none.clone()
    by_position[:, 0] = -0.3 / 7.0  # a ball that moves to the right brings darker paint
    return SphereView(
        paint=0.5 + 0.3 * across[None, 0],
        coverage=torch.ones(1, count, dtype=torch.float64),
        across=across[None],
        outward=none,
        aside=across.norm(dim=0)[None],
        paint_by_rotation=none,
        paint_by_position=by_position,
        coverage_by_position=none,
        known=None,
        blur=torch.full((1, 1), blur, dtype=torch.float64),
    )


def test_the_blur_of_paint_and_light_together_is_that_of_their_product():
    across = torch.tensor([[0.2, -0.4], [0.1, 0.0]], dtype=torch.float64)
    lean = even_light(1)["lean"]
    lean[0, 0, 0] = 0.5  # the logarithm of the light rises by so much per radius to the right
    model = SimpleNamespace(light=SimpleNamespace(lean=lean), radius_mm=7.0)
    pixels = SimpleNamespace(axes=torch.eye(3, dtype=torch.float64)[None, :2])
    found = leaning(a_view(across), pixels, model).paint
    node, weight = (torch.from_numpy(part) for part in np.polynomial.hermite_e.hermegauss(9))
    lit = weight * (0.5 * 0.1 * node).exp()
    by_force = (lit * (0.5 + 0.3 * (across[0][:, None] + 0.1 * node))).sum(1) / lit.sum()
    assert_close(found[0], by_force, atol=1e-9)
    assert not torch.allclose(a_view(across).paint, found, atol=1e-3)


def test_the_lean_of_a_light_is_the_slope_of_its_logarithm():
    class Lamp(DiskLight):
        def at(self, view: SphereView, pixels: Pixels) -> tuple[Tensor, Tensor]:
            x, y = view.across.unbind(1)
            return 80.0 * (0.5 * x - 0.25 * y + 0.3 * x * y).exp(), 0.0 * x

    step = torch.linspace(-0.65, 0.65, 24, dtype=torch.float64)
    across = torch.stack(torch.meshgrid(step, step, indexing="xy")).flatten(1)
    lamp = Lamp.unknown(1, NOISE).with_lean(a_view(across), None, torch.ones(1, 1, dtype=torch.bool))
    by_x, by_y = lamp.lean[0].double()
    expected = torch.zeros(2, 10, dtype=torch.float64)  # of 1, x, y, ...
    expected[0, [0, 2]], expected[1, [0, 1]] = torch.tensor([[0.5, 0.3], [-0.25, 0.3]]).double()
    assert_close(by_x, expected[0], atol=1e-3)
    assert_close(by_y, expected[1], atol=1e-3)
