"""Flags of frames that no other frame confirms, or that the others contradict."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from run_examples import EXCERPT, SHORT

from sphereorient import so3
from sphereorient.methods import precise
from sphereorient.methods.settings import load_settings
from sphereorient.run import MemoryStore, Request, run
from sphereorient.trajectory import Flag, Trajectory

TURNED = 20  # frame


def tracked(monkeypatch, change, **known):
    """The excerpt, with its measured poses changed before they are joined, and its appearance."""
    joined = precise.join_ball

    def changed(job, appearance, table):
        change(table)
        return joined(job, replace(appearance, **known), table)

    monkeypatch.setattr(precise, "join_ball", changed)
    return run(Request(experiment=EXCERPT, settings=load_settings(None, SHORT)), MemoryStore())


@pytest.mark.slow
def test_a_pose_that_the_frames_before_and_after_contradict_is_marked(monkeypatch):
    def turn(table):
        by = so3.exp(torch.tensor([0.02, 0.0, 0.0], dtype=torch.float64))
        table.R_lab_body[TURNED, 0] = by @ table.R_lab_body[TURNED, 0]

    track = tracked(monkeypatch, turn)
    doubtful = (track.flags & Flag.DOUBTFUL_FIT) != 0
    assert doubtful[TURNED]
    assert doubtful.sum() == 1


@pytest.mark.slow
@pytest.mark.parametrize("log_odds", [None, 0.0, 14.0])
def test_a_frame_alone_in_its_segment_has_the_confidence_of_its_map(monkeypatch, log_odds):
    def lose(table):
        lost = np.r_[0:TURNED, TURNED + 1 : len(table)]
        table.mask[lost], table.use[lost] = False, False

    track = tracked(monkeypatch, lose, map_log_odds=log_odds)
    assert track.valid.sum() == 1
    assert track.valid[TURNED]
    expected = np.nan if log_odds is None else 1 / (1 + np.exp(-log_odds))
    assert track.confidence[TURNED] == pytest.approx(expected, abs=1e-3, nan_ok=True)


def test_a_track_states_that_its_score_is_evidence_for_paint(tmp_path):
    Trajectory.empty(np.arange(3.0), cameras=("a",)).save(tmp_path / "track.h5")
    with h5py.File(tmp_path / "track.h5") as file:
        assert file.attrs["schema"] == "sphereorient-track/1"
        assert file.attrs["schema_minor"] == 1
