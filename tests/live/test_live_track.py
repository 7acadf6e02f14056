"""track.h5 of `live`: a journal that a kill cannot spoil, and the whole track at the end."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import REPO
from live_examples import EXCERPT, LIMIT_S, excerpt_opened, followed, until
from overlay_examples import true_track
from typer.testing import CliRunner

from sphereorient.cli import app
from sphereorient.errors import OutputError, TrackError
from sphereorient.experiment import load_experiment
from sphereorient.experiment.recording import open_recording
from sphereorient.live.lines import FicTracLines, Forms, Quantities
from sphereorient.live.live import REMARK, TrackBlocks
from sphereorient.live.outputs import TrackOutput
from sphereorient.live.sources import movie_frames
from sphereorient.methods.settings import Settings
from sphereorient.trajectory import Flag, Reason, Trajectory, journal
from sphereorient.trajectory.datasets import stored_fields
from sphereorient.trajectory.walk import FicTracAxes

HIDDEN, DROPPED = range(15, 18), range(24, 26)
OF_FIT = Flag.ONE_CAMERA | Flag.DOUBTFUL_FIT | Flag.AMBIGUOUS


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Frames of the excerpt, three of them black, two dropped; with what makes tracks of them."""
    with excerpt_opened(tmp_path_factory) as opened:
        frames = [
            replace(one, pictures=[np.zeros_like(picture) for picture in one.pictures]) if k in HIDDEN else one
            for k, one in enumerate(movie_frames(opened.recording, paced=False))
            if k not in DROPPED
        ]
        found = followed(opened, frames)
        yield opened.recording, opened.tracker, found


def test_a_frame_of_one_camera_is_flagged_at_once_and_doubtful_if_the_other_should_see_the_ball(tmp_path_factory):
    def seen(k, picture):
        return np.zeros_like(picture) if k == 5 else np.roll(picture, 200, 1) if k == 7 else picture

    with excerpt_opened(tmp_path_factory) as opened:
        frames = [
            replace(one, pictures=[one.pictures[0], seen(k, one.pictures[1])])
            for k, one in zip(range(9), movie_frames(opened.recording, paced=False), strict=False)
        ]
        found = followed(opened, frames)
    expected = [0, 0, 0, 0, 0, Flag.ONE_CAMERA, 0, Flag.ONE_CAMERA | Flag.DOUBTFUL_FIT, 0]
    assert [now.flags for now in found] == expected
    lines = [
        json.loads(Forms(now, FicTracLines(FicTracAxes.of_lab(np.eye(3))), Quantities(fixed=False)).json)
        for now in found
    ]
    assert [sum(Flag[name] for name in line["flags"]) for line in lines] == expected


def blocks_of(run) -> TrackBlocks:
    return TrackBlocks(recording=run[0], tracker=run[1], even=True, settings=Settings(), command="sphereorient live")


def test_the_track_states_of_each_frame_what_was_measured(run, tmp_path):
    blocks, path = blocks_of(run), tmp_path / "track.h5"
    output = TrackOutput(path, pytest.fail)
    output.begin(blocks)
    for now in run[2]:
        output.send(now)
    output.close()
    assert sorted(tmp_path.iterdir()) == [path]
    track, truth = Trajectory.load(path), true_track()
    np.testing.assert_allclose(track.time, truth.time, atol=1e-12)
    lost = np.isin(np.arange(40), [*HIDDEN, *DROPPED])
    assert np.array_equal(track.valid, ~lost)
    for now in run[2]:
        k = now.number
        np.testing.assert_array_equal(track.orientation[k], now.R_lab_body)
        np.testing.assert_array_equal(track.position[k], now.position_lab_mm)
        assert now.flags == track.flags[k] & OF_FIT
        if now.valid:  # the errors that all frames share are added
            assert np.trace(track.orientation_cov[k]) >= np.trace(now.covariance[:3, :3])
            assert np.trace(track.orientation_cov[k]) < 4 * np.trace(now.covariance[:3, :3])
    for camera in track.cameras.values():
        reason = np.array([str(why) for why in camera.reason])
        assert set(reason[~lost]) == {Reason.OK}
        assert set(reason[list(HIDDEN)]) <= {Reason.DARK, Reason.REPEATED}
        assert set(reason[list(DROPPED)]) == {Reason.MISSING}
        assert np.isfinite(camera.radius_px[~lost]).all()
        assert np.isnan(camera.radius_px[lost]).all()
    assert [k for k in range(40) if track.flags[k] & Flag.RECOVERED] == [HIDDEN.stop, DROPPED.stop]
    assert [np.unique(track.segment[a:b]).tolist() for a, b in ((0, 15), (15, 18), (18, 24), (26, 40))] == [
        [0],
        [-1],
        [1],
        [2],
    ]
    assert np.isnan(track.velocity).all()
    assert REMARK in track.provenance["remarks"]
    assert (track.method, track.experiment, track.frame_rate) == ("precise", truth.experiment, 600.0)


def test_blocks_of_any_length_give_the_same_track(run):
    whole, parts = blocks_of(run).block(run[2]), blocks_of(run)
    some = [parts.block(run[2][k : k + 7]) for k in range(0, len(run[2]), 7)]
    for name, _ in stored_fields(Trajectory):
        joint = np.concatenate([getattr(part, name) for part in some])
        np.testing.assert_allclose(joint, getattr(whole, name), rtol=1e-9, atol=1e-12, err_msg=name)


def test_a_jump_begins_a_segment(run):
    jumped = [replace(now, found=now.number == 5) for now in run[2][:10]]
    track = blocks_of(run).block(jumped)
    assert track.segment.tolist() == [0] * 5 + [1] * 5
    assert np.flatnonzero(track.flags & Flag.SPIKE).tolist() == [5]


def test_a_journal_that_was_cut_anywhere_is_the_track_until_there(run, tmp_path):
    blocks, path = blocks_of(run), tmp_path / "track.h5"
    head, whole = blocks.head(), blocks.block(run[2])
    content = journal.rows(whole)
    size = len(content) // 40
    for cut, frames in ((0, 0), (1, 0), (size, 1), (17 * size - 1, 16), (len(content), 40)):
        journal.journal_path(path).write_bytes(journal.head(head) + content[:cut])
        track = Trajectory.load(path)
        assert len(track) == frames
        for name, _ in stored_fields(Trajectory):
            np.testing.assert_array_equal(getattr(track, name), getattr(whole[:frames], name), name)
        for name, camera in track.cameras.items():
            assert camera.reason == whole[:frames].cameras[name].reason
        assert track.provenance == head.provenance
    lean = Trajectory.load(journal.journal_path(path))
    assert lean.velocity.strides[0] == 0  # nothing measured takes no memory
    lean.save(path)
    assert len(Trajectory.load(path)) == 40
    for damaged in (b"", journal.MARK, journal.head(head)[:-9], b'{"schema": "sphereorient-journal/1"}\n'):
        journal.journal_path(path).write_bytes(damaged)
        with pytest.raises(TrackError):
            Trajectory.load(journal.journal_path(path))


def test_existing_files_are_not_replaced(tmp_path):
    for name in ("track.h5", "track.h5.partial"):
        (tmp_path / name).write_text("mine")
        with pytest.raises(OutputError, match="expected a new file"):
            TrackOutput(tmp_path / "track.h5", pytest.fail)
        (tmp_path / name).unlink()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full device")
def test_a_full_disk_is_reported_and_the_rows_before_it_stay(run, tmp_path):
    messages: list[str] = []
    blocks = blocks_of(run)
    output = TrackOutput(tmp_path / "track.h5", messages.append)
    output.begin(blocks)
    output.send(run[2][0])
    until(lambda: len(Trajectory.load(tmp_path / "track.h5")) == 1)
    output._file.close()
    output._file = Path("/dev/full").open("wb")  # noqa: SIM115
    output.send(run[2][1])
    until(lambda: messages)
    output.send(run[2][2])
    output.close()
    assert len(messages) == 1
    assert "expected a disk with room" in messages[0]
    assert len(Trajectory.load(tmp_path / "track.h5")) == 1


@pytest.mark.slow  # a program of its own
def test_after_kill_9_what_was_measured_is_read_as_a_track(tmp_path):
    path = tmp_path / "track.h5"
    command = [sys.executable, "-m", "sphereorient.cli", "live", str(EXCERPT / "experiment.yaml")]
    with open_recording(EXCERPT / "experiment.yaml") as recording:
        pictures = [one.pictures for one in movie_frames(recording, paced=False)]
    program = subprocess.Popen(
        [*command, "--source", "-", "--to", str(path), "-q"],
        stdin=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(REPO)},
    )
    for row in pictures[:30]:
        program.stdin.write(b"".join(picture.tobytes() for picture in row))
    program.stdin.flush()
    until(lambda: journal.journal_path(path).exists() and len(Trajectory.load(path)) == 30, 6 * LIMIT_S)
    program.send_signal(signal.SIGKILL)
    program.wait()
    track = Trajectory.load(path)
    assert track.valid.all()
    run = CliRunner().invoke(app, ["export", str(path), "--to", "csv", "--out", str(tmp_path / "track.csv")])
    assert run.exit_code == 0, run.output
    assert not path.exists()


def test_the_track_states_the_errors_that_last_of_the_frame_not_of_the_time_of_writing(run):
    """A map that is learnt live states other errors at each frame; the rows of a frame may be written later."""
    learnt = [replace(now, lasting=1e-3 * (1 + now.number) * np.eye(6)) for now in run[2]]
    track = blocks_of(run).block(learnt)
    for now in learnt:
        if now.valid:
            expected = now.covariance + now.lasting
            np.testing.assert_allclose(track.orientation_cov[now.number], expected[:3, :3], rtol=1e-9, atol=1e-15)
            np.testing.assert_allclose(track.position_cov[now.number], expected[3:, 3:], rtol=1e-9, atol=1e-15)
    assert np.isnan(track.orientation_cov[[*HIDDEN, *DROPPED]]).all()


def test_a_map_that_is_to_be_learnt_is_no_input_of_the_track_and_a_refused_track_leaves_no_journal(tmp_path):
    path = tmp_path / "track.h5"
    experiment = load_experiment(EXCERPT / "experiment.yaml").with_sphere(texture_path=tmp_path / "own.png")
    with open_recording(experiment, textured=False) as recording:
        output = TrackOutput(path, pytest.fail)
        blocks = TrackBlocks(recording, SimpleNamespace(), even=True, settings=Settings(), command="sphereorient live")
        output.begin(blocks)
        output.close()
        assert not any("own.png" in name for name in Trajectory.load(path).provenance["sha256"])
        path.unlink()
        output = TrackOutput(path, pytest.fail)
        blocks = replace(blocks, recording=replace(recording, experiment=replace(experiment, path=tmp_path / "gone")))
        with pytest.raises(FileNotFoundError):
            output.begin(blocks)
        output.close()
    assert list(tmp_path.iterdir()) == []
