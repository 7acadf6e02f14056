"""From a path to a movie, by suffix."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.movie import Movie
from sphereorient.movies.npy import NpyMovie
from sphereorient.movies.video import VideoMovie

READERS: dict[str, Callable[[Path], Movie]] = {
    ".mkv": VideoMovie,
    ".avi": VideoMovie,
    ".mp4": VideoMovie,
    ".mov": VideoMovie,
    ".npy": NpyMovie,
}


def open_movie(path: Path | str) -> Movie:
    """Open a movie by the suffix of its file.

    Args:
        path: .mkv, .avi, .mp4, .mov (any codec that FFmpeg decodes) or .npy ((N, H, W), uint8 or uint16).

    Returns:
        The movie; use it in a `with` block.

    Raises:
        MovieError: missing, a folder, of another suffix, unreadable, or empty.
    """
    path = Path(path)
    if path.is_dir():
        raise MovieError(refusal(str(path), expected="a movie file", got="a folder", do="name the file in it"))
    if not path.is_file():
        raise MovieError(refusal(str(path), expected="a movie file", got="no such file", do="correct the path"))
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        got, do = f"'{path.suffix}'", "convert it, lossless: ffmpeg -i MOVIE -c:v ffv1 -pix_fmt gray MOVIE.mkv"
        raise MovieError(refusal(str(path), expected=f"a movie of type {' '.join(READERS)}", got=got, do=do))
    return reader(path)


def movie_files(path: Path | str) -> list[Path]:
    """Return the files that a movie is made of, for fingerprints: one, or the pictures of a sequence."""
    return [Path(path)]
