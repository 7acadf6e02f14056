"""Inputs of ../shared/cases that failed once, with the right poses."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED

from sphereorient import Trajectory, track_movies
from sphereorient.trajectory.rotations import distance_deg

pytestmark = [pytest.mark.shared, pytest.mark.slow]
CASES = SHARED / "cases"


def live(folder: Path, source: str = "movie-fast", experiment: str = "experiment.yaml") -> list[dict[str, object]]:
    """The lines of `live` of a case."""
    words = ["live", experiment, "--source", source, "--to", "p.jsonl", "-q"]
    subprocess.run([sys.executable, "-m", "sphereorient.cli", *words], cwd=folder, check=True, capture_output=True)
    return [json.loads(line) for line in (folder / "p.jsonl").read_text().splitlines()]


@pytest.mark.parametrize(("name", "most_deg"), [("near_ball", (0.01, 0.02)), ("sharp_pictures", (0.025, 0.05))])
def test_a_near_ball_and_sharp_pictures_are_measured(name, most_deg, tmp_path):
    folder = Path(shutil.copytree(CASES / name, tmp_path / name))
    truth = np.load(folder / "truth.npz")["R"]
    track = track_movies(folder / "experiment.yaml")
    assert isinstance(track, Trajectory)
    assert track.valid.all()
    error_deg = distance_deg(track.orientation, truth)
    assert (np.quantile(error_deg, (0.5, 0.95)) < most_deg).all()
    stated_deg = np.rad2deg(np.sqrt(np.trace(track.orientation_cov, axis1=1, axis2=2)))
    assert np.sqrt(np.mean((error_deg / stated_deg) ** 2)) < 1.3


def test_lengths_of_a_ball_of_unknown_size_are_named_radii(tmp_path):
    line = live(Path(shutil.copytree(CASES / "radii_called_mm", tmp_path / "case")))[-1]
    assert not [key for key in line if "_mm" in key]
    assert np.linalg.norm(np.array(line["position_radii"], float)) == pytest.approx(9.385, abs=0.1)


def test_live_turns_no_picture_that_track_does_not(tmp_path):
    folder = Path(shutil.copytree(CASES / "rotation_tag", tmp_path / "case"))
    lines = live(folder, "camera:rot180.mp4", "rot180.yaml")
    assert [line["valid"] for line in lines] == [True] * 24
