"""A ring of pictures or poses in a file mapped into memory: one program writes, others read.

Bytes, little-endian: "SPHEREO1"; then uint64: slots, bytes a slot, slots written so far, 1 at the end; then float64
times (s) of the slots; then the slots. Number n lies in slot n % slots. A writer writes time and content first, then
the number of slots written. A slot holds the pictures of all cameras at one instant, row by row; or a pose: float64
numbers in the order of `lines.Quantities`, NaN for what is not known.
"""

import mmap
import os
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, OutputError, error_words, refusal
from sphereorient.experiment.recording import CameraStream
from sphereorient.live.feed import Arrival, FrameBytes

MAGIC = b"SPHEREO1"
SLOTS, SIZE, WRITTEN, ENDED = range(1, 5)  # indices of the numbers after MAGIC
HEAD = 5  # words of 8 bytes
WORD = 8  # bytes
REPLACED_S = 0.5  # between checks for another ring
NEXT_S = 0.0002  # between checks for a new slot
# No check before this share of the usual interval, since each delays the computing thread; largest factors by which
# that interval changes from frame to frame.
NO_LOOK, SHRINKS, GROWS = 0.7, 0.5, 1.2
POSES, POSE_BYTES = 4096, WORD * 33  # of a ring of poses: slots, and bytes of each


class SharedFrames:
    """Writes into a ring of `slots` of `size` bytes; never waits. Raises OutputError: the file exists, or no room."""

    def __init__(self, path: Path, size: int, slots: int = 16) -> None:
        length = WORD * (HEAD + slots) + slots * size
        self._path, self._slots = path, slots
        try:
            with path.open("x+b") as file:
                file.truncate(length)
                if hasattr(os, "posix_fallocate"):  # a full disk later would end the program
                    os.posix_fallocate(file.fileno(), 0, length)
                self._map = mmap.mmap(file.fileno(), length)
        except OSError as error:
            if not isinstance(error, FileExistsError):
                with suppress(OSError):
                    path.unlink()
            do = "name a new file in a folder with room"
            raise OutputError(refusal(str(path), expected="a new file", got=error_words(error), do=do)) from None
        self._words = np.frombuffer(self._map, np.uint64, HEAD)
        self._times = np.frombuffer(self._map, np.float64, slots, WORD * HEAD)
        self._content = np.frombuffer(self._map, np.uint8, slots * size, WORD * (HEAD + slots)).reshape(slots, size)
        self._words[SLOTS], self._words[SIZE] = slots, size
        self._map[:WORD] = MAGIC  # last: then readers accept it

    def write(self, time_s: float, parts: Sequence[NDArray[Any]]) -> None:
        """Write one instant: the pictures of all cameras, or a pose."""
        number = int(self._words[WRITTEN])
        slot, begin = number % self._slots, 0
        self._times[slot] = time_s
        for part in parts:
            content = np.ascontiguousarray(part).reshape(-1).view(np.uint8)
            self._content[slot, begin : begin + len(content)] = content
            begin += len(content)
        self._words[WRITTEN] = number + 1

    def close(self) -> None:
        """Mark the end for readers, and remove the file."""
        self._words[ENDED] = 1
        del self._words, self._times, self._content
        self._map.close()
        self._path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *fault: object) -> None:
        self.close()


Slot = tuple[int, float, bytes, float]  # number, time (s), content, time of reading by time.perf_counter


class SlotReader:
    """A ring of another program, with slots of `size` bytes. Raises MovieError: no ring, or slots of another size."""

    def __init__(self, path: Path, size: int) -> None:
        try:
            with path.open("rb") as file:
                self._memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
                self._path, self._file_number = path, os.fstat(file.fileno()).st_ino
        except (OSError, ValueError):  # ValueError: an empty file
            do = "start the program that writes it (docs/live.md)"
            raise MovieError(refusal(str(path), expected="a ring of frames", got="none", do=do)) from None
        self._slots, self._size = self._word(SLOTS), self._word(SIZE)
        self._first = WORD * (HEAD + self._slots)  # of the slots
        whole = len(self._memory) == self._first + self._slots * self._size
        right = self._memory[:WORD] == MAGIC and 0 < self._slots <= 1 << 16 and whole
        if not right or self._size != size:
            got = f"{self._size} bytes a frame" if right else "another file"
            do = "write the pictures of all cameras, of the size and type of the experiment's movies"
            raise MovieError(refusal(str(path), expected=f"a ring of {size} bytes a frame", got=got, do=do))

    def _word(self, place: int) -> int:
        return int.from_bytes(self._memory[WORD * place : WORD * (place + 1)], "little")

    @property
    def written(self) -> int:
        """Number of slots written so far."""
        return self._word(WRITTEN)

    @property
    def ended(self) -> bool:
        """Whether the writer has ended."""
        return bool(self._word(ENDED))

    @property
    def replaced(self) -> bool:
        """Whether another readable ring has replaced this one."""
        with suppress(OSError), self._path.open("rb") as file:
            return os.fstat(file.fileno()).st_ino != self._file_number and file.read(WORD) == MAGIC
        return False

    def oldest(self, number: int) -> int:
        """Return the number, or that of the oldest slot not yet overwritten."""
        return max(number, self.written - self._slots + 1)

    def read(self, number: int) -> Slot | None:
        """Return a written slot; None if it was overwritten."""
        slot, arrived_s = number % self._slots, time.perf_counter()
        begin = self._first + slot * self._size
        content = self._memory[begin : begin + self._size]
        (time_s,) = struct.unpack_from("<d", self._memory, WORD * (HEAD + slot))
        return None if self.written - number >= self._slots else (number, time_s, content, arrived_s)


def shared_frames(path: Path, streams: Sequence[CameraStream]) -> Iterator[Arrival]:
    """Yield the frames of a ring of pictures, as `shared_slots` does."""
    layout = FrameBytes(streams)
    for number, time_s, content, arrived_s in shared_slots(path, layout.size):
        yield Arrival(number=number, time_s=time_s, pictures=layout.pictures(content), arrived_s=arrived_s)


def shared_poses(path: Path) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Yield the poses of a ring, (33,) in the order of `Quantities`, with their count, as `shared_slots` does."""
    for number, _, content, _ in shared_slots(path, POSE_BYTES):
        yield number, np.frombuffer(content, "<f8")


def shared_slots(path: Path, size: int) -> Iterator[Slot]:
    """Yield the slots of a ring from the newest on; overwritten slots leave gaps in the numbering, which continues in a
    ring that replaces this one. Raises MovieError: no such ring, or slots of another size.
    """
    before = 0  # slots of former rings
    while True:
        ring, look_s = SlotReader(path, size), time.perf_counter()
        number, arrived_s, usual_s = max(0, ring.written - 1), look_s, NEXT_S
        while not ring.ended or number < ring.written:  # this order misses none at the end
            if number >= ring.written:
                if time.perf_counter() > look_s + REPLACED_S:
                    look_s = time.perf_counter()
                    if ring.replaced:
                        break
                time.sleep(max(NEXT_S, arrived_s + NO_LOOK * usual_s - time.perf_counter()))
                continue
            before_s, arrived_s = arrived_s, time.perf_counter()
            usual_s = min(max(arrived_s - before_s, SHRINKS * usual_s), GROWS * usual_s)
            number = ring.oldest(number)
            if (slot := ring.read(number)) is not None:
                yield before + number, *slot[1:]
                number += 1
        else:
            return
        before += number
