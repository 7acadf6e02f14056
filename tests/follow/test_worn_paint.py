"""Paint that has come off the ball is found in its movie, not used, told, and kept with what was learnt."""

from __future__ import annotations

import math

import h5py
import numpy as np
import pytest
import torch

from sphereorient import so3
from sphereorient.evaluate.robustness.scenes import BenchmarkScene, write_scene
from sphereorient.methods.method import Learnt
from sphereorient.methods.settings import load_settings
from sphereorient.run.stages import run
from sphereorient.run.store import MemoryStore, Request


@pytest.fixture(scope="module")
def worn(tmp_path_factory):
    """A movie of a ball that has lost an eighth of its paint."""
    scene = BenchmarkScene(kind="wear", level=3, seed=0, number=0, degradations={"paint_wear": 3}, frames=24)
    return write_scene(tmp_path_factory.mktemp("worn"), scene)


def off_deg(track, experiment) -> np.ndarray:
    with h5py.File(experiment.parent / "truth.h5") as truth:
        R = torch.from_numpy(truth["orientation"][()])
    return np.degrees(so3.geodesic_distance(torch.from_numpy(track.orientation), R).numpy())


@pytest.mark.slow
def test_worn_paint_is_not_used_told_and_kept(worn, tmp_path):
    known = tmp_path / "learnt.h5"
    track = run(Request(experiment=worn, save_learnt=known), MemoryStore())
    asis = run(Request(experiment=worn, settings=load_settings(None, ["refine.learn_paint=false"])), MemoryStore())
    off, before = off_deg(track, worn), off_deg(asis, worn)
    assert np.median(off) < 0.03 < 2 * 0.03 < np.median(before)
    sigma = np.degrees(np.sqrt(np.trace(track.orientation_cov, axis1=1, axis2=2)))
    assert math.sqrt(np.mean((off / sigma) ** 2)) < 1.5
    told = [line for line in track.provenance["remarks"] if "differs from the texture map" in line]
    assert len(told) == 1
    assert not any("differs" in line for line in asis.provenance["remarks"])
    share = Learnt.load(known).worn.float().mean()
    assert 0.04 < float(share) < 0.2  # not all of it was in sight
    again = run(Request(experiment=worn, learnt=known), MemoryStore())
    assert again.orientation.tobytes() == track.orientation.tobytes()
    assert again.orientation_cov.tobytes() == track.orientation_cov.tobytes()
