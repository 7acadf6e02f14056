"""Writing movies without loss, whatever they were read from."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, refusal
from sphereorient.files.hdf5 import GuardedFile
from sphereorient.files.outputs import put_aside
from sphereorient.movies.ffv1 import check_alike, check_kind, write_ffv1
from sphereorient.movies.movie import Grey

PLAYER_RATE_HZ = 25.0
FRAMES, TIME = "frames", "time"  # names of the data sets
LEVEL = 1  # of gzip: higher ones cost twice the time for 4 % less
WRITERS = (".mkv", ".h5", ".hdf5")


def write_movie(
    path: Path | str,
    frames: Iterable[Grey | None],
    times_s: NDArray[np.float64] | None = None,
    frame_rate_hz: float = PLAYER_RATE_HZ,
) -> int:
    """Write grey frames as FFV1 (.mkv) or HDF5 (.h5, .hdf5), aside and then under their name, and return their number.

    A frame that is None keeps its number: in HDF5 nothing is written for it, and reading finds it unreadable as before;
    in .mkv it is black. HDF5 holds the times beside the frames; .mkv has no place for exact ones, and they go to a
    table beside it, `MOVIE.times.csv`, which experiment.yaml takes as `times:`.

    Args:
        path: the movie; an old one is replaced.
        frames: (H, W) uint8 or uint16 each, all alike; taken one by one.
        times_s: (N,) s, of the frames, where they are known.
        frame_rate_hz: of .mkv, for players only.

    Raises:
        MovieError: another suffix, no frame, or frames that are not alike.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in WRITERS:
        do = "end its name in one of these"
        raise MovieError(refusal(str(path), expected=" ".join(WRITERS), got=f"'{path.suffix}'", do=do))
    if path.suffix.lower() != ".mkv":
        return write_hdf5(path, frames, times_s)
    count = write_ffv1(path, _black_where_none(path, frames), frame_rate_hz)
    if times_s is not None:
        text = "".join(f"{time!r}\n" for time in np.asarray(times_s, np.float64).tolist())
        with put_aside(times_path(path)) as aside:
            aside.write_text(f"time_s\n{text}", encoding="utf-8")
    return count


def times_path(path: Path) -> Path:
    """Return where the times of an .mkv are written."""
    return path.with_suffix(".times.csv")


def write_hdf5(path: Path, frames: Iterable[Grey | None], times_s: NDArray[np.float64] | None = None) -> int:
    """Write frames as the data set `frames` (N, H, W), a chunk each, and times as `time` (N,); see `write_movie`."""
    with put_aside(path, also=(RuntimeError,)) as aside:
        return _fill(aside, path, frames, times_s)


def _fill(aside: Path, path: Path, frames: Iterable[Grey | None], times_s: NDArray[np.float64] | None) -> int:
    dead, first, rest = _first(path, frames)
    with GuardedFile(aside) as guarded:
        with h5py.File(guarded, "w") as file:
            data = _data_set(file, first)
            count = dead
            for picture in chain([first], rest):
                if picture is not None:
                    check_alike(path, count, picture, first)
                    if count >= len(data):
                        data.resize(2 * count + 64, axis=0)
                    data[count] = picture
                    guarded.check()
                count += 1
            data.resize(count, axis=0)
            if times_s is not None:
                time = file.create_dataset(TIME, data=np.asarray(times_s, np.float64))
                time.attrs["units"], time.attrs["description"] = "s", "time of each frame"
        guarded.check()
    return count


def _data_set(file: Any, picture: Grey) -> Any:
    data = file.create_dataset(
        FRAMES,
        shape=(0, *picture.shape),
        maxshape=(None, *picture.shape),
        dtype=picture.dtype,
        chunks=(1, *picture.shape),
        compression="gzip",
        compression_opts=LEVEL,
    )
    data.attrs["units"], data.attrs["description"] = "grey level", "pictures, row 0 on top"
    return data


def _first(path: Path, frames: Iterable[Grey | None]) -> tuple[int, Grey, Iterable[Grey | None]]:
    """Return how many frames at the start are None, the first that is not, and those after it."""
    rest = iter(frames)
    dead = 0
    for picture in rest:
        if picture is not None:
            check_kind(path, dead, picture)
            return dead, picture, rest
        dead += 1
    got = f"{dead}, none of which is readable" if dead else "none"
    raise MovieError(refusal(str(path), expected="frames to write", got=got, do="pass at least one"))


def _black_where_none(path: Path, frames: Iterable[Grey | None]) -> Iterable[Grey]:
    dead, first, rest = _first(path, frames)
    black = np.zeros_like(first)
    for picture in chain([black] * dead, [first], rest):
        yield black if picture is None else picture
