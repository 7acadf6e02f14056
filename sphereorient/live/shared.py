"""A ring of frames in a file that two programs map into memory: one writes pictures, the other reads the newest.

Bytes, little-endian: "SPHEREO1"; then uint64: slots, bytes a frame, frames written so far, 1 at the end; then float64
times (s) of the slots; then the slots, each the pictures of all cameras, row by row. Frame n lies in slot n % slots. A
writer writes time and pictures first, then the number of frames.
"""

import mmap
import os
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, refusal
from sphereorient.experiment.recording import CameraStream
from sphereorient.live.feed import Arrival, FrameBytes

MAGIC = b"SPHEREO1"
SLOTS, SIZE, WRITTEN, ENDED = range(1, 5)  # places of the numbers behind MAGIC
HEAD = 5  # words of 8 bytes
WORD = 8  # bytes
REPLACED_S = 0.5  # between looks for another ring
NEXT_S = 0.0002  # between looks for a new frame
# No look before this share of the usual interval has passed: each holds up the thread that computes. From one frame to
# the next that interval changes by these factors at most.
NO_LOOK, SHRINKS, GROWS = 0.7, 0.5, 1.2


class SharedFrames:
    """Writes frames of `size` bytes into a ring of `slots`; the file is removed at the end."""

    def __init__(self, path: Path, size: int, slots: int = 16) -> None:
        length = WORD * (HEAD + slots) + slots * size
        with path.open("xb") as file:
            file.truncate(length)
        self._path, self._slots, self._size = path, slots, size
        self._file = path.open("r+b")
        self._map = mmap.mmap(self._file.fileno(), length)
        self._words = np.frombuffer(self._map, np.uint64, HEAD)
        self._times = np.frombuffer(self._map, np.float64, slots, WORD * HEAD)
        self._frames = np.frombuffer(self._map, np.uint8, slots * size, WORD * (HEAD + slots)).reshape(slots, size)
        self._words[SLOTS], self._words[SIZE] = slots, size
        self._map[:WORD] = MAGIC  # last: now it can be read

    def write(self, time_s: float, pictures: Sequence[NDArray[np.generic]]) -> None:
        """Write the pictures of all cameras at one instant."""
        number = int(self._words[WRITTEN])
        slot, begin = number % self._slots, 0
        self._times[slot] = time_s
        for picture in pictures:
            content = np.ascontiguousarray(picture).reshape(-1).view(np.uint8)
            self._frames[slot, begin : begin + len(content)] = content
            begin += len(content)
        self._words[WRITTEN] = number + 1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._words[ENDED] = 1
        del self._words, self._times, self._frames
        self._map.close()
        self._file.close()
        self._path.unlink(missing_ok=True)


def shared_frames(path: Path, streams: Sequence[CameraStream]) -> Iterator[Arrival]:
    """Yield the frames of a ring, each once; of those that were written over before they were read the numbers are left
    out. Where another ring of this name takes its place, the numbers go on with that.
    Raise MovieError: no such ring, or one of frames of another size.
    """
    before = 0  # frames of former rings
    again = True
    while again:
        again, number = False, -1
        try:
            with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as memory:
                for found in _read(memory, path, os.fstat(file.fileno()).st_ino, FrameBytes(streams)):
                    if again := found is None:
                        break
                    number = found.number
                    yield replace(found, number=before + number) if before else found
        except (OSError, ValueError):  # ValueError: an empty file
            do = "begin the program that writes it (docs/live.md)"
            raise MovieError(refusal(str(path), expected="a ring of frames", got="none", do=do)) from None
        before += number + 1


def _read(memory: mmap.mmap, path: Path, file_number: int, layout: FrameBytes) -> Iterator[Arrival | None]:
    """Yield the frames of a ring, and None where another file of its name has taken its place."""

    def word(place: int) -> int:
        return int.from_bytes(memory[WORD * place : WORD * (place + 1)], "little")

    slots, size = word(SLOTS), word(SIZE)
    first = WORD * (HEAD + slots)  # of the frames
    right = memory[:WORD] == MAGIC and 0 < slots <= 1 << 16 and len(memory) == first + slots * size
    if not right or size != layout.size:
        got = f"{size} bytes a frame" if right else "another file"
        do = "write the pictures of all cameras, of the size and type of the experiment's movies"
        raise MovieError(refusal(str(path), expected=f"a ring of {layout.size} bytes a frame", got=got, do=do))
    number, look_s = max(0, word(WRITTEN) - 1), time.perf_counter()
    arrived_s, usual_s = look_s, NEXT_S
    while True:
        written = word(WRITTEN)
        if number >= written:
            if word(ENDED):
                return
            if time.perf_counter() > look_s + REPLACED_S:
                look_s = time.perf_counter()
                with suppress(OSError):
                    if path.stat().st_ino != file_number and path.stat().st_size:
                        yield None
                        return
            time.sleep(max(NEXT_S, arrived_s + NO_LOOK * usual_s - time.perf_counter()))
            continue
        number = max(number, written - slots + 1)
        slot, before_s, arrived_s = number % slots, arrived_s, time.perf_counter()
        usual_s = min(max(arrived_s - before_s, SHRINKS * usual_s), GROWS * usual_s)
        content = memory[first + slot * size : first + (slot + 1) * size]
        (time_s,) = struct.unpack_from("<d", memory, WORD * (HEAD + slot))
        if word(WRITTEN) - number >= slots:  # written over meanwhile
            continue
        yield Arrival(number=number, time_s=time_s, pictures=layout.pictures(content), arrived_s=arrived_s)
        number += 1
