"""Cameras of makers and of OpenCV behave alike with any driver."""

import signal
import struct
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path
from threading import main_thread
from types import SimpleNamespace
from typing import Any

import av
import cv2
import numpy as np
import pytest
from fake_makers import GONE, MAKERS, TIMEOUT, Body, install
from live_examples import EXCERPT, excerpt_opened, off_deg, until
from typer.testing import CliRunner

from sphereorient.cli import app
from sphereorient.errors import MovieError, Reason, SettingsError
from sphereorient.experiment.experiment import DeviceKeys
from sphereorient.experiment.recording import Recording, open_recording
from sphereorient.live.feed import Feed
from sphereorient.live.live import measured
from sphereorient.live.sources import source_of
from sphereorient.movies import open_movie, write_movie

HEIGHT = WIDTH = 650
FEATURES = {
    "PixelFormat": "Mono8",
    "Width": 1000,
    "Height": 800,
    "OffsetX": 100,
    "OffsetY": 50,
    "ExposureTime": 5000.0,
    "ExposureAuto": "Continuous",
    "AcquisitionFrameRate": 30.0,
    "AcquisitionFrameRateEnable": False,
    "TriggerSelector": "AcquisitionStart",
    "TriggerMode": "Off",
    "TriggerSource": "Software",
}


@pytest.fixture(scope="module")
def both() -> Iterator[Recording]:
    with open_recording(EXCERPT / "experiment.yaml") as opened:
        yield opened


@pytest.fixture
def alone(both) -> Recording:
    return replace(both, streams=both.streams[:1])


@pytest.fixture(autouse=True)
def _quickly(monkeypatch):
    monkeypatch.setattr("sphereorient.live.devices.AGAIN_S", 0.001)
    monkeypatch.setattr("sphereorient.live.devices.WAIT_S", 0.005)


@pytest.fixture(params=sorted(MAKERS))
def maker(request) -> str:
    return request.param


def body(*script: list[Any], serial: str = "4711", **changes: Any) -> Body:
    return Body(serial=serial, script=[iter(each) for each in script], features=FEATURES | changes)


def grey(value: int, *, rows: int = HEIGHT) -> np.ndarray:
    return np.full((rows, WIDTH), value, np.uint8)


def with_keys(recording: Recording, **keys: DeviceKeys) -> Recording:
    return replace(recording, experiment=replace(recording.experiment, devices=keys))


def test_pictures_are_copies_with_the_devices_time_and_waiting_ones_are_read_again(maker, alone, monkeypatch):
    camera = body([TIMEOUT, (grey(1), 70.0, 5), TIMEOUT, TIMEOUT, (grey(2), 70.25, 6), (grey(3), 70.5, 8)])
    install(maker, [camera], monkeypatch)
    frames = source_of(f"{maker}4711", print).frames(alone)
    found = list(islice(frames, 3))
    frames.close()
    assert [int(one.pictures[0][-1, -1]) for one in found] == [1, 2, 3]
    assert [one.number for one in found] == [0, 1, 3], "one was lost on the way"
    assert np.diff([one.time_s for one in found]) == pytest.approx([0.25, 0.25])
    assert camera.log[0] == "opened"
    assert camera.log[-1] == "closed"


def test_a_device_is_set_as_in_the_experiment(maker, alone, monkeypatch):
    camera = body([(grey(1), 1.0, 1)])
    install(maker, [camera], monkeypatch)
    keys = DeviceKeys(trigger="Line1", exposure_ms=0.4, rate_hz=600.0, pixel_format="Mono8", offset=(8, 4))
    frames = source_of(f"{maker}4711", print).frames(with_keys(alone, cam1=keys))
    next(frames)
    frames.close()
    assert camera.features == FEATURES | {
        "Width": WIDTH,
        "Height": HEIGHT,
        "OffsetX": 8,
        "OffsetY": 4,
        "ExposureTime": 400.0,
        "ExposureAuto": "Off",
        "AcquisitionFrameRate": 600.0,
        "AcquisitionFrameRateEnable": True,
        "TriggerSelector": "FrameStart",
        "TriggerMode": "On",
        "TriggerSource": "Line1",
    }
    at = camera.log.index
    assert at(("OffsetX", 0)) < at(("Width", WIDTH)) < at(("OffsetX", 8)) < at("started")
    assert at(("TriggerSource", "Line1")) < at(("TriggerMode", "On"))


def test_without_the_key_a_device_stays_as_it_is_and_an_older_one_has_other_names(alone, monkeypatch):
    camera = body([(grey(1), 1.0, 1)], TriggerMode="On")
    install("pylon:", [camera], monkeypatch)
    next(source_of("pylon:4711", print).frames(alone))
    assert camera.features == FEATURES | {"TriggerMode": "On"}
    older = body([(grey(1), 1.0, 1)], ExposureTimeAbs=1.0)
    del older.features["ExposureTime"], older.features["AcquisitionFrameRateEnable"]
    install("pylon:", [older], monkeypatch)
    keys = DeviceKeys(trigger="none", exposure_ms=0.4)
    next(source_of("pylon:4711", print).frames(with_keys(alone, cam1=keys)))
    assert older.features["ExposureTimeAbs"] == 400.0
    assert older.features["TriggerMode"] == "Off"


def test_all_that_a_device_does_not_take_is_named_in_one_line(maker, alone, monkeypatch):
    camera = body([(grey(1), 1.0, 1)])
    camera.limits = {"ExposureTime": lambda value: value > 20, "TriggerSource": lambda value: value != "Line9"}
    del camera.features["AcquisitionFrameRate"]
    install(maker, [camera], monkeypatch)
    keys = DeviceKeys(trigger="Line9", exposure_ms=0.01, rate_hz=50)
    with pytest.raises(MovieError) as refused:
        next(source_of(f"{maker}4711", print).frames(with_keys(alone, cam1=keys)))
    line = str(refused.value)
    for words in ("ExposureTime 10.0 ('10.0 is out of range')", "AcquisitionFrameRate 50", "TriggerSource Line9"):
        assert words in line
    assert "\n" not in line
    assert "Width" not in line
    assert "started" not in camera.log
    assert camera.log[-1] == "closed"


def test_a_device_that_takes_another_value_is_reported(alone, monkeypatch):
    camera = body([(grey(1), 1.0, 1)])
    camera.set = lambda name, value: camera.features.update(
        {name: min(value, 100.0) if name == "ExposureTime" else value}
    )
    install("pylon:", [camera], monkeypatch)
    with pytest.raises(MovieError, match=r"ExposureTime 400.0 \(it is 100.0\)"):
        next(source_of("pylon:4711", print).frames(with_keys(alone, cam1=DeviceKeys(exposure_ms=0.4))))


@pytest.mark.parametrize("form", ["BayerRG8", "RGB8", "Mono12p", "Mono12Packed"])
def test_other_pixels_are_refused(maker, form, alone, monkeypatch):
    camera = body([(grey(1), 1.0, 1)], PixelFormat=form)
    install(maker, [camera], monkeypatch)
    with pytest.raises(MovieError, match=f"expected grey pictures, got {form}; set its PixelFormat"):
        next(source_of(f"{maker}4711", print).frames(alone))
    assert camera.log[-1] == "closed"


def test_a_camera_that_vanishes_is_reported_once_and_taken_up_again(maker, alone, monkeypatch):
    first, again = [(grey(1), 50.0, 90), GONE], [(grey(2), 3.0, 1), (grey(3), 3.1, 2)]
    camera, messages = body(first, again), []
    install(maker, [camera], monkeypatch)
    frames = source_of(f"{maker}4711", messages.append).frames(alone)
    found = list(islice(frames, 3))
    frames.close()
    assert [int(one.pictures[0][0, 0]) for one in found] == [1, 2, 3]
    assert all(a.time_s < b.time_s for a, b in pairwise(found)), "its clock restarted"
    name = maker.replace("maker.cti#", "") + "4711"
    assert [line.split(";")[0] for line in messages] == [
        f"{name}: expected a working camera, got 'it was removed'",
        f"{name}: pictures arrive again.",
    ]
    assert messages[0].endswith("It is reopened each second.")
    assert camera.log.count("closed") == camera.log.count("opened") == 2


def test_a_picture_that_is_not_whole_is_reported(maker, alone, monkeypatch):
    camera, messages = body([(grey(1), 1.0, 1), (None, 1.1, 2), (grey(3), 1.2, 3), (grey(4), 1.3, 4)]), []
    install(maker, [camera], monkeypatch)
    frames = source_of(f"{maker}4711", messages.append).frames(alone)
    whole = [one for one in islice(frames, 3 if "genicam" in maker else 4) if one.pictures[0] is not None]
    frames.close()
    assert [(one.number, int(one.pictures[0][0, 0])) for one in whole] == [(0, 1), (2, 3), (3, 4)]
    (line,) = messages
    assert "cam1 missing 1" in line or "cam1 incomplete 1" in line


def test_a_camera_that_fails_at_once_or_is_not_there_is_refused(maker, alone, monkeypatch):
    install(maker, [body([(grey(1, rows=HEIGHT - 1), 1.0, 1)])], monkeypatch)
    with pytest.raises(MovieError, match="got 650 x 649 px"):
        next(source_of(f"{maker}4711", print).frames(alone))
    with pytest.raises(MovieError, match="a camera 9, got 4711"):
        next(source_of(f"{maker}9", print).frames(alone))
    with pytest.raises(SettingsError, match="a device for each camera"):
        next(source_of(f"{maker}4711,9", print).frames(alone))
    install(maker, [], monkeypatch)
    with pytest.raises(MovieError, match="4711, got none"):
        next(source_of(f"{maker}4711", print).frames(alone))
    for name in MAKERS[maker]([]):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MovieError, match=rf"pip install 'sphereorient\[{maker.partition(':')[0]}\]'"):
        next(source_of(f"{maker}4711", print).frames(alone))


def test_the_first_genicam_camera_needs_no_number(alone, monkeypatch):
    install("genicam:maker.cti#", [body([(grey(1), 1.0, 1)]), body(serial="4712")], monkeypatch)
    assert next(source_of("genicam:maker.cti", print).frames(alone)).number == 0


def test_live_ends_and_releases_the_camera_while_it_waits_for_its_trigger(maker, alone, monkeypatch):
    camera, messages = body(), []
    install(maker, [camera], monkeypatch)
    source = source_of(f"{maker}4711", messages.append)
    feed = Feed(source.frames(with_keys(alone, cam1=DeviceKeys(trigger="Line1"))), most=64, wait=False)
    until(lambda: messages)
    assert messages == ["waiting for the first trigger."]
    feed.close()
    source.close()
    assert camera.log[-1] == "closed"
    assert list(feed) == []


def test_live_ends_and_releases_a_camera_that_films(alone, monkeypatch):
    def forever() -> Iterator[Any]:
        for k in range(10**6):
            time.sleep(0.005)
            yield grey(1), 0.005 * k, k

    camera = body()
    camera.script = [forever()]
    install("pylon:", [camera], monkeypatch)
    source = source_of("pylon:4711", print)
    feed = Feed(source.frames(alone), most=64, wait=False)
    next(iter(feed))
    feed.close()
    source.close()
    assert camera.log[-1] == "closed"


def filmed(
    number: int, begun_s: float, lost: tuple[int, ...], zero_s: float, stuck: int | None = None
) -> Iterator[Any]:
    """Yield the pictures of a trigger of 67 Hz, each holding its trigger's number; one comes 50 ms late."""
    random = np.random.default_rng(number)
    for k in range(1, 100):
        due_s = begun_s + 0.015 * k + 0.004 * random.random() + 0.05 * (k == stuck)
        while time.perf_counter() < due_s:
            yield TIMEOUT
        if k not in lost:
            yield grey(k), zero_s + (1 + 3e-5 * number) * 0.015 * k, k
        if k == 70:
            yield grey(k), zero_s + (1 + 3e-5 * number) * 0.015 * k, k


def test_two_cameras_film_in_step_and_what_is_missing_is_reported(maker, both, monkeypatch):
    begun_s, messages = time.perf_counter() + 0.3, []
    first = body(serial="a")
    second = body(serial="b")
    first.script, second.script = [filmed(1, begun_s, (60,), 9e3)], [filmed(2, begun_s, (80,), 0.0, stuck=90)]
    install(maker, [first, second], monkeypatch)
    source = source_of(f"{maker}a,b", messages.append)
    keys = {name: DeviceKeys(trigger="Line1") for name in ("cam1", "cam2")}
    feed = Feed(source.frames(with_keys(both, **keys)), most=1000, wait=True)
    found = []
    for one in feed:
        found.append([None if picture is None else int(picture[0, 0]) for picture in one.pictures])
        if 99 in found[-1]:
            break
    feed.close()
    source.close()
    assert all(len(set(row) - {None}) == 1 for row in found), "a picture of another instant"
    at = {next(k for k in row if k is not None): row for row in found}
    assert at[60] == [None, 60]
    assert at[80] == [80, None]
    assert np.mean([at[k] == [k, k] for k in range(40, 90)]) > 0.7
    assert messages[0] == "waiting for the first trigger."
    assert 1 < len(messages) < 5
    assert "unused or missing" in messages[1]
    assert first.log[-1] == second.log[-1] == "closed"


def test_one_camera_goes_on_while_the_other_is_gone(maker, both, monkeypatch):
    begun_s, messages = time.perf_counter() + 0.1, []
    first, second = body(serial="a"), body(serial="b")
    first.script = [filmed(1, begun_s, (), 5.0)]
    second.script = [iter([*[(grey(k), 0.02 * k, k) for k in range(3)], GONE])]
    install(maker, [first, second], monkeypatch)
    source = source_of(f"{maker}a,b", messages.append)
    feed = Feed(source.frames(both), most=1000, wait=True)
    found = list(islice(feed, 40))
    feed.close()
    source.close()
    assert sum(one.pictures[0] is not None for one in found) > 30
    assert any("It is reopened each second." in line for line in messages)


def test_a_fault_of_one_of_two_at_the_start_ends_both(maker, both, monkeypatch):
    first, second = body(serial="a"), body(serial="b", PixelFormat="RGB8")
    install(maker, [first, second], monkeypatch)
    with pytest.raises(MovieError, match="b: expected grey pictures"):
        next(source_of(f"{maker}a,b", print).frames(both))
    assert first.log[-1:] in ([], ["closed"])


class Capture:
    """A camera of OpenCV."""

    def __init__(self, pictures: list[np.ndarray], *, opens: bool = True) -> None:
        self.pictures, self.opens, self.released, self.values = list(pictures), opens, False, {}

    def isOpened(self) -> bool:
        return self.opens

    def set(self, what: int, value: float) -> bool:
        self.values[what] = value
        return what != cv2.CAP_PROP_FRAME_HEIGHT

    def get(self, what: int) -> float:
        return self.values.get(what, 650.0)

    def read(self) -> tuple[bool, np.ndarray | None]:
        return (True, self.pictures.pop(0)) if self.pictures else (False, None)

    def release(self) -> None:
        self.released = True


def opencv(monkeypatch, *devices: Capture) -> None:
    waiting = list(devices)
    monkeypatch.setattr(cv2, "VideoCapture", lambda number: waiting.pop(0))


def test_a_camera_of_opencv_gives_grey_pictures_of_the_size_of_the_movie(alone, both, monkeypatch):
    colour = np.dstack([grey(value) for value in (10, 20, 30)])  # blue, green, red
    device = Capture([colour, colour[..., 0]])
    opencv(monkeypatch, device)
    frames = source_of("camera:0", print).frames(alone)
    first, second = islice(frames, 2)
    frames.close()
    assert (int(first.pictures[0][0, 0]), int(second.pictures[0][0, 0])) == (22, 10)
    assert device.released
    opencv(monkeypatch, Capture([colour[:-1]]))
    with pytest.raises(MovieError, match="px"):
        list(source_of("camera:0", print).frames(alone))
    opencv(monkeypatch, Capture([], opens=False))
    with pytest.raises(MovieError, match="expected a camera, got none"):
        list(source_of("camera:0", print).frames(alone))
    with pytest.raises(SettingsError, match="a device for each camera"):
        list(source_of("camera:0", print).frames(both))


def test_opencv_sets_rate_and_size_alone(alone, monkeypatch):
    device = Capture([grey(1)])
    opencv(monkeypatch, device)
    next(source_of("camera:0", print).frames(with_keys(alone, cam1=DeviceKeys(rate_hz=90.0, trigger="none"))))
    assert device.values[cv2.CAP_PROP_FPS] == 90.0
    opencv(monkeypatch, Capture([grey(1)]))
    with pytest.raises(MovieError, match=r"ExposureTime 400.0 \('not through OpenCV'\), TriggerSource Line1"):
        next(source_of("camera:0", print).frames(with_keys(alone, cam1=DeviceKeys(exposure_ms=0.4, trigger="Line1"))))


def test_a_camera_of_opencv_that_ends_or_changes_its_pictures_is_reported_once_and_taken_up_again(alone, monkeypatch):
    messages: list[str] = []
    devices = [
        Capture([grey(1), grey(2)]),
        Capture([], opens=False),
        Capture([], opens=False),
        Capture([grey(3)]),
        Capture([grey(4)[:-1]]),
        Capture([grey(5), grey(6)[:-1]]),
        Capture([grey(7)]),
    ]
    opencv(monkeypatch, *devices)
    frames = source_of("camera:0", messages.append).frames(alone)
    found = list(islice(frames, 5))
    assert [int(one.pictures[0][0, 0]) for one in found] == [1, 2, 3, 5, 7]
    assert [one.number for one in found] == [0, 1, 2, 3, 4]
    assert all(a.time_s < b.time_s for a, b in pairwise(found))
    assert [line.split(";")[0] for line in messages] == [
        "camera:0: pictures have stopped. It is reopened each second.",
        "camera:0: pictures arrive again.",
        "camera:0: pictures have stopped. It is reopened each second.",
        "camera:0: pictures arrive again.",
        "camera:0: expected 650 x 650 px uint8, got 650 x 649 px uint8",
        "camera:0: pictures arrive again.",
    ]
    assert all(device.released for device in devices[:6])


@pytest.mark.parametrize("how", ["horizontal", "transpose"])
def test_pictures_are_mirrored_as_those_of_the_movie_are(alone, monkeypatch, how):
    seen = np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(HEIGHT, WIDTH)
    opencv(monkeypatch, Capture([np.ascontiguousarray(seen.T if how == "transpose" else seen[:, ::-1])]))
    mirrored = replace(alone, experiment=replace(alone.experiment, flip={"cam1": how}))
    np.testing.assert_array_equal(next(source_of("camera:0", print).frames(mirrored)).pictures[0], seen)


TURNS = {90: (0, -1, 1, 0), 180: (-1, 0, 0, -1)}  # of a display matrix


def tag(path: Path, angle: int) -> None:
    """Write a rotation into the track header of an MP4 file: players, and OpenCV by default, rotate its pictures."""
    content = bytearray(path.read_bytes())
    a, b, c, d = (value << 16 for value in TURNS[angle])
    at = content.index(b"tkhd") + 44
    content[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(content)


@pytest.mark.parametrize("angle", [90, 180])
def test_a_movie_with_a_rotation_tag_comes_as_track_reads_it(angle, tmp_path):
    path = tmp_path / "tagged.mp4"
    ramp = np.add.outer(np.arange(64), np.arange(96)).astype(np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(ramp, format="gray").reformat(format="yuv420p")))
        container.mux(stream.encode())
    tag(path, angle)
    there, turned = cv2.VideoCapture(str(path)).read()
    assert there
    assert turned.shape[:2] == ((96, 64) if angle == 90 else (64, 96))
    movie = open_movie(path)
    assert any("rotation tag" in remark for remark in movie.remarks)
    read = next(movie.frames())
    assert abs(read.astype(int) - ramp).mean() < 15, "of limited range"
    fake = SimpleNamespace(name="cam1", movie=movie)
    about = SimpleNamespace(devices={}, flip={})
    recording = SimpleNamespace(streams=[fake], experiment=about, timeline=SimpleNamespace(frame_s=0.04))
    found = list(source_of(f"camera:{path}", print).frames(recording))
    assert len(found) == 3, "a movie ends"
    assert abs(found[0].pictures[0].astype(int) - read).mean() < 15


@pytest.mark.slow  # two seconds of a film, and its set-up
def test_two_cameras_in_step_give_right_poses(monkeypatch, tmp_path_factory):
    order, messages = [*range(40), *range(38, -1, -1)], []

    def film(pictures: list[np.ndarray], seed: int, lost: int, twice: int) -> Iterator[Any]:
        random, zero_s = np.random.default_rng(seed), 1e3 * seed
        for n, k in enumerate(order):
            due_s = begun_s + 0.025 * n + 0.006 * random.random()
            while time.perf_counter() < due_s:
                yield TIMEOUT
            for _ in range((n != lost) + (n == twice)):
                yield pictures[k], zero_s + (1 + 5e-5 * seed) * 0.025 * n, n + 1

    with excerpt_opened(tmp_path_factory) as opened:
        movies = [[picture for picture, _ in stream.pictures()] for stream in opened.recording.streams]
        first, second = body(serial="a"), body(serial="b")
        begun_s = time.perf_counter() + 0.5
        first.script, second.script = [film(movies[0], 1, 40, 50)], [film(movies[1], 2, 60, 45)]
        install("pylon:", [first, second], monkeypatch)
        source = source_of("pylon:a,b", messages.append)
        feed = Feed(source.frames(opened.recording), most=1000, wait=True)
        found = list(
            islice(measured(opened.tracker, opened.tracker.appearances[""].fitter.views, feed), len(order) - 1)
        )
        feed.close()
        source.close()
    there = [now for now in found if now.valid]
    assert len(there) > len(found) - 4
    assert all(off_deg(now, order[now.number]) < 0.5 for now in there)
    assert sum(now.reason == (Reason.OK, Reason.OK) for now in found) > 10, "pairs come also where the machine is busy"
    assert any("cam1 missing 1" in line or "cam1 doubled 1" in line or "cam2 doubled 1" in line for line in messages)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="of POSIX")
def test_ctrl_c_ends_live_while_it_waits_and_releases_the_camera(monkeypatch):
    def never() -> Iterator[Any]:
        for k in range(10**6):
            if k == 20:
                # A signal of the system, as by Ctrl-C; that of _thread.interrupt_main wakes no waiting thread.
                signal.pthread_kill(main_thread().ident, signal.SIGINT)
            yield TIMEOUT

    camera = body()
    camera.script = [never()]
    install("vimba:", [camera], monkeypatch)
    monkeypatch.setattr("sphereorient.live.feed.STALLED_S", 0.01)  # at Ctrl-C it waits without a limit
    command = ["live", str(EXCERPT / "experiment.yaml"), "--cameras", "cam1", "--source", "vimba:4711"]
    run = CliRunner().invoke(app, command)
    assert run.exit_code == 0, run.output
    assert "0 frames" in run.output
    assert camera.log[-2:] == ["stopped", "closed"]


def test_pylons_own_emulation_behaves_as_the_fake(alone, monkeypatch):
    pytest.importorskip("pypylon")
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    keys = DeviceKeys(rate_hz=100, exposure_ms=2, pixel_format="Mono8", offset=(8, 4), trigger="none")
    frames = source_of("pylon:0815-0000", print).frames(with_keys(alone, cam1=keys))
    found = list(islice(frames, 3))
    frames.close()
    assert found[2].pictures[0].shape == (HEIGHT, WIDTH)
    with pytest.raises(MovieError, match=r"AcquisitionFrameRateAbs 5000000000\.0"):
        next(source_of("pylon:0815-0000", print).frames(with_keys(alone, cam1=DeviceKeys(rate_hz=5e9))))


def test_the_frames_of_a_movie_file_have_the_rate_of_the_experiment(tmp_path):
    path = tmp_path / "movie.mkv"
    write_movie(path, [np.full((64, 64), k, np.uint8) for k in range(20)])
    fake = SimpleNamespace(name="cam1", movie=open_movie(path))
    about = SimpleNamespace(devices={}, flip={})
    recording = SimpleNamespace(streams=[fake], experiment=about, timeline=SimpleNamespace(frame_s=0.04))
    source = source_of(f"camera:{path}", print)
    assert source.even
    feed, found, late_s = Feed(source.frames(recording), most=64, wait=source.waits), [], []
    for one in feed:
        late_s.append(time.perf_counter() - one.arrived_s)
        found.append((one.number, one.time_s))
        time.sleep(0.01)  # it is tracked; meanwhile further ones are decoded
    assert found == [(k, pytest.approx(0.04 * k)) for k in range(20)]
    assert max(late_s) < 0.01, "waiting in line is no latency"


def test_a_camera_of_opencv_that_opens_and_gives_no_picture_is_refused(alone, monkeypatch):
    opencv(monkeypatch, Capture([]))
    with pytest.raises(MovieError, match="camera:0: expected pictures, got none; end other programs"):
        list(source_of("camera:0", print).frames(alone))


def test_sizes_that_differ_by_some_px_are_set(maker, alone, monkeypatch):
    camera = body([(grey(1), 1.0, 1)], Width=WIDTH + 6, Height=HEIGHT - 4, OffsetX=0, OffsetY=0)
    camera.set = lambda name, value: camera.features.update({name: 200 if value == 202 else value})
    install(maker, [camera, body(serial="9")], monkeypatch)
    next(source_of(f"{maker}4711", print).frames(with_keys(alone, cam1=DeviceKeys(rate_hz=30.3))))
    assert (camera.features["Width"], camera.features["Height"]) == (WIDTH, HEIGHT)
    assert camera.features["AcquisitionFrameRate"] == 30.0, "within what devices round"
    with pytest.raises(MovieError, match=r"OffsetX 202 \(it is 200\)"):
        next(source_of(f"{maker}4711", print).frames(with_keys(alone, cam1=DeviceKeys(offset=(202, 0)))))
