"""Raw recording beside a loop that must not wait: frames go through shared memory to a process that writes movies."""

import math
import multiprocessing
import shutil
import signal
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Thread
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import OutputError, SphereOrientError, error_words, refusal
from sphereorient.files.whole_file import unfinished
from sphereorient.movies.movie import Grey
from sphereorient.movies.write import FAULTS, new_movie, write_times

RING_BYTES, MOST_WAIT = 128 << 20, 1000  # of the frames that wait for the disk; the smallest pipe holds so many times
LEFT_BYTES = 200_000_000  # of the disk for others: a recording ends before it is full
EVERY = 64  # frames from one look at the disk to the next
ROOM_S = 0.001  # between looks for room in the memory


@dataclass(frozen=True, kw_only=True)
class MovieFile:
    """The movie of a camera that is to be recorded."""

    path: Path  # .mkv or .h5, a new file
    shape: tuple[int, ...]  # (H, W)
    dtype: "np.dtype[Any]"


@dataclass(frozen=True, kw_only=True, eq=False)
class _Plan:
    """What both processes know."""

    files: Sequence[MovieFile]
    frame_s: float  # usual time from frame to frame
    left_bytes: int
    memory: Sequence[Any]  # of each camera, of a ring of frames
    written: Any  # number of frames, in memory that both see

    def ring(self) -> list[NDArray[Any]]:
        """Return the memory as frames (K, H, W) of each camera."""
        pairs = zip(self.memory, self.files, strict=True)
        return [np.frombuffer(memory, file.dtype).reshape(-1, *file.shape) for memory, file in pairs]


class Recorder:
    """Records what cameras show, a movie of each, with times, in a process of its own. A frame that finds no room in
    memory is lost, or with `wait` waits. `tell` gets a line where frames begin to be lost, and where the disk takes no
    more: then nothing more is recorded. A movie gets its name once it is whole, also after a kill of this process.
    Raise OutputError: the files cannot be written.
    """

    def __init__(
        self,
        files: Sequence[MovieFile],
        frame_s: float,
        tell: Callable[[str], object],
        *,
        wait: bool = False,
        left_bytes: int = LEFT_BYTES,
    ) -> None:
        spawn = multiprocessing.get_context("spawn")
        sizes = [file.shape[0] * file.shape[1] * file.dtype.itemsize for file in files]
        self._most = max(2, min(RING_BYTES // sum(sizes), MOST_WAIT))  # frames in memory
        memory = [spawn.RawArray("B", self._most * size) for size in sizes]
        plan = _Plan(files=files, frame_s=frame_s, left_bytes=left_bytes, memory=memory, written=spawn.RawValue("Q"))
        self._ring, self._written = plan.ring(), plan.written
        self._tell, self._wait, self._name = tell, wait, ", ".join(str(file.path) for file in files)
        self._sent = self._lost = 0
        self._ended = False
        stamps, self._stamps = spawn.Pipe(duplex=False)
        self._told, tells = spawn.Pipe(duplex=False)
        self._process = spawn.Process(target=_record, args=(plan, stamps, tells), name="recorder")
        self._process.start()
        stamps.close()
        tells.close()
        try:
            fault = self._told.recv_bytes().decode()  # empty: it is ready
        except EOFError:
            fault = self._without_process()
        if fault:
            raise OutputError(fault)
        self._thread = Thread(target=self._listen, name="recorder", daemon=True)
        self._thread.start()

    def take(self, time_s: float, pictures: Sequence[Grey | None]) -> None:
        """Take the pictures of an instant, one of each camera, black for None."""
        while (full := self._sent - self._written.value >= self._most) and self._wait and not self._ended:
            time.sleep(ROOM_S)
        if full or self._ended:
            if not (self._lost or self._ended):
                self._tell(f"{self._name}: frames are lost: they come faster than they are written.")
            self._lost += 1
            return
        for ring, picture in zip(self._ring, pictures, strict=True):
            ring[self._sent % self._most] = 0 if picture is None else picture
        try:
            self._stamps.send_bytes(struct.pack("d", time_s))
            self._sent += 1
        except OSError:
            self._lost, self._ended = self._lost + 1, True

    def _listen(self) -> None:
        with suppress(EOFError, OSError):
            while True:
                self._tell(self._told.recv_bytes().decode())
        self._ended = True
        if fault := self._without_process():
            self._tell(fault)

    def _without_process(self) -> str:
        """Wait for the end of the process, and return the words for one that did not end by itself."""
        self._process.join()
        got, do = f"its end ({self._process.exitcode})", "begin again; tracking goes on without it"
        words = refusal(self._name, expected="a process that records", got=got, do=do)
        return words if self._process.exitcode else ""

    def summary(self) -> str:
        """Return what was recorded, in words."""
        written = int(self._written.value)
        return f"{self._name}: {written} frames recorded, {self._lost + self._sent - written} lost"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *fault: object) -> None:
        """Write what waits, and give the movies their names."""
        self._stamps.close()
        self._thread.join()


def _record(plan: _Plan, stamps: Connection, tells: Connection) -> None:
    """Write movies of what comes, and tell, in bytes, that it is ready (none), and what goes wrong (a line)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the tracking
    asides = [unfinished(file.path) for file in plan.files]
    try:
        times_s = _written(plan, asides, stamps, tells)
        for aside, file in zip(asides, plan.files, strict=True):
            if not times_s:
                aside.unlink()
                continue
            if file.path.exists():  # hours may have passed
                do = "name another one"
                raise OutputError(refusal(str(file.path), expected="a new file", got="one that is there", do=do))
            aside.replace(file.path)
            if file.path.suffix.lower() == ".mkv":
                write_times(file.path, times_s)
    except (SphereOrientError, *FAULTS) as error:
        name, do = str(plan.files[0].path), "choose a folder that has room; tracking goes on without it"
        words = refusal(name, expected="a file that can be written", got=error_words(error), do=do)
        line = str(error) if isinstance(error, SphereOrientError) else words
        if plan.written.value:
            line += f" What was recorded is in {', '.join(str(aside) for aside in asides if aside.exists())}."
        else:
            for aside in asides:
                aside.unlink(missing_ok=True)
        tells.send_bytes(line.encode())


def _written(plan: _Plan, asides: Sequence[Path], stamps: Connection, tells: Connection) -> list[float]:
    """Write frames until no more come, or the disk is nearly full, and return their times, s."""
    times_s = list[float]()
    with ExitStack() as opened:
        adds = [
            opened.enter_context(new_movie(aside, file.shape, file.dtype, 1 / plan.frame_s))
            for aside, file in zip(asides, plan.files, strict=True)
        ]
        tells.send_bytes(b"")
        ring = plan.ring()
        for time_s in _times(stamps, plan.frame_s):
            number = len(times_s)
            free = shutil.disk_usage(asides[0].parent).free if number % EVERY == 0 else plan.left_bytes
            if free < plan.left_bytes:
                stamps.close()
                got, do = f"{free / 1e6:.0f} MB left", "make room; the recording ends here, tracking goes on"
                name = str(plan.files[0].path)
                tells.send_bytes(refusal(name, expected="a disk with room", got=got, do=do).encode())
                break
            for add, frames in zip(adds, ring, strict=True):
                add(frames[number % len(frames)], time_s)
            times_s.append(time_s)
            plan.written.value = len(times_s)
    return times_s


def _times(stamps: Connection, frame_s: float) -> Iterator[float]:
    """Yield the times that come until their sender ends; where they stand or go back, they go on by a frame, for good:
    times of a movie increase.
    """
    last_s, shift_s = -math.inf, 0.0
    with suppress(EOFError):
        while True:
            (time_s,) = struct.unpack("d", stamps.recv_bytes())
            if time_s + shift_s <= last_s:
                shift_s = last_s + frame_s - time_s
            last_s = time_s + shift_s
            yield last_s
