"""Frames in order of arrival, read in a separate thread."""

import math
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from threading import Condition, Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.experiment.recording import CameraStream

Picture = NDArray[Any]
Log = Callable[[str], object]  # gets a message of one line
LATE, GROWS = 1, 2  # frames that may wait; largest ratio of successive steps
STEADY = 8  # frames without a search after which large steps did not cause the next search
STALLED_S, STALLED_FRAMES = 1.0, 10.0  # without a frame, usual intervals: the source stalls


@dataclass(frozen=True, kw_only=True, eq=False)
class Arrival:
    """One instant: a picture of each camera, None if unreadable."""

    number: int  # counts all instants of the source, also dropped ones
    time_s: float
    pictures: Sequence[Picture | None]
    arrived_s: float  # by the clock of time.perf_counter; NaN: set when tracking takes it


class FrameBytes:
    """Layout of all cameras' pictures in the bytes of one frame: row by row, of the movies' size and type."""

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


class Feed:
    """Reads a source in a thread, and yields its frames in order, or raises its error. At most `most` frames wait; then
    the oldest is dropped, or with `wait` the source waits. While more than `LATE` wait, frames are skipped, in steps
    that grow slowly so that the motion stays known. `log` gets a line when the source stalls and when it resumes.
    """

    def __init__(self, source: Iterator[Arrival], most: int, *, wait: bool, log: Log = lambda line: None) -> None:
        self.dropped = 0
        self.newest_s = -math.inf  # time of the newest frame of a source that does not wait
        self._log, self._usual_s, self._last_s = log, 0.0, 0.0
        self._source, self._most, self._wait = source, most, wait
        self._waiting: deque[Arrival] = deque()
        self._changed = Condition()
        self._ended = self._closed = False
        self._fault: Exception | None = None
        self._overrun = False  # whether frames after the last one were dropped
        self._step, self._since = 0, STEADY  # from the frame before to the last one; frames since the last search
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
                        self.dropped, self._overrun = self.dropped + 1, True
                    self._waiting.append(arrival)
                    self.newest_s = self.newest_s if self._wait else arrival.time_s
                    if self._last_s and math.isfinite(arrival.arrived_s):
                        step_s = arrival.arrived_s - self._last_s
                        self._usual_s += (step_s - self._usual_s) / 16 if self._usual_s else step_s
                    self._last_s = arrival.arrived_s
                    self._changed.notify_all()
                    if self._closed:
                        return
        except Exception as fault:  # raised in the iterating thread
            self._fault = fault
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()
            if isinstance(self._source, Generator):
                self._source.close()  # releases a device

    def restart(self) -> None:
        """Restart with small steps, as the motion is unknown; with one frame if the last search was recent. If frames
        after the last one were dropped, the waiting ones are skipped.
        """
        with self._changed:
            self._step, self._since = int(self._since >= STEADY), 0
            if self._overrun:
                self.dropped += len(self._waiting)
                self._waiting.clear()

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
                arrival, self._overrun = self._waiting.popleft(), False
                late = LATE if self._since else 0  # frames that came during a search are late anyway
                most = min(len(self._waiting) + 1 - late, GROWS * self._step)
                if not self._wait and most > 1:
                    self.dropped += most - 1
                    for _ in range(most - 1):
                        arrival = self._waiting.popleft()
                self._step, self._since = max(most, 1), self._since + 1
                self._changed.notify_all()
            taken_s = arrival.arrived_s if math.isfinite(arrival.arrived_s) else time.perf_counter()
            yield replace(arrival, arrived_s=taken_s)
        if self._fault is not None:
            raise self._fault

    def _await(self) -> None:
        def is_there() -> bool:
            return bool(self._waiting) or self._ended

        since = time.perf_counter()
        if self._changed.wait_for(is_there, max(STALLED_S, STALLED_FRAMES * self._usual_s)):
            return
        self._log(f"source: no frame for {time.perf_counter() - since:.1f} s; tracking waits.")
        self._changed.wait_for(is_there)
        if self._waiting:
            self._log(f"source: frames arrive again, after {time.perf_counter() - since:.1f} s.")
