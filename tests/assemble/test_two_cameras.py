"""Two cameras: repair in both directions, weights, the scale of sigma, flags."""

from __future__ import annotations

import math

import pytest
import torch
from assemble_examples import candidates_of, noisy, single, times, turned_deg, turning
from conftest import assert_close

from sphereorient import so3
from sphereorient.assemble import AssembleSettings, Fused, assemble_paths, fuse
from sphereorient.errors import ExperimentError, ShapeError
from sphereorient.trajectory import Flag

SETTINGS = AssembleSettings()
STRETCH = range(20, 30)


def fused(cameras, settings: AssembleSettings = SETTINGS) -> Fused:
    time = times(len(next(iter(cameras.values()))))
    return fuse(assemble_paths(cameras, time, settings), cameras, time, settings)


def has(track: Fused, flag: Flag) -> list[int]:
    return torch.nonzero((track.flags & int(flag)) > 0).flatten().tolist()


def deceived(R, *, truth_too: bool, true_score: float = 0.85, false_score: float = 0.9):
    """A camera that in the stretch follows a false candidate standing still, with the true one beside it or not."""
    still = turned_deg(R[25], 0.0, 0.0, 110.0)
    frames = [[(R[k], 0.9)] for k in range(len(R))]
    for k in STRETCH:
        frames[k] = [(still, false_score)] + [(R[k], true_score)] * truth_too
    return candidates_of(frames)


def in_order(wrong_first: bool, wrong, right):
    return {"cam1": wrong, "cam2": right} if wrong_first else {"cam1": right, "cam2": wrong}


@pytest.fixture(params=[True, False], ids=["first_wrong", "second_wrong"])
def wrong_first(request: pytest.FixtureRequest) -> bool:
    return request.param


def test_a_camera_deceived_for_a_stretch_is_repaired_from_the_other(wrong_first):
    R = turning(60)
    # a motionless false candidate wins over the truth in the path (A6) only if the way there is short: give it T near 1
    wrong = deceived(R, truth_too=True, true_score=0.7, false_score=0.999)
    cameras = in_order(wrong_first, wrong, single(R, 0.95))
    name = "cam1" if wrong_first else "cam2"
    other = "cam2" if wrong_first else "cam1"
    paths = assemble_paths(cameras, times(60), SETTINGS)
    deceived_in = torch.nonzero(so3.geodesic_distance(paths[name].R_lab_body, R) > 0.5).flatten().tolist()
    if not deceived_in:
        pytest.fail("the example does not deceive the path")
    track = fused(cameras)
    assert_close(track.R_lab_body, R, 1e-9)
    assert has(track, Flag.REPAIRED_FROM_OTHER_CAMERA) == deceived_in
    assert torch.nonzero(track.repaired[name]).flatten().tolist() == deceived_in
    assert not track.repaired[other].any()
    assert_close(track.R_lab_body_of[name], R)
    assert has(track, Flag.AMBIGUOUS) == []
    assert has(track, Flag.ONE_CAMERA) == []
    assert not track.spike.any()
    assert (track.segment == 0).all()
