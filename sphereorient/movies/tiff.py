"""Stacks of pictures in one TIFF file: pages, or ImageJ's contiguous values."""

from __future__ import annotations

import logging
import lzma
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.indexed import IndexedMovie, missing_remark
from sphereorient.movies.luma import COLOUR_REMARK, luma
from sphereorient.movies.movie import Grey
from sphereorient.movies.tiff_lzw import LZW, decode_lzw

if TYPE_CHECKING:
    from tifffile import TiffFile

# What tifffile raises on files that are no TIFF or damaged ones, as it runs into what is not as it should be.
DAMAGE = (
    *(ValueError, TypeError, LookupError, ArithmeticError, AttributeError, OSError, EOFError, RuntimeError),
    *(MemoryError, AssertionError, struct.error, zlib.error, lzma.LZMAError),
)
WHITE_IS_ZERO, BLACK_IS_ZERO, RGB = 0, 1, 2  # PhotometricInterpretation
UNCOMPRESSED = 1
ORIENTATION = 274  # tag: where row 0 and column 0 are
STEPS = {1: (1, 1), 2: (1, -1), 3: (-1, -1), 4: (-1, 1)}  # of rows and columns, by orientation
FRAMES_A_MAP = 64  # see NpyMovie: keeps memory flat
LARGEST_RATIO = 1200  # by which a picture of one grey value shrinks at most

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # damage is told by our own refusals


class TiffMovie(IndexedMovie):
    """A stack in a .tif file, classic or BigTIFF, 8 or 16 bit, grey or colour."""

    def __init__(self, path: Path) -> None:
        with _opened(path) as file:
            page = _first_page(path, file)
            form = f"TIFF, {np.dtype(page.dtype).itemsize * 8} bit, {_compression(page)}"
            pages, told = len(file.pages), _told(path, file)
            self._kind = (page.shape, page.dtype)
            self.colour = page.photometric == RGB
            self._planar = page.axes == "SYX"
            self._white_is_zero = page.photometric == WHITE_IS_ZERO
            self._steps = _steps(path, page)
            self._stored = np.dtype(page.dtype).newbyteorder(file.byteorder)
            whole = self._whole_values(path, page) if told > pages else 0
            self._offset = int(page.dataoffsets[0]) if whole > pages else None
            count = min(told, whole) if self._offset is not None else pages
        remarks = missing_remark(told, count) + ((COLOUR_REMARK,) if self.colour else ())
        remarks += ("stored with white as 0: turned round",) if self._white_is_zero else ()
        shape = (int(page.imagelength), int(page.imagewidth))
        super().__init__(path, form, count, shape, np.dtype(page.dtype), remarks=remarks)

    @staticmethod
    def _whole_values(path: Path, page: Any) -> int:
        """Return how many pictures fit between the first one's values and the end of the file.

        ImageJ's stacks above 4 GB have one page only, and a stack that was cut off has lost its table of pages: in both
        the values follow one another without gaps.
        """
        if page.compression != UNCOMPRESSED or not page.is_contiguous:
            return 0
        return int((path.stat().st_size - page.dataoffsets[0]) // page.nbytes)

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        return self._read_pages(numbers) if self._offset is None else self._read_values(self._offset, numbers)

    def _read_values(self, offset: int, numbers: Sequence[int]) -> Iterator[Grey]:
        for start in range(0, len(numbers), FRAMES_A_MAP):
            shape = (self._count, *self._kind[0])
            values: Grey = np.memmap(self.path, self._stored, "r", offset, shape)
            for number in numbers[start : start + FRAMES_A_MAP]:
                yield self._grey(values[number])

    def _read_pages(self, numbers: Sequence[int]) -> Iterator[Grey]:
        with _opened(self.path) as file:
            for number in numbers:
                yield self._page(file, number)

    def _page(self, file: TiffFile, number: int) -> Grey:
        try:
            page: Any = file.pages[number]
            if (page.shape, page.dtype) != self._kind:
                raise self._damage(number, f"a page {page.shape} of {page.dtype}")
            _check_claim(page)
            return self._grey(decode_lzw(page) if page.compression == LZW else page.asarray())
        except DAMAGE as error:
            raise self._damage(number, words(error)) from error

    def _grey(self, values: NDArray[Any]) -> Grey:
        """Return grey values as they are to be seen: of the machine's byte order, black as 0, row 0 on top."""
        values = values.astype(self.dtype)
        if values.ndim == 3:
            channels = values if self._planar else np.moveaxis(values, 2, 0)
            values = luma(*channels[:3]) if self.colour else channels[0]
        if self._white_is_zero:
            values = np.iinfo(self.dtype).max - values
        rows, columns = self._steps
        return np.ascontiguousarray(values[::rows, ::columns])


def words(error: Exception) -> str:
    """Return an error of tifffile in one line."""
    return f"'{str(error).splitlines()[0][:200]}'" if str(error) else type(error).__name__


@contextmanager
def _opened(path: Path) -> Iterator[TiffFile]:
    from tifffile import TiffFile

    try:
        file = TiffFile(path)
    except DAMAGE as error:
        do = "export it again"
        raise MovieError(refusal(str(path), expected="a TIFF file", got=words(error), do=do)) from error
    with file:
        yield file


def _first_page(path: Path, file: TiffFile) -> Any:
    """Return the first page, refused where its pixels are not grey or colour of 8 or 16 bit."""
    try:
        page: Any = file.pages[0]
        kind = f"{np.dtype(page.dtype)}, photometric {page.photometric}, {page.shape}"
        known = page.photometric in (WHITE_IS_ZERO, BLACK_IS_ZERO, RGB) and page.dtype in (np.uint8, np.uint16)
        _check_claim(page)
    except DAMAGE as error:
        do = "export it again"
        raise MovieError(refusal(str(path), expected="a TIFF file with pages", got=words(error), do=do)) from error
    if not known or page.axes not in ("YX", "YXS", "SYX") or (page.photometric == RGB and len(page.shape) != 3):
        do = "export it as 8 or 16 bit grey"
        raise MovieError(refusal(str(path), expected="grey or RGB pages of 8 or 16 bit", got=kind, do=do))
    return page


def _check_claim(page: Any) -> None:
    """Refuse a page that claims more than what is stored of it can hold."""
    stored = min(sum(page.databytecounts), page.parent.filehandle.size)  # the counts are a claim as well
    if not page.nbytes or page.nbytes > LARGEST_RATIO * stored:
        raise ValueError(f"a page {page.shape} with {stored} bytes of pixels")


def _told(path: Path, file: TiffFile) -> int:
    """Return how many pictures the notes in the file tell of, 0 where there are none."""
    try:
        if file.is_imagej and file.imagej_metadata:
            notes = file.imagej_metadata
            axes = [int(notes.get(axis, 1)) for axis in ("channels", "slices", "frames")]
            told = int(notes.get("images", 1))
        elif file.is_shaped and file.shaped_metadata and len(file.shaped_metadata) == 1:
            axes = [int(size) for size in file.shaped_metadata[0]["shape"]]
            spare = len(file.pages[0].shape)
            axes = axes[:-spare]
            told = int(np.prod([1, *axes], dtype=object))
        else:
            return 0
    except DAMAGE:
        return 0  # notes are a courtesy: without them the pages count
    if sum(size > 1 for size in axes) > 1:
        got, do = " x ".join(map(str, axes)) + " pictures", "export one channel and one slice as a stack"
        raise MovieError(refusal(str(path), expected="pictures along one axis, time", got=got, do=do))
    return told


def _compression(page: Any) -> str:
    return "uncompressed" if page.compression == UNCOMPRESSED else str(getattr(page.compression, "name", "")).lower()


def _steps(path: Path, page: Any) -> tuple[int, int]:
    tag = page.tags.get(ORIENTATION)
    orientation = 1 if tag is None else tag.value
    steps = STEPS.get(orientation)
    if steps is None:
        got, do = f"orientation {orientation}", "export it upright"
        raise MovieError(refusal(str(path), expected="pages that are not turned by 90 degrees", got=got, do=do))
    return steps
