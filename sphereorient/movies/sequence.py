"""Movies as one picture file a frame: a folder, or a pattern with * or %05d."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import reduce
from itertools import pairwise
from pathlib import Path

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.indexed import IndexedMovie
from sphereorient.movies.luma import COLOUR_REMARK
from sphereorient.movies.movie import Grey
from sphereorient.movies.picture import LOSSY, PICTURES, read_picture

WILD = re.compile(r"(\*|%0?\d*d)")
DIGITS = re.compile(r"(\d+)")
MOST_MISSING = 100  # times the pictures that are there: beyond, the numbers are no frame numbers
SHOWN = 5  # gaps named in a remark
ENOUGH, TRIED = 5, 64  # pictures that tell the size; those looked at where the first ones are damaged


class SequenceMovie(IndexedMovie):
    """Picture files in the order of the number in their names; a number that is missing is an unreadable frame."""

    def __init__(self, path: Path) -> None:
        numbered = _numbered(path, sequence_files(path))
        numbers = sorted(numbered)
        step = max(1, reduce(math.gcd, (number - numbers[0] for number in numbers), 0))
        count = (numbers[-1] - numbers[0]) // step + 1
        if count > MOST_MISSING * (len(numbers) + 1):
            got, do = f"{len(numbers)} with numbers from {numbers[0]} to {numbers[-1]}", "number them by frame"
            raise MovieError(refusal(str(path), expected="pictures numbered by frame", got=got, do=do))
        self._files = {(number - numbers[0]) // step: numbered[number] for number in numbers}
        picture, colour = _usual_picture(path, list(self._files.values()))
        remarks = list(_number_remarks(numbers, step, count))
        if colour:
            remarks.append(COLOUR_REMARK)
        if self._files[0].suffix.lower() in LOSSY:
            remarks.append("JPEG loses fine detail of the pictures")
        form = f"{len(numbers)} pictures, {self._files[0].suffix.lower()[1:]}"
        super().__init__(path, form, count, (picture.shape[0], picture.shape[1]), picture.dtype, remarks=remarks)

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        for number in numbers:
            file = self._files.get(number)
            if file is None:
                raise self._damage(number, "no file of its number")
            try:
                picture, _ = read_picture(file)
            except MovieError as error:
                raise self._damage(number, f"{file.name}, which cannot be decoded") from error
            if (picture.shape, picture.dtype) != (self.frame_shape, self.dtype):
                raise self._damage(number, f"{file.name} with {picture.shape} of {picture.dtype}")
            yield picture


def is_pattern(path: Path) -> bool:
    """Return whether a path names many files: with * or %05d in its last part."""
    return WILD.search(path.name) is not None


def sequence_files(path: Path) -> list[Path]:
    """Return the pictures of a folder or pattern, sorted by name.

    Raises:
        MovieError: there are none.
    """
    folder, pattern = (path, "*") if path.is_dir() else (path.parent, path.name)
    if not folder.is_dir():
        raise MovieError(refusal(str(path), expected="a folder", got="no such folder", do="correct the path"))
    pieces = [r"\d+" if piece[0] == "%" else ".*" if piece == "*" else re.escape(piece) for piece in _pieces(pattern)]
    fits = re.compile("".join(pieces))
    files = sorted(
        file
        for file in folder.iterdir()
        if file.suffix.lower() in PICTURES and fits.fullmatch(file.name) and not file.name.startswith(".")
    )
    if not files:
        expected, do = f"pictures ({' '.join(PICTURES)})", "correct the folder or the pattern"
        raise MovieError(refusal(str(path), expected=expected, got="none", do=do))
    return files


def _pieces(pattern: str) -> list[str]:
    return [piece for piece in WILD.split(pattern) if piece]


def _numbered(path: Path, files: list[Path]) -> dict[int, Path]:
    """Return number -> file: the number is the one part of the names that differs from file to file."""
    names = [DIGITS.split(file.stem) for file in files]
    words = [(*name[0::2], file.suffix) for name, file in zip(names, files, strict=True)]
    do = "choose one movie's pictures by a pattern, such as cam1_*.tif"
    other = next((file for file, word in zip(files, words, strict=True) if word != words[0]), None)
    if other is not None:
        got = f"{files[0].name} beside {other.name}"
        raise MovieError(refusal(str(path), expected="names alike but for a number", got=got, do=do))
    numbers = [name[1::2] for name in names]
    varying = [place for place, column in enumerate(zip(*numbers, strict=True)) if len(set(map(int, column))) > 1]
    if len(files) > 1 and len(varying) != 1:
        got = f"{files[0].name} .. {files[-1].name}"
        raise MovieError(refusal(str(path), expected="names alike but for one number", got=got, do=do))
    place = varying[0] if varying else 0
    numbered = {int(number[place]) if number else 0: file for number, file in zip(numbers, files, strict=True)}
    if len(numbered) < len(files):
        got = f"{len(files) - len(numbered)} numbers twice"
        raise MovieError(refusal(str(path), expected="one picture of each number", got=got, do=do))
    return numbered


def _usual_picture(path: Path, files: list[Path]) -> tuple[Grey, bool]:
    """Return a picture of the size and type that most of the first ones have, and whether it is in colour."""
    found: list[tuple[Grey, bool]] = []
    last: MovieError | None = None
    for file in files[:TRIED]:
        try:
            found.append(read_picture(file))
        except MovieError as error:
            last = error
        if len(found) == ENOUGH:
            break
    if not found:
        got, do = "none that can be decoded", "export them again"
        raise MovieError(refusal(str(path), expected="pictures", got=got, do=do)) from last
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
