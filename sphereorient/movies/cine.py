"""Movies of Phantom cameras (.cine), mapped into memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sphereorient.movies.cine_header import CineHeader, read_header, refuse
from sphereorient.movies.cine_pixels import LAYOUTS, Layout
from sphereorient.movies.indexed import IndexedMovie, missing_remark
from sphereorient.movies.luma import COLOUR_REMARK
from sphereorient.movies.movie import Grey

FRAMES_A_MAP = 64  # see NpyMovie: keeps memory flat
JPEG, FILTER_ARRAY = 1, 2
PREFIX = 8  # bytes before the pixels at least: size of the annotation, size of the image


class CineMovie(IndexedMovie):
    """A .cine file of uncompressed or packed images.

    Raises:
        MovieError: not a .cine file, damaged, compressed, or of raw colours of a filter array.
    """

    def __init__(self, path: Path) -> None:
        header = self._header = read_header(path)
        self._layout = _layout(path, header)
        self._offsets = header.offsets
        self._top_down = header.setup.flip_vertical != self._layout.packed
        self._image_size, prefix = self._first_image(path)
        self._stride = self._check_stride(path)
        there = np.flatnonzero((self._offsets > 0) & (self._offsets <= header.file_size - prefix - self._image_size))
        count = int(there[-1]) + 1 if len(there) else 0
        if count < 1:
            raise refuse(path, "at least one whole image", "none", "copy it from the camera again")
        times_s, remarks = cine_times(header, count)
        bits = header.setup.real_bits
        super().__init__(
            path,
            f".cine, {self._layout.name}" + (f" ({bits} of them used)" if 0 < bits < self._layout.bits else ""),
            count,
            (header.height, header.width),
            np.dtype(self._layout.dtype),
            times_s,
            (*missing_remark(header.told, count), *remarks, *self._pixel_remarks()),
        )

    def _first_image(self, path: Path) -> tuple[int, int]:
        """Return the bytes of an image and those before its pixels, as most of the first images have them."""
        content = np.memmap(path, np.uint8, "r")
        found = Counter(_prefix_and_size(content, int(offset)) for offset in self._offsets[:FRAMES_A_MAP])
        found.pop((0, 0), None)
        if not found:
            raise refuse(path, "at least one whole image", "none", "copy it from the camera again")
        (prefix, size), _ = found.most_common(1)[0]
        return size, prefix

    def _check_stride(self, path: Path) -> int:
        """Return the bytes of a row, by the size of an image: rows may be padded."""
        stride, rest = divmod(self._image_size, self._header.height)
        least = self._layout.row_bytes(self._header.width)
        if rest or stride < least:
            expected = f"images of {self._header.height} rows of at least {least} bytes"
            do = "export it again; its header is damaged"
            raise refuse(path, expected, f"{self._image_size} bytes", do)
        return stride

    def _pixel_remarks(self) -> Iterator[str]:
        setup = self._header.setup
        if self._layout.colour:
            yield COLOUR_REMARK
        if self._layout.name == "packed 10 bit":
            yield "packed 10 bit: grey values are the recorder's codes, which are not linear in brightness"
        if setup.flip_vertical:
            yield "its header asks for rows turned round (bFlipV), applied; if the picture stands on its head: flip"
        if setup.flip_horizontal:
            yield "its header asks for columns turned round (bFlipH), applied; if the picture is mirrored: flip"
        if setup.rotate_deg:
            yield f"its header asks for a turn by {setup.rotate_deg} degrees, which is not applied"

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        for start in range(0, len(numbers), FRAMES_A_MAP):
            content = np.memmap(self.path, np.uint8, "r")
            for number in numbers[start : start + FRAMES_A_MAP]:
                yield self._picture(content, number)

    def _picture(self, content: NDArray[np.uint8], number: int) -> Grey:
        offset = int(self._offsets[number])
        prefix, size = _prefix_and_size(content, offset)
        if size != self._image_size:
            raise self._damage(number, "an image that is cut off or of another size")
        pixels = content[offset + prefix : offset + prefix + size]
        grey = self._layout.grey(pixels.reshape(self._header.height, self._stride), self._header.width)
        upright = grey if self._top_down else grey[::-1]
        if self._header.setup.flip_horizontal:
            upright = upright[:, ::-1]
        return np.array(upright, self.dtype, order="C")  # a copy: the memory is the file's


def cine_times(header: CineHeader, count: int) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Return the time of each frame from the trigger, (count,), s, and what is to be said about it.

    By the block of time stamps; without one by the frame rate of the recording.
    """
    remark = "it has no time stamps"
    if header.times_s is not None and len(header.times_s) >= count:
        times_s = header.times_s[:count]
        if (np.diff(times_s) > 0).all():
            return times_s, ()
        remark = "its time stamps do not increase"
    rate = header.setup.frame_rate_hz
    if not rate:
        return None, (f"{remark} and no frame rate",)
    numbers = header.first_number + np.arange(count, dtype=np.float64)
    return numbers / rate, (f"{remark}: times are by its frame rate, {rate} Hz",)


def _layout(path: Path, header: CineHeader) -> Layout:
    if header.compression == FILTER_ARRAY:
        do = "export it from the camera's software as interpolated colour or grey"
        raise refuse(path, "grey or colour pixels", "raw colours of a filter array, one a pixel", do)
    if header.compression == JPEG:
        do = "export it uncompressed from the camera's software"
        raise refuse(path, "uncompressed or packed images", "JPEG in .cine, which nothing here decodes", do)
    layout = LAYOUTS.get((header.packing, header.bits))
    if layout is None or header.compression != 0:
        got = f"{header.bits} bit, compression {header.compression}, packing {header.packing}"
        do = "export it uncompressed from the camera's software, or as grey .avi"
        raise refuse(path, "8 or 16 bit grey, colour, or packed 10 or 12 bit", got, do)
    return layout


def _prefix_and_size(content: NDArray[np.uint8], offset: int) -> tuple[int, int]:
    """Return bytes before the pixels of an image and bytes of its pixels; (0, 0) where these are not whole."""
    if not 0 < offset <= len(content) - PREFIX:
        return 0, 0
    prefix = int.from_bytes(content[offset : offset + 4].tobytes(), "little")
    if not PREFIX <= prefix <= len(content) - offset:
        return 0, 0
    size = int.from_bytes(content[offset + prefix - 4 : offset + prefix].tobytes(), "little")
    return (prefix, size) if size <= len(content) - offset - prefix else (0, 0)
