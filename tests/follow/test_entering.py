"""A ball that comes into view, and one that comes nearer than in the frames of the appearance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from run_examples import EXCERPT, SHORT

from sphereorient import so3
from sphereorient.follow.ball import BallTracker
from sphereorient.methods.method import load_learnt
from sphereorient.methods.settings import load_settings
from sphereorient.pose.poses import no_pose
from sphereorient.run import MemoryStore, Request, run
from sphereorient.trajectory import Reason

SETTINGS = load_settings(None, [*SHORT[1:], "refine.chunk_frames=16"])


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """The track of the excerpt, and the file of its appearance."""
    path = tmp_path_factory.mktemp("known") / "learnt.h5"
    return run(Request(experiment=EXCERPT, settings=SETTINGS, save_learnt=path), MemoryStore()), path


def assert_same_poses(track, other):
    assert track.valid.all()
    turn = so3.geodesic_distance(*(torch.from_numpy(one.orientation) for one in (track, other)))
    # The first frame of a chunk is fitted without the motion in its exposure, one that is followed back with it.
    sigma = np.sqrt(np.trace(other.orientation_cov, axis1=1, axis2=2))
    assert (turn.numpy() < 0.5 * sigma).all()
    assert np.abs(track.position - other.position).max() < 0.005


@pytest.mark.slow
def test_frames_before_the_first_one_that_a_search_finds_are_followed_back(known, monkeypatch):
    right, path = known
    searches = []
    found = BallTracker.searched

    def searched(self, frames):
        searches.append(frames)
        # Nothing is found in the first frames of the chunks, which go side by side.
        here = found(self, frames)
        return no_pose(len(frames), [Reason.NOT_FOUND] * len(frames)) if len(searches) < 8 else here

    monkeypatch.setattr(BallTracker, "searched", searched)
    track = run(Request(experiment=EXCERPT, settings=SETTINGS, learnt=path), MemoryStore())
    assert len(searches) >= 8
    assert_same_poses(track, right)


@pytest.mark.slow
def test_a_disk_may_be_larger_than_those_that_were_studied(known):
    right, path = known
    learnt = {name: replace(one, widest_px=0.9 * one.widest_px) for name, one in load_learnt(path).items()}
    track = run(Request(experiment=EXCERPT, settings=SETTINGS, learnt=learnt), MemoryStore())
    assert_same_poses(track, right)
