import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from several_examples import Several, write_several
from typer.testing import CliRunner

from sphereorient import so3
from sphereorient.cli import app
from sphereorient.live.live import measured
from sphereorient.live.loop import open_live
from sphereorient.live.sources import movie_frames
from sphereorient.methods.settings import Settings


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Several:
    return write_several(tmp_path_factory.mktemp("several"), "ab", 2)


def off_deg(R: np.ndarray, truth: np.ndarray) -> float:
    return math.degrees(float(so3.geodesic_distance(torch.from_numpy(R), torch.from_numpy(truth))))


@pytest.mark.slow  # appearances of two balls
def test_balls_are_followed_past_each_other_and_searched_for_once_a_second_where_they_jump(scene):
    order = [*range(16), 4, 5, 6, 7]  # jumps back, and 1.1 s later shows another frame
    times = [*(k / 600 for k in range(18)), 1.2, 1.2 + 1 / 600]
    with open_live(scene.experiment, Settings(), None, None) as opened:
        views = opened.tracker.appearances["a"].fitter.views
        frames = list(movie_frames(opened.recording, paced=False))
        shown = [replace(frames[k], number=n, time_s=times[n]) for n, k in enumerate(order)]
        found = list(measured(opened.tracker, views, shown))
    assert [(now.number, now.ball) for now in found] == [(n, ball) for n in range(len(order)) for ball in "ab"]
    for now in found:
        lost = now.number in (16, 17)  # within a second after the long search of frame 0
        assert now.valid != lost
        assert now.found == (now.number in (0, 18))
        if now.valid:
            assert off_deg(now.R_lab_body, scene.R_lab_body[now.ball][order[now.number]]) < 0.3


@pytest.mark.slow  # the same
def test_each_line_names_its_ball(scene, tmp_path: Path):
    to = tmp_path / "a.jsonl"
    run = CliRunner().invoke(app, ["live", str(scene.experiment), "--source", "movie-fast", "--to", str(to)])
    assert run.exit_code == 0, run.output
    rows = [json.loads(line) for line in to.read_text().splitlines()]
    assert [row["ball"] for row in rows[:4]] == ["a", "b", "a", "b"]
    assert [row["frame"] for row in rows[:4]] == [0, 0, 1, 1]


@pytest.mark.parametrize("to", ["tcp:0", "walk.dat", "track.h5"])
def test_forms_of_one_ball_are_refused(scene, to, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("sphereorient.methods.precise.learn", lambda job, progress: pytest.fail("too late"))
    where = to if ":" in to else str(tmp_path / to)
    run = CliRunner().invoke(app, ["live", str(scene.experiment), "--to", where])
    assert run.exit_code != 0
    assert "several balls" in str(run.exception)
