from dataclasses import replace

import numpy as np
import pytest
import torch

from sphereorient.methods.precise import comparable_cameras
from sphereorient.methods.results import missed_text
from sphereorient.pose.poses import no_pose, pose_table
from sphereorient.trajectory import Reason, Trajectory

FRAMES = 10
ALL = [Reason.OK] * FRAMES


def remarks_on(cam1: list[Reason], cam2: list[Reason]) -> list[str]:
    track = Trajectory.empty(np.arange(FRAMES) / 600.0, cameras=("cam1", "cam2"))
    reasons = {"cam1": tuple(cam1), "cam2": tuple(cam2)}
    cameras = {name: replace(one, reason=reasons[name]) for name, one in track.cameras.items()}
    valid = np.array([Reason.OK in both for both in zip(cam1, cam2, strict=True)])
    return missed_text(replace(track, valid=valid, cameras=cameras))


def test_a_camera_that_never_sees_the_ball_is_named_with_the_frames_looked_at():
    (text,) = remarks_on(ALL, [Reason.NOT_FOUND] * 6 + [Reason.OUTLINE] + [Reason.MISSING] * 3)
    assert text.startswith("cam2: no ball found in 7 frames")


def test_a_map_that_fits_no_frame_of_any_camera_is_reported_once_with_what_may_look_like_it():
    (text,) = remarks_on([Reason.LOW_SCORE] * FRAMES, [Reason.LOW_SCORE] * 9 + [Reason.OUTLINE])
    assert text.startswith("cam1, cam2: no pose of the map")
    assert "another map" in text


def test_frames_that_nearly_every_orientation_explains_are_reported_with_the_other_method():
    (text,) = remarks_on([Reason.RUNAWAY] * FRAMES, [Reason.RUNAWAY] * FRAMES)
    assert text.startswith("cam1, cam2: nearly every orientation")
    assert "precise" in text


def test_where_another_camera_measures_the_map_is_not_doubted():
    (text,) = remarks_on(ALL, [Reason.LOW_SCORE] * FRAMES)
    assert "no pose of the map" in text
    assert "another map" not in text


@pytest.mark.parametrize(
    "seen",
    [ALL, [Reason.OK] + [Reason.NOT_FOUND] * 9, [Reason.CONTRADICTS] * FRAMES, [Reason.MISSING] * FRAMES],
    ids=["all", "once", "elsewhere", "no pictures"],
)
def test_a_camera_that_sees_the_ball_or_has_no_pictures_gets_no_remark(seen):
    assert remarks_on(ALL, seen) == []


def test_the_own_rotation_of_a_camera_without_the_ball_is_compared_with_none():
    whole = replace(no_pose(2, ALL[:2]), use=torch.tensor([True, True]))
    rows = [
        (True, True, Reason.OK, Reason.OK),
        (True, False, Reason.OK, Reason.CONTRADICTS),
        (True, False, Reason.OK, Reason.MISSING),
        (False, True, Reason.NOT_FOUND, Reason.OK),
    ]
    frames = [replace(whole, use=torch.tensor([one, two]), reason=(why, other)) for one, two, why, other in rows]
    assert comparable_cameras(pose_table(frames, 2)).tolist() == [[1, 1], [1, 1], [1, 0], [0, 1]]
