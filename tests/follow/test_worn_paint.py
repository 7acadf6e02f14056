"""Paint that has come off the ball is found in its movie, left out, reported, and kept with the appearance."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from run_examples import off_deg, rms_sigmas

from sphereorient.bench.scenes import BenchmarkScene, write_scene
from sphereorient.cli import main
from sphereorient.methods.method import load_learnt
from sphereorient.pose.worn import UNUSED_PAINT, worn_of_text, worn_share
from sphereorient.run.stages import run
from sphereorient.run.store import MemoryStore, Request
from sphereorient.trajectory import Flag, Trajectory


@pytest.fixture(scope="module")
def worn(tmp_path_factory):
    """A movie of a ball that has lost an eighth of its paint."""
    scene = BenchmarkScene(kind="wear", level=3, seed=0, number=0, degradations={"paint_wear": 3})
    return write_scene(tmp_path_factory.mktemp("worn"), scene)


@pytest.mark.slow
def test_worn_paint_is_not_used_but_reported_and_kept(worn, tmp_path, monkeypatch):
    known = tmp_path / "learnt.h5"
    track = run(Request(experiment=worn, save_learnt=known), MemoryStore())
    monkeypatch.setattr(sys, "argv", f"sphereorient track {worn} -o {tmp_path}/asis.h5 -q --no-learn-paint".split())
    with pytest.raises(SystemExit, match=r"^0$"):
        main()
    asis = Trajectory.load(tmp_path / "asis.h5")
    off, before = off_deg(track, worn), off_deg(asis, worn)
    assert np.median(off) < 0.031 < 2 * 0.031 < np.median(before)
    assert rms_sigmas(track, off) < 1.5
    remarks = [line for line in track.provenance["remarks"] if "differs from the texture map" in line]
    assert len(remarks) == 1
    assert not any("differs" in line for line in asis.provenance["remarks"])
    cells = load_learnt(known)[""].worn
    assert 0.04 < worn_share(cells) < 0.2  # not all of it was in sight
    assert torch.equal(worn_of_text(track.provenance[UNUSED_PAINT]), cells)
    assert UNUSED_PAINT not in asis.provenance
    assert not (track.flags & int(Flag.DOUBTFUL_FIT)).any()
    again = run(Request(experiment=worn, learnt=known), MemoryStore())
    assert again.orientation.tobytes() == track.orientation.tobytes()
    assert again.orientation_cov.tobytes() == track.orientation_cov.tobytes()


@pytest.mark.slow
def test_a_ball_that_has_lost_half_of_its_paint_is_in_doubt(tmp_path):
    scene = BenchmarkScene(kind="wear", level=5, seed=0, number=0, degradations={"paint_wear": 5})
    track = run(Request(experiment=write_scene(tmp_path, scene)), MemoryStore())
    assert track.valid.all()
    assert (track.flags[track.valid] & int(Flag.DOUBTFUL_FIT)).all()
