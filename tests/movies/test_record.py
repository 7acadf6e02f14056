"""Raw recording in a process of its own: no frame is held up, lost ones are reported, no file is incomplete."""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import REPO
from movie_examples import FRAMES, pictures

from sphereorient.experiment.timeline import load_times
from sphereorient.movies import open_movie
from sphereorient.movies.record import Recorder
from sphereorient.movies.write import times_path

LIMIT_S, LARGE = 30.0, 500_000_000
TIMES_S = np.cumsum(np.random.default_rng(1).uniform(0.1, 0.2, FRAMES)) - 1


@contextmanager
def recording(path: Path, log: Callable[[str], object] = pytest.fail, like: np.ndarray | None = None, **options):
    like = pictures()[0] if like is None else like
    recorder = Recorder(path, SimpleNamespace(frame_shape=like.shape, dtype=like.dtype), 0.1, log, **options)
    try:
        yield recorder
    finally:
        recorder.close()


def take(recorder: Recorder, time_s: float, picture: np.ndarray | None = None) -> None:
    recorder.take(time_s, pictures()[0] if picture is None else picture, recorder.room())


def until(true: object) -> None:
    end = time.monotonic() + LIMIT_S
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def times_of(path: Path) -> np.ndarray:
    return open_movie(path).times_s if path.suffix == ".h5" else load_times(times_path(path))


@pytest.mark.parametrize("suffix", ["mkv", "h5"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_recording_has_the_pictures_and_times(tmp_path, suffix, dtype):
    path, expected = tmp_path / f"run.{suffix}", pictures(dtype).copy()
    expected[2] = 0
    with recording(path, like=expected[0], wait=True) as recorder:
        for k, time_s in enumerate(TIMES_S.tolist()):
            recorder.take(time_s, None if k == 2 else expected[k], recorder.room())
    assert recorder.summary() == f"{path}: {FRAMES} frames recorded, 0 lost"
    assert np.array_equal(times_of(path), TIMES_S)
    with open_movie(path) as movie:
        assert np.array_equal(movie.sample(range(FRAMES)), expected)
    assert {*tmp_path.iterdir()} == {path, *([times_path(path)] if suffix == "mkv" else [])}


def test_times_that_stand_or_go_back_go_on_by_a_frame(tmp_path):
    with recording(tmp_path / "run.h5") as recorder:
        for time_s in (5.0, 5.1, 5.1, 5.2, 0.0, 0.1):
            take(recorder, time_s)
    take(recorder, 9.0)  # behind the end: not lost
    assert recorder.summary().endswith("6 frames recorded, 0 lost")
    assert open_movie(tmp_path / "run.h5").times_s == pytest.approx([5.0, 5.1, 5.2, 5.3, 5.4, 5.5])


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="of POSIX")
def test_frames_that_find_no_room_are_lost_counted_and_reported_once(tmp_path, monkeypatch):
    monkeypatch.setattr("sphereorient.movies.record.MOST_WAIT", 3)
    messages: list[str] = []
    with recording(tmp_path / "run.mkv", messages.append) as recorder:
        (process,) = multiprocessing.active_children()
        os.kill(process.pid, signal.SIGSTOP)  # a disk that hangs
        for k in range(20):
            take(recorder, 0.1 * k)
        os.kill(process.pid, signal.SIGCONT)
        until(lambda: "3 frames" in recorder.summary())
        take(recorder, 2.0)
    assert recorder.summary().endswith("run.mkv: 4 frames recorded, 17 lost")
    (only,) = messages
    assert "frames are lost" in only
    assert load_times(tmp_path / "run.times.csv") == pytest.approx([0.0, 0.1, 0.2, 2.0])


def test_a_recording_that_waits_loses_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("sphereorient.movies.record.MOST_WAIT", 2)
    with recording(tmp_path / "run.mkv", wait=True) as recorder:
        for k in range(20):
            take(recorder, 0.1 * k)
    assert recorder.summary().endswith("20 frames recorded, 0 lost")


@pytest.mark.parametrize(("after", "side_px"), [(0, 20), (64, 20), (4, 2048)])
def test_a_disk_that_is_nearly_full_ends_the_recording_whole(tmp_path, monkeypatch, after, side_px):
    """The disk is looked at each 64 frames, or each 16 MB of frames."""
    messages, picture = [], np.full((side_px, side_px), 7, np.uint8)
    free = shutil.disk_usage(tmp_path).free
    if after and (free < 4 * LARGE or not hasattr(os, "posix_fallocate")):
        pytest.skip("needs room for a large file")
    monkeypatch.setattr("sphereorient.movies.record.LEFT_BYTES", free - LARGE if after else 1 << 62)
    with recording(tmp_path / "run.mkv", messages.append, picture) as recorder:
        for k in range(after):
            take(recorder, 0.1 * k, picture)
        until(lambda: f": {after} frames" in recorder.summary())
        if after:
            with (tmp_path / "large").open("wb") as other:
                os.posix_fallocate(other.fileno(), 0, 2 * LARGE)
        for k in range(after, after + 20):
            take(recorder, 0.1 * k, picture)
    assert f"{after} frames recorded, 20 lost" in recorder.summary()
    (only,) = messages
    assert "expected a disk with room" in only
    (tmp_path / "large").unlink(missing_ok=True)
    movies = [open_movie(path) for path in tmp_path.glob("*.mkv")]
    assert [len(movie) for movie in movies] == ([after] if after else [])


@pytest.mark.parametrize("suffix", ["mkv", "h5"])
def test_a_disk_that_takes_no_more_is_reported_in_a_line_and_holds_nothing_up(tmp_path, suffix):
    resource = pytest.importorskip("resource", reason="of POSIX")
    if not hasattr(resource, "prlimit"):
        pytest.skip("of Linux")
    messages, noise = [], np.random.default_rng(0).integers(0, 255, (50, 500, 600), np.uint8)
    with recording(tmp_path / f"run.{suffix}", messages.append, noise[0]) as recorder:
        (process,) = multiprocessing.active_children()
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))
        for k, picture in enumerate(noise):
            take(recorder, 0.1 * k, picture)
    (only,) = messages
    assert "expected a file that can be written" in only
    assert [*tmp_path.iterdir()] == []


def test_a_process_that_is_killed_is_reported(tmp_path):
    messages: list[str] = []
    with recording(tmp_path / "run.mkv", messages.append) as recorder:
        take(recorder, 0.0)
        multiprocessing.active_children()[0].kill()
        until(lambda: messages)
        for k in range(20):
            take(recorder, 1 + 0.1 * k)
    (only,) = messages
    assert "expected a process that records" in only
    assert not (tmp_path / "run.mkv").exists()


def test_a_file_that_came_meanwhile_is_not_replaced(tmp_path):
    path, messages = tmp_path / "run.mkv", []
    with recording(path, messages.append) as recorder:
        take(recorder, 0.0)
        path.write_text("mine")
    assert path.read_text() == "mine"
    (only,) = messages
    assert "expected a new file" in only


KILLED = """
import os, signal, sys, time
from pathlib import Path
from types import SimpleNamespace
import numpy as np
from sphereorient.movies.record import Recorder
if __name__ == "__main__":
    path, picture = Path(sys.argv[1]), np.full((20, 30), 7, np.uint8)
    recorder = Recorder(path, SimpleNamespace(frame_shape=picture.shape, dtype=picture.dtype), 0.1, print)
    for k in range(9):
        recorder.take(0.1 * k, picture, recorder.room())
    if sys.argv[2] == "SIGKILL":
        os.kill(os.getpid(), signal.SIGKILL)
    number = getattr(signal, sys.argv[2])
    signal.signal(number, signal.SIG_DFL)  # a program under nohup ignores SIGHUP
    os.killpg(0, number)
    time.sleep(60)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="of POSIX")
@pytest.mark.parametrize("name", ["SIGKILL", "SIGHUP", "SIGTERM"])
def test_after_a_kill_of_the_tracking_or_the_end_of_its_terminal_the_movie_is_whole(tmp_path, name):
    """SIGHUP and SIGTERM reach all processes of the group. The recorder writes the movie, and ends."""
    program, path = tmp_path / "program.py", tmp_path / "run.mkv"
    program.write_text(KILLED)
    around = {**os.environ, "PYTHONPATH": str(REPO)}
    run = subprocess.Popen([sys.executable, program, path, name], env=around, start_new_session=True)
    assert run.wait(LIMIT_S) == -getattr(signal, name)

    def ended() -> bool:
        try:
            os.killpg(run.pid, 0)
        except ProcessLookupError:
            return True
        return False

    until(ended)
    assert len(open_movie(path)) == len(load_times(times_path(path))) == 9
