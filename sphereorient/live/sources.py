"""Where frames come from: movies, raw bytes of another program, cameras, a ring in memory.

A new source is a function here or in a file of its own, and a line of `SOURCES`.
"""

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from sphereorient.errors import MovieError, SettingsError, error_words, refusal
from sphereorient.experiment.recording import CameraStream, Recording
from sphereorient.files.picture import luma
from sphereorient.files.provenance import package
from sphereorient.live.feed import Arrival, FrameBytes, Picture, Tell
from sphereorient.live.shared import shared_frames
from sphereorient.movies.record import Recorder

AGAIN_S = 1.0  # between attempts to open a camera


@dataclass(frozen=True, kw_only=True)
class Source:
    """Frames, and how they come."""

    frames: Callable[[Recording], Iterator[Arrival]]
    waits: bool = False  # for the tracking, instead of dropping frames
    even: bool = False  # at the rate of the experiment


def movie_frames(recording: Recording, paced: bool) -> Iterator[Arrival]:
    """Yield the frames of an experiment's movies; `paced`: at the times of the recording."""
    pictures = zip(*(stream.pictures() for stream in recording.streams), strict=True)
    begun, first_s = time.perf_counter(), float(recording.timeline.time_s[0])
    for number, (row, time_s) in enumerate(zip(pictures, recording.timeline.time_s.tolist(), strict=True)):
        if paced:
            time.sleep(max(0.0, begun + time_s - first_s - time.perf_counter()))
        shown = [picture for picture, _ in row]
        yield Arrival(number=number, time_s=time_s, pictures=shown, arrived_s=time.perf_counter())


def raw_frames(source: BinaryIO, streams: Sequence[CameraStream], rate_hz: float) -> Iterator[Arrival]:
    """Yield frames of bytes without a header, see `FrameBytes`. Raise MovieError: the source ends within a frame."""
    layout, number = FrameBytes(streams), 0
    while content := source.read(layout.size):
        arrived_s = time.perf_counter()
        if len(content) < layout.size:
            expected, got = f"{layout.size} bytes a frame", f"{len(content)} bytes at the end"
            do = "write whole pictures of the size and type of the experiment's movies"
            raise MovieError(refusal(f"frame {number}", expected=expected, got=got, do=do))
        pictures = layout.pictures(content)
        yield Arrival(number=number, time_s=number / rate_hz, pictures=pictures, arrived_s=arrived_s)
        number += 1


def camera_pictures(
    device: int | str, open_device: Callable[..., cv2.VideoCapture] = cv2.VideoCapture
) -> Iterator[Picture]:
    """Yield grey pictures of OpenCV's camera of a number or address while it gives some; MovieError: no such camera."""
    capture = open_device(device)
    try:
        if not capture.isOpened():
            do = "connect it, or name another number"
            raise MovieError(refusal(f"camera {device}", expected="a camera", got="none that opens", do=do))
        while True:
            there, picture = capture.read()
            if not there:
                return
            yield picture if picture.ndim == 2 else luma(*np.moveaxis(picture[..., ::-1], -1, 0))
    finally:
        capture.release()


def genicam_pictures(where: str) -> Iterator[Picture]:
    """Yield grey pictures of the first GenICam camera of the producer that its maker's driver brings, PRODUCER.cti, or
    of that with a serial number: PRODUCER.cti#SERIAL.
    Raise MovieError: the package harvesters is missing, no such camera, one of colour, or one that fails.
    """
    name = f"genicam:{where}"
    driver = package("harvesters.core", "genicam", MovieError)
    producer, _, serial = where.partition("#")
    try:
        with driver.Harvester() as harvester:
            harvester.add_file(producer, check_existence=True, check_validity=True)
            harvester.update()
            if not harvester.device_info_list:
                do = "connect it, or close the program that has it"
                raise MovieError(refusal(name, expected="a camera", got="none", do=do))
            with harvester.create({"serial_number": serial} if serial else 0) as camera:
                camera.start()
                while True:
                    try:
                        # Of one call of a GenICam driver; a camera that waits for its trigger is asked again.
                        buffer = camera.fetch(timeout=1.0)
                    except driver.TimeoutException:
                        continue
                    with buffer:  # its memory is the driver's again behind this
                        shown = buffer.payload.components[0]
                        if not shown.data_format.startswith("Mono"):
                            do = "set its PixelFormat to Mono8 or Mono16"
                            raise MovieError(refusal(name, expected="grey pictures", got=shown.data_format, do=do))
                        picture = np.array(shown.data.reshape(shown.height, -1)[:, : shown.width])  # padding behind
                    yield picture
    except MovieError:
        raise
    except Exception as error:  # each driver has errors of its own
        do = "look whether the maker's viewer shows its pictures"
        raise MovieError(refusal(name, expected="a camera that works", got=error_words(error), do=do)) from None


def device_frames(
    name: str, open_pictures: Callable[[], Iterator[Picture]], stream: CameraStream, tell: Tell | None
) -> Iterator[Arrival]:
    """Yield frames of a camera with the time of their arrival. With `tell`, which gets what is wrong in one line, a
    camera that ends, fails or changes its pictures after its first frame is opened again, each second.
    Raise MovieError: no camera, or pictures of another size or type than the experiment's movie.
    """
    (height, width), kind = stream.movie.frame_shape, stream.movie.dtype
    begun, number, fault = time.perf_counter(), 0, ""
    while True:
        found = f"{name}: no picture comes any more."
        try:
            for picture in open_pictures():
                arrived_s = time.perf_counter()
                if (*picture.shape, picture.dtype) != (height, width, kind):
                    got = f"{picture.shape[1]} x {picture.shape[0]} px {picture.dtype}"
                    do = "set the camera to the size and depth of the movie that the experiment names"
                    raise MovieError(refusal(name, expected=f"{width} x {height} px {kind}", got=got, do=do))
                if fault and tell is not None:
                    tell(f"{name}: pictures come again.")
                fault = ""
                yield Arrival(number=number, time_s=arrived_s - begun, pictures=[picture], arrived_s=arrived_s)
                number += 1
        except MovieError as error:
            if tell is None or not number:
                raise
            found = str(error)
        if tell is None or not number:
            return
        if not fault:
            tell(f"{found} It is opened again each second.")
        fault = found
        time.sleep(AGAIN_S)


def _stdin(recording: Recording) -> Iterator[Arrival]:
    return raw_frames(sys.stdin.buffer, recording.streams, 1 / recording.timeline.frame_s)


def _genicam(where: str, tell: Tell) -> Source:
    pictures = partial(genicam_pictures, where)
    return Source(frames=lambda opened: device_frames(f"genicam:{where}", pictures, _only_stream(opened), tell))


def _camera(where: str, tell: Tell) -> Source:
    pictures = partial(camera_pictures, int(where) if where.isdigit() else where)
    again = None if Path(where).is_file() else tell  # a movie ends
    return Source(frames=lambda opened: device_frames(f"camera {where}", pictures, _only_stream(opened), again))


def _only_stream(recording: Recording) -> CameraStream:
    if len(recording.streams) > 1:
        do = "add --cameras with one name"
        raise SettingsError(refusal("--source", expected="one camera", got=f"{len(recording.streams)}", do=do))
    return recording.streams[0]


# By name; the functions get what is behind ":".
SOURCES: Mapping[str, Callable[[str, Tell], Source]] = {
    "movie": lambda *_: Source(frames=partial(movie_frames, paced=True), even=True),
    "movie-fast": lambda *_: Source(frames=partial(movie_frames, paced=False), waits=True, even=True),
    "-": lambda *_: Source(frames=_stdin, waits=True, even=True),
    "camera:": _camera,
    "genicam:": _genicam,
    "shared:": lambda where, _: Source(frames=lambda opened: shared_frames(Path(where), opened.streams)),
}


def source_of(name: str, tell: Tell) -> Source:
    """Return the source of a name, such as movie or camera:0; raise SettingsError for an unknown one."""
    kind, colon, where = name.partition(":")
    if kind + colon not in SOURCES or bool(colon) != bool(where):
        expected = "movie, movie-fast, -, camera:NUMBER, genicam:PRODUCER.cti or shared:FILE"
        raise SettingsError(refusal("--source", expected=expected, got=name, do="choose one of these"))
    return SOURCES[kind + colon](where, tell)


def recorded(source: Source, recorders: Sequence[Recorder]) -> Source:
    """Return a source whose frames are recorded as they come, tracked or not: in all movies, or in none."""

    def frames(recording: Recording) -> Iterator[Arrival]:
        for arrival in source.frames(recording):
            room = all(one.room() for one in recorders)
            for one, picture in zip(recorders, arrival.pictures, strict=True):
                one.take(arrival.time_s, picture, room)
            yield arrival

    return replace(source, frames=frames)
