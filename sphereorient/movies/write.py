from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from itertools import chain
from pathlib import Path

import av
import h5py
import numpy as np
from numpy.typing import NDArray

from sphereorient.files.hdf5 import GuardedFile
from sphereorient.files.whole_file import put_aside, write_text
from sphereorient.movies.movie import Grey, movie_error

Times = NDArray[np.float64] | Sequence[float]
WRITERS = (".mkv", ".h5", ".hdf5")
PIXEL_FORMATS = {np.dtype(np.uint8): "gray", np.dtype(np.uint16): "gray16le"}
# Key frames only, with check sums: each frame can be read alone, and damage affects one frame.
FFV1_OPTIONS = {"level": "3", "g": "1", "slicecrc": "1"}
# With many slices, only those with the ball are decoded; they add 1.5 % to the file.
SLICES, SLICED_PX = "24", 96  # number of slices; least side of a picture with so many


def write_movie(
    path: Path | str,
    frames: Iterable[Grey | None],
    times_s: Times | None = None,
    frame_rate_hz: float = 25.0,
) -> int:
    """Write grey frames (H, W), uint8 or uint16, as FFV1 (.mkv) or HDF5 (.h5, .hdf5); return their number.
    A frame None keeps its number: unreadable in HDF5, black in .mkv. `times_s` (N,), s, go into HDF5, or beside the
    .mkv into `MOVIE.times.csv`, for `times:` of experiment.yaml; only players use `frame_rate_hz` of .mkv. Raises
    MovieError: another suffix, no frame, or frames of different size or type; OutputError: the file cannot be written;
    an old file is kept.
    """
    path = Path(path)
    if path.suffix.lower() not in WRITERS:
        raise movie_error(path, " ".join(WRITERS), f"'{path.suffix}'", "end its name in one of these")
    if path.suffix.lower() != ".mkv":
        with put_aside(path, also=(RuntimeError,)) as aside:
            return _write_hdf5(aside, path, frames, times_s)
    count = write_ffv1(path, frames, frame_rate_hz)
    if times_s is not None:
        text = "".join(f"{time!r}\n" for time in np.asarray(times_s, np.float64).tolist())
        write_text(times_path(path), f"time_s\n{text}")
    return count


def times_path(path: Path) -> Path:
    """Return the path of the times of an .mkv."""
    return path.with_suffix(".times.csv")


def write_ffv1(path: Path | str, frames: Iterable[Grey | None], frame_rate_hz: float) -> int:
    """Write grey frames as FFV1 in Matroska; see `write_movie`."""
    path = Path(path)
    most = max(1, min(1_000_000, int(2e9 / max(frame_rate_hz, 1.0))))  # numerators have 31 bits
    rate = Fraction(frame_rate_hz).limit_denominator(most)
    count, first, checked = _checked(path, frames)
    black = np.zeros_like(first)
    with put_aside(path, also=(av.FFmpegError,)) as aside, av.open(str(aside), "w", format="matroska") as container:
        many = {"slices": SLICES} if min(first.shape) >= SLICED_PX else {}
        stream = container.add_stream("ffv1", rate=rate, options=FFV1_OPTIONS | many)
        stream.height, stream.width = first.shape
        stream.pix_fmt = PIXEL_FORMATS[first.dtype]
        number = -1
        for number, picture in enumerate(chain([None] * count, checked)):
            whole = np.ascontiguousarray(black if picture is None else picture)
            frame = av.VideoFrame.from_ndarray(whole, format=stream.pix_fmt)
            frame.pts, frame.time_base = number, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return number + 1


def _write_hdf5(aside: Path, path: Path, frames: Iterable[Grey | None], times_s: Times | None) -> int:
    """Write frames as the data set `frames` (N, H, W), one chunk each, and times as `time` (N,)."""
    count, first, checked = _checked(path, frames)
    with GuardedFile(aside) as guarded:
        with h5py.File(guarded, "w") as file:
            file.attrs["made_by"] = "sphereorient"
            data = file.create_dataset(
                "frames",
                shape=(0, *first.shape),
                maxshape=(None, *first.shape),
                dtype=first.dtype,
                chunks=(1, *first.shape),
                compression="gzip",
                compression_opts=1,  # of gzip: higher ones cost twice the time for 4 % less
            )
            data.attrs["units"], data.attrs["description"] = "grey level", "pictures, row 0 on top"
            for picture in checked:
                if picture is not None:
                    if count >= len(data):
                        data.resize(2 * count + 64, axis=0)
                    data[count] = picture
                    guarded.check()
                count += 1
            data.resize(count, axis=0)
            if times_s is not None:
                time = file.create_dataset("time", data=np.asarray(times_s, np.float64))
                time.attrs["units"], time.attrs["description"] = "s", "time of each frame"
        guarded.check()
    return count


def _checked(path: Path, frames: Iterable[Grey | None]) -> tuple[int, Grey, Iterator[Grey | None]]:
    """Return the number of leading None, the first picture, and all frames from it on, checked one by one."""
    rest = iter(frames)
    dead = 0
    for picture in rest:
        if picture is not None:
            break
        dead += 1
    else:
        got = f"{dead}, none of which is readable" if dead else "none"
        raise movie_error(path, "frames to write", got, "pass at least one")
    if picture.ndim != 2 or picture.dtype not in PIXEL_FORMATS:
        expected, got = "frames (H, W) of uint8 or uint16", f"{picture.shape} of {picture.dtype}"
        raise movie_error(f"{path}, frame {dead}", expected, got, "convert them")
    return dead, picture, _alike(path, dead, picture, chain([picture], rest))


def _alike(path: Path, number: int, first: Grey, frames: Iterable[Grey | None]) -> Iterator[Grey | None]:
    for at, picture in enumerate(frames, start=number):
        if picture is not None and (picture.shape != first.shape or picture.dtype != first.dtype):
            expected, got = f"{first.shape} of {first.dtype}", f"{picture.shape} of {picture.dtype}"
            raise movie_error(f"{path}, frame {at}", expected, got, "make them equal in size and type")
        yield picture
