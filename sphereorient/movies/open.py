"""From a path to a movie, by suffix."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.cine import CineMovie
from sphereorient.movies.hdf5 import Hdf5Movie, split_path
from sphereorient.movies.movie import Movie
from sphereorient.movies.npy import NpyMovie
from sphereorient.movies.picture import PICTURES
from sphereorient.movies.sequence import SequenceMovie, is_pattern, sequence_files
from sphereorient.movies.tiff import TiffMovie
from sphereorient.movies.video import VideoMovie

READERS: dict[str, Callable[[Path], Movie]] = {
    ".mkv": VideoMovie,
    ".avi": VideoMovie,
    ".mp4": VideoMovie,
    ".mov": VideoMovie,
    ".npy": NpyMovie,
    ".cine": CineMovie,
    ".tif": TiffMovie,
    ".tiff": TiffMovie,
    ".h5": Hdf5Movie,
    ".hdf5": Hdf5Movie,
}


def open_movie(path: Path | str) -> Movie:
    """Open a movie by the suffix of its file.

    Args:
        path: .mkv, .avi, .mp4, .mov (any codec that FFmpeg decodes), .cine, .tif, .tiff (a stack), .npy ((N, H, W),
            uint8 or uint16), .h5, .hdf5 (its only such data set, or `file.h5::group/dataset`); or single pictures: a
            folder, or a pattern with * or %05d in its last part.

    Returns:
        The movie; use it in a `with` block.

    Raises:
        MovieError: missing, of another suffix, unreadable, or empty.
    """
    path = Path(path)
    file = split_path(path)[0]
    if _is(path, Path.is_dir) or (is_pattern(path) and not _is(file, Path.is_file)):
        return SequenceMovie(path)
    if not _is(file, Path.is_file):
        raise MovieError(refusal(str(path), expected="a movie file", got="no such file", do="correct the path"))
    suffix = file.suffix.lower()
    if suffix in PICTURES and suffix not in READERS:
        do = f"name all of them: their folder, or a pattern such as '*{file.suffix}'"
        raise MovieError(refusal(str(path), expected="a movie", got="one picture", do=do))
    reader = READERS.get(suffix)
    if reader is None:
        got, do = f"'{path.suffix}'", "convert it, lossless: ffmpeg -i MOVIE -c:v ffv1 -pix_fmt gray MOVIE.mkv"
        expected = f"a movie of type {' '.join(READERS)} or a folder of pictures"
        raise MovieError(refusal(str(path), expected=expected, got=got, do=do))
    return reader(path)


def _is(path: Path, kind: Callable[[Path], bool]) -> bool:
    """Ask what a path is, also one too long for any file, at which Path's own methods raise."""
    try:
        return kind(path)
    except OSError:
        return False


def movie_files(path: Path | str) -> list[Path]:
    """Return the files that a movie is made of: one, or the pictures of a sequence.

    Args:
        path: as `open_movie` takes it.

    Raises:
        MovieError: a folder or a pattern without pictures.
    """
    path = Path(path)
    file = split_path(path)[0]
    many = _is(path, Path.is_dir) or (is_pattern(path) and not _is(file, Path.is_file))
    return sequence_files(path) if many else [file]
