"""Raw recording beside a loop that must not wait: frames go through shared memory to a process that writes a movie."""

import multiprocessing
import shutil
import signal
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from sphereorient.errors import SphereOrientError, refusal
from sphereorient.movies.movie import Grey, Movie
from sphereorient.movies.write import write_movie

RING_BYTES, MOST_WAIT = 128 << 20, 1000  # of frames waiting for the disk; times that fit into the smallest pipe
LEFT_BYTES = 200_000_000  # left free on the disk when a recording ends
EVERY, EVERY_BYTES = 64, 16 << 20  # frames, and their bytes, between checks of the disk
BEGIN_S, ROOM_S, SHORTEST_S = 20.0, 0.001, 1e-6  # for the process to start; between checks for room; least of a frame


# Shared memory: frames, the number of written ones, and shape and type of one.
_Ring = tuple[Any, Any, tuple[int, int], "np.dtype[Any]"]


class Recorder:
    """Records frames like those of a movie, and their times, in a separate process. The new movie, .mkv or .h5, gets
    its name when it is complete, also after a kill of this process. `log` gets a line when frames begin to be lost,
    and when the file cannot be written further: then recording ends. `wait`: wait for room instead of losing frames.
    """

    def __init__(
        self, path: Path, like: Movie, frame_s: float, log: Callable[[str], object], *, wait: bool = False
    ) -> None:
        spawn, (height, width), dtype = multiprocessing.get_context("spawn"), like.frame_shape, like.dtype
        size = height * width * dtype.itemsize
        memory, self._written = (
            spawn.RawArray("B", max(2, min(RING_BYTES // size, MOST_WAIT)) * size),
            spawn.RawValue("Q"),
        )
        self._frames = np.frombuffer(memory, dtype).reshape(-1, height, width)
        self._path, self._log, self._wait = path, log, wait
        self._sent = self._lost = 0
        self._ended = False
        stamps, self._stamps = spawn.Pipe(duplex=False)
        self._lines, lines = spawn.Pipe(duplex=False)
        ring = memory, self._written, like.frame_shape, dtype
        arguments = path, ring, stamps, lines, max(SHORTEST_S, frame_s), LEFT_BYTES  # NaN for a single frame
        self._process = spawn.Process(target=_record, args=arguments, name="recorder")
        self._process.start()
        stamps.close()
        lines.close()
        self._lines.poll(BEGIN_S)
        self._thread = Thread(target=self._listen, name="recorder", daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        with suppress(EOFError, OSError):
            while True:
                if line := self._lines.recv_bytes().decode():
                    self._log(line)
        self._ended = True
        self._process.join()
        if code := self._process.exitcode:
            got, do = f"its end ({code})", "begin again; tracking goes on without it"
            self._log(refusal(str(self._path), expected="a process that records", got=got, do=do))

    def room(self) -> bool:
        """Return whether there is room for a frame, or recording has ended."""
        while self._sent - self._written.value >= len(self._frames) and not self._ended:
            if not self._wait:
                return False
            time.sleep(ROOM_S)
        return True

    def take(self, time_s: float, picture: Grey | None, room: bool) -> None:
        """Take a frame, black for None, if there is room; else count it as lost."""
        if not room:
            if not self._lost:
                self._log(f"{self._path}: frames are lost, as they arrive faster than they are written.")
            self._lost += 1
            return
        self._frames[self._sent % len(self._frames)] = 0 if picture is None else picture
        try:
            self._stamps.send_bytes(struct.pack("d", time_s))
            self._sent += 1
        except OSError:  # the process has ended, or was closed
            self._ended, self._lost = True, self._lost + (not self._stamps.closed)

    def summary(self) -> str:
        """Return a summary of the recording as text."""
        written = int(self._written.value)
        return f"{self._path}: {written} frames recorded, {self._lost + self._sent - written} lost"

    def close(self) -> None:
        """Write the waiting frames, and give the movie its name."""
        self._stamps.close()
        self._thread.join()


def _record(path: Path, ring: _Ring, stamps: Connection, lines: Connection, frame_s: float, left_bytes: int) -> None:
    """Write a movie of the frames whose times arrive, until the sender ends; send a line for each problem."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # Ctrl-C, a closed terminal: the sender ends, then this process
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    memory, written, shape, dtype = ring
    times_s, frames = list[float](), np.frombuffer(memory, dtype).reshape(-1, *shape)
    every = max(1, min(EVERY, EVERY_BYTES // frames[0].nbytes))

    def taken() -> Iterator[Grey]:
        shift_s = 0.0
        with suppress(EOFError):
            while True:
                (time_s,) = struct.unpack("d", stamps.recv_bytes())
                if times_s and time_s + shift_s <= times_s[-1]:  # times of a movie increase
                    shift_s = times_s[-1] + frame_s - time_s
                if len(times_s) % every == 0 and (free := shutil.disk_usage(path.parent).free) < left_bytes:
                    got, do = f"{free / 1e6:.0f} MB left", "make room; the recording ends here, tracking goes on"
                    lines.send_bytes(refusal(str(path), expected="a disk with room", got=got, do=do).encode())
                    stamps.close()
                    return
                times_s.append(time_s + shift_s)
                yield frames[written.value % len(frames)]
                written.value += 1

    lines.send_bytes(b"")  # started
    try:
        write_movie(path, taken(), times_s, 1 / frame_s)
    except SphereOrientError as error:
        lines.send_bytes(str(error).encode() if times_s else b"")  # without frames there is no movie
