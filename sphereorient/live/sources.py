"""Sources of frames: movies, raw bytes of another program, cameras, rings in memory. A new one needs a function and a
line in `SOURCES`.
"""

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Event
from typing import BinaryIO

from sphereorient.errors import MovieError, SettingsError, refusal
from sphereorient.experiment.recording import CameraStream, Recording
from sphereorient.live.devices import MAKERS, RELEASE_S, LiveCamera, device_frames, worded
from sphereorient.live.feed import Arrival, FrameBytes, Log
from sphereorient.live.shared import shared_frames
from sphereorient.movies import flipped_picture
from sphereorient.movies.record import Recorder


@dataclass(frozen=True, kw_only=True)
class Source:
    """A source of frames and its timing."""

    frames: Callable[[Recording], Iterator[Arrival]]
    waits: bool = False  # whether it waits for the tracking instead of dropping frames
    even: bool = False  # whether frames come at the experiment's rate
    close: Callable[[], None] = lambda: None  # releases its resources


def movie_frames(recording: Recording, paced: bool) -> Iterator[Arrival]:
    """Yield the frames of an experiment's movies; `paced`: at the recorded times, else on demand."""
    pictures = zip(*(stream.pictures() for stream in recording.streams), strict=True)
    begun, first_s = time.perf_counter(), float(recording.timeline.time_s[0])
    numbers, times_s = recording.timeline.number.tolist(), recording.timeline.time_s.tolist()
    for number, row, time_s in zip(numbers, pictures, times_s, strict=True):
        if paced:
            time.sleep(max(0.0, begun + time_s - first_s - time.perf_counter()))
        shown = [picture for picture, _ in row]
        yield Arrival(
            number=number, time_s=time_s, pictures=shown, arrived_s=time.perf_counter() if paced else math.nan
        )


def raw_frames(source: BinaryIO, streams: Sequence[CameraStream], rate_hz: float) -> Iterator[Arrival]:
    """Yield frames of raw bytes, see `FrameBytes`. Raises MovieError: the source ends within a frame."""
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


def _at_rate(pictures: Iterator[Arrival], frame_s: float) -> Iterator[Arrival]:
    """Yield the pictures of a movie, which arrive as fast as they are decoded, at the experiment's rate."""
    for arrival in pictures:
        yield replace(arrival, time_s=arrival.number * frame_s, arrived_s=math.nan)


def _devices(kind: str, where: str, log: Log) -> Source:
    """Return a maker's cameras by serial numbers, in the order of the experiment's cameras."""
    ends = kind == "camera:" and Path(where).is_file()  # a movie
    stopped, released = Event(), Event()
    released.set()

    def close() -> None:
        stopped.set()
        released.wait(RELEASE_S)

    def frames(opened: Recording) -> Iterator[Arrival]:
        producer, _, listed = where.partition("#") if kind == "genicam:" else ("", "", where)
        serials = [listed] if kind == "camera:" else listed.split(",")
        if len(serials) != len(opened.streams):
            expected = f"a device for each camera ({', '.join(one.name for one in opened.streams)})"
            do = "add --cameras with one name" + ("" if kind == "camera:" else ", or list serial numbers: A,B")
            raise SettingsError(refusal("--source", expected=expected, got=f"{len(serials)}", do=do))
        released.clear()
        try:
            with ExitStack() as drivers:
                with worded(f"{kind}{where}"):
                    open_device = drivers.enter_context(MAKERS[kind](producer))
                cameras = [
                    LiveCamera(
                        name=f"{kind}{serial or producer}",
                        open=partial(open_device, serial),
                        stream=stream,
                        keys=None if ends else opened.experiment.devices.get(stream.name),
                        flip=opened.experiment.flip.get(stream.name, "none"),
                        log=None if ends else log,
                    )
                    for serial, stream in zip(serials, opened.streams, strict=True)
                ]
                pictures = device_frames(cameras, log, stopped)
                yield from _at_rate(pictures, opened.timeline.frame_s) if ends else pictures
        finally:
            released.set()

    return Source(frames=frames, waits=ends, even=ends, close=close)


# By name; the functions get the text after ":".
SOURCES: Mapping[str, Callable[[str, Log], Source]] = {
    "movie": lambda *_: Source(frames=partial(movie_frames, paced=True), even=True),
    "movie-fast": lambda *_: Source(frames=partial(movie_frames, paced=False), waits=True, even=True),
    "-": lambda *_: Source(
        frames=lambda opened: raw_frames(sys.stdin.buffer, opened.streams, 1 / opened.timeline.frame_s),
        waits=True,
        even=True,
    ),
    **{kind: partial(_devices, kind) for kind in MAKERS},
    "shared:": lambda where, _: Source(frames=lambda opened: shared_frames(Path(where), opened.streams)),
}


def source_of(name: str, log: Log) -> Source:
    """Return the source of a name, such as movie or camera:0. Raises SettingsError: unknown name."""
    kind, colon, where = name.partition(":")
    if kind + colon not in SOURCES or bool(colon) != bool(where):
        expected = "movie, movie-fast, -, shared:FILE, camera:NUMBER, genicam:PRODUCER.cti, pylon:SERIAL or vimba:ID"
        raise SettingsError(refusal("--source", expected=expected, got=name, do="choose one of these"))
    return SOURCES[kind + colon](where, log)


def recorded(source: Source, recorders: Sequence[Recorder]) -> Source:
    """Return a source whose frames are recorded, in all movies or in none, flipped as the movies."""

    def frames(recording: Recording) -> Iterator[Arrival]:
        how = [recording.experiment.flip.get(stream.name, "none") for stream in recording.streams]
        for arrival in source.frames(recording):
            room = all(one.room() for one in recorders)
            for one, picture, flip in zip(recorders, arrival.pictures, how, strict=True):
                one.take(arrival.time_s, None if picture is None else flipped_picture(picture, flip), room)
            yield arrival

    return replace(source, frames=frames)
