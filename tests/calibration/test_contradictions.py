"""Frames in which two cameras contradict each other are marked, and their stated errors hold the contradiction."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sphereorient import so3
from sphereorient.calibration.contradictions import with_contradictions
from sphereorient.calibration.systematic import with_lasting_errors
from sphereorient.cameras import Camera, sphere_radius_px
from sphereorient.methods.results import missed_by
from sphereorient.pose.camera_view import CameraView
from sphereorient.synth import SynthSettings
from sphereorient.synth.write import default_cameras, frame_times_s, motion_of
from sphereorient.trajectory import Flag, Reason, Trajectory

CAMERAS = default_cameras(SynthSettings())
FRAMES, MM, SIGMA_RAD = 12, 18.0, math.radians(0.02)


def track_of(
    turn_deg: dict[str, float], shift_px: dict[str, float], why: Reason = Reason.OK, of: dict[str, Camera] = CAMERAS
) -> Trajectory:
    """Return a track whose cameras alone are off by rotations about x, by pixels along v; `why`: of cam2."""
    motion = motion_of(SynthSettings()).at(frame_times_s(SynthSettings(frames=FRAMES)))
    X, R = motion.position_lab_mm, motion.R_lab_body
    track = Trajectory.empty(motion.time_s.numpy(), cameras=tuple(of))
    cameras = {}
    for name, camera in of.items():
        turn = so3.exp(torch.tensor([math.radians(turn_deg.get(name, 0.0)), 0.0, 0.0]).double())
        off = torch.tensor([shift_px.get(name, 0.0), 0.0]).double()
        radius_px = sphere_radius_px(camera, X, MM / 2).numpy()
        cameras[name] = replace(
            track.cameras[name],
            centre_px=(camera.project(X) + off).numpy(),
            # The middle of two lines of sight of equal error has an error of 1e-3 mm.
            centre_sigma_px=math.sqrt(2) * 1e-3 * radius_px / (MM / 2),
            radius_px=radius_px,
            orientation=(turn @ R).numpy(),
            orientation_cov=np.broadcast_to(SIGMA_RAD**2 * np.eye(3), (FRAMES, 3, 3)).copy(),
            reason=(why if name == "cam2" else Reason.OK,) * FRAMES,
        )
    return replace(
        track,
        valid=np.ones(FRAMES, bool),
        position=X.numpy(),
        orientation=R.numpy(),
        position_cov=np.broadcast_to(1e-6 * np.eye(3), (FRAMES, 3, 3)).copy(),
        orientation_cov=np.broadcast_to(SIGMA_RAD**2 / 2 * np.eye(3), (FRAMES, 3, 3)).copy(),
        cameras=cameras,
    )


def test_cameras_that_agree_change_nothing():
    track = track_of({"cam1": 0.02}, {})
    marked, found = with_contradictions(track, CAMERAS, MM, True)
    assert not marked.flags.any()
    np.testing.assert_array_equal(marked.orientation_cov, track.orientation_cov)
    np.testing.assert_array_equal(marked.position_cov, track.position_cov)
    assert (found.frames, found.contradicts) == (FRAMES, False)


def test_a_rotation_beyond_five_sigmas_is_marked_and_half_of_it_stated():
    marked, found = with_contradictions(track_of({"cam1": 1.0}, {}), CAMERAS, MM, True)
    assert (marked.flags == Flag.CONTRADICTION).all()
    sigma = np.degrees(np.sqrt(marked.orientation_cov[:, 0, 0]))
    np.testing.assert_allclose(sigma, math.hypot(0.5, math.degrees(SIGMA_RAD) / math.sqrt(2)), rtol=1e-6)
    assert found.contradicts


def test_cameras_may_differ_by_what_lasts_in_each_of_them():
    """Light that a model lacks changes each camera's orientation in its own way, in all frames alike."""
    track = track_of({"cam1": 1.0}, {})
    own_rad2 = math.radians(0.5) ** 2 * torch.eye(3, dtype=torch.float64).expand(len(CAMERAS), 3, 3)
    marked, _ = with_contradictions(track, CAMERAS, MM, True, own_rad2)
    assert not marked.flags.any()
    np.testing.assert_array_equal(marked.orientation_cov, track.orientation_cov)


@pytest.mark.parametrize("why", [Reason.CONTRADICTS, Reason.SECOND_BALL])
def test_a_frame_of_one_camera_alone_has_the_whole_disagreement_as_its_error(why):
    marked, _ = with_contradictions(track_of({"cam2": 1.0}, {}, why), CAMERAS, MM, True)
    assert (marked.flags == Flag.CONTRADICTION).all()
    np.testing.assert_allclose(np.degrees(np.sqrt(marked.orientation_cov[:, 1, 1])), 1.0, rtol=1e-3)


def test_a_gap_between_the_lines_of_sight_is_stated_and_marked_from_a_pixel_on():
    for shift_px, flag in ((0.4, 0), (3.0, Flag.CONTRADICTION)):
        track = track_of({}, {"cam1": shift_px})
        marked, _ = with_contradictions(track, CAMERAS, MM, True)
        assert (marked.flags == flag).all()
        half_mm = shift_px / 2 * MM / (2 * track.cameras["cam1"].radius_px)
        np.testing.assert_allclose(np.sqrt(marked.position_cov[:, 0, 0]), half_mm, rtol=0.02)


def test_a_gap_that_errors_of_the_calibration_explain_is_not_stated_again():
    """Two lines of sight whose middle errs by sigma are 2 sigma apart: 7 sigma are 3.5 of these, 14 are 7."""
    track = track_of({}, {"cam1": 3.0})
    gap_mm = float((3.0 * MM / (2 * track.cameras["cam1"].radius_px)).mean())
    for sigmas, stated in ((7, False), (14, True)):
        systematic = np.broadcast_to((gap_mm / sigmas) ** 2 * np.eye(3), (FRAMES, 3, 3))
        marked, _ = with_contradictions(replace(track, position_systematic_cov=systematic), CAMERAS, MM, True)
        assert ((marked.position_cov > track.position_cov)[:, 0, 0] == stated).all()


def test_a_gap_turns_a_pose_between_two_pictures_but_not_that_of_one_camera():
    for why, rolls in ((Reason.OK, True), (Reason.CONTRADICTS, False)):
        track = track_of({}, {"cam1": 3.0}, why)
        marked, _ = with_contradictions(track, CAMERAS, MM, True)
        half_mm = 3.0 / 2 * MM / (2 * track.cameras["cam1"].radius_px)
        added = np.sqrt(marked.orientation_cov[:, 0, 0] - track.orientation_cov[:, 0, 0])
        np.testing.assert_allclose(added, half_mm / (MM / 2) * rolls, rtol=0.02)


def test_the_error_that_lasts_is_added_by_the_cameras_that_measured_a_frame():
    rng = np.random.default_rng(5)
    whole, cam1, cam2 = (torch.from_numpy(a @ np.swapaxes(a, -1, -2)) for a in (rng.normal(size=(3, 6, 6))))
    alone = torch.stack([cam1, cam2])
    track = track_of({}, {})
    track = replace(track, orientation_smooth_cov=2 * track.orientation_cov, position_smooth_cov=2 * track.position_cov)
    reason = (Reason.OK, Reason.CONTRADICTS, Reason.NOT_FOUND, *[Reason.OK] * (FRAMES - 3))
    reasons = {"cam1": reason[::-1], "cam2": reason}
    one = {name: replace(camera, reason=reasons[name]) for name, camera in track.cameras.items()}
    added = with_lasting_errors(replace(track, cameras=one), whole, alone)
    more = np.stack([whole.numpy()] * FRAMES)
    more[1:3], more[-3:-1] = cam1.numpy(), cam2.numpy()
    for kind in ("_cov", "_smooth_cov"):
        for name, what in (("orientation", more[:, :3, :3]), ("position", more[:, 3:, 3:])):
            np.testing.assert_allclose(getattr(added, name + kind), getattr(track, name + kind) + what, rtol=1e-12)


def test_frames_that_are_not_valid_get_no_flag():
    track = replace(track_of({"cam1": 1.0}, {}), valid=np.arange(FRAMES) % 2 == 0)
    marked, _ = with_contradictions(track, CAMERAS, MM, True)
    np.testing.assert_array_equal(marked.flags > 0, track.valid)


def test_cameras_that_scatter_more_than_they_state_scale_all_errors_but_for_a_frame_of_their_own():
    track = track_of({}, {})
    rng = np.random.default_rng(3)
    turned = so3.exp(torch.from_numpy(rng.normal(0, 1.4 * math.sqrt(2) * SIGMA_RAD, (FRAMES, 3))))
    off = rng.normal(0, 0.06, FRAMES)
    off[5] = 3.0  # a frame apart: marked, and without effect on the others
    cam1 = track.cameras["cam1"]
    shifted = cam1.centre_px + off[:, None] * np.array([1.0, 0.0])
    cam1 = replace(cam1, orientation=(turned @ torch.from_numpy(cam1.orientation)).numpy(), centre_px=shifted)
    marked, _ = with_contradictions(replace(track, cameras=track.cameras | {"cam1": cam1}), CAMERAS, MM, True)
    usual = np.delete(np.arange(FRAMES), 5)
    assert not marked.flags[usual].any()
    assert marked.flags[5] == Flag.CONTRADICTION
    sigma_rad, sigma_mm = np.sqrt(marked.orientation_cov[usual, 0, 0]), np.sqrt(marked.position_cov[usual, 0, 0])
    rolled_rad = np.sqrt(sigma_mm**2 - 1e-6) / (MM / 2)  # the same paint at another place
    np.testing.assert_allclose(sigma_rad, np.hypot(1.4 * SIGMA_RAD / math.sqrt(2), rolled_rad), rtol=0.1)
    np.testing.assert_allclose(sigma_mm, 0.5 * 0.06 * MM / (2 * cam1.radius_px[usual]), rtol=0.4)


def test_cameras_that_state_no_error_of_their_own_do_not_contradict_each_other():
    track = track_of({"cam1": 3.0}, {})
    silent = {name: replace(one, orientation_cov=one.orientation_cov * np.nan) for name, one in track.cameras.items()}
    marked, _ = with_contradictions(replace(track, cameras=silent), CAMERAS, MM, True)
    assert not marked.flags.any()
    np.testing.assert_array_equal(marked.orientation_cov, track.orientation_cov)


def test_a_frame_without_a_place_keeps_the_errors_of_its_orientation():
    track = track_of({}, {"cam1": 0.1})
    lost = replace(track, position_cov=np.where(np.arange(FRAMES)[:, None, None] < 2, np.nan, track.position_cov))
    marked, _ = with_contradictions(lost, CAMERAS, MM, True)
    np.testing.assert_array_equal(marked.orientation_cov[:2], track.orientation_cov[:2])
    assert (marked.orientation_cov[2:, 0, 0] > track.orientation_cov[2:, 0, 0]).all()


@pytest.mark.parametrize(
    ("why", "u_px", "shown", "missed"),
    [
        (Reason.LOW_SCORE, 300.0, None, True),
        (Reason.NOT_FOUND, 300.0, None, True),
        (Reason.OUTLINE, 300.0, np.ones((650, 650), bool), True),
        (Reason.OUTLINE, 300.0, np.zeros((650, 650), bool), False),  # under the mask
        (Reason.LOW_SCORE, 30.0, None, False),  # the edge cuts the disk
        (Reason.LOW_SCORE, 615.0, None, False),
        (Reason.LOW_SCORE, math.nan, None, False),
        (Reason.UNSEEN, 300.0, None, False),
        (Reason.MISSING, 300.0, None, False),
        (Reason.CONTRADICTS, 300.0, None, False),  # which has a flag of its own
    ],
)
def test_a_camera_that_should_show_the_whole_ball_and_does_not_is_found(why, u_px, shown, missed):
    camera = next(iter(CAMERAS.values()))
    scene = SimpleNamespace(shown=shown)
    centre_px, radius_px = torch.tensor([[u_px, 250.0], [300.0, 250.0]]), torch.full((2,), 40.0)
    assert camera.image_size == (650, 650)
    view = CameraView(name="cam1", camera=camera, background=scene, diameter_px=80.0, sight=None)
    assert missed_by(view, (why, Reason.OK), centre_px, radius_px).tolist() == [missed, False]


THREE = default_cameras(SynthSettings(cameras=3))


def test_a_camera_that_two_others_overrule_widens_nothing_and_marks_nothing():
    track = track_of({"cam2": 2.0}, {"cam2": 9.0}, Reason.CONTRADICTS, THREE)
    marked, found = with_contradictions(track, THREE, MM, True)
    assert not marked.flags.any()
    np.testing.assert_array_equal(marked.orientation_cov, track.orientation_cov)
    np.testing.assert_array_equal(marked.position_cov, track.position_cov)
    assert found.contradicts
    assert "cam2" in found.advice
    assert "cam1" not in found.advice


def test_one_camera_of_three_that_is_off_moves_the_mean_by_a_third():
    marked, _ = with_contradictions(track_of({"cam3": 1.0}, {}, of=THREE), THREE, MM, True)
    assert (marked.flags == Flag.CONTRADICTION).all()
    sigma = np.degrees(np.sqrt(marked.orientation_cov[:, 0, 0]))
    # Two pairs show it.
    np.testing.assert_allclose(sigma, math.hypot(math.sqrt(2) / 3, math.degrees(SIGMA_RAD) / math.sqrt(2)), rtol=1e-6)


def test_lasting_errors_are_larger_where_fewer_cameras_count():
    lasting = torch.eye(6, dtype=torch.float64), torch.zeros(3, 6, 6, dtype=torch.float64)
    all_three = track_of({}, {}, of=THREE)
    two = track_of({}, {}, Reason.LOW_SCORE, THREE)
    added = [with_lasting_errors(one, *lasting).position_cov[0, 0, 0] - 1e-6 for one in (all_three, two)]
    np.testing.assert_allclose(added, [1.0, 1.5])
