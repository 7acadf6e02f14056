"""scripts/train_proposer.py, evaluate_proposer.py, evaluate_track.py: the commands' results, refusals of one line."""

from __future__ import annotations

import json
import runpy
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest
import yaml
from conftest import REPO
from learn_examples import tiny

from sphereorient.learn.checkpoint import load_checkpoint
from sphereorient.trajectory import Trajectory

TRUTH = REPO / "synthetic_data" / "excerpt" / "truth.h5"
SCRIPTS = {"train_proposer": "train", "evaluate_proposer": "evaluate", "evaluate_track": "score"}


@pytest.fixture
def script(monkeypatch, capsys):
    """Run a script in this process; return its exit code, its output, and its errors."""

    def run(name: str, *arguments: object) -> tuple[int, str, str]:
        path = REPO / "scripts" / f"{name}.py"
        monkeypatch.setattr(sys, "argv", [str(path), *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            runpy.run_path(str(path), run_name="__main__")
        return int(stopped.value.code or 0), *capsys.readouterr()

    return run


@pytest.mark.parametrize(("name", "command"), SCRIPTS.items())
def test_help_and_the_example_are_those_of_the_command(script, name, command):
    code, printed, _ = script(name, "--help")
    assert code == 0
    assert f"sphereorient {command}" in printed
    text = (REPO / "scripts" / f"{name}.py").read_text()
    assert f"    scripts/{name}.py " in text
    assert len(text.splitlines()) < 60


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_file_that_is_not_there_is_one_line(script, tmp_path, name):
    more = [TRUTH] if name == "evaluate_track" else []
    code, _, errors = script(name, tmp_path / "none.h5", *more)
    assert code == 2
    assert len(errors.strip().splitlines()) == 1
    assert "none.h5" in errors


@pytest.mark.slow
def test_a_network_is_trained_and_evaluated(script, tmp_path):
    tree = tiny().model_dump(mode="json")
    tree["pictures"]["degradations"] = ["read_noise"]
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(tree))
    length = ("--set", "training.epochs=1", "--set", "training.steps=2", "--set", "pictures.validation=16")
    code, printed, _ = script("train_proposer", tmp_path / "tiny.yaml", "--out", tmp_path / "out", *length, "--quiet")
    assert (code, printed) == (0, "")
    checkpoint = tmp_path / "out" / "proposer.ckpt"
    assert load_checkpoint(checkpoint).settings.training.steps == 2
    code, printed, _ = script("evaluate_proposer", checkpoint, "--pictures", 2, "--json", "--quiet")
    assert code == 0
    assert {one["family"] for one in json.loads(printed)["families"]} == {"read_noise"}


def test_the_planted_errors_of_a_track_are_printed(script, tmp_path):
    with h5py.File(TRUTH) as file:
        truth = {key: file[key][()] for key in ("time", "position", "orientation")}
    track = Trajectory.empty(truth["time"], cameras=("cam1", "cam2"), frame_rate=600.0, method="paper")
    shifted = truth["position"] + np.array([0.0, 0.25, 0.0])
    track = replace(track, valid=np.ones(len(track), bool), orientation=truth["orientation"], position=shifted)
    track.save(tmp_path / "track.h5")
    code, printed, _ = script("evaluate_track", tmp_path / "track.h5", TRUTH)
    assert code == 0
    assert "40 of 40" in printed
    assert "0.2500" in printed.split()
    code, _, errors = script("evaluate_track", TRUTH, TRUTH)
    assert (code, len(errors.strip().splitlines())) == (2, 1)
