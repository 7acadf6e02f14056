import math
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
import torch
from conftest import assert_close
from refine_examples import (
    BEHIND,
    BLACK,
    BLUR_PX,
    LOOKS,
    RADIUS_MM,
    WHITE,
    Rig,
    balls,
    base_of,
    camera_of,
    cut,
    f64,
    fitted,
    moved,
    noisy,
    paint_of,
    rig_of,
    scene_of,
    share_pictures,
    turn_errors,
    turned,
)
from torch import Tensor

from sphereorient import so3
from sphereorient.locate import CameraScene
from sphereorient.pose import compiled
from sphereorient.pose import residuals as residuals_module
from sphereorient.pose.camera_view import CameraView, Optics, PyramidLevel
from sphereorient.pose.fit import longest_near_rad
from sphereorient.pose.fitter import first_fitter
from sphereorient.pose.model import FIRST
from sphereorient.pose.pixels import Pixels, cut_pixels, stacked
from sphereorient.pose.poses import POSE_PARTS, FittedPoses
from sphereorient.sphere.texture_table import texture_table

SIGMA = 8.0  # grey levels, 5 % of the step from black to white
COUNT = 10
DIAMETER_PX = 48.0
SLOW = pytest.mark.slow
RIGS = {"two": ("pinhole", "tsai"), "one": ("pinhole",)}
# rms over poses of the noise and of the model's simplifications: rotation in degrees, place across the sight in mm
ROTATION_RMS = {"two": 0.075, "one": 0.14}
ACROSS_RMS_MM, DEPTH_RMS_MM = 0.009, 0.2


def rig(cameras: str = "two") -> Rig:
    return rig_of(DIAMETER_PX, RIGS[cameras])


@cache
def truth(count: int = COUNT) -> tuple[Tensor, Tensor]:
    return balls(count, 1)


@cache
def shares(kind: str = "patches", count: int = COUNT) -> tuple[Tensor, Tensor]:
    return share_pictures(rig(), kind, *truth(count))


def pictures(cameras: str = "two", kind: str = "patches", count: int = COUNT) -> Tensor:
    paint, ball = shares(kind, count)
    clean = BEHIND + (BLACK - BEHIND) * ball + (WHITE - BLACK) * paint
    return noisy(clean, SIGMA, 1)[:, : len(RIGS[cameras])]


@cache
def disks(cameras: str = "two", kind: str = "patches", count: int = COUNT) -> Pixels:
    return cut(rig(cameras), pictures(cameras, kind, count), truth(count)[0])


@cache
def from_truth(cameras: str = "two", kind: str = "patches", count: int = COUNT) -> FittedPoses:
    return fitted(rig(cameras), kind, disks(cameras, kind, count), *truth(count), SIGMA)


def apart_deg(one: FittedPoses, other: FittedPoses) -> float:
    return float(so3.geodesic_distance(one.R_lab_body, other.R_lab_body).rad2deg().max())


def apart_mm(one: FittedPoses, other: FittedPoses) -> float:
    return float((one.position_lab_mm - other.position_lab_mm).norm(dim=1).max())


def errors(fit: FittedPoses, X: Tensor, R: Tensor) -> Tensor:
    """Errors (B, 6) as in the covariance: rotation in rad, position in mm."""
    return torch.cat([turn_errors(fit, R), X - fit.position_lab_mm], dim=1)


def whitened(fit: FittedPoses, error: Tensor) -> Tensor:
    root = torch.linalg.cholesky(fit.covariance)
    return torch.linalg.solve_triangular(root, error[..., None], upper=False)[..., 0]


def rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


@pytest.mark.parametrize("kind", ["patches", pytest.param("dots", marks=SLOW), pytest.param("blobs", marks=SLOW)])
@pytest.mark.parametrize("cameras", RIGS)
def test_the_planted_pose_is_found(cameras, kind):
    fit = from_truth(cameras, kind)
    X, R = truth()
    assert math.degrees(rms(turn_errors(fit, R).norm(dim=1))) < ROTATION_RMS[cameras]
    off = fit.position_lab_mm - X
    assert rms(off[:, [0, 2]]) < ACROSS_RMS_MM
    assert rms(off[:, 1]) < (ACROSS_RMS_MM if cameras == "two" else DEPTH_RMS_MM)
    assert (fit.score > 0.95).all()
    assert (fit.excess - 1).abs().max() < 0.6
    assert fit.step.abs().max() < 0.01


@pytest.mark.parametrize(("off_px", "off_deg"), [(0.5, 0.0), (2.0, 0.0), (0.0, 1.0), (0.0, 5.0)])
@pytest.mark.parametrize("cameras", RIGS)
def test_errors_of_the_centre_and_of_the_rotation_are_made_good(cameras, off_px, off_deg):
    X, R = moved(truth()[0], off_px * rig(cameras).px_mm, 3), turned(truth()[1], off_deg, 3)
    fit = fitted(rig(cameras), "patches", disks(cameras), X, R, SIGMA)
    assert apart_deg(fit, from_truth(cameras)) < 0.01
    assert apart_mm(fit, from_truth(cameras)) < (0.002 if cameras == "two" else 0.01)


@pytest.mark.parametrize("deeper_mm", [-15.0, 2.0, 15.0])
def test_one_camera_makes_an_error_of_the_distance_good(deeper_mm):
    # 15 mm are 6 % of the distance: the disk begins 1.4 px too large or too small.
    start = truth()[0] + f64([0, deeper_mm, 0])
    fit = fitted(rig("one"), "patches", disks("one"), start, truth()[1], SIGMA, iterations=8)
    assert apart_deg(fit, from_truth("one")) < 0.02
    assert apart_mm(fit, from_truth("one")) < 0.02


@pytest.mark.parametrize("larger", [0.98, 1.01])
def test_one_camera_takes_a_wrong_radius_for_another_distance_and_turns_nothing(larger):
    X, R = truth()
    camera = rig("one").cameras[0]
    centre = -camera.R_cam_lab.mT @ camera.T_cam_lab_mm
    fit = fitted(rig("one"), "patches", disks("one"), X, R, SIGMA, radius_mm=larger * RADIUS_MM, iterations=8)
    expected = centre + larger * (from_truth("one").position_lab_mm - centre)
    assert apart_deg(fit, from_truth("one")) < 0.02
    assert (fit.position_lab_mm - expected).norm(dim=1).max() < 0.03


def cut_at(level: PyramidLevel, cameras: str, frames: Tensor, X: Tensor) -> Pixels:
    one = rig(cameras)
    stencil = level.stencil(1.06 * DIAMETER_PX / 2)
    background = scene_of(np.full(frames.shape[-2:], BEHIND, np.float32))
    return stacked(
        [
            cut_pixels(frame.numpy(), background, sight, tuple(camera.project(x).tolist()), stencil, level.extra_px)
            for x, several in zip(X, frames, strict=True)
            for camera, sight, frame in zip(one.cameras, one.sights, several, strict=True)
        ]
    )


@cache
def optics() -> Optics:
    return Optics(base_of("patches"), BLUR_PX, DIAMETER_PX)


@cache
def at_level(name: str, cameras: str) -> Pixels:
    return cut_at(getattr(optics(), name), cameras, pictures(cameras), truth()[0])


@pytest.mark.parametrize("angle_deg", [1.0, 4.0, 8.0])
@pytest.mark.parametrize("cameras", RIGS)
def test_errors_of_rotation_and_centre_are_made_good_through_the_levels(cameras, angle_deg):
    X, R = moved(truth()[0], 0.5 * rig(cameras).px_mm, 4), turned(truth()[1], angle_deg, 5)
    left = []
    for name, iterations in (("coarse", 5), ("middle", 4), ("fine", 4)):
        level = getattr(optics(), name)
        given = {"paint": level.paint, "blur_px": level.blur_px, "iterations": iterations}
        fit = fitted(rig(cameras), "patches", at_level(name, cameras), X, R, SIGMA, **given)
        X, R = fit.position_lab_mm, fit.R_lab_body
        left.append(float(turn_errors(fit, truth()[1]).norm(dim=1).rad2deg().max()))
    assert left[0] < 0.5
    assert left[1] < 0.4
    assert apart_deg(fit, from_truth(cameras)) < 0.04


def test_gain_and_offset_of_the_whole_picture_do_not_matter():
    brighter = pictures() * 1.2 + 11.0
    pixels = cut(rig(), brighter, truth()[0], behind=BEHIND * 1.2 + 11.0)
    fit = fitted(rig(), "patches", pixels, *truth(), 1.2 * SIGMA)
    assert apart_deg(fit, from_truth()) < 0.005
    assert apart_mm(fit, from_truth()) < 0.001
    error = (fit.covariance - from_truth().covariance).diagonal(dim1=1, dim2=2)
    assert (error.abs() < 0.02 * from_truth().covariance.diagonal(dim1=1, dim2=2)).all()


def tint(camera: int) -> tuple[Tensor, Tensor, Tensor]:
    """x and y in radii about each ball, (B, H, W), and a factor of low order."""
    height, width = shares()[0].shape[-2:]
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    x, y = (
        (torch.stack([u, v]) - rig().cameras[camera].project(truth()[0])[:, :, None, None]) / (0.5 * DIAMETER_PX)
    ).unbind(1)
    side = 1.0 if camera == 0 else -0.8
    return x, y, 1 + side * (0.35 * x - 0.2 * y) - 0.15 * x * y + 0.1 * x * x


def shaded() -> Tensor:
    """Pictures under light that changes over the disk, in factor and offset."""
    paint, ball = shares()
    frames = []
    for c in range(2):
        x, y, factor = tint(c)
        lit = ((WHITE - BLACK) * paint[:, c] + BLACK * ball[:, c]) * factor + ball[:, c] * (8 * x - 5 * y)
        frames.append(lit + BEHIND * (1 - ball[:, c]))
    return noisy(torch.stack(frames, dim=1).float(), SIGMA, 1)


def test_light_of_low_order_over_the_disk_does_not_matter():
    X, R = truth()
    pixels = cut(rig(), shaded(), X)
    fit = fitted(rig(), "patches", pixels, X, R, SIGMA, shading=FIRST)
    assert rms(whitened(fit, errors(fit, X, R))) < 1.5
    assert math.degrees(rms(turn_errors(fit, R).norm(dim=1))) < 1.3 * ROTATION_RMS["two"]
    assert (fit.score > 0.95).all()
    # Second order in the factor, first in the offset, is what this light needs.
    assert apart_deg(fit, fitted(rig(), "patches", pixels, X, R, SIGMA)) < 0.05


def test_saturated_pixels_give_only_a_lower_bound_of_their_grey_level():
    X, R = truth()
    full = 0.5 * (BLACK + WHITE)  # nearly all white paint is clipped
    frames = pictures().clamp_max(full)
    fit, believed = (
        fitted(rig(), "patches", cut(rig(), frames, X, full_scale=scale), X, R, SIGMA) for scale in (full, math.inf)
    )
    off = rms(turn_errors(fit, R).norm(dim=1))
    assert math.degrees(off) < 2.0 * ROTATION_RMS["two"]
    assert rms(whitened(fit, errors(fit, X, R))) < 1.6
    assert rms(turn_errors(believed, R).norm(dim=1)) > 2.0 * off
    # Where nothing is clipped, nothing changes.
    same = fitted(rig(), "patches", cut(rig(), pictures(), X, full_scale=1e4), X, R, SIGMA)
    for name in POSE_PARTS:
        assert_close(getattr(same, name), getattr(from_truth(), name), atol=0)


@pytest.mark.parametrize("body", ["compiled", "torch"])
def test_a_picture_that_is_white_all_over_is_not_explained_by_paint(body, monkeypatch):
    if body == "torch":
        monkeypatch.setattr(compiled, "refine_library", lambda: None)
    X, R = truth()
    white = cut(rig(), torch.full_like(pictures(), 255.0), X, full_scale=255.0)
    assert float(fitted(rig(), "patches", white, X, R, SIGMA).score.max()) < 0.1


def test_the_deviation_of_normal_residuals_is_one_with_a_few_arbitrary_ones():
    rng = torch.Generator().manual_seed(0)
    residual = 3.0 * torch.randn(2, 40000, generator=rng)
    residual[:, ::9] = 500.0
    inside = torch.ones_like(residual, dtype=torch.bool)
    inside[1, ::9] = False
    found = residuals_module.robust_deviation(residual, torch.full_like(residual, 9.0), inside)
    assert_close(found, torch.tensor([1.15, 1.0]), atol=0.03)  # among a ninth of outliers: the 56 % quantile


def test_a_bubble_before_part_of_the_disk_does_not_move_the_pose():
    X, R = truth()
    frames = pictures()
    height, width = frames.shape[-2:]
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    for c, camera in enumerate(rig().cameras):
        middle = camera.project(X) + f64([7.0, -5.0])
        distance = (torch.stack([u, v]) - middle[:, :, None, None]).norm(dim=1)
        # Brighter than any paint, 5 px of 24 in radius.
        frames[:, c] = torch.where(distance < 5, 420.0, frames[:, c])
    fit = fitted(rig(), "patches", cut(rig(), frames, X), X, R, SIGMA)
    lured = whitened(from_truth(), errors(fit, X, R) - errors(from_truth(), X, R))
    assert rms(lured) < 0.8
    assert lured.abs().max() < 4
    # Its score falls, because those pixels are not explained, but stays above any wrong pose's.
    assert (fit.score < from_truth().score).all()
    assert (fit.score > 0.5).all()


def test_the_score_distinguishes_paint_from_a_smooth_disk_and_from_the_empty_scene():
    """A blob that is lit from one side is explained to 90 % by shades alone: that is no evidence for the paint."""
    X, R = truth()
    _, ball = shares()
    slope = torch.linspace(-1.0, 1.0, ball.shape[-1])
    lit = BEHIND + (0.5 * (WHITE + BLACK) + 80.0 * slope - BEHIND) * ball
    empty = torch.full_like(ball, BEHIND)
    right = from_truth().score
    for shown, most in ((lit, 0.3), (empty, 0.05)):  # 0 but for noise
        pixels = cut(rig(), noisy(shown, SIGMA, 3), X)
        assert fitted(rig(), "patches", pixels, X, R, SIGMA).score.max() < most
    assert right.min() > 0.8
    # Nor is another pose of the same paint.
    wrong = fitted(rig(), "patches", disks(), X, turned(R, 70.0, 2), SIGMA).score.amin(1)
    assert wrong.max() < 0.5


def test_masked_pixels_do_not_count():
    X, R = truth()
    pixels = disks()
    masked = torch.zeros_like(pixels.inside)
    masked[:, 3::5] = True
    garbage = replace(pixels, grey=torch.where(masked, 1e4, pixels.grey), inside=pixels.inside & ~masked)
    clean = replace(pixels, inside=pixels.inside & ~masked)
    one, other = (fitted(rig(), "patches", some, X, R, SIGMA) for some in (garbage, clean))
    assert apart_deg(one, other) < 1e-4
    assert_close(one.score, other.score, atol=1e-5)
    sigma, sigma_all = (f.covariance.diagonal(dim1=1, dim2=2).sqrt().mean() for f in (other, from_truth()))
    assert sigma / sigma_all == pytest.approx(math.sqrt(5 / 4), abs=0.08)


def test_the_only_camera_has_no_change_by_itself():
    fit = from_truth("one")
    assert_close(fit.own_turn, torch.zeros_like(fit.own_turn), atol=1e-9)
    assert_close(fit.own_move, torch.zeros_like(fit.own_move), atol=1e-6)


def test_changes_by_each_camera_alone_add_up_to_zero():
    fit = from_truth()
    weight = torch.linalg.inv(fit.own_covariance)
    mean = torch.linalg.solve(weight.sum(1), (weight @ fit.own_turn[..., None]).sum(1))[..., 0]
    assert rms(mean) < 0.3 * rms(fit.own_turn)
    # They disagree by as much as they state.
    fit = from_truth(count=40)
    apart = (fit.own_turn[:, 0] - fit.own_turn[:, 1])[..., None]
    root = torch.linalg.cholesky(fit.own_covariance.sum(1))
    assert 0.7 < rms(torch.linalg.solve_triangular(root, apart, upper=False)) < 1.5


def test_the_change_by_a_camera_alone_is_its_own_fit():
    X, R = truth()
    fit = from_truth()
    for camera in range(2):
        use = torch.zeros(COUNT, 2, dtype=torch.bool)
        use[:, camera] = True
        alone = fitted(rig(), "patches", disks(), X, R, SIGMA, iterations=8, use=use)
        places = alone.position_lab_mm, fit.position_lab_mm + fit.own_move[:, camera]
        seen, projected = (rig().cameras[camera].project(place) for place in places)
        assert (seen - projected).norm(dim=-1).max() < 0.02  # px


def second_shows(X: Tensor, R: Tensor, **changes: object) -> FittedPoses:
    """The fit to a ball of which the second camera shows another pose."""
    paint, ball = share_pictures(rig(), "patches", X, R)
    frames = pictures().clone()
    frames[:, 1] = noisy(BEHIND + (BLACK - BEHIND) * ball + (WHITE - BLACK) * paint, SIGMA, 2)[:, 1]
    return fitted(rig(), "patches", cut(rig(), frames, truth()[0]), *truth(), SIGMA, **changes)


def test_disagreement_of_cameras_in_attitude_is_measured():
    X, R = truth()
    delta = f64([0.006, -0.004, 0.008])
    # The position is held: a free one would move and take a part of the rotation.
    held = (1e9 * torch.eye(3, dtype=torch.float64)).expand(COUNT, 3, 3)
    fit = second_shows(X, so3.exp(delta) @ R, place_precision=held)
    assert (fit.own_turn[:, 1] - fit.own_turn[:, 0] - delta).mean(0).norm() < 0.15 * delta.norm()
    # The pose lies between the two.
    share = (so3.log(fit.R_lab_body @ R.mT) @ delta) / delta.norm() ** 2
    assert ((share > 0.2) & (share < 0.8)).all()


def test_disagreement_of_cameras_in_position_is_measured():
    # Lab x lies across both lines of sight.
    X, R = truth()
    fit = second_shows(X + f64([0.03, 0.0, 0.0]), R)
    assert_close((fit.own_move[:, 1] - fit.own_move[:, 0])[:, 0].mean(), f64(0.03), atol=0.004)
    share = (fit.position_lab_mm - X)[:, 0] / 0.03
    assert ((share > 0.1) & (share < 0.9)).all()


@pytest.mark.parametrize("camera", [0, 1])
def test_a_camera_not_in_use_does_not_count(camera):
    X, R = truth()
    use = torch.ones(COUNT, 2, dtype=torch.bool)
    use[:, 1 - camera] = False
    spoilt = disks()
    grey = spoilt.grey.clone()
    grey[1 - camera :: 2] = 100 * torch.rand(grey[0].shape, generator=torch.Generator().manual_seed(1))
    one = fitted(rig(), "patches", spoilt, X, R, SIGMA, use=use)
    other = fitted(rig(), "patches", replace(spoilt, grey=grey), X, R, SIGMA, use=use)
    assert one.R_lab_body.equal(other.R_lab_body)
    assert one.position_lab_mm.equal(other.position_lab_mm)
    assert one.covariance.equal(other.covariance)
    assert one.nll.equal(other.nll)
    # Along its own line of sight its error is large: lab y for the first, lab z for the second.
    sigma = one.covariance.diagonal(dim1=1, dim2=2).sqrt()[:, 3:].mean(0)
    assert int(sigma.argmax()) == (1, 2)[camera]
    assert sigma.max() > 5 * sigma.median()
    if camera == 0:
        alone = fitted(rig("one"), "patches", disks("one"), X, R, SIGMA)
        assert_close(one.R_lab_body, alone.R_lab_body, atol=1e-12)


@pytest.mark.parametrize("start_mm", [0.0, 0.3])
def test_a_pose_that_no_camera_sees_stays_where_it_is_and_the_others_do_not(start_mm):
    X, R = moved(truth()[0], start_mm, 3), turned(truth()[1], 1.0, 4)
    use = torch.ones(COUNT, 2, dtype=torch.bool)
    use[3] = False
    fit = fitted(rig(), "patches", disks(), X, R, SIGMA, use=use)
    assert fit.position_lab_mm[3].equal(X[3])
    assert fit.R_lab_body[3].equal(R[3])
    assert (fit.step[3] == 0).all()
    others = torch.arange(COUNT) != 3
    whole = fitted(rig(), "patches", disks(), X, R, SIGMA)
    assert fit.R_lab_body[others].equal(whole.R_lab_body[others])
    assert (whole.R_lab_body[3] - R[3]).abs().max() > 1e-3


def test_a_pose_whose_start_is_not_a_number_changes_no_others():
    X, R = truth()
    lost = X.clone()
    lost[3] = torch.nan
    fit = fitted(rig(), "patches", disks(), lost, R, SIGMA)
    assert fit.position_lab_mm[3].isnan().all()
    others = torch.arange(COUNT) != 3
    assert fit.R_lab_body[others].equal(from_truth().R_lab_body[others])
    assert fit.covariance[others].equal(from_truth().covariance[others])


def prior_pull(precision: float) -> tuple[Tensor, FittedPoses]:
    """By what share of 0.2 mm along the line of sight a prior on the place moves one camera's fit, (B,)."""
    free = from_truth("one")
    start = free.position_lab_mm + f64([0, 0.2, 0])
    given = {"place_precision": (precision * torch.eye(3, dtype=torch.float64)).expand(COUNT, 3, 3)}
    fit = fitted(rig("one"), "patches", disks("one"), start, free.R_lab_body, SIGMA, iterations=10, **given)
    return (fit.position_lab_mm - free.position_lab_mm)[:, 1] / 0.2, fit


def test_a_prior_pulls_by_its_information():
    # With information I a prior of precision p moves the place by p / (p + I) of the way: I follows from one, the
    # others must agree.
    known = 100.0
    share, fit = prior_pull(known)
    own = known * (1 - share) / share
    assert ((share > 0.2) & (share < 0.9)).all()
    for precision in (25.0, 400.0):
        assert_close(prior_pull(precision)[0], precision / (precision + own), atol=0.03)
    # And it is the information of the covariance without a prior, less the part of a limb's error.
    stated = 1 / from_truth("one").covariance[:, 4, 4]
    assert ((own / stated > 0.9) & (own / stated < 6)).all()
    assert (fit.covariance[:, 4, 4] < from_truth("one").covariance[:, 4, 4]).all()


def test_a_strong_prior_holds_the_position_and_a_zero_prior_changes_nothing():
    X, R = truth()
    start = X + f64([0, 0.2, 0.1])
    for precision, expected in ((1e12, start), (1e-6, from_truth("one").position_lab_mm)):
        given = {"place_precision": (precision * torch.eye(3, dtype=torch.float64)).expand(COUNT, 3, 3)}
        fit = fitted(rig("one"), "patches", disks("one"), start, R, SIGMA, iterations=8, **given)
        assert (fit.position_lab_mm - expected).norm(dim=1).max() < 0.01
    fit = from_truth("one")
    held = torch.diag(f64([1e-6, 1e8, 1e-6])).expand(COUNT, 3, 3)
    along = fitted(rig("one"), "patches", disks("one"), start, R, SIGMA, iterations=8, place_precision=held)
    assert (along.position_lab_mm - start)[:, 1].abs().max() < 1e-3
    assert (along.position_lab_mm - fit.position_lab_mm)[:, [0, 2]].abs().max() < 0.02


def test_score_and_likelihood_show_wrong_poses():
    right = from_truth()
    X, R = right.position_lab_mm, right.R_lab_body
    scores, nll = [], []
    for angle_deg in (0.0, 1.0, 3.0, 10.0, 60.0):
        at = fitted(rig(), "patches", disks(), X, turned(R, angle_deg, 6), SIGMA, iterations=1)
        scores.append(at.score.amin(1))
        nll.append(at.nll)
    assert (torch.stack(scores).diff(dim=0)[:3] < 0).all()
    assert (torch.stack(nll).diff(dim=0)[:3] > 0).all()
    assert scores[0].min() > 0.95
    assert scores[-1].max() < 0.7
    assert (nll[-1] - nll[0]).min() > 1000


@pytest.mark.slow
def test_the_likelihood_falls_off_as_the_covariance_states():
    # Three standard deviations from the best pose the negative logarithm is 4.5 higher; noise moves its minimum.
    count = 40
    fit = from_truth(count=count)
    root = torch.linalg.cholesky(fit.covariance)
    at_best = fitted(rig(), "patches", disks(count=count), fit.position_lab_mm, fit.R_lab_body, SIGMA, iterations=1).nll
    rise = []
    for i in range(6):
        for side in (3.0, -3.0):
            step = side * root[:, :, i]
            X, R = fit.position_lab_mm + step[:, 3:], so3.exp(step[:, :3]) @ fit.R_lab_body
            rise.append(fitted(rig(), "patches", disks(count=count), X, R, SIGMA, iterations=1).nll - at_best)
    mean = torch.stack(rise).reshape(6, 2, count).mean((1, 2))
    assert ((mean > 2.5) & (mean < 7)).all()


@pytest.mark.slow
def test_a_map_in_a_mirror_scores_worse():
    mirrored = texture_table(paint_of("patches").flip(1), 2 * BLUR_PX / DIAMETER_PX)
    fit = fitted(rig(), "patches", disks(), *truth(), SIGMA, paint=mirrored)
    assert (fit.score < from_truth().score - 0.2).all()


@pytest.mark.parametrize("chosen", [[0], [2, 3], [9, 4, 0], list(range(9))])
def test_a_pose_does_not_depend_on_its_neighbours_in_the_batch(chosen):
    X, R = moved(truth()[0], 0.1, 3), turned(truth()[1], 1.0, 4)
    whole = fitted(rig(), "patches", disks(), X, R, SIGMA)
    index = torch.tensor(chosen)
    pixels = disks().where(torch.stack([2 * index, 2 * index + 1], dim=1).reshape(-1))
    some = fitted(rig(), "patches", pixels, X[index], R[index], SIGMA)
    for name in POSE_PARTS:
        assert getattr(some, name).equal(getattr(whole, name)[index]), name


def test_no_pose_gives_no_fit():
    fit = fitted(rig(), "patches", disks().where(torch.arange(0)), truth()[0][:0], truth()[1][:0], SIGMA)
    assert fit.R_lab_body.shape == (0, 3, 3)
    assert fit.own_covariance.shape == (0, 2, 3, 3)
    assert fit.score.shape == (0, 2)


def test_nothing_that_was_given_is_written_to():
    pixels, X, R = disks(), truth()[0].clone(), truth()[1].clone()
    precision = torch.eye(3, dtype=torch.float64).expand(COUNT, 3, 3).clone()
    before = [pixels.grey.clone(), pixels.behind.clone(), X.clone(), R.clone(), precision.clone()]
    fitted(rig(), "patches", pixels, X, R, SIGMA, place_precision=precision)
    for part, expected in zip((pixels.grey, pixels.behind, X, R, precision), before, strict=True):
        assert part.equal(expected)


def test_a_fit_is_float64_with_rotations_that_are_rotations_and_covariances_that_are_covariances():
    for name in RIGS:
        fit = from_truth(name)
        for field in ("position_lab_mm", "R_lab_body", "covariance", "own_turn", "own_covariance", "nll", "step"):
            assert getattr(fit, field).dtype == torch.float64
        assert_close(fit.R_lab_body @ fit.R_lab_body.mT, torch.eye(3, dtype=torch.float64).expand(COUNT, 3, 3), 1e-10)
        assert_close(fit.covariance, fit.covariance.mT, atol=1e-10)
        assert (torch.linalg.eigvalsh(fit.covariance) > 0).all()
        assert (torch.linalg.eigvalsh(fit.own_covariance) > 0).all()


@pytest.mark.slow
def test_errors_that_neighbours_share_widen_the_covariance():
    # The same scatter in every pixel, but in clouds of two pixels: they hold far less information.
    X, R = truth()
    paint, ball = shares()
    clean = BEHIND + (BLACK - BEHIND) * ball + (WHITE - BLACK) * paint
    scaled, wider, own = [], [], []
    for seed in range(4):
        drawn = noisy(torch.zeros_like(clean), 1.0, seed).numpy()
        clouds = torch.from_numpy(np.stack([[cv2.GaussianBlur(one, (0, 0), 1.3) for one in pair] for pair in drawn]))
        pixels = cut(rig(), clean + SIGMA / clouds.std() * clouds, X)
        fit = fitted(rig(), "patches", pixels, X, R, SIGMA)
        scaled.append(whitened(fit, errors(fit, X, R)))
        wider.append((fit.covariance / from_truth().covariance).diagonal(dim1=1, dim2=2).sqrt())
        own.append((fit.own_covariance / from_truth().own_covariance).diagonal(dim1=2, dim2=3).sqrt())
    assert torch.cat(wider).mean() > 1.8
    assert torch.cat(own).mean() > 1.6, "each camera's own too"
    assert rms(torch.cat(scaled)) < 1.8


def drawn(diameter_px: float, cameras: str, kind: str, attitudes: int, draws: int) -> tuple[Tensor, Tensor]:
    """Errors (N, 6) of N = attitudes * draws fits, whitened, and in sigmas component by component."""
    one = rig_of(diameter_px, RIGS[cameras])
    scaled, in_sigmas = [], []
    for first in range(0, attitudes, 20):
        count = min(20, attitudes - first)
        X, R = balls(count, 100 + first)
        paint, ball = share_pictures(one, kind, X, R)
        clean = BEHIND + (BLACK - BEHIND) * ball + (WHITE - BLACK) * paint
        start = None
        for k in range(draws):
            pixels = cut(one, noisy(clean, SIGMA, 1000 * first + k), X)
            # All draws of an attitude lie near each other.
            given = (moved(X, 0.02, k), turned(R, 0.3, k)) if start is None else start
            fit = fitted(one, kind, pixels, *given, SIGMA, iterations=6 if start is None else 3)
            start = start or (fit.position_lab_mm, fit.R_lab_body)
            error = errors(fit, X, R)
            scaled.append(whitened(fit, error))
            in_sigmas.append(error / fit.covariance.diagonal(dim1=1, dim2=2).sqrt())
    return torch.cat(scaled), torch.cat(in_sigmas)


CHI2_95 = 12.592  # of six degrees of freedom


def check_coverage(cameras: str, scaled: Tensor, in_sigmas: Tensor) -> None:
    # One camera has half as many tiles to learn its scores' scatter from, and an edge that all its directions share.
    most, least_inside = {"two": (1.15, 0.84), "one": (1.22, 0.78)}[cameras]
    inside = float((scaled.square().sum(1) < CHI2_95).double().mean())
    assert 0.9 < rms(scaled) < most
    assert least_inside < inside < 0.99
    for part in in_sigmas.T:
        assert 0.7 < rms(part) < 1.3


@pytest.mark.parametrize("cameras", [pytest.param("two", marks=SLOW), "one"])
def test_errors_are_as_large_as_the_covariance_states(cameras):
    check_coverage(cameras, *drawn(64.0, cameras, "patches", 20, 6))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["patches", "blobs"])
@pytest.mark.parametrize("cameras", RIGS)
def test_errors_of_2000_noisy_renders_are_as_large_as_the_covariance_states(cameras, kind):
    scaled, in_sigmas = drawn(64.0, cameras, kind, 200, 10)
    assert len(scaled) == 2000
    check_coverage(cameras, scaled, in_sigmas)


def test_information_without_the_light_is_the_inverse_of_the_poses_covariance(rng):
    columns = torch.randn(2, 9, 40, generator=rng, dtype=torch.float64)
    normal, gradient = columns @ columns.mT, torch.randn(2, 9, generator=rng, dtype=torch.float64)
    information, left, mixed = residuals_module.without_light(normal, gradient)
    assert_close(information, torch.linalg.inv(torch.linalg.inv(normal)[:, :6, :6]), atol=1e-4)
    step = torch.linalg.solve(information, left[..., None])[..., 0]
    whole = torch.linalg.solve(normal, gradient[..., None])[..., 0]
    assert_close(step, whole[:, :6], atol=1e-6)
    assert_close(mixed, torch.linalg.solve(normal[:, 6:, 6:], normal[:, 6:, :6]), atol=1e-6)


def test_a_step_is_long_by_the_blurs_angle_and_sooner_where_edges_fall_between_pixels():
    assert longest_near_rad(0.62, 30.0) == longest_near_rad(0.9, 40.0)  # wide enough: the largest
    assert 400 * longest_near_rad(0.62, 400.0) == pytest.approx(200 * longest_near_rad(0.62, 200.0))
    assert longest_near_rad(0.45, 70.0) < 0.5 * longest_near_rad(0.55, 70.0)


def test_the_largest_picture_of_all_cameras_bounds_the_disk_whatever_their_order():
    large, small = camera_of("pinhole", LOOKS[0], 400.0, 1000), camera_of("pinhole", LOOKS[1], 64.0, 160)
    views = [
        CameraView.of(
            "cam", camera, CameraScene(background=scene_of(np.zeros(camera.image_size, np.float32)), diameter_px=64.0)
        )
        for camera in (large, small)
    ]
    one, other = (first_fitter(each, RADIUS_MM, base_of("blobs"), BLUR_PX) for each in (views, views[::-1]))
    reach = [fitter.stencil(fitter.optics.fine, 200.0).reach for fitter in (one, other)]
    assert reach[0] == reach[1] > 200
