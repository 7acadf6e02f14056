import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sphereorient.files.picture import luma
from sphereorient.movies.movie import COLOUR_REMARK, Grey, Movie, mapped, movie_error

FILE_HEADER = struct.Struct("<2s3HiIiI3IQ")
BITMAP_HEADER = struct.Struct("<IiiHHIIiiII")
SETUP_START = struct.Struct("<H138x2sH")
SETUP = struct.Struct("<756xii4xI112xi8xI")  # both flips, frame rate, rotation, bits used; zeros beyond its end
BLOCK_HEADER = struct.Struct("<IHH")
TIME_BLOCK = 1002  # a TIME64 for each image
MAX_BLOCKS = 10_000  # tagged blocks; recorders write few
FLAG_BITS = np.uint64(3)  # the two lowest bits of a TIME64 are flags
MAX_SIDE = 1 << 16  # px; larger than any sensor
FIRST = 64  # images that determine the usual size
JPEG, FILTER_ARRAY = 1, 2  # values of `compression`
PREFIX = 8  # least bytes before the pixels: size of the annotation, size of the image
COPY_AGAIN, EXPORT_AGAIN = "copy it from the camera again", "export it again; its header is damaged"
_Rows = NDArray[np.uint8]  # (H, stride), as stored


@dataclass(frozen=True)
class _Layout:
    name: str
    bits: int  # of a pixel in the file
    dtype: type[np.uint8] | type[np.uint16]
    colour: bool = False
    packed: bool = False


class CineMovie(Movie):
    """A .cine file of uncompressed or packed images; MovieError for compressed ones, filter arrays or damage."""

    def __init__(self, path: Path) -> None:
        self._read_header(path)
        layout, (height, width) = self._layout, self._size
        self._top_down = bool(self._flip_vertical) != layout.packed
        content = np.memmap(path, np.uint8, "r")
        found = Counter(_prefix_and_size(content, int(offset)) for offset in self._offsets[:FIRST])
        found.pop((0, 0), None)
        if not found:
            raise movie_error(path, "at least one whole image", "none", COPY_AGAIN)
        (prefix, self._image_size), _ = found.most_common(1)[0]
        self._stride, rest = divmod(self._image_size, height)  # rows may be padded
        least = -(-width * layout.bits // 8)
        if rest or self._stride < least:
            expected = f"images of {height} rows of at least {least} bytes"
            raise movie_error(path, expected, f"{self._image_size} bytes", EXPORT_AGAIN)
        there = np.flatnonzero((self._offsets > 0) & (self._offsets <= len(content) - prefix - self._image_size))
        count = int(there[-1]) + 1  # at least one is whole
        used = f" ({self._real_bits} of them used)" if 0 < self._real_bits < layout.bits else ""
        super().__init__(path, f".cine, {layout.name}{used}", count, self._size, np.dtype(layout.dtype))
        if 8 < self._real_bits <= 14:  # 16 may be the size of a pixel only
            self.full_scale = float(2**self._real_bits - 1)
        self.times_s, remarks = self._times(count)
        self.remarks = (*self._truncated(self._stated), *remarks, *self._pixel_remarks())

    def _read_header(self, path: Path) -> None:
        """Read the header (little-endian, packed without gaps); allocate nothing larger than the file."""
        with path.open("rb") as file:
            size = file.seek(0, 2)
            kind, header_size, compression, _, _, _, first, count, at_bitmap, at_setup, at_table, trigger = _unpack(
                path, file, 0, FILE_HEADER
            )
            if kind != b"CI" or header_size < FILE_HEADER.size:
                do = "name a movie of a Phantom camera"
                raise movie_error(path, "a .cine file, which begins with CI", f"{kind!r}", do)
            _, width, height, _, bits, packing, *_ = _unpack(path, file, at_bitmap, BITMAP_HEADER)
            if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
                raise movie_error(path, "the size of a picture", f"{width} x {height}", EXPORT_AGAIN)
            rate_16, mark, length = _unpack(path, file, at_setup, SETUP_START)
            if mark != b"ST":  # older than any version whose fields are known
                length = 0
            file.seek(at_setup)
            setup = SETUP.unpack(file.read(min(length, SETUP.size)).ljust(SETUP.size, b"\0"))
            file.seek(at_table)
            offsets = np.frombuffer(file.read(8 * min(count, max(0, size - at_table) // 8)), "<i8")
            stamps_s = _read_times(file, at_setup + length, min(at_table, size), trigger) if length else None
        self._layout, self._size = _layout(path, compression, packing, bits), (height, width)
        self._stated = count  # images by the header
        self._offsets = offsets.astype(np.int64)  # (stated or fewer,), of images in the file
        self._first_number = first  # of the first image, counted from the trigger
        self._stamps_s = stamps_s  # (n,), s, from the trigger; None: no block of time stamps
        self._flip_horizontal, self._flip_vertical, rate, self._rotate_deg, self._real_bits = setup
        self._frame_rate_hz = rate or rate_16  # the short field stops at 65535

    def _times(self, count: int) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
        """Return the time (count,), s, of each frame from the trigger, by stamps or frame rate, and a remark."""
        remark = "it has no time stamps"
        if self._stamps_s is not None and len(self._stamps_s) >= count:
            times_s = self._stamps_s[:count]
            if (np.diff(times_s) > 0).all():
                return times_s, ()
            remark = "its time stamps do not increase"
        rate = self._frame_rate_hz
        if not rate:
            return None, (f"{remark} and no frame rate",)
        numbers = self._first_number + np.arange(count, dtype=np.float64)
        return numbers / rate, (f"{remark}: times are by its frame rate, {rate} Hz",)

    def _pixel_remarks(self) -> Iterator[str]:
        if self._layout.colour:
            yield COLOUR_REMARK
        if self._layout.name == "packed 10 bit":
            yield "packed 10 bit: grey values are the recorder's codes, not linear in brightness"
        if self._flip_vertical:
            yield "rows are reversed as its header states (bFlipV); if the picture is upside down: flip"
        if self._flip_horizontal:
            yield "columns are reversed as its header states (bFlipH); if the picture is mirrored: flip"
        if self._rotate_deg:
            yield f"the rotation by {self._rotate_deg} degrees in its header is not applied"

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        whole = (self.path.stat().st_size,)
        for number, content in mapped(self.path, numbers, np.dtype(np.uint8), 0, whole):
            yield self._picture(content, number)

    def _picture(self, content: NDArray[np.uint8], number: int) -> Grey:
        offset = int(self._offsets[number])
        prefix, size = _prefix_and_size(content, offset)
        if size != self._image_size:
            raise self._damage(number, "an image that is cut off or of another size")
        pixels = content[offset + prefix : offset + prefix + size]
        grey = _grey(pixels.reshape(self._size[0], self._stride), self._size[1], self._layout)
        upright = grey if self._top_down else grey[::-1]
        if self._flip_horizontal:
            upright = upright[:, ::-1]
        return np.array(upright, self.dtype, order="C")  # a copy, as the memory is the file's


def _prefix_and_size(content: NDArray[np.uint8], offset: int) -> tuple[int, int]:
    """Return the bytes before the pixels of an image and the bytes of its pixels; (0, 0) if incomplete."""
    if not 0 < offset <= len(content) - PREFIX:
        return 0, 0
    prefix = int.from_bytes(content[offset : offset + 4].tobytes(), "little")
    if not PREFIX <= prefix <= len(content) - offset:
        return 0, 0
    size = int.from_bytes(content[offset + prefix - 4 : offset + prefix].tobytes(), "little")
    return (prefix, size) if size <= len(content) - offset - prefix else (0, 0)


def _unpack(path: Path, file: BinaryIO, at: int, layout: struct.Struct) -> tuple[Any, ...]:
    file.seek(at)
    content = file.read(layout.size)
    if len(content) < layout.size:
        raise movie_error(path, "a .cine file with its header", "a cut off or empty one", COPY_AGAIN)
    return layout.unpack(content)


def _read_times(file: BinaryIO, at: int, end: int, trigger: int) -> NDArray[np.float64] | None:
    """Return the times of the images, s from the trigger, in the tagged blocks between `at` and `end`; None without."""
    for _ in range(MAX_BLOCKS):
        if at + BLOCK_HEADER.size > end:
            break
        file.seek(at)
        size, kind, _ = BLOCK_HEADER.unpack(file.read(BLOCK_HEADER.size))
        if size < BLOCK_HEADER.size or at + size > end:
            break
        if kind == TIME_BLOCK:
            stamps = np.frombuffer(file.read((size - BLOCK_HEADER.size) // 8 * 8), "<u8").astype(np.uint64)
            since = (stamps & ~FLAG_BITS) - (np.uint64(trigger) & ~FLAG_BITS)  # may wrap around; correct if signed
            return since.view(np.int64) / 2.0**32
        at += size
    return None


def _layout(path: Path, compression: int, packing: int, bits: int) -> _Layout:
    if compression == FILTER_ARRAY:
        do = "export it from the camera's software as interpolated colour or grey"
        raise movie_error(path, "grey or colour pixels", "raw colours of a filter array, one a pixel", do)
    if compression == JPEG:
        do = "export it uncompressed from the camera's software"
        raise movie_error(path, "uncompressed or packed images", "JPEG in .cine, which cannot be decoded", do)
    layout = LAYOUTS.get((packing, bits))
    if layout is None or compression != 0:
        got = f"{bits} bit, compression {compression}, packing {packing}"
        do = "export it uncompressed from the camera's software, or as grey .avi"
        raise movie_error(path, "8 or 16 bit grey, colour, or packed 10 or 12 bit", got, do)
    return layout


def _grey(rows: _Rows, width: int, layout: _Layout) -> NDArray[Any]:
    """Return the grey values (H, W) of an image's rows."""
    if layout.packed:  # without gaps, most significant bits first; each pixel is in two bytes
        first, offset = np.divmod(layout.bits * np.arange(width), 8)
        pair = (rows.take(first, axis=1).astype(np.uint16) << 8) | rows.take(first + 1, axis=1)
        return (pair >> (16 - layout.bits - offset).astype(np.uint16)) & np.uint16(2**layout.bits - 1)
    stored = np.dtype(layout.dtype).newbyteorder("<")
    values = np.ascontiguousarray(rows[:, : width * layout.bits // 8]).view(stored)
    if not layout.colour:
        return values
    blue, green, red = np.moveaxis(values.astype(layout.dtype).reshape(len(rows), width, 3), 2, 0)
    return luma(red, green, blue)


_TEN = _Layout("packed 10 bit", 10, np.uint16, packed=True)
_TWELVE = _Layout("packed 12 bit", 12, np.uint16, packed=True)
LAYOUTS: dict[tuple[int, int], _Layout] = {  # by biCompression and biBitCount
    (0, 8): _Layout("8 bit", 8, np.uint8),
    (0, 16): _Layout("16 bit", 16, np.uint16),
    (0, 24): _Layout("colour, 8 bit", 24, np.uint8, colour=True),
    (0, 48): _Layout("colour, 16 bit", 48, np.uint16, colour=True),
    **{(256, bits): _TEN for bits in (10, 16)},
    **{(1024, bits): _TWELVE for bits in (12, 16)},
}
