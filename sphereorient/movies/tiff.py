import logging
import lzma
import math
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tifffile import TiffFile, TiffFileError

from sphereorient.errors import error_words
from sphereorient.files.picture import luma
from sphereorient.files.whole_file import LARGEST_RATIO
from sphereorient.movies.movie import COLOUR_REMARK, Grey, Movie, mapped, movie_error

# Exceptions of tifffile and imagecodecs on damaged files, depending on the damage.
DAMAGE = (
    *(ValueError, TypeError, LookupError, ArithmeticError, AttributeError, OSError, EOFError, RuntimeError),
    *(MemoryError, AssertionError, struct.error, zlib.error, lzma.LZMAError, TiffFileError),
)
WHITE_IS_ZERO, BLACK_IS_ZERO, RGB = 0, 1, 2  # PhotometricInterpretation
UNCOMPRESSED = 1
STEPS = {1: (1, 1), 2: (1, -1), 3: (-1, -1), 4: (-1, 1)}  # of rows and columns, by orientation

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # damage is reported by refusals


class TiffMovie(Movie):
    """A stack in a .tif file, classic or BigTIFF, 8 or 16 bit, grey or colour."""

    def __init__(self, path: Path) -> None:
        with _opened(path) as file:
            page = _first_page(path, file)
            packed = str(getattr(page.compression, "name", "")).lower()
            compression = "uncompressed" if page.compression == UNCOMPRESSED else packed
            form = f"TIFF, {np.dtype(page.dtype).itemsize * 8} bit, {compression}"
            pages, stated = len(file.pages), _stated(path, file)
            self._kind = (page.shape, page.dtype)
            self.colour = page.photometric == RGB
            self._planar = page.axes == "SYX"
            self._white_is_zero = page.photometric == WHITE_IS_ZERO
            self._steps = _steps(path, page)
            self._stored = np.dtype(page.dtype).newbyteorder(file.byteorder)
            # ImageJ's stacks above 4 GB have one page, truncated stacks lack the table of pages: values are contiguous.
            whole = 0
            if stated > pages and not file.is_ome and page.compression == UNCOMPRESSED and page.is_contiguous:
                whole = int((path.stat().st_size - page.dataoffsets[0]) // page.nbytes)
            self._offset = int(page.dataoffsets[0]) if whole > pages else None
            count = min(stated, whole) if self._offset is not None else pages
        super().__init__(path, form, count, (int(page.imagelength), int(page.imagewidth)), np.dtype(page.dtype))
        remarks = self._truncated(stated) + ((COLOUR_REMARK,) if self.colour else ())
        self.remarks = remarks + (("stored with white as 0: inverted",) if self._white_is_zero else ())

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        if self._offset is None:
            return self._read_pages(numbers)
        shape = (len(self), *self._kind[0])
        pages = mapped(self.path, numbers, self._stored, self._offset, shape)
        return (self._grey(values[number]) for number, values in pages)

    def _read_pages(self, numbers: Sequence[int]) -> Iterator[Grey]:
        with _opened(self.path) as file:
            for number in numbers:
                try:
                    page: Any = file.pages[number]
                    if (page.shape, page.dtype) != self._kind:
                        raise self._damage(number, f"a page {page.shape} of {page.dtype}")
                    _check_claim(page)
                    picture = self._grey(page.asarray())
                except DAMAGE as error:
                    raise self._damage(number, error_words(error)) from error
                yield picture

    def _grey(self, values: NDArray[Any]) -> Grey:
        """Return native grey values, black as 0, row 0 on top."""
        values = values.astype(self.dtype)
        if values.ndim == 3:
            channels = values if self._planar else np.moveaxis(values, 2, 0)
            values = luma(*channels[:3]) if self.colour else channels[0]
        if self._white_is_zero:
            values = np.iinfo(self.dtype).max - values
        rows, columns = self._steps
        return np.ascontiguousarray(values[::rows, ::columns])


@contextmanager
def _opened(path: Path) -> Iterator[TiffFile]:
    try:
        file = TiffFile(path)
    except DAMAGE as error:
        raise movie_error(path, "a TIFF file", error_words(error), "export it again") from error
    with file:
        yield file


def _first_page(path: Path, file: TiffFile) -> Any:
    try:
        page: Any = file.pages[0]
        kind = f"{np.dtype(page.dtype)}, photometric {page.photometric}, {page.shape}"
        known = page.photometric in (WHITE_IS_ZERO, BLACK_IS_ZERO, RGB) and page.dtype in (np.uint8, np.uint16)
        _check_claim(page)
    except DAMAGE as error:
        raise movie_error(path, "a TIFF file with pages", error_words(error), "export it again") from error
    if not known or page.axes not in ("YX", "YXS", "SYX") or (page.photometric == RGB and len(page.shape) != 3):
        raise movie_error(path, "grey or RGB pages of 8 or 16 bit", kind, "export it as 8 or 16 bit grey")
    return page


def _check_claim(page: Any) -> None:
    stored = min(sum(page.databytecounts), page.parent.filehandle.size)  # the counts may be wrong too
    if not page.nbytes or page.nbytes > LARGEST_RATIO * stored:
        raise ValueError(f"a page {page.shape} with {stored} bytes of pixels")


def _stated(path: Path, file: TiffFile) -> int:
    """Return the number of pictures by the metadata of ImageJ, OME or tifffile; 0 without metadata."""
    try:
        if file.is_ome:
            text, page = str(file.ome_metadata), _first_page(path, file)
            files, images = set(re.findall(r'FileName="([^"]*)"', text)), len(re.findall(r"<(?:\w+:)?Pixels\b", text))
            if len(files) > 1 or images > 1:
                got = f"{images} movies in {max(len(files), 1)} files"
                raise movie_error(path, "one movie in the file", got, "export it as one movie in one file")
            sizes = {axis: int(size) for axis, size in re.findall(r'\bSize([CZT])="(\d{1,9})"', text)}
            axes = [sizes["C"] // page.samplesperpixel, sizes["Z"], sizes["T"]]
            stated = int(math.prod(axes))
        elif file.is_imagej and file.imagej_metadata:
            notes = file.imagej_metadata
            axes = [int(notes.get(axis, 1)) for axis in ("channels", "slices", "frames")]
            stated = int(notes.get("images", 1))
        elif file.is_shaped and file.shaped_metadata and len(file.shaped_metadata) == 1:
            axes = [int(size) for size in file.shaped_metadata[0]["shape"]][: -len(file.pages[0].shape)]
            stated = int(np.prod([1, *axes], dtype=object))
        else:
            return 0
    except DAMAGE:
        return 0  # without metadata the pages count
    if sum(size > 1 for size in axes) > 1:
        got, do = " x ".join(map(str, axes)) + " pictures", "export one channel and one slice as a stack"
        raise movie_error(path, "pictures along one axis, time", got, do)
    return stated


def _steps(path: Path, page: Any) -> tuple[int, int]:
    tag = page.tags.get(274)  # tag: position of row 0 and column 0
    orientation = 1 if tag is None else tag.value
    steps = STEPS.get(orientation)
    if steps is None:
        got = f"orientation {orientation}"
        raise movie_error(path, "pages that are not rotated by 90 degrees", got, "export it upright")
    return steps
