"""Scenes of a ball under an animal: their truth, their motion, and the first pass through one."""

from __future__ import annotations

import json
import math

import h5py
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from sphereorient import so3
from sphereorient.bench.ball import SCENES, BallErrors, BallRow, walked, write_ball_scene
from sphereorient.cli import app
from sphereorient.errors import SphereOrientError
from sphereorient.experiment import load_experiment
from sphereorient.movies import open_movie


def test_a_fly_walks_forward_turns_and_stops():
    turns = walked(3000, np.random.default_rng(1))
    assert (turns[0] == 0).all()
    speed = turns[:, 1] * 5.0 * 100  # mm/s
    assert 3.0 < np.median(speed[speed > 1]) < 20.0
    stands = np.abs(turns).max(1) < 0.003
    assert 0.05 < stands.mean() < 0.7
    assert 4.0 < np.rad2deg(np.abs(turns[:, 2])).max() < 15.0  # a saccade, a frame
    assert np.abs(turns[:, 0]).std() < 0.3 * np.abs(turns[:, 1]).std()


def test_a_scene_names_no_map_and_its_truth_turns_as_its_pictures(tmp_path):
    path = write_ball_scene(tmp_path / "one", SCENES["clean_fly"], 12, 3)
    experiment = load_experiment(path)
    assert experiment.mapless
    with h5py.File(path.with_name("truth.h5")) as file:
        R, omega = (torch.from_numpy(file[name][()]) for name in ("orientation", "omega_lab"))
    torch.testing.assert_close(so3.exp(omega[1:] / 100) @ R[:-1], R[1:])
    with open_movie(path.with_name("cam1.mkv")) as movie:
        pictures = list(movie.frames(0, 12))
    assert pictures[0].shape == (480, 640)
    inside, beside = pictures[0][200:280, 280:360], pictures[0][:60, :60]
    assert inside.std() > 30.0
    assert 20 < beside.mean() < 60
    assert np.abs(pictures[11].astype(float) - pictures[0]).mean() > 3.0


def test_errors_take_off_a_turn_of_body_and_lab_and_count_sigmas():
    rng = torch.Generator().manual_seed(2)
    R_true = so3.exp(torch.cumsum(0.05 * torch.randn(400, 3, generator=rng, dtype=torch.float64), 0))
    sigma = math.radians(0.02)
    R = so3.exp(sigma * torch.randn(400, 3, generator=rng, dtype=torch.float64)) @ R_true
    body = so3.exp(torch.tensor([0.4, -0.2, 0.9], dtype=torch.float64))
    covariance = np.broadcast_to(sigma**2 * np.eye(3), (400, 3, 3))
    found = BallErrors.of(np.arange(400) / 100, (R @ body).numpy(), covariance, R_true.numpy())
    assert found.found == 400
    assert np.median(found.orientation_deg) == pytest.approx(0.02 * 1.538, rel=0.1)  # median of a Maxwell variable
    assert np.median(found.step_deg) == pytest.approx(0.02 * 1.538 * math.sqrt(2), rel=0.1)
    assert found.over_sigma == pytest.approx(1.0, abs=0.1)
    assert found.behaviour.gain.value == pytest.approx(np.ones(4), abs=3e-3)


@pytest.mark.slow
def test_the_command_measures_a_scene_once(tmp_path):
    options = [
        "bench",
        "ball",
        "--out",
        str(tmp_path / "run"),
        "--scenes",
        "lab_small_ball",
        "--frames",
        "300",
        "--first",
    ]
    done = CliRunner().invoke(app, options)
    assert done.exit_code == 0, done.output
    assert "lab_small_ball" in done.output
    (found,) = (tmp_path / "run").glob("*.json")
    row = json.loads(found.read_text())
    assert row["first"]["found"] == 300
    assert row["first"]["step_p50_deg"] < 0.05
    assert row["first"]["orientation_p95_deg"] < 0.3
    again = CliRunner().invoke(app, options)
    assert again.output.splitlines()[-8:] == done.output.splitlines()[-8:]


def test_a_run_of_the_first_pass_is_not_taken_for_one_of_both(tmp_path, monkeypatch):
    """Before: one file for both, so that the command printed the first pass alone, or ran nothing."""
    turns = so3.exp(0.05 * torch.randn(50, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    errors = BallErrors.of(np.arange(50) / 100, turns.numpy(), np.tile(1e-6 * np.eye(3), (50, 1, 1)), turns.numpy())
    asked = []

    def measured(path: object, settings: object, refine: bool, progress: object) -> BallRow:
        asked.append(refine)
        return BallRow(first=errors, refined=errors if refine else None, cpu_ms=1.0, radius_px=9.0)

    monkeypatch.setattr("sphereorient.bench.ball.write_ball_scene", lambda folder, *_: folder)
    monkeypatch.setattr("sphereorient.bench.ball.measure_scene", measured)
    (tmp_path / "run").mkdir()
    options = ["bench", "ball", "--out", str(tmp_path / "run"), "--scenes", "clean_fly", "--quiet"]
    for more in (["--first"], [], ["--first"], []):
        assert CliRunner().invoke(app, options + more).exit_code == 0
    assert asked == [False, True]
    rows = [json.loads(path.read_text()) for path in sorted((tmp_path / "run").glob("*.json"))]
    assert sorted("refined" in row for row in rows) == [False, True]


def test_another_scene_is_refused(tmp_path):
    done = CliRunner().invoke(app, ["bench", "ball", "--out", str(tmp_path / "run"), "--scenes", "moon"])
    assert isinstance(done.exception, SphereOrientError)
    assert "clean_fly" in str(done.exception)
