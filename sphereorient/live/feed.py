"""Frames as they come: from movies, from raw bytes of another program, from a camera; in a thread of its own."""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from threading import Condition, Thread
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, refusal
from sphereorient.experiment.recording import Recording
from sphereorient.experiment.stream import CameraStream
from sphereorient.movies.movie import luma

Picture = NDArray[np.generic]
Tell = Callable[[str], object]  # gets what is wrong, in one line
AGAIN_S = 1.0  # between attempts to open a camera
STALLED_S, STALLED_FRAMES = 1.0, 10.0  # without a frame, usual intervals: then the source stalls
USUAL_FRAMES = 16  # over which the interval is averaged


@dataclass(frozen=True, kw_only=True, eq=False)
class Arrival:
    """One instant: a picture of each camera, None where it could not be read."""

    number: int  # counts all instants of the source, also those that were dropped
    time_s: float
    pictures: Sequence[Picture | None]
    arrived_s: float  # by the clock of time.perf_counter


def movie_frames(recording: Recording, paced: bool) -> Iterator[Arrival]:
    """Yield the frames of an experiment's movies; `paced`: at the times of the recording."""
    pictures = zip(*(stream.pictures() for stream in recording.streams), strict=True)
    begun, first_s = time.perf_counter(), float(recording.timeline.time_s[0])
    for number, (row, time_s) in enumerate(zip(pictures, recording.timeline.time_s.tolist(), strict=True)):
        if paced:
            time.sleep(max(0.0, begun + time_s - first_s - time.perf_counter()))
        shown = [picture for picture, _ in row]
        yield Arrival(number=number, time_s=time_s, pictures=shown, arrived_s=time.perf_counter())


def rate_of(recording: Recording) -> float:
    """Return the frame rate of an experiment, Hz."""
    return float(1 / np.median(np.diff(recording.timeline.time_s)))


class FrameBytes:
    """How the pictures of all cameras lie in the bytes of one frame: row by row, of the movies' size and type."""

    def __init__(self, streams: Sequence[CameraStream]) -> None:
        self._kinds = [(stream.movie.frame_shape, stream.movie.dtype) for stream in streams]
        sizes = [shape[0] * shape[1] * dtype.itemsize for shape, dtype in self._kinds]
        self._ends = np.cumsum([0, *sizes]).tolist()
        self.size = int(self._ends[-1])

    def pictures(self, content: bytes) -> list[Picture]:
        """Return the pictures of `size` bytes."""
        return [
            np.frombuffer(content, dtype, shape[0] * shape[1], begin).reshape(shape)
            for (shape, dtype), begin in zip(self._kinds, self._ends[:-1], strict=True)
        ]


def raw_frames(source: BinaryIO, streams: Sequence[CameraStream], rate_hz: float) -> Iterator[Arrival]:
    """Yield frames of bytes without a header, see `FrameBytes`.

    Raises:
        MovieError: the source ends within a frame.
    """
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
    """Yield grey pictures of a camera that OpenCV knows by number or address, until it gives none.

    Raises:
        MovieError: no such camera.
    """
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


def device_frames(
    name: str, open_pictures: Callable[[], Iterator[Picture]], stream: CameraStream, tell: Tell | None
) -> Iterator[Arrival]:
    """Yield frames of a camera with the time of their arrival. With `tell`, which gets what is wrong in one line, a
    camera that ends, fails or changes its pictures after its first frame is opened again, each second.

    Raises:
        MovieError: no camera, or pictures of another size or type than the experiment's movie.
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


class Feed:
    """Reads a source in a thread. `most` frames wait at most: then the oldest is dropped, or with `wait` the source
    waits. While more than half as many wait, every other frame is dropped: even steps keep the motion known. Iterating
    yields what is there, in order, and raises what the source raised. `tell` gets a line where no
    frame comes for ten times the usual interval, a second at least, and one where they come again.
    """

    def __init__(self, source: Iterator[Arrival], most: int, *, wait: bool, tell: Tell = lambda line: None) -> None:
        self.dropped = 0
        self.newest_s = -math.inf  # time of the newest frame of a source that does not wait
        self._tell, self._usual_s, self._last_s = tell, 0.0, 0.0
        self._source, self._most, self._wait = source, most, wait
        self._waiting: deque[Arrival] = deque()
        self._changed = Condition()
        self._ended = self._closed = False
        self._fault: Exception | None = None
        self._thread = Thread(target=self._read, name="feed", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        try:
            for arrival in self._source:
                with self._changed:
                    while self._wait and len(self._waiting) >= self._most and not self._closed:
                        self._changed.wait()
                    if len(self._waiting) >= self._most:
                        self._waiting.popleft()
                        self.dropped += 1
                    self._waiting.append(arrival)
                    self.newest_s = self.newest_s if self._wait else arrival.time_s
                    if self._last_s:
                        step_s = arrival.arrived_s - self._last_s
                        self._usual_s += (step_s - self._usual_s) / USUAL_FRAMES if self._usual_s else step_s
                    self._last_s = arrival.arrived_s
                    self._changed.notify_all()
                    if self._closed:
                        return
        except Exception as fault:  # goes on in the thread that iterates
            self._fault = fault
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def close(self) -> None:
        """Read no further frame."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __iter__(self) -> Iterator[Arrival]:
        while True:
            with self._changed:
                self._await()
                if not self._waiting:
                    break
                arrival = self._waiting.popleft()
                if not self._wait and len(self._waiting) > self._most / 2:
                    arrival = self._waiting.popleft()
                    self.dropped += 1
                self._changed.notify_all()
            yield arrival
        if self._fault is not None:
            raise self._fault

    def _await(self) -> None:
        """Wait for a frame or the end."""

        def is_there() -> bool:
            return bool(self._waiting) or self._ended

        since = time.perf_counter()
        if self._changed.wait_for(is_there, max(STALLED_S, STALLED_FRAMES * self._usual_s)):
            return
        self._tell(f"source: no frame for {time.perf_counter() - since:.1f} s; tracking waits.")
        self._changed.wait_for(is_there)
        if self._waiting:
            self._tell(f"source: frames come again, after {time.perf_counter() - since:.1f} s.")
