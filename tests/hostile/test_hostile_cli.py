"""The command line's answer to hostile files: one line, exit code 2, no traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hostile_kinds import BOMBS
from hostile_texts import experiment_documents, write_cameras


def answer(*arguments: str | Path) -> str:
    """Run a command and return its one line."""
    command = [sys.executable, "-m", "sphereorient.cli", *map(str, arguments)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert run.returncode == 2, run.stderr
    assert "Traceback" not in run.stderr
    lines = [line for line in run.stderr.splitlines() if line]  # a progress bar that never began leaves an empty one
    assert len(lines) == 1, lines
    return lines[0]


@pytest.mark.slow
def test_a_pipe_in_place_of_an_experiment_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "experiment.yaml")
    line = answer("track", tmp_path / "experiment.yaml", "--out", tmp_path / "track.h5")
    assert "experiment.yaml" in line
    assert "a pipe" in line


@pytest.mark.slow
def test_a_bomb_of_settings_is_refused(tmp_path):
    (tmp_path / "settings.yaml").write_text(BOMBS["merged without end"])
    line = answer("track", "none.yaml", "--out", tmp_path / "track.h5", "--settings", tmp_path / "settings.yaml")
    assert "settings.yaml" in line


@pytest.mark.slow
def test_an_experiment_whose_movie_is_garbage_is_refused(tmp_path):
    write_cameras(tmp_path)
    for name in ("cam1.npy", "cam2.npy"):
        (tmp_path / name).write_bytes(bytes(range(256)) * 20)
    document = experiment_documents()[0]
    (tmp_path / "experiment.yaml").write_text(yaml.safe_dump(document))
    line = answer("track", tmp_path / "experiment.yaml", "--out", tmp_path / "track.h5")
    assert "cam1.npy" in line or "texture.png" in line


@pytest.mark.slow
def test_a_calibration_with_a_tag_is_refused_and_nothing_runs(tmp_path):
    made = tmp_path / "made"
    (tmp_path / "calibration.yaml").write_text(f"schema: !!python/object/apply:os.mkdir ['{made}']\n")
    line = answer("calibrate", tmp_path / "calibration.yaml", "--out", tmp_path / "cameras.yaml")
    assert "a tag" in line
    assert not made.exists()
