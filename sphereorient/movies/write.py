from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from fractions import Fraction
from itertools import chain, count
from pathlib import Path

import av
import h5py
import numpy as np
from numpy.typing import NDArray

from sphereorient.files.hdf5 import GuardedFile
from sphereorient.files.whole_file import put_aside, write_text
from sphereorient.movies.movie import Grey, refused

WRITERS = (".mkv", ".h5", ".hdf5")
PIXEL_FORMATS = {np.dtype(np.uint8): "gray", np.dtype(np.uint16): "gray16le"}
# Every frame a key frame, with check sums: any frame can be read alone, and damage stays in its frame.
FFV1_OPTIONS = {"level": "3", "g": "1", "slicecrc": "1"}
# Of many slices only those that hold the ball are decoded; they cost 1.5 % of the file.
SLICES, SLICED_PX = "24", 96  # and the least side of a picture that is cut into so many
FAULTS = (OSError, RuntimeError, av.FFmpegError)  # of a disk that is full; HDF5 raises either of the first two


Add = Callable[[Grey | None, float | None], object]  # takes the next frame of a movie, and its time, s, where known


def write_movie(
    path: Path | str,
    frames: Iterable[Grey | None],
    times_s: NDArray[np.float64] | None = None,
    frame_rate_hz: float = 25.0,
) -> int:
    """Write grey frames (H, W), uint8 or uint16, as FFV1 (.mkv) or HDF5 (.h5, .hdf5); return their number.
    A frame None keeps its number: unreadable in HDF5, black in .mkv. `times_s` (N,), s, go into the HDF5 file, or
    beside the .mkv into `MOVIE.times.csv`, for `times:` of experiment.yaml; players alone use `frame_rate_hz` of .mkv.
    Raises MovieError: another suffix, no frame, or frames of different size or type; OutputError: the file cannot be
    written; an old file is kept.
    """
    path = Path(path)
    if path.suffix.lower() not in WRITERS:
        raise refused(path, " ".join(WRITERS), f"'{path.suffix}'", "end its name in one of these")
    dead, first, checked = _checked(path, frames)
    stamps: list[float] = [] if times_s is None else np.asarray(times_s, np.float64).tolist()
    written, following = 0, iter(stamps)
    with put_aside(path, also=FAULTS) as aside, new_movie(aside, first.shape, first.dtype, frame_rate_hz) as add:
        for picture in chain([None] * dead, checked):
            add(picture, next(following, None))
            written += 1
    if times_s is not None and path.suffix.lower() == ".mkv":
        write_times(path, stamps)
    return written


def write_ffv1(path: Path | str, frames: Iterable[Grey | None], frame_rate_hz: float) -> int:
    """Write grey frames as FFV1 in Matroska, an .mkv; see `write_movie`."""
    return write_movie(path, frames, frame_rate_hz=frame_rate_hz)


def times_path(path: Path) -> Path:
    """Return where the times of an .mkv are written."""
    return path.with_suffix(".times.csv")


def write_times(path: Path, times_s: Iterable[float]) -> None:
    """Write the times of an .mkv, s, as a table beside it; raise OutputError if that fails."""
    write_text(times_path(path), "time_s\n" + "".join(f"{time_s!r}\n" for time_s in times_s))


def new_movie(path: Path, shape: tuple[int, ...], dtype: np.dtype, rate_hz: float) -> AbstractContextManager[Add]:
    """Open a file, FFV1 for .mkv, else HDF5, which gives what adds frames (H, W); `FAULTS` are raised where it cannot
    be written. Times are of HDF5 alone.
    """
    return _ffv1(path, shape, dtype, rate_hz) if path.suffix.lower() == ".mkv" else _hdf5(path, shape, dtype)


@contextmanager
def _ffv1(path: Path, shape: tuple[int, ...], dtype: np.dtype, frame_rate_hz: float) -> Iterator[Add]:
    rate, numbers = Fraction(frame_rate_hz).limit_denominator(1_000_000), count()
    black, pixels = np.zeros(shape, dtype), PIXEL_FORMATS[dtype]
    with av.open(str(path), "w", format="matroska") as container:
        many = {"slices": SLICES} if min(shape) >= SLICED_PX else {}
        stream = container.add_stream("ffv1", rate=rate, options=FFV1_OPTIONS | many)
        stream.height, stream.width = shape
        stream.pix_fmt = pixels

        def add(picture: Grey | None, time_s: float | None) -> None:
            whole = np.ascontiguousarray(black if picture is None else picture)
            frame = av.VideoFrame.from_ndarray(whole, format=pixels)
            frame.pts, frame.time_base = next(numbers), 1 / rate
            container.mux(stream.encode(frame))

        yield add
        container.mux(stream.encode(None))


@contextmanager
def _hdf5(path: Path, shape: tuple[int, ...], dtype: np.dtype) -> Iterator[Add]:
    """Open a file of the data set `frames` (N, H, W), one chunk each, and `time` (N,) where there are times."""
    numbers, times_s = count(), list[float]()
    with GuardedFile(path) as guarded:
        with h5py.File(guarded, "w") as file:
            file.attrs["made_by"] = "sphereorient"
            data = file.create_dataset(
                "frames",
                shape=(0, *shape),
                maxshape=(None, *shape),
                dtype=dtype,
                chunks=(1, *shape),
                compression="gzip",
                compression_opts=1,  # of gzip: higher ones cost twice the time for 4 % less
            )
            data.attrs["units"], data.attrs["description"] = "grey level", "pictures, row 0 on top"

            def add(picture: Grey | None, time_s: float | None) -> None:
                number = next(numbers)
                if time_s is not None:
                    times_s.append(time_s)
                if picture is not None:
                    if number >= len(data):
                        data.resize(2 * number + 64, axis=0)
                    data[number] = picture
                    guarded.check()

            yield add
            data.resize(next(numbers), axis=0)
            if times_s:
                time = file.create_dataset("time", data=np.asarray(times_s, np.float64))
                time.attrs["units"], time.attrs["description"] = "s", "time of each frame"
        guarded.check()


def _checked(path: Path, frames: Iterable[Grey | None]) -> tuple[int, Grey, Iterator[Grey | None]]:
    """Return how many leading frames are None, the first picture, and all frames from it on, checked one by one."""
    rest = iter(frames)
    dead = 0
    for picture in rest:
        if picture is not None:
            break
        dead += 1
    else:
        got = f"{dead}, none of which is readable" if dead else "none"
        raise refused(path, "frames to write", got, "pass at least one")
    if picture.ndim != 2 or picture.dtype not in PIXEL_FORMATS:
        expected, got = "frames (H, W) of uint8 or uint16", f"{picture.shape} of {picture.dtype}"
        raise refused(f"{path}, frame {dead}", expected, got, "convert them")
    return dead, picture, _alike(path, dead, picture, chain([picture], rest))


def _alike(path: Path, number: int, first: Grey, frames: Iterable[Grey | None]) -> Iterator[Grey | None]:
    for at, picture in enumerate(frames, start=number):
        if picture is not None and (picture.shape != first.shape or picture.dtype != first.dtype):
            expected, got = f"{first.shape} of {first.dtype}", f"{picture.shape} of {picture.dtype}"
            raise refused(f"{path}, frame {at}", expected, got, "make them alike")
        yield picture
