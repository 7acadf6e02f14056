"""Movies in HDF5: one data set (N, H, W), and its times beside it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.indexed import IndexedMovie, missing_remark
from sphereorient.movies.movie import Grey

SEPARATOR = "::"  # between the file and the data set in it
TIMES = ("time", "times", "timestamps")
MAX_OBJECTS = 10_000  # looked through for the one data set
BLOCK_BYTES = 64 << 20  # held at once, of a data set whose chunks hold many frames
LARGEST_RATIO = 1200  # by which a picture of one grey value shrinks at most
# What h5py raises on damaged files, depending on the place where HDF5 notices.
DAMAGE = (OSError, RuntimeError, ValueError, TypeError, LookupError, ArithmeticError, MemoryError, AttributeError)


@dataclass(frozen=True)
class Storage:
    """What of a data set is in the file."""

    count: int  # frames up to the last one that was written
    block: int  # frames in one chunk
    blocks: frozenset[int] | None  # chunks along the first axis that were written; None: no chunks, all is there

    def has(self, number: int) -> bool:
        """Return whether a frame was ever written."""
        return self.blocks is None or number // self.block in self.blocks


class Hdf5Movie(IndexedMovie):
    """A data set (N, H, W) of uint8 or uint16; frames that were never written are unreadable."""

    def __init__(self, path: Path) -> None:
        self._file, name = split_path(path)
        with _opened(path, self._file) as file:
            data = _data_set(path, file, name)
            self._name = data.name
            told, *frame_shape = (int(size) for size in data.shape)
            self._storage = _storage(path, data, self._file.stat().st_size)
            count = self._storage.count
            if count < 1:
                raise _refuse(path, "frames", f"{told} of which none was written", "record it again")
            times_s, remarks = _times(data, told, count)
            dtype = data.dtype.newbyteorder("=")
            form = f"HDF5, data set {data.name}" + (f", {data.compression}" if data.compression else "")
        super().__init__(
            path,
            form,
            count,
            (frame_shape[0], frame_shape[1]),
            dtype,
            times_s,
            (*missing_remark(told, count), *remarks),
        )

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        at_once = max(1, BLOCK_BYTES // (math.prod(self.frame_shape) * self.dtype.itemsize))
        held, pictures = -1, np.empty(0, self.dtype)
        with _opened(self.path, self._file) as file:
            data = _follow(self.path, file, self._name)
            for number in numbers:
                if not self._storage.has(number):
                    raise self._damage(number, "none that was ever written")
                # Of the frames of one chunk, which are decompressed together, as many as memory allows.
                within = number % self._storage.block
                start = number - within % at_once
                if start != held:
                    end = number - within + self._storage.block
                    pictures = self._pictures(data, number, start, min(start + at_once, end, len(self)))
                    held = start
                yield pictures[number - start].astype(self.dtype)

    def _pictures(self, data: Any, number: int, first: int, last: int) -> Grey:
        try:
            pictures: Grey = data[first:last]
        except DAMAGE as error:
            raise self._damage(number, words(error)) from error
        return pictures


def split_path(path: Path) -> tuple[Path, str]:
    """Return the file and the name of the data set in it, empty where `path` names none."""
    file, _, name = str(path).partition(SEPARATOR)
    return Path(file), name


def words(error: Exception) -> str:
    """Return an error of HDF5 in one line."""
    return f"'{str(error).splitlines()[0][:200]}'" if str(error) else type(error).__name__


def _shown(name: object) -> str:
    """Return a name out of the file as one line of at most 60 characters."""
    text = str(name)
    return (text if text.isprintable() else repr(text))[:60]


def _refuse(path: Path, expected: str, got: str, do: str) -> MovieError:
    return MovieError(refusal(str(path), expected=expected, got=got, do=do))


@contextmanager
def _opened(path: Path, file: Path) -> Iterator[Any]:
    """Open the file; what HDF5 raises while it is looked at is damage."""
    try:
        with h5py.File(file, "r") as opened:
            yield opened
    except DAMAGE as error:
        raise _refuse(path, "an HDF5 file that is whole", words(error), "copy or record it again") from error


def _data_set(path: Path, file: Any, name: str) -> Any:
    """Return the data set of a name, or the only one that can be a movie, refused where it leads out of the file."""
    data = _follow(path, file, name) if name else _only(path, file)
    if not (isinstance(data, h5py.Dataset) and _is_movie(data)):
        got = f"{data.shape} of {data.dtype}" if isinstance(data, h5py.Dataset) else "a group"
        expected = "a data set (N, H, W) of uint8 or uint16"
        raise _refuse(path, expected, got, "name another one: file.h5::group/dataset")
    if data.external or data.is_virtual:
        got, do = "one that lies in other files", "copy the pictures into this file"
        raise _refuse(path, "a data set in the file itself", got, do)
    plist = data.id.get_create_plist()
    unknown = [plist.get_filter(k)[0] for k in range(plist.get_nfilters())]
    unknown = [code for code in unknown if not h5py.h5z.filter_avail(code)]
    if unknown:
        do = "write it with gzip, lzf or without compression"
        raise _refuse(path, "a compression that HDF5 has", f"filter {unknown[0]}", do)
    return data


def _follow(path: Path, file: Any, name: str) -> Any:
    """Go to an object by its name, through nothing but the groups of this file: links may lead to other files."""
    here = file
    for part in name.strip("/").split("/"):
        link = here.get(part, getlink=True) if isinstance(here, h5py.Group) and part else None
        if link is None:
            known = ", ".join(map(_shown, _movies(file)[:5])) or "no data set (N, H, W)"
            raise _refuse(path, "a data set that the file has", f"'{name}'", f"name one of: {known}")
        if not isinstance(link, h5py.HardLink):
            do = "name the data set itself, copied into this file"
            raise _refuse(path, "a data set in the file itself", f"a link, '{part}'", do)
        here = here[part]
    return here


def _only(path: Path, file: Any) -> Any:
    names = _movies(file)
    if len(names) != 1:
        got = ", ".join(map(_shown, names[:5])) or "none"
        do = "name one: file.h5::group/dataset"
        raise _refuse(path, "one data set (N, H, W) of uint8 or uint16", got, do)
    return file[names[0]]


def _movies(file: Any) -> list[str]:
    """Return the names of the data sets that can be movies."""
    found: list[str] = []
    seen = 0

    def look(name: str, thing: Any) -> bool | None:
        nonlocal seen
        seen += 1
        if isinstance(thing, h5py.Dataset) and _is_movie(thing):
            found.append(name)
        return True if seen > MAX_OBJECTS else None  # anything but None ends the walk

    file.visititems(look)  # each object once, links to other files left out
    return found


def _is_movie(data: Any) -> bool:
    shape = data.shape
    return shape is not None and len(shape) == 3 and 0 not in shape and data.dtype in (np.uint8, np.uint16)


def _storage(path: Path, data: Any, file_bytes: int) -> Storage:
    """Find out what of a data set is in the file, whatever its shape claims; nothing is read."""
    told, height, width = (int(size) for size in data.shape)
    frame_bytes = height * width * data.dtype.itemsize
    if frame_bytes > LARGEST_RATIO * file_bytes:
        raise _refuse(path, "frames that the file can hold", f"{height} x {width}", "record it again")
    if data.chunks is None:
        stored = min(data.id.get_storage_size(), file_bytes)
        return Storage(count=min(told, stored // frame_bytes), block=1, blocks=None)
    block, rows, columns = data.chunks
    claimed = block * rows * columns * data.dtype.itemsize
    tiles = -(-height // rows) * -(-width // columns)
    there: Counter[int] = Counter()

    def note(chunk: Any) -> None:
        if claimed <= LARGEST_RATIO * min(chunk.size, file_bytes):
            there[chunk.chunk_offset[0] // block] += 1

    data.id.chunk_iter(note)
    whole = frozenset(place for place, count in there.items() if count == tiles)
    return Storage(count=min(told, (max(whole, default=-1) + 1) * block), block=block, blocks=whole)


def _times(data: Any, told: int, count: int) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Return the times that lie beside a data set, (count,), s, and what is to be said about them."""
    for name in TIMES:
        link = data.parent.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            continue
        times = data.parent[name]
        if not isinstance(times, h5py.Dataset) or times.shape != (told,) or times.dtype.kind not in "fiu":
            return None, (f"its '{name}' is not used: it is not one number a frame",)
        unit = times.attrs.get("units", "s")
        if unit != "s":
            return None, (f"its '{name}' is not used: in {_shown(unit)}, not in s",)
        if times.external or times.is_virtual:
            return None, (f"its '{name}' is not used: it lies in other files",)
        seconds = times[:count].astype(np.float64)
        if not (np.isfinite(seconds).all() and (np.diff(seconds) > 0).all()):
            return None, (f"its '{name}' is not used: it does not increase",)
        return seconds, ()
    return None, ()
