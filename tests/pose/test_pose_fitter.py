"""PoseFitter: poses from pictures without the pipeline, of any leading shape."""

import math

import pytest
import torch
from conftest import assert_close
from refine_examples import BEHIND, BLUR_PX, RADIUS_MM, balls, noisy, paint_of, pictures_of, rig_of, turned

from sphereorient import so3
from sphereorient.errors import CameraError, SettingsError, ShapeError
from sphereorient.pose import camera_view
from sphereorient.pose.pose_fitter import PoseFitter
from sphereorient.sphere.texture import map_directions

RIG = rig_of(64.0)


@pytest.fixture(scope="module")
def seen():
    X, R = balls(4, 3)
    pictures = noisy(pictures_of(RIG, "patches", X, R), 1.0, seed=2)
    background = torch.full((2, *pictures.shape[-2:]), BEHIND)
    made = {"radius_mm": RADIUS_MM, "diameter_px": 64.0, "blur_px": BLUR_PX, "background": background}
    return PoseFitter(RIG.cameras, paint_of("patches"), **made), X, R, pictures


def test_poses_are_found_from_five_degrees_away_within_their_errors(seen):
    fitter, X, R, pictures = seen
    found = fitter(pictures, turned(R, 5.0, 1), X + 0.1)
    error = so3.geodesic_distance(found.R_lab_body, R)
    assert math.degrees(float(error.max())) < 0.1
    assert float((found.position_lab_mm - X).norm(dim=-1).max()) < 0.02
    assert bool(found.success.all())
    assert found.reason == [""] * 4
    assert float(found.score.min()) > 0.9
    sigma = found.covariance[..., :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    assert float((error / sigma).max()) < 4


def test_leading_shapes_numpy_and_single_precision_are_accepted(seen):
    fitter, X, R, pictures = seen
    start = turned(R, 2.0, 1)
    flat = vars(fitter(pictures, start, X))
    shaped = vars(
        fitter(
            pictures.float().numpy().reshape(2, 2, *pictures.shape[1:]),
            start.reshape(2, 2, 3, 3).numpy(),
            X.reshape(2, 2, 3),
        )
    )
    for name, one in flat.items():
        assert shaped[name].shape[:2] == (2, 2)
        assert_close(shaped[name].reshape(one.shape).double(), one.double(), atol=1e-5)
    alone = fitter(pictures[0], start[0], X[0])
    assert alone.success.shape == ()
    assert alone.covariance.shape == (6, 6)
    assert_close(alone.R_lab_body, flat["R_lab_body"][0], atol=1e-5)
    none = fitter(pictures[:0], start[:0], X[:0])
    assert {part.shape[0] for part in vars(none).values()} == {0}
    assert none.reason == []


@pytest.mark.parametrize("away_deg", [60.0, 86.0, 120.0])
def test_a_fit_that_ends_elsewhere_is_no_success_and_states_no_error(seen, away_deg):
    """It stated 1.0 degree where it was 69.5 degrees off."""
    fitter, X, R, pictures = seen
    found = fitter(pictures, turned(R, away_deg, 1), X)
    assert math.degrees(float(so3.geodesic_distance(found.R_lab_body, R).min())) > 30
    assert not bool(found.success.any())
    assert bool(found.covariance.isnan().all())
    assert float(found.score.mean(-1).max()) < 0.5
    assert all("start nearer" in why for why in found.reason)


def test_paint_that_is_not_known_does_not_count(seen):
    """Grey there would pull the pose."""
    _, X, R, pictures = seen
    paint = paint_of("patches")
    unseen = map_directions(len(paint))[..., 2] < -0.3
    made = {"radius_mm": RADIUS_MM, "diameter_px": 64.0, "blur_px": BLUR_PX}
    made |= {"background": torch.full((2, *pictures.shape[-2:]), BEHIND)}
    found = PoseFitter(RIG.cameras, torch.where(unseen, torch.nan, paint), **made)(pictures, turned(R, 3.0, 1), X)
    assert bool(found.success.all())
    assert math.degrees(float(so3.geodesic_distance(found.R_lab_body, R).max())) < 0.2


def test_one_wrong_start_does_not_spoil_the_others(seen):
    fitter, X, R, pictures = seen
    start = torch.cat([turned(R[:1], 86.0, 1), turned(R[1:], 5.0, 1)])
    found = fitter(pictures, start, X)
    assert found.success.tolist() == [False, True, True, True]
    assert [bool(why) for why in found.reason] == [True, False, False, False]
    assert bool(found.covariance[1:].isfinite().all())


def test_a_picture_of_another_ball_is_no_success(seen):
    fitter, X, R, _ = seen
    other = noisy(pictures_of(RIG, "dots", X, R), 1.0, seed=2)
    assert not bool(fitter(other, R, X).success.any())


def test_pictures_of_another_size_are_refused(seen):
    fitter, X, R, pictures = seen
    with pytest.raises(ShapeError, match=r"got \(4, 2, 160, 159\)"):
        fitter(pictures[..., 1:], R, X)


def test_inputs_that_do_not_agree_are_refused(seen):
    fitter, _, R, pictures = seen
    with pytest.raises(ShapeError, match=r"position_lab_mm: expected shape \(4, 3\) or \(3,\), got \(5, 3\)"):
        fitter(pictures, R, torch.zeros(5, 3))
    given = {"radius_mm": RADIUS_MM, "diameter_px": 64.0}
    paint, (width, height) = paint_of("patches"), RIG.cameras[0].image_size
    with pytest.raises(CameraError, match="one or more, got none"):
        PoseFitter([], paint, **given)
    with pytest.raises(CameraError, match="one picture size, got 160 x 160 px, 175 x 175 px"):
        PoseFitter([RIG.cameras[0], rig_of(70.0).cameras[1]], paint, **given)
    with pytest.raises(SettingsError, match="blur_px: expected a number above 0, got 0"):
        PoseFitter(RIG.cameras, paint, blur_px=0.0, **given)
    with pytest.raises(ShapeError, match=r"background: expected shape \(2, 160, 160\), got \(160, 160\)"):
        PoseFitter(RIG.cameras, paint, background=torch.zeros(height, width), **given)


def test_the_only_cameras_background_needs_no_axis_of_cameras(seen):
    _, X, R, pictures = seen
    given = {"radius_mm": RADIUS_MM, "diameter_px": 64.0, "blur_px": BLUR_PX}
    scene = torch.full(pictures.shape[-2:], BEHIND)
    one, other = (
        PoseFitter(RIG.cameras[0], paint_of("patches"), background=background, **given)(pictures[:, 0], R, X)
        for background in (scene, scene[None])
    )
    assert torch.equal(one.R_lab_body, other.R_lab_body)


TABLES = [(80, 0.4, 512), (100, 0.4, 512), (160, 0.4, 1024), (400, 0.8, 1024)]


@pytest.mark.parametrize(("diameter_px", "blur_px", "side"), TABLES)
def test_large_disks_have_a_finer_table(monkeypatch, diameter_px, blur_px, side):
    """At 250 px the usual table alone cost 0.009 degrees for 0.0025."""
    monkeypatch.setattr(camera_view, "texture_table", lambda texture, blur_rad, side, unseen: (blur_rad, side))
    blur_rad, cells = camera_view.base_table(torch.zeros(4, 8), diameter_px)
    assert blur_rad * diameter_px / 2 == pytest.approx(blur_px)
    assert cells == side
