import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import reduce
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from sphereorient.errors import MovieError
from sphereorient.files.picture import claimed_pixels, decoded, luma
from sphereorient.files.whole_file import LARGEST_RATIO
from sphereorient.movies.movie import COLOUR_REMARK, GAMMA_CODED, MOST_MISSING, MOST_PIXELS, Grey, Movie, movie_error
from sphereorient.movies.tiff import TiffMovie

TIFF = (".tif", ".tiff")
LOSSY = (".jpg", ".jpeg")
PICTURES = (".png", ".bmp", ".pgm", ".ppm", *LOSSY, *TIFF)
WILD = re.compile(r"(\*|%0?\d*d)")
DIGITS = re.compile(r"(\d+)")
SHOWN = 5  # gaps named in a remark
ENOUGH, TRIED = 5, 64  # pictures that determine the size; most tried if the first ones are damaged
LARGEST_BYTES = 1 << 28  # of a picture file


class SequenceMovie(Movie):
    """Picture files ordered by the number in their names; a missing number is an unreadable frame."""

    def __init__(self, path: Path) -> None:
        numbered = _numbered(path, sequence_files(path))
        numbers = sorted(numbered)
        step = max(1, reduce(math.gcd, (number - numbers[0] for number in numbers), 0))
        count = (numbers[-1] - numbers[0]) // step + 1
        if count > MOST_MISSING * (len(numbers) + 1):
            got = f"{len(numbers)} with numbers from {numbers[0]} to {numbers[-1]}"
            raise movie_error(path, "pictures numbered by frame", got, "number them by frame")
        self._files = {(number - numbers[0]) // step: numbered[number] for number in numbers}
        picture, colour = _usual_picture(path, list(self._files.values()))
        suffix = self._files[0].suffix.lower()
        form = f"{len(numbers)} pictures, {suffix[1:]}"
        super().__init__(path, form, count, (picture.shape[0], picture.shape[1]), picture.dtype)
        self.photographs = self.dtype == np.uint8 and suffix not in TIFF
        self.remarks = (
            *_number_remarks(numbers, step, count),
            *([COLOUR_REMARK] if colour else []),
            *([f"JPEG loses fine detail of the pictures; {GAMMA_CODED}"] if suffix in LOSSY else []),
        )

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        for number in numbers:
            file = self._files.get(number)
            if file is None:
                raise self._damage(number, "no file of its number")
            try:
                picture, _ = _read_picture(file)
            except MovieError as error:
                raise self._damage(number, f"{file.name}, which cannot be decoded") from error
            if (picture.shape, picture.dtype) != (self.frame_shape, self.dtype):
                raise self._damage(number, f"{file.name} with {picture.shape} of {picture.dtype}")
            yield picture


def is_pattern(path: Path) -> bool:
    """Return whether the last part of a path has * or %05d."""
    return WILD.search(path.name) is not None


def sequence_files(path: Path) -> list[Path]:
    """Return the pictures of a folder or pattern, sorted by name; MovieError without any."""
    folder, pattern = (path, "*") if path.is_dir() else (path.parent, path.name)
    if not folder.is_dir():
        raise movie_error(path, "a folder", "no such folder", "correct the path")
    pieces = [piece for piece in WILD.split(pattern) if piece]
    fits = re.compile("".join(r"\d+" if p[0] == "%" else ".*" if p == "*" else re.escape(p) for p in pieces))
    files = sorted(
        file
        for file in folder.iterdir()
        if file.suffix.lower() in PICTURES and fits.fullmatch(file.name) and not file.name.startswith(".")
    )
    if not files:
        raise movie_error(path, f"pictures ({' '.join(PICTURES)})", "none", "correct the folder or the pattern")
    return files


def _numbered(path: Path, files: list[Path]) -> dict[int, Path]:
    """Return files by number, the only part of the names that differs between files."""
    names = [DIGITS.split(file.stem) for file in files]
    words = [(*name[0::2], file.suffix) for name, file in zip(names, files, strict=True)]
    do = "choose one movie's pictures by a pattern, such as cam1_*.tif"
    other = next((file for file, word in zip(files, words, strict=True) if word != words[0]), None)
    if other is not None:
        raise movie_error(path, "names alike but for a number", f"{files[0].name} beside {other.name}", do)
    numbers = [name[1::2] for name in names]
    varying = [place for place, column in enumerate(zip(*numbers, strict=True)) if len(set(map(int, column))) > 1]
    if len(files) > 1 and len(varying) != 1:
        raise movie_error(path, "names alike but for one number", f"{files[0].name} .. {files[-1].name}", do)
    place = varying[0] if varying else 0
    numbered = {int(number[place]) if number else 0: file for number, file in zip(numbers, files, strict=True)}
    if len(numbered) < len(files):
        raise movie_error(path, "one picture of each number", f"{len(files) - len(numbered)} numbers twice", do)
    return numbered


def _usual_picture(path: Path, files: list[Path]) -> tuple[Grey, bool]:
    """Return a picture of the most frequent size and type among the first ones, and whether it is in colour."""
    found: list[tuple[Grey, bool]] = []
    last: MovieError | None = None
    for file in files[:TRIED]:
        try:
            found.append(_read_picture(file))
        except MovieError as error:
            last = error
        if len(found) == ENOUGH:
            break
    if not found:
        raise movie_error(path, "pictures", "none that can be decoded", "export them again") from last
    (shape, dtype), _ = Counter((picture.shape, picture.dtype) for picture, _ in found).most_common(1)[0]
    return next(one for one in found if (one[0].shape, one[0].dtype) == (shape, dtype))


def _number_remarks(numbers: list[int], step: int, count: int) -> Iterator[str]:
    if step > 1:
        yield f"numbered in steps of {step}: taken as consecutive frames"
    gaps = [(a + step, b - step) for a, b in pairwise(numbers) if b > a + step]
    if gaps:
        named = [f"{a}" if a == b else f"{a} .. {b}" for a, b in gaps[:SHOWN]]
        more = [f"{len(gaps) - SHOWN} more gaps"] if len(gaps) > SHOWN else []
        yield f"{count - len(numbers)} pictures are missing: {', '.join(named + more)}"


def _read_picture(path: Path) -> tuple[Grey, bool]:
    """Return a picture (H, W), uint8 or uint16, row 0 on top, and whether it was in colour (else MovieError)."""
    if not path.is_file():
        raise movie_error(path, "a picture", "no such file", "find it, or record it as missing")
    if path.suffix.lower() in TIFF:
        movie = TiffMovie(path)
        if len(movie) != 1:
            raise movie_error(path, "one picture a file", f"{len(movie)} pages", "name the stack itself as the movie")
        return movie.sample([0])[0], movie.colour
    if path.stat().st_size > LARGEST_BYTES:
        raise movie_error(path, "a picture", "a file as large as a movie", "export it again")
    content = path.read_bytes()
    claimed = claimed_pixels(content) or 0
    if claimed > MOST_PIXELS:
        expected, do = f"at most {MOST_PIXELS / 1e6:.3g} million pixels", "cut out the part where the ball is"
        raise movie_error(path, expected, f"{claimed / 1e6:.3g} million", do)
    if claimed > LARGEST_RATIO * len(content):
        raise movie_error(path, "a picture", "a header that claims more than the file can hold", "export it again")
    # As stored: not rotated by the camera's orientation tag, nor reduced to 8 bit.
    picture = decoded(content, cv2.IMREAD_UNCHANGED) if claimed else None
    if picture is None:
        raise movie_error(path, "a picture", "none that can be decoded", "export it again")
    if picture.dtype not in (np.uint8, np.uint16):
        raise movie_error(path, "8 or 16 bit", str(picture.dtype), "export it as 8 or 16 bit grey")
    if picture.ndim == 2:
        return picture, False
    if picture.shape[2] < 3:  # grey with opacity
        return np.ascontiguousarray(picture[..., 0]), False
    blue, green, red = np.moveaxis(picture[..., :3], 2, 0)
    return luma(red, green, blue), True
