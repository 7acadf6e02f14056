"""Frame by frame: the same poses as a whole run, and the whole command."""

import json
import math
import os
import re
import socket
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import REPO
from live_examples import EXCERPT, LIMIT_S, excerpt_opened, followed, known, off_deg
from overlay_examples import true_track
from typer.testing import CliRunner

from sphereorient import so3
from sphereorient.cli import app
from sphereorient.experiment import load_experiment
from sphereorient.experiment.recording import open_recording
from sphereorient.follow.ball import BallTracker
from sphereorient.live.feed import Feed
from sphereorient.live.lines import FicTracLines, Forms, Quantities
from sphereorient.live.loop import open_live
from sphereorient.live.sources import movie_frames
from sphereorient.methods.settings import Settings
from sphereorient.trajectory.walk import FICTRAC, FicTracAxes


def test_frames_one_by_one_are_as_good_as_a_whole_run_and_a_black_out_is_reported(tmp_path_factory):
    hidden = range(15, 19)
    with excerpt_opened(tmp_path_factory) as opened:
        frames = [
            replace(one, pictures=[np.zeros_like(picture) for picture in one.pictures]) if k in hidden else one
            for k, one in enumerate(movie_frames(opened.recording, paced=False))
        ]
        found = followed(opened, frames)
    for k, now in enumerate(found):
        assert now.number == k
        assert now.valid == (k not in hidden)
        assert now.found == (k in (0, hidden.stop))
        if now.valid:
            assert off_deg(now, k) < 0.2
            assert now.error_rad < math.radians(0.2)


def test_a_jump_is_found_and_reported(tmp_path_factory):
    """From one frame to the next the ball rotates by some tens of degrees, forty times as fast as before."""
    order = [*range(12), *range(39, 29, -1)]
    truth = torch.from_numpy(true_track().orientation)
    assert float(so3.geodesic_distance(truth[11], truth[39])) > math.radians(20)
    with excerpt_opened(tmp_path_factory) as opened:
        frames = list(movie_frames(opened.recording, paced=False))
        times = opened.recording.timeline.time_s
        shown = [replace(frames[k], number=n, time_s=float(times[n])) for n, k in enumerate(order)]
        found = followed(opened, shown)
    assert [n for n, now in enumerate(found) if now.found] == [0, 12]
    for now, k in zip(found, order, strict=True):
        assert off_deg(now, k) < 0.2


def test_a_jump_needs_no_long_search_and_a_hidden_ball_one_a_second(monkeypatch, tmp_path_factory):
    """The ball rotates by some tens of degrees at once; later something grey without any paint is before it."""
    asked: list[int] = []
    long_search = BallTracker.searched
    monkeypatch.setattr(BallTracker, "searched", lambda self, frames: asked.append(1) or long_search(self, frames))
    order, hidden = [*range(8), *range(39, 30, -1)], range(12, 15)
    with excerpt_opened(tmp_path_factory) as opened:
        frames = list(movie_frames(opened.recording, paced=False))
        flat = [[np.full_like(picture, 90) for picture in one.pictures] for one in frames]
        for n in hidden:  # noise: no picture is like the one before
            flat[n] = [
                picture + np.random.default_rng(n).integers(0, 9, picture.shape, np.uint8) for picture in flat[n]
            ]
        shown = [
            replace(frames[k], number=n, time_s=0.4 * n, pictures=flat[n] if n in hidden else frames[k].pictures)
            for n, k in enumerate(order)
        ]
        found = followed(opened, shown)
    assert [now.valid for now in found] == [n not in hidden for n in range(len(order))]
    assert [n for n, now in enumerate(found) if now.found] == [0, 8, 15]
    for n, k in enumerate(order):
        if n not in hidden:
            assert off_deg(found[n], k) < 0.2
    assert len(asked) == 1  # 0.8 s are hidden


def test_times_that_stand_or_go_back_begin_anew(tmp_path_factory):
    with excerpt_opened(tmp_path_factory) as opened:
        frames = list(movie_frames(opened.recording, paced=False))[:12]
        times = [0.01 * k for k in (0, 1, 2, 3, 3, 4, 5, 6, 1, 2, 3, 4)]
        shown = [replace(frame, time_s=time_s) for frame, time_s in zip(frames, times, strict=True)]
        found = followed(opened, shown)
    assert [n for n, now in enumerate(found) if now.found] == [0, 4, 8]
    for k, now in enumerate(found):
        assert off_deg(now, k) < 0.2


def test_the_command_writes_and_sends_each_frame(tmp_path, tmp_path_factory):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reader:
        reader.bind(("127.0.0.1", 0))
        reader.settimeout(LIMIT_S)
        to = [tmp_path / "a.dat", tmp_path / "a.jsonl", f"udp:{reader.getsockname()[1]}"]
        command = ["live", str(EXCERPT / "experiment.yaml"), "--source", "movie-fast"]
        command += ["--learnt", str(known(tmp_path_factory))]
        run = CliRunner().invoke(app, [*command, *(word for one in to for word in ("--to", str(one)))])
        assert run.exit_code == 0, run.output
        assert reader.recv(2000).startswith(b"FT, 0, ")
    assert "40 frames, 0 without a pose, 0 dropped" in run.output
    assert np.loadtxt(tmp_path / "a.dat", delimiter=",").shape == (40, 25)
    assert len((tmp_path / "a.jsonl").read_text().splitlines()) == 40


def test_the_recording_beside_live_is_an_experiment(tmp_path, tmp_path_factory):
    command = ["live", str(EXCERPT / "experiment.yaml"), "--source", "movie-fast", "--learnt"]
    more = [str(known(tmp_path_factory)), "--record", str(tmp_path / "run.mkv")]
    run = CliRunner().invoke(app, [*command, *more])
    assert run.exit_code == 0, run.output
    assert "40 frames recorded, 0 lost" in run.output
    given = load_experiment(EXCERPT / "experiment.yaml")
    movies = {name: tmp_path / f"run.{name}.mkv" for name in given.movie_paths}
    times = str(tmp_path / "run.cam1.times.csv")
    again = replace(given, movie_paths=movies, times=times, frame_rate_hz=math.nan, frames=None, start={})
    with open_recording(given) as before, open_recording(again) as after:
        assert np.array_equal(after.timeline.time_s, before.timeline.time_s)
        for one, other in zip(before.streams, after.streams, strict=True):
            for (shown, _), (expected, _) in zip(other.pictures(), one.pictures(), strict=True):
                assert np.array_equal(shown, expected)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--to", "tcp:99999999"], "expected tcp:PORT"),
        (["--to", "poses.csv"], "expected tcp:PORT"),
        (["--to", "zmq:x"], "zmq:PORT"),
        (["--to", "osc:²"], "osc:PORT"),
        (["--to", "lsl:"], "lsl:NAME"),
        (["--record", "movie.avi"], "expected .mkv"),
        (["--record", "no such folder/movie.mkv"], "expected a new file"),
        (["--record", "new.h5", "--to", "new.h5"], "expected a file of its own"),
        (["--source", "genicam:"], "expected movie"),
        (["--source", "webcam"], "expected movie"),
        (["--source", "camera:"], "expected movie"),
    ],
)
def test_unknown_outputs_and_sources_of_live_are_refused(options, message, monkeypatch):
    monkeypatch.setattr("sphereorient.methods.precise.learn", lambda job, progress: pytest.fail("too late"))
    run = CliRunner().invoke(app, ["live", str(EXCERPT / "experiment.yaml"), *options])
    assert run.exit_code != 0
    assert message in str(run.exception)


def test_a_refused_output_leaves_no_output_of_the_ones_before(tmp_path):
    ring = tmp_path / "poses"
    command = ["live", str(EXCERPT / "experiment.yaml"), "--to", f"shared:{ring}", "--to", str(tmp_path / "walk.dta")]
    run = CliRunner().invoke(app, command)
    assert "expected tcp:PORT" in str(run.exception)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("names", ["cam2,cam1", "cam1,cam1", "cam1,cam2,cam1"])
def test_cameras_in_another_order_than_their_devices_are_refused(names, monkeypatch):
    """Devices are paired with cameras in the order of the movies."""
    monkeypatch.setattr("sphereorient.methods.precise.learn", lambda job, progress: pytest.fail("too late"))
    command = ["live", str(EXCERPT / "experiment.yaml"), "--source", "pylon:B,A", "--cameras", names]
    run = CliRunner().invoke(app, command)
    expected = "cam1" if names == "cam1,cam1" else "cam1, cam2"
    words = f"--cameras: expected the order of movies: {expected}, got {names.replace(',', ', ')}; write them"
    assert words in str(run.exception)


def test_frames_of_a_part_of_the_movies_keep_their_numbers_and_none_is_dropped(tmp_path_factory):
    experiment = replace(load_experiment(EXCERPT / "experiment.yaml"), frames=(5, 9))
    with open_live(experiment, Settings(), None, known(tmp_path_factory)) as opened:
        feed = Feed(movie_frames(opened.recording, paced=False), 8, wait=True)
        found = followed(opened, feed)
    table, quantities = FicTracLines(FicTracAxes.of_lab(np.eye(3))), Quantities(fixed=False)
    forms = [Forms(now, table, quantities) for now in found]
    assert [one.columns[FICTRAC["frame"]] for one in forms] == [5, 6, 7, 8]
    assert [json.loads(one.json)["frame"] for one in forms] == [5, 6, 7, 8]
    assert [now.dropped for now in found] == [0] * 4
    assert feed.dropped == 0
    for now in found:
        assert off_deg(now, now.number) < 0.2


@pytest.mark.slow  # a program of its own, and its ball
def test_the_closed_loop_holds_the_heading_and_measures_its_delay():
    command = [sys.executable, str(REPO / "scripts" / "closed_loop.py"), "20", "8"]
    around = {**os.environ, "PYTHONPATH": str(REPO)}
    run = subprocess.run(command, env=around, capture_output=True, text=True, check=True)
    assert 0 < float(re.findall(r"answer: ([0-9.]+) ms", run.stdout)[0]) < 5000
    held, expected = map(float, re.findall(r"at ([0-9.]+) degrees; expected ([0-9.]+)", run.stdout)[0])
    assert held == pytest.approx(expected, abs=0.2)
