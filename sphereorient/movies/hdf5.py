import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sphereorient.errors import error_words
from sphereorient.files.hdf5 import DAMAGE
from sphereorient.files.whole_file import LARGEST_RATIO
from sphereorient.movies.movie import MOST_MISSING, Grey, Movie, flipped, grey_shape, movie_error
from sphereorient.movies.stamps import UNITS, Stamps, unit_in

KIND = "data set (N, H, W) of uint8 or uint16"
UPRIGHT = "higher than wide: if MATLAB's h5write wrote it, rows are columns: write flip: transpose"
NAME_ONE = "name one: file.h5::group/dataset"
AS_MOVIE = "write one channel as a data set of its own: file['grey'] = file['NAME'][..., 0]"
SHOWN = 5  # data sets named in a refusal
SEPARATOR = "::"  # between the file and the data set in it
TIMES = ("time", "times", "timestamps")
MATLAB = "MATLAB_class"  # attribute of data by MATLAB, whose axes are reversed in the file
MAX_OBJECTS = 10_000  # most objects searched for the data set
BLOCK_BYTES = 64 << 20  # held at once, if chunks hold many frames


class Hdf5Movie(Movie):
    """A data set (N, H, W) of uint8 or uint16, without a fourth axis of 1; frames never written are unreadable."""

    def __init__(self, path: Path) -> None:
        self._file, name = split_path(path)
        with _opened(path, self._file) as file:
            data = _data_set(path, file, name)
            self._name = data.name
            stated, height, width = grey_shape(data.shape) or (0, 0, 0)
            self.by_matlab = MATLAB in data.attrs
            self._block = 1 if data.chunks is None else data.chunks[0]  # frames in one chunk
            count, self._blocks = _written(path, data, self._file.stat().st_size)
            if count < 1:
                raise movie_error(path, "frames", f"{stated} of which none was written", "record it again")
            self.times_s, self.times_unit, remarks = _times(data, stated, count)
            form = f"HDF5, data set {data.name} {data.shape}" + (f", {data.compression}" if data.compression else "")
            super().__init__(path, form, count, (height, width), data.dtype.newbyteorder("="))
        doubtful = (UPRIGHT,) if height > width and not self.by_matlab else ()
        self.remarks = (*self._truncated(stated), *remarks, *doubtful)

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        at_once = max(1, BLOCK_BYTES // (math.prod(self.frame_shape) * self.dtype.itemsize))
        held, pictures = -1, np.empty(0, self.dtype)
        with _opened(self.path, self._file) as file:
            data = _follow(self.path, file, self._name)
            for number in numbers:
                if self._blocks is not None and number // self._block not in self._blocks:
                    raise self._damage(number, "none that was ever written")
                # Frames of one chunk are decompressed together: hold up to BLOCK_BYTES of them.
                within = number % self._block
                start = number - within % at_once
                if start != held:
                    end = min(start + at_once, number - within + self._block, len(self))
                    try:
                        held, pictures = start, data[start:end]
                    except DAMAGE as error:
                        raise self._damage(number, error_words(error)) from error
                yield pictures[number - start].reshape(self.frame_shape).astype(self.dtype)


def hdf5_movie(path: Path) -> Movie:
    """Open a data set of a file; rows and columns of one saved by MATLAB, (H, W, N) there, are as in MATLAB."""
    movie = Hdf5Movie(path)
    return flipped(movie, "transpose" if movie.by_matlab else "none")


def split_path(path: Path) -> tuple[Path, str]:
    """Return the file and the name of its data set, empty if `path` has none."""
    file, _, name = str(path).partition(SEPARATOR)
    return Path(file), name


def _shown(name: object) -> str:
    text = str(name)
    return (text if text.isprintable() else repr(text))[:60]


@contextmanager
def _opened(path: Path, file: Path) -> Iterator[Any]:
    try:
        with h5py.File(file, "r") as opened:
            yield opened
    except DAMAGE as error:
        do = "save it in MATLAB with '-v7.3'" if file.suffix.lower() == ".mat" else "copy or record it again"
        raise movie_error(path, "an HDF5 file that is whole", error_words(error), do) from error


def _data_set(path: Path, file: Any, name: str) -> Any:
    """Return the named data set, or the only one that can be a movie; refuse one stored in other files."""
    if name:
        data = _follow(path, file, name)
    else:
        names = _candidates(file)
        if len(names) != 1:
            others = [f"{_shown(one)} {file[one].shape} of {file[one].dtype}" for one in _data_sets(file)[:SHOWN]]
            got = ", ".join([_shown(one) for one in names[:SHOWN]] or others) or "none"
            raise movie_error(path, f"one {KIND}", got, NAME_ONE if names else AS_MOVIE)
        data = file[names[0]]
    if not _is_movie(data):
        got = f"{data.shape} of {data.dtype}" if isinstance(data, h5py.Dataset) else "a group"
        raise movie_error(path, f"a {KIND}", got, NAME_ONE if _candidates(file) else AS_MOVIE)
    if data.external or data.is_virtual:
        got, do = "one that lies in other files", "copy the pictures into this file"
        raise movie_error(path, "a data set in the file itself", got, do)
    plist = data.id.get_create_plist()
    filters = [plist.get_filter(k)[0] for k in range(plist.get_nfilters())]
    unknown = [code for code in filters if not h5py.h5z.filter_avail(code)]
    if unknown:
        do = "write it with gzip, lzf or without compression"
        raise movie_error(path, "a compression that HDF5 has", f"filter {unknown[0]}", do)
    return data


def _follow(path: Path, file: Any, name: str) -> Any:
    """Return an object by its name, through groups of this file only, as links may lead to other files."""
    here = file
    for part in name.strip("/").split("/"):
        link = here.get(part, getlink=True) if isinstance(here, h5py.Group) and part else None
        if link is None:
            known = ", ".join(map(_shown, _candidates(file)[:5])) or "no data set (N, H, W)"
            raise movie_error(path, "a data set that the file has", f"'{name}'", f"name one of: {known}")
        if not isinstance(link, h5py.HardLink):
            do = "name the data set itself, copied into this file"
            raise movie_error(path, "a data set in the file itself", f"a link, '{part}'", do)
        here = here[part]
    return here


def _candidates(file: Any) -> list[str]:
    return _data_sets(file, _is_movie)


def _data_sets(file: Any, wanted: Callable[[Any], bool] = lambda thing: isinstance(thing, h5py.Dataset)) -> list[str]:
    found: list[str] = []
    seen = 0

    def visit(name: str, thing: Any) -> bool | None:
        nonlocal seen
        seen += 1
        if wanted(thing):
            found.append(name)
        return True if seen > MAX_OBJECTS else None  # other values than None end the walk

    file.visititems(visit)  # visits each object once, and follows no links to other files
    return found


def _is_movie(thing: Any) -> bool:
    if not isinstance(thing, h5py.Dataset) or thing.dtype not in (np.uint8, np.uint16):
        return False
    return thing.shape is not None and grey_shape(thing.shape) is not None


def _written(path: Path, data: Any, file_bytes: int) -> tuple[int, frozenset[int] | None]:
    """Return the number of frames up to the last written one, and the written chunks, None if contiguous."""
    stated, *frame_shape = (int(size) for size in data.shape)
    frame_bytes = math.prod(frame_shape) * data.dtype.itemsize
    if frame_bytes > LARGEST_RATIO * file_bytes:
        raise movie_error(path, "frames that the file can hold", f"{frame_shape} px", "record it again")
    if data.chunks is None:
        stored = min(data.id.get_storage_size(), file_bytes)
        return min(stated, stored // frame_bytes), None
    block, *tile = data.chunks
    claimed = block * math.prod(tile) * data.dtype.itemsize
    tiles = math.prod(-(-size // part) for size, part in zip(frame_shape, tile, strict=True))
    there: Counter[int] = Counter()

    def note(chunk: Any) -> None:
        if claimed <= LARGEST_RATIO * min(chunk.size, file_bytes):
            there[chunk.chunk_offset[0] // block] += 1

    data.id.chunk_iter(note)
    whole = frozenset(place for place, count in there.items() if count == tiles)
    count = min(stated, (max(whole, default=-1) + 1) * block)
    if count > MOST_MISSING * (len(whole) + 1) * block:
        raise movie_error(path, "frames", f"{len(whole) * block} of {count} that were never written", "record it again")
    return count, whole


def _times(data: Any, stated: int, count: int) -> tuple[Stamps | None, str, tuple[str, ...]]:
    """Return the times (count,), s, beside a data set, their unit in the file, or a remark why they are not used."""
    for name in TIMES:
        if not isinstance(data.parent.get(name, getlink=True), h5py.HardLink):
            continue
        times = data.parent[name]
        shapes = (stated,), (stated, 1), (1, count)  # the last two by MATLAB
        single = isinstance(times, h5py.Dataset) and times.shape in shapes and times.dtype.kind in "fiu"
        unit = times.attrs.get("units", "") if single else ""
        if not single:
            fault = f"it is not one number a frame: {getattr(times, 'shape', ())} for {stated} frames"
        elif "units" in times.attrs and not unit_in(unit):
            fault = f"in {_shown(unit)}, not in {', '.join(UNITS)}"
        elif times.external or times.is_virtual:
            fault = "it lies in other files"
        else:
            seconds = times[:count].reshape(-1)[:count].astype(np.float64) * UNITS[unit_in(unit) or "s"]
            if np.isfinite(seconds).all() and (np.diff(seconds) > 0).all():
                return seconds, unit_in(unit), ()
            fault = "it does not increase"
        return None, "", (f"its '{name}' is not used: {fault}",)
    return None, "", ()
