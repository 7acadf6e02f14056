"""Errors that all frames share: small with noise alone, and as large as the true errors with wrong light."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from conftest import assert_close
from refine_examples import (
    BEHIND,
    BLUR_PX,
    balls,
    base_of,
    cut,
    fitted,
    fitter_of,
    model_of,
    noisy,
    pictures_of,
    refined,
    rig_of,
    scene_of,
)
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.systematic import with_lasting_errors
from sphereorient.follow.appearance.light import light_and_blur
from sphereorient.follow.appearance.record import Studied
from sphereorient.pose.compiled import fitted_residuals
from sphereorient.pose.lasting import Lasting, by_power, cell_means, lasting_errors, limb_wider_px, of_left_out
from sphereorient.pose.lights.disk import glint_shares
from sphereorient.pose.model import SphereModel
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses, PoseStart
from sphereorient.trajectory import Reason, Trajectory

COUNT, SIGMA = 24, 4.0
LOBE, LOBE_AT, LOBE_WIDTH = 60.0, (0.45, -0.3), 0.2  # grey levels; radii along the camera's x and y
RIG = rig_of()


@cache
def seen(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Positions and orientations, and their evenly lit pictures."""
    X, R = balls(count, 4)
    return X, R, pictures_of(RIG, "patches", X, R)


@cache
def studied(count: int, lobe: float, *, glints: bool) -> tuple[Pixels, FittedPoses, Tensor, SphereModel]:
    """Fits to pictures with a reflection; without `glints` no model holds it."""
    X, R, pictures = seen(count)
    pictures = pictures.clone()
    row, column = torch.meshgrid(*(torch.arange(size) for size in pictures.shape[-2:]), indexing="ij")
    for c, camera in enumerate(RIG.cameras):
        middle, radius = camera.project(X), RIG.diameter_px / 2
        right, down = ((grid - at[:, None, None]) / radius for grid, at in zip((column, row), middle.T, strict=True))
        away2 = (right - LOBE_AT[0]).square() + (down - LOBE_AT[1]).square()
        pictures[:, c] += lobe * torch.exp(-0.5 * away2 / LOBE_WIDTH**2) * (right.hypot(down) < 0.97)
    pixels = cut(RIG, noisy(pictures, SIGMA, 7), X)
    fit = fitted(RIG, "patches", pixels, X, R, SIGMA)
    model, use = model_of(RIG.table("patches"), SIGMA), torch.ones(count, 2, dtype=torch.bool)
    for _ in range(2):
        model = replace(model, light=model.light.learnt(pixels, fit, use, model, glints=glints))
        begin = PoseStart(fit.position_lab_mm, fit.R_lab_body, use)
        fit = refined(pixels, begin, model, 3)
    return pixels, fit, use, model


@cache
def measured(count: int, lobe: float, *, glints: bool = False) -> tuple[Tensor, FittedPoses, Lasting]:
    """Errors (B, 6), rad and mm, of such fits, and their errors that last."""
    X, R, _ = seen(count)
    pixels, fit, use, model = studied(count, lobe, glints=glints)
    found = lasting_errors(pixels, fit, use, model)
    off = torch.cat([so3.log(fit.R_lab_body @ R.mT), fit.position_lab_mm - X], dim=-1)
    return off, fit, found


def test_noise_alone_gives_little_error_that_lasts():
    _, fit, found = measured(COUNT, 0.0)
    frame = so3.trace(fit.covariance[:, :3, :3]).mean()
    assert so3.trace(found.covariance[:3, :3]) < 0.1 * frame
    assert bool((torch.linalg.eigvalsh(found.covariance) > 0).all())
    assert found.own_rad2.shape == (2, 3, 3)


def test_the_error_of_all_poses_by_a_reflection_is_stated():
    off, _, found = measured(COUNT, LOBE)
    calm = measured(COUNT, 0.0)[2]
    assert so3.trace(found.covariance[:3, :3]) > 3 * so3.trace(calm.covariance[:3, :3])
    mean = off.mean(0)
    distance2 = mean @ torch.linalg.solve(found.covariance, mean)
    assert 0.3 < float((distance2 / 6).sqrt()) < 3.0


def test_a_reflection_is_learnt_as_a_glint():
    off, _, found = measured(COUNT, LOBE, glints=True)
    unknown, _, lasting = measured(COUNT, LOBE)
    assert off.square().mean(0).sum() < 0.5 * unknown.square().mean(0).sum()
    assert so3.trace(found.covariance[:3, :3]) < 0.5 * so3.trace(lasting.covariance[:3, :3])


def test_a_mat_ball_has_no_glints():
    calm, fit, _ = measured(COUNT, 0.0)
    _, learnt, _ = measured(COUNT, 0.0, glints=True)
    assert so3.geodesic_distance(fit.R_lab_body, learnt.R_lab_body).max() < 0.1 * calm[:, :3].norm(dim=1).mean()


@pytest.mark.parametrize("count", [2, COUNT])
def test_a_glint_follows_its_pixels_and_a_mat_ball_has_none(count: int):
    medians = []
    for lobe in (0.0, LOBE):
        pixels, fit, use, model = studied(count, lobe, glints=True)
        at = fitted_residuals(pixels, fit, model)
        shares = glint_shares(at, use, model.light.mirrors(at.view, pixels))
        assert bool(((shares >= 0.0) & (shares <= 1.0)).all())
        medians.append(float(shares[shares > 0.0].median()) if bool((shares > 0.0).any()) else 0.0)
    assert medians[0] < 0.5 < 0.8 < medians[1]


def test_one_frame_gives_no_glints():
    pixels, fit, use, model = studied(1, LOBE, glints=True)
    at = fitted_residuals(pixels, fit, model)
    assert glint_shares(at, use, model.light.mirrors(at.view, pixels)).max() < 1e-6


def test_cells_are_eliminated_as_far_as_they_may_change():
    rng = torch.Generator().manual_seed(3)
    values = torch.randn(3, 50, 4, generator=rng, dtype=torch.float64)
    weight = torch.rand(3, 50, generator=rng, dtype=torch.float64)
    weight[0, :5] = 0.0  # beyond the limb
    cell = torch.randint(0, 6, (3, 50), generator=rng)
    prior = torch.tensor([1e-9, 0.1, 1.0, 10.0, 1e9, 1.0], dtype=torch.float64)
    whole = torch.zeros(6, dtype=torch.float64).index_add_(0, cell.flatten(), weight.flatten())
    left = values - cell_means(values, weight, cell, whole / (whole + prior))
    found = torch.einsum("bpi,bp,bpj->ij", left, weight, left)
    rows = torch.nn.functional.one_hot(cell, 6).double()
    columns = torch.cat([values, rows], dim=-1).flatten(0, 1)
    normal = columns.mT @ (weight.flatten()[:, None] * columns) + torch.cat([torch.zeros(4), prior]).diag()
    exact = normal[:4, :4] - normal[:4, 4:] @ torch.linalg.solve(normal[4:, 4:], normal[4:, :4])
    torch.testing.assert_close(found, exact, rtol=1e-6, atol=1e-9)


def test_more_error_may_last_of_one_frame_than_of_many():
    one, many = (measured(count, LOBE)[2] for count in (1, COUNT))
    assert so3.trace(one.covariance[:3, :3]) > so3.trace(many.covariance[:3, :3])
    alone = many.of(1)
    assert alone.own_rad2.shape == (1, 3, 3)
    assert torch.equal(alone.covariance, many.alone[1])


def test_one_camera_alone_errs_by_more_than_with_its_position_held():
    _, _, found = measured(COUNT, LOBE)
    assert bool((so3.trace(found.alone[:, :3, :3]) > so3.trace(found.own_rad2)).all())
    assert bool((torch.linalg.eigvalsh(found.alone) > 0).all())


@pytest.mark.parametrize("wider_px", [-0.04, 0.0, 0.06])
def test_the_blur_of_the_limb_is_found(wider_px: float):
    X, R, pictures = seen(COUNT)
    pixels = cut(RIG, noisy(pictures, 1.0, 7), X)
    model, use = model_of(RIG.table("patches"), 1.0), torch.ones(COUNT, 2, dtype=torch.bool)
    model = replace(model, blur_px=model.blur_px - wider_px)
    fit = refined(pixels, PoseStart(X, R, use), model)
    assert limb_wider_px(pixels, fit, use, model) == pytest.approx(wider_px, abs=0.012)


def test_the_blur_of_the_limb_is_learnt_where_that_of_the_paint_is_another():
    X, R, pictures = seen(COUNT)
    use, blur_px = torch.ones(COUNT, 2, dtype=torch.bool), 0.9 * BLUR_PX  # as of disks larger than the table's
    empty = scene_of(np.full(pictures.shape[-2:], BEHIND, np.float32))
    fitter = fitter_of(RIG, blur_px)
    fitter = replace(fitter, views=[replace(view, background=empty) for view in fitter.views])
    grey = [list(of_frame) for of_frame in noisy(pictures, 1.0, 7).numpy()]
    optics = light_and_blur(
        Studied.begun(fitter, base_of("patches"), grey, (X, R, use), None), given=True
    ).fitter.optics
    assert optics.blur_px == blur_px
    assert optics.limb_blur_px == pytest.approx(BLUR_PX, rel=0.04)
    assert optics.middle.blur_px**2 - optics.middle.extra_px**2 == pytest.approx(optics.limb_blur_px**2)


def test_leaving_out_is_fitting_again():
    rng = torch.Generator().manual_seed(11)
    columns = torch.randn(5, 40, 4, generator=rng, dtype=torch.float64)
    grey = torch.randn(5, 40, generator=rng, dtype=torch.float64)
    columns[3] = 0.0  # a part that shows nothing is none
    found = of_left_out(columns.mT @ columns, (columns.mT @ grey[..., None])[..., 0], torch.zeros(4, 4).double())

    def fitted_without(k: int) -> Tensor:
        rest = [part for part in range(5) if part != k]
        return torch.linalg.lstsq(columns[rest].reshape(-1, 4), grey[rest].reshape(-1), driver="gels").solution

    moved = torch.stack([fitted_without(k) - fitted_without(5) for k in (0, 1, 2, 4)])
    torch.testing.assert_close(found, 0.75 * moved.mT @ moved, rtol=1e-6, atol=0.0)


def test_the_difference_of_two_models_is_within_one_sigma():
    _, fit, found = measured(COUNT, 0.0)
    use = torch.ones(COUNT, 2, dtype=torch.bool)
    use[::2, 1] = False  # an unused camera does not count
    more = torch.tensor([[3e-3, 0.0, 0.0], [0.0, -2e-3, 0.0]], dtype=torch.float64)
    own = torch.where(use[..., None], fit.own_turn + more, torch.nan_to_num(torch.full((), torch.inf)))
    for turn_rad, moved_mm in ((1e-3, 0.02), (1e-7, 1e-6)):
        turn = torch.tensor([turn_rad, -turn_rad, 0.0], dtype=torch.float64)
        move = torch.tensor([0.0, moved_mm, 0.0], dtype=torch.float64)
        other = replace(
            fit,
            R_lab_body=so3.exp(turn) @ fit.R_lab_body,
            position_lab_mm=fit.position_lab_mm + move,
            own_turn=own - turn,
        )
        wide = found.widened(fit, other, use)
        way = torch.cat([turn, move])
        if turn_rad < 1e-6:  # less than the error that lasts anyway
            assert wide.covariance.equal(found.covariance)
            continue
        assert_close(way @ torch.linalg.solve(wide.covariance, way), torch.ones((), dtype=torch.float64), atol=1e-4)
        for camera in range(2):
            distance2 = more[camera] @ torch.linalg.solve(wide.own_rad2[camera], more[camera])
            assert_close(distance2, torch.ones((), dtype=torch.float64), atol=1e-4)


def test_light_by_the_logarithm_of_its_power_is_that_of_differences():
    light, scale, step = torch.tensor([3.0, 40.0, 90.0], dtype=torch.float64), torch.tensor(40.0), 1e-5
    more, less = (scale * (light / scale) ** np.exp(power) for power in (step, -step))
    assert_close(by_power(light, scale), (more - less) / (2 * step), atol=1e-6)


def test_the_errors_of_some_cameras_are_those_that_a_track_states():
    """Four cameras with independent errors; in frame k all but the first k + 1 do not see the ball."""
    one = torch.diag(torch.arange(1.0, 7.0, dtype=torch.float64)) * 1e-4
    found = Lasting(covariance=one / 4, own_rad2=one[:3, :3].expand(4, 3, 3), alone=one.expand(4, 6, 6))
    track = Trajectory.empty(np.arange(4.0), cameras=[f"cam{k}" for k in range(4)])
    cameras = {
        name: replace(camera, reason=tuple(Reason.OK if k <= frame else Reason.HIDDEN for frame in range(4)))
        for k, (name, camera) in enumerate(track.cameras.items())
    }
    zero = np.zeros((4, 3, 3))
    track = replace(track, orientation_cov=zero, position_cov=zero, cameras=cameras)
    track = with_lasting_errors(track, found.covariance, found.alone)
    for frame in range(4):
        stated = found.of_use(torch.arange(4) <= frame)
        torch.testing.assert_close(stated[:3, :3], torch.from_numpy(track.orientation_cov[frame]), rtol=1e-6, atol=0.0)
        torch.testing.assert_close(stated[3:, 3:], torch.from_numpy(track.position_cov[frame]), rtol=1e-6, atol=0.0)
        torch.testing.assert_close(stated, one / (frame + 1), rtol=1e-6, atol=0.0)
