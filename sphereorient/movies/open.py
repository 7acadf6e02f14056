from collections.abc import Callable
from pathlib import Path

from sphereorient.movies.cine import CineMovie
from sphereorient.movies.hdf5 import hdf5_movie, split_path
from sphereorient.movies.movie import Movie, movie_error
from sphereorient.movies.npy import NpyMovie
from sphereorient.movies.sequence import PICTURES, SequenceMovie, is_pattern, sequence_files
from sphereorient.movies.tiff import TiffMovie
from sphereorient.movies.video import VideoMovie

READERS: dict[str, Callable[[Path], Movie]] = {
    **dict.fromkeys((".mkv", ".avi", ".mp4", ".mov"), VideoMovie),
    ".npy": NpyMovie,
    ".cine": CineMovie,
    **dict.fromkeys((".tif", ".tiff"), TiffMovie),
    **dict.fromkeys((".h5", ".hdf5", ".mat"), hdf5_movie),
}
LOSSLESS = "convert it, lossless: ffmpeg -i FILE{} -c:v ffv1 -pix_fmt gray FILE.mkv"
PHOTRON = "convert it in Python: numpy.save('FILE.npy', pyMRAW.load_video('FILE.cihx')[0]), or .cih; pip install pyMRAW"
CONVERT = {  # files that ffmpeg does not read, by suffix
    **dict.fromkeys((".mraw", ".cih", ".cihx"), PHOTRON),
    ".seq": "convert it in Python: numpy.save('FILE.npy', numpy.array(pims.NorpixSeq('FILE.seq'))); pip install pims",
    ".fmf": "convert it with motmot.FlyMovieFormat: fmf2bmps FILE.fmf --extension=png --outdir=FILE; name that folder",
    ".slp": "name the labelled movie: this file holds labels, and at most the labelled frames",
}


def open_movie(path: Path | str) -> Movie:
    """Open a movie by the suffix of its file.
    Videos: .mkv, .avi, .mp4, .mov (any codec of FFmpeg), .cine. Stacks of uint8 or uint16: .tif, .tiff, .npy (N, H, W),
    .h5, .hdf5, .mat of v7.3 (its only such data set, or `file.h5::group/dataset`). Pictures: one, a folder, or a
    pattern with * or %05d. Raises MovieError: missing, of another suffix, unreadable, or empty.
    """
    path = Path(path)
    if _is_sequence(path):
        return SequenceMovie(path)
    file = split_path(path)[0]
    if not _is(file, Path.is_file):
        raise movie_error(path, "a movie file", "no such file", "correct the path")
    suffix = file.suffix.lower()
    reader = READERS.get(suffix, SequenceMovie if suffix in PICTURES else None)
    if reader is None:
        expected = f"a movie of type {' '.join(READERS)} or a folder of pictures"
        do = CONVERT.get(suffix, LOSSLESS.format(suffix)).replace("FILE", file.stem)
        raise movie_error(path, expected, f"'{path.suffix}'", do)
    return reader(path)


def is_movie(path: Path) -> bool:
    """Return whether a file is a movie by the suffix of its name."""
    return path.suffix.lower() in (*READERS, *PICTURES) and _is(path, Path.is_file)


def movie_files(path: Path | str) -> list[Path]:
    """Return the files of a movie: one, or the pictures of a sequence (MovieError without any)."""
    path = Path(path)
    return sequence_files(path) if _is_sequence(path) else [split_path(path)[0]]


def _is_sequence(path: Path) -> bool:
    return _is(path, Path.is_dir) or (is_pattern(path) and not _is(split_path(path)[0], Path.is_file))


def _is(path: Path, kind: Callable[[Path], bool]) -> bool:
    """Call `Path.is_dir` or `Path.is_file`; False for names too long for any file."""
    try:
        return kind(path)
    except OSError:
        return False
