"""Frames in which two cameras contradict each other are marked, and their stated errors hold the contradiction."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sphereorient import so3
from sphereorient.cameras import sphere_radius_px
from sphereorient.methods.results import with_contradictions
from sphereorient.synth import SynthSettings
from sphereorient.synth.write import default_cameras, frame_times_s, motion_of
from sphereorient.trajectory import Flag, Reason, Trajectory

CAMERAS = default_cameras(SynthSettings())
FRAMES, MM, SIGMA_RAD = 12, 18.0, math.radians(0.02)


def track_of(turn_deg: dict[str, float], shift_px: dict[str, float], why: Reason = Reason.OK) -> Trajectory:
    """Return a track whose cameras alone are off by rotations about x, by pixels along v; `why`: of cam2."""
    motion = motion_of(SynthSettings()).at(frame_times_s(SynthSettings(frames=FRAMES)))
    X, R = motion.position_lab_mm, motion.R_lab_body
    track = Trajectory.empty(motion.time_s.numpy(), cameras=tuple(CAMERAS))
    cameras = {}
    for name, camera in CAMERAS.items():
        turn = so3.exp(torch.tensor([math.radians(turn_deg.get(name, 0.0)), 0.0, 0.0]).double())
        off = torch.tensor([shift_px.get(name, 0.0), 0.0]).double()
        cameras[name] = replace(
            track.cameras[name],
            centre_px=(camera.project(X) + off).numpy(),
            radius_px=sphere_radius_px(camera, X, MM / 2).numpy(),
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


@pytest.mark.parametrize("why", [Reason.CONTRADICTS, Reason.SECOND_BALL])
def test_a_camera_that_was_believed_alone_may_be_off_by_all_of_it(why):
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


def test_frames_that_are_not_valid_get_no_flag():
    track = replace(track_of({"cam1": 1.0}, {}), valid=np.arange(FRAMES) % 2 == 0)
    marked, _ = with_contradictions(track, CAMERAS, MM, True)
    np.testing.assert_array_equal(marked.flags > 0, track.valid)
