"""Frame by frame: the same poses as a whole run, frames as they come, and lines that no reader can hold up."""

from __future__ import annotations

import io
import json
import math
import re
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np
import pytest
import torch
from conftest import REPO
from overlay_examples import true_track
from typer.testing import CliRunner

from sphereorient import so3
from sphereorient.cameras import PinholeCamera
from sphereorient.cli import app
from sphereorient.errors import MovieError, OutputError
from sphereorient.experiment.recording import open_recording
from sphereorient.live.feed import Arrival, Feed, camera_frames, movie_frames, raw_frames
from sphereorient.live.lines import FicTracLines, json_line
from sphereorient.live.live import Measured, measured
from sphereorient.live.outputs import MOST_LINES, FileOutput, TcpOutput, UdpOutput
from sphereorient.live.prepare import open_live
from sphereorient.live.shared import ENDED, SharedFrames, shared_frames
from sphereorient.methods.settings import Settings
from sphereorient.report.export_poses import fictrac_table
from sphereorient.trajectory import Reason, Trajectory

EXCERPT = REPO / "synthetic_data" / "excerpt"
LIMIT_S = 20.0


def arrivals(count: int) -> Iterator[Arrival]:
    for number in range(count):
        picture = np.full((2, 3), number, np.uint8)
        yield Arrival(number=number, time_s=0.1 * number, pictures=[picture], arrived_s=time.perf_counter())


def until(true: object, limit_s: float = LIMIT_S) -> None:
    end = time.monotonic() + limit_s
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_feed_that_waits_gives_all_frames_in_order():
    feed = Feed(arrivals(50), 3, wait=True)
    assert [one.number for one in feed] == list(range(50))
    assert feed.dropped == 0


def test_a_feed_of_a_camera_drops_the_oldest_frames_and_counts_them():
    ended = Event()

    def source() -> Iterator[Arrival]:
        yield from arrivals(50)
        ended.set()

    feed = Feed(source(), 3, wait=False)
    assert ended.wait(LIMIT_S)
    assert [one.number for one in feed] == [47, 48, 49]
    assert feed.dropped == 47


def test_a_fault_of_the_source_comes_after_its_frames():
    def source() -> Iterator[Arrival]:
        yield from arrivals(2)
        raise MovieError("movie: expected more, got an end; look at it.")

    frames = iter(Feed(source(), 10, wait=True))
    assert [next(frames).number, next(frames).number] == [0, 1]
    with pytest.raises(MovieError, match="expected more"):
        next(frames)


@pytest.fixture(scope="module")
def recording():
    with open_recording(EXCERPT / "experiment.yaml") as opened_:
        yield opened_


def test_raw_bytes_are_the_pictures_of_all_cameras(recording):
    movies = list(movie_frames(recording, paced=False))[:3]
    content = b"".join(picture.tobytes() for one in movies for picture in one.pictures)
    found = list(raw_frames(io.BytesIO(content), recording.streams, 600.0))
    assert [one.time_s for one in found] == pytest.approx([0, 1 / 600, 2 / 600])
    for one, other in zip(found, movies, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(one.pictures, other.pictures, strict=True))
    with pytest.raises(MovieError, match="bytes a frame"):
        list(raw_frames(io.BytesIO(content[:-5]), recording.streams, 600.0))


def test_a_ring_in_memory_gives_each_frame_once(recording, tmp_path):
    movies = list(movie_frames(recording, paced=False))
    size = sum(picture.nbytes for picture in movies[0].pictures)
    with SharedFrames(tmp_path / "ring", size, slots=8) as ring:
        ring.write(0.5, movies[0].pictures)
        frames = shared_frames(tmp_path / "ring", recording.streams)
        for k in range(5):
            found = next(frames)
            assert (found.number, found.time_s) == (k, 0.5 + k)
            assert all(np.array_equal(a, b) for a, b in zip(found.pictures, movies[k].pictures, strict=True))
            ring.write(1.5 + k, movies[k + 1].pictures)
        for k in range(20):
            ring.write(10.0 + k, movies[k].pictures)
        assert next(frames).number == 26 - 8 + 1  # 26 were written; the oldest slot may be written at any time
        frames.close()
    assert not (tmp_path / "ring").exists()


def test_a_ring_that_ends_or_is_another_one_is_told(recording, tmp_path):
    path = tmp_path / "ring"
    with pytest.raises(MovieError, match="expected a ring of frames"):
        next(shared_frames(path, recording.streams))
    with SharedFrames(path, 77), pytest.raises(MovieError, match="77 bytes a frame"):
        next(shared_frames(path, recording.streams))
    path.write_bytes(b"x" * 200)
    with pytest.raises(MovieError, match="another file"):
        next(shared_frames(path, recording.streams))
    path.unlink()
    pictures = next(movie_frames(recording, paced=False)).pictures
    with SharedFrames(path, sum(picture.nbytes for picture in pictures)) as ring:
        ring.write(0.0, pictures)
        frames = shared_frames(path, recording.streams)
        next(frames)
        ring._words[ENDED] = 1
        assert list(frames) == []


class FakeDevice:
    """A camera of OpenCV."""

    def __init__(self, pictures: list[np.ndarray], *, opens: bool = True) -> None:
        self.pictures, self.opens, self.released = list(pictures), opens, False

    def isOpened(self) -> bool:
        return self.opens

    def read(self) -> tuple[bool, np.ndarray | None]:
        return (True, self.pictures.pop(0)) if self.pictures else (False, None)

    def release(self) -> None:
        self.released = True


def test_a_camera_gives_grey_pictures_of_the_size_of_the_movie(recording):
    stream = recording.streams[0]
    height, width = stream.movie.frame_shape
    colour = np.dstack([np.full((height, width), value, np.uint8) for value in (10, 20, 30)])  # blue, green, red
    device = FakeDevice([colour, colour[..., 0]])
    first, second = camera_frames(0, stream, lambda number: device)
    assert (int(first.pictures[0][0, 0]), int(second.pictures[0][0, 0])) == (22, 10)
    assert device.released
    with pytest.raises(MovieError, match="px"):
        list(camera_frames(0, stream, lambda number: FakeDevice([colour[:-1]])))
    with pytest.raises(MovieError, match="none that opens"):
        list(camera_frames(0, stream, lambda number: FakeDevice([], opens=False)))


# --- lines ---


@pytest.fixture(scope="module")
def track() -> Trajectory:
    """The excerpt's truth; frames 7 and 8 were not measured."""
    whole = true_track()
    orientation = whole.orientation.copy()
    orientation[7:9] = np.nan
    valid = np.isfinite(orientation).all((1, 2))
    return replace(whole, orientation=orientation, orientation_smooth=orientation, valid=valid)


def rows(track: Trajectory) -> Iterator[Measured]:
    for k, R in enumerate(track.orientation):
        known = np.isfinite(R).all()
        yield Measured(
            number=k,
            time_s=float(track.time[k]),
            position_lab_mm=np.zeros(3) if known else np.full(3, np.nan),
            R_lab_body=R,
            covariance=np.zeros((6, 6)) + 1e-6 * np.eye(6) if known else np.full((6, 6), np.nan),
            reason=(Reason.OK if known else Reason.NOT_FOUND,),
            found=k == 0,
            dropped=0,
            latency_s=0.001,
        )


def test_lines_are_the_rows_of_the_exported_table(track):
    R_cam_lab = so3.exp(torch.tensor([0.7, -0.1, 0.4], dtype=torch.float64))
    camera = PinholeCamera(
        image_size=(64, 48),
        f_px=torch.tensor(90.0),
        centre_px=torch.tensor([31.5, 23.5]),
        R_cam_lab=R_cam_lab,
        T_cam_lab_mm=torch.zeros(3),
    )
    table, lines = fictrac_table(track, camera), FicTracLines(camera)
    found = np.array([[float(part) for part in lines.line(now).split(", ")] for now in rows(track)])
    assert found.shape == (len(track), 25)
    rest = [k for k in range(25) if k != 4]  # the stated error is another one here
    np.testing.assert_allclose(found[:, rest], table[:, rest], atol=1e-9)


def test_json_has_null_for_what_is_not_known(track):
    known, lost = [json.loads(json_line(now)) for now in rows(track)][6:8]
    assert known["valid"]
    assert known["sigma_rad"] == pytest.approx([1e-3] * 3)
    assert math.hypot(*known["quaternion_wxyz"]) == pytest.approx(1)
    assert (lost["valid"], lost["quaternion_wxyz"], lost["reason"]) == (False, [None] * 4, ["not_found"])


# --- outputs ---


def test_a_tcp_reader_gets_lines_and_one_that_went_away_holds_nothing_up():
    output = TcpOutput("127.0.0.1", 0)
    try:
        with socket.create_connection(("127.0.0.1", output.port)) as first:
            until(lambda: output._readers)
            output.send("FT, 1")
            assert first.makefile().readline() == "FT, 1\n"
        for k in range(2 * MOST_LINES):
            output.send(f"FT, {k}, {'x' * 200}")
        with socket.create_connection(("127.0.0.1", output.port)) as again:
            until(lambda: not output._readers[-1].gone and len(output._readers) <= 2)
            time.sleep(0.2)
            output.send("FT, again")
            assert again.makefile().readline() == "FT, again\n"
    finally:
        output.close()


def test_a_slow_reader_loses_lines_and_takes_no_time():
    output = TcpOutput("127.0.0.1", 0)
    try:
        with socket.create_connection(("127.0.0.1", output.port)):
            until(lambda: output._readers)
            begun = time.monotonic()
            for _ in range(20_000):
                output.send("x" * 1000)
            assert time.monotonic() - begun < LIMIT_S
            assert len(output._readers[0]._lines) <= MOST_LINES
    finally:
        output.close()


def test_a_port_in_use_is_told():
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(OutputError, match="expected a free port"):
        TcpOutput("127.0.0.1", taken.getsockname()[1])


def test_udp_sends_a_datagram_a_line():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reader:
        reader.bind(("127.0.0.1", 0))
        reader.settimeout(LIMIT_S)
        output = UdpOutput("127.0.0.1", reader.getsockname()[1])
        output.send("FT, 7")
        assert reader.recv(100) == b"FT, 7\n"
        output.close()
        UdpOutput("127.0.0.1", 9).send("nobody is there")


def test_a_file_grows_line_by_line_and_replaces_none(tmp_path):
    path = tmp_path / "a.dat"
    output = FileOutput(path)
    output.send("1, 2")
    assert path.read_text() == "1, 2\n"  # before it is closed
    output.close()
    with pytest.raises(OutputError, match="expected a new file"):
        FileOutput(path)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full device")
def test_a_full_disk_is_told_and_does_not_stop(tmp_path):
    path = tmp_path / "full.dat"
    output = FileOutput(path)
    output._file = Path("/dev/full").open("w", buffering=1)  # noqa: SIM115
    output.send("1")
    output.send("2")
    assert output.fault is not None
    assert "expected a disk with room" in str(output.fault)


# --- the whole ---


def test_frames_one_by_one_are_as_good_as_a_whole_run_and_a_black_out_is_told():
    hidden = range(15, 19)
    with open_live(EXCERPT / "experiment.yaml", Settings(), None, None) as (recording, tracker, views):
        frames = [
            replace(one, pictures=[np.zeros_like(picture) for picture in one.pictures]) if k in hidden else one
            for k, one in enumerate(movie_frames(recording, paced=False))
        ]
        found = list(measured(tracker, views, frames))
    truth = torch.from_numpy(true_track().orientation)
    for k, now in enumerate(found):
        assert now.number == k
        assert now.valid == (k not in hidden)
        assert now.found == (k in (0, hidden.stop))
        if now.valid:
            off = float(so3.geodesic_distance(torch.from_numpy(now.R_lab_body), truth[k]))
            assert math.degrees(off) < 0.2
            assert now.error_rad < math.radians(0.2)


def test_a_jump_is_found_and_told(tmp_path):
    """From one frame to the next the ball turns by some tens of degrees, forty times as fast as before."""
    order = [*range(12), *range(39, 29, -1)]
    truth = torch.from_numpy(true_track().orientation)
    assert float(so3.geodesic_distance(truth[11], truth[39])) > math.radians(20)
    with open_live(EXCERPT / "experiment.yaml", Settings(), None, None) as (recording, tracker, views):
        frames = list(movie_frames(recording, paced=False))
        times = recording.timeline.time_s
        shown = [replace(frames[k], number=n, time_s=float(times[n])) for n, k in enumerate(order)]
        found = list(measured(tracker, views, shown))
    assert [n for n, now in enumerate(found) if now.found] == [0, 12]
    for now, k in zip(found, order, strict=True):
        assert float(so3.geodesic_distance(torch.from_numpy(now.R_lab_body), truth[k])) < math.radians(0.2)


def test_the_command_writes_and_sends_each_frame(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reader:
        reader.bind(("127.0.0.1", 0))
        reader.settimeout(LIMIT_S)
        to = [tmp_path / "a.dat", tmp_path / "a.jsonl", f"udp:{reader.getsockname()[1]}"]
        command = ["live", str(EXCERPT / "experiment.yaml"), "--source", "movie-fast"]
        run = CliRunner().invoke(app, [*command, *(word for one in to for word in ("--to", str(one)))])
        assert run.exit_code == 0, run.output
        assert reader.recv(2000).startswith(b"FT, 1, ")
    assert "40 frames, 0 without a pose, 0 dropped" in run.output
    assert np.loadtxt(tmp_path / "a.dat", delimiter=",").shape == (40, 25)
    assert len((tmp_path / "a.jsonl").read_text().splitlines()) == 40


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--to", "tcp:99999999"], "expected tcp:PORT"),
        (["--to", "poses.csv"], "expected tcp:PORT"),
        (["--source", "webcam"], "expected movie"),
        (["--source", "camera:"], "expected movie"),
    ],
)
def test_what_live_does_not_know_is_refused(options, message, monkeypatch):
    monkeypatch.setattr("sphereorient.methods.precise.learn", lambda job, progress: pytest.fail("too late"))
    run = CliRunner().invoke(app, ["live", str(EXCERPT / "experiment.yaml"), *options])
    assert run.exit_code != 0
    assert message in str(run.exception)


@pytest.mark.slow  # two programs
def test_the_bench_times_each_line(tmp_path):
    run = CliRunner().invoke(app, ["bench", "live", str(EXCERPT / "experiment.yaml"), "--rate", "20", "--seconds", "2"])
    assert run.exit_code == 0, run.output
    came, written = (int(number) for number in re.findall(r"(\d+) lines of (\d+) frames", run.output)[0])
    assert came > 20
    assert came <= written
    assert 0 < float(re.findall(r"delay: ([0-9.]+) ms", run.output)[0]) < 5000
