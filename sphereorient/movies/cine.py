import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sphereorient.movies.grey import COLOUR_REMARK, luma
from sphereorient.movies.movie import Grey, Movie, mapped, refused, truncated_remark

FILE_HEADER = struct.Struct("<2s3HiIiI3IQ")
BITMAP_HEADER = struct.Struct("<IiiHHIIiiII")
SETUP_START = struct.Struct("<H138x2sH")
BLOCK_HEADER = struct.Struct("<IHH")
TIME_BLOCK = 1002  # a TIME64 for each image
MAX_BLOCKS = 10_000  # tagged blocks; recorders write a handful
FLAG_BITS = np.uint64(3)  # the two lowest bits of a TIME64 are flags
MAX_SIDE = 1 << 16  # px; larger than any sensor
FIRST = 64  # images that determine the usual size
JPEG, FILTER_ARRAY = 1, 2  # values of `compression`
PREFIX = 8  # bytes before the pixels at least: size of the annotation, size of the image
COPY_AGAIN = "copy it from the camera again"
Rows = NDArray[np.uint8]  # (H, stride), as stored


@dataclass(frozen=True)
class _Layout:
    name: str
    bits: int  # of a pixel in the file
    dtype: type[np.uint8] | type[np.uint16]
    grey: Callable[[Rows, int], NDArray[Any]]  # rows and width -> (H, W)
    colour: bool = False
    packed: bool = False


@dataclass(frozen=True, eq=False)
class _Header:
    compression: int  # 0 none, 1 JPEG, 2 raw colour filter array
    packing: int  # 0 none, 256: 10 bit, 1024: 12 bit
    bits: int  # stored, of a pixel
    width: int
    height: int
    stated: int  # images by the header
    offsets: NDArray[np.int64]  # (stated or fewer,), of images in the file
    first_number: int  # of the first image, counted from the trigger
    times_s: NDArray[np.float64] | None  # (n,) by the block of time stamps, from the trigger
    frame_rate_hz: int
    flip_horizontal: bool
    flip_vertical: bool
    rotate_deg: int
    real_bits: int


class CineMovie(Movie):
    """A .cine file of uncompressed or packed images; MovieError for compressed ones, filter arrays or damage."""

    def __init__(self, path: Path) -> None:
        header = self._header = _read_header(path)
        layout = self._layout = _layout(path, header)
        self._top_down = header.flip_vertical != layout.packed
        content = np.memmap(path, np.uint8, "r")
        found = Counter(_prefix_and_size(content, int(offset)) for offset in header.offsets[:FIRST])
        found.pop((0, 0), None)
        if not found:
            raise refused(path, "at least one whole image", "none", COPY_AGAIN)
        (prefix, self._image_size), _ = found.most_common(1)[0]
        self._stride, rest = divmod(self._image_size, header.height)  # rows may be padded
        least = -(-header.width * layout.bits // 8)
        if rest or self._stride < least:
            expected = f"images of {header.height} rows of at least {least} bytes"
            do = "export it again; its header is damaged"
            raise refused(path, expected, f"{self._image_size} bytes", do)
        there = np.flatnonzero((header.offsets > 0) & (header.offsets <= len(content) - prefix - self._image_size))
        count = int(there[-1]) + 1 if len(there) else 0
        if count < 1:
            raise refused(path, "at least one whole image", "none", COPY_AGAIN)
        used = f" ({header.real_bits} of them used)" if 0 < header.real_bits < layout.bits else ""
        form = f".cine, {layout.name}{used}"
        super().__init__(path, form, count, (header.height, header.width), np.dtype(layout.dtype))
        self.times_s, remarks = _times(header, count)
        self.remarks = (*truncated_remark(header.stated, count), *remarks, *self._pixel_remarks())

    def _pixel_remarks(self) -> Iterator[str]:
        if self._layout.colour:
            yield COLOUR_REMARK
        if self._layout.name == "packed 10 bit":
            yield "packed 10 bit: grey values are the recorder's codes, which are not linear in brightness"
        if self._header.flip_vertical:
            yield "its header asks for rows turned round (bFlipV), applied; if the picture stands on its head: flip"
        if self._header.flip_horizontal:
            yield "its header asks for columns turned round (bFlipH), applied; if the picture is mirrored: flip"
        if self._header.rotate_deg:
            yield f"its header asks for a turn by {self._header.rotate_deg} degrees, which is not applied"

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        whole = (self.path.stat().st_size,)
        for number, content in mapped(self.path, numbers, np.dtype(np.uint8), 0, whole):
            yield self._picture(content, number)

    def _picture(self, content: NDArray[np.uint8], number: int) -> Grey:
        offset = int(self._header.offsets[number])
        prefix, size = _prefix_and_size(content, offset)
        if size != self._image_size:
            raise self._damage(number, "an image that is cut off or of another size")
        pixels = content[offset + prefix : offset + prefix + size]
        grey = self._layout.grey(pixels.reshape(self._header.height, self._stride), self._header.width)
        upright = grey if self._top_down else grey[::-1]
        if self._header.flip_horizontal:
            upright = upright[:, ::-1]
        return np.array(upright, self.dtype, order="C")  # a copy: the memory is the file's


def _prefix_and_size(content: NDArray[np.uint8], offset: int) -> tuple[int, int]:
    """Return bytes before the pixels of an image and bytes of its pixels; (0, 0) where these are not whole."""
    if not 0 < offset <= len(content) - PREFIX:
        return 0, 0
    prefix = int.from_bytes(content[offset : offset + 4].tobytes(), "little")
    if not PREFIX <= prefix <= len(content) - offset:
        return 0, 0
    size = int.from_bytes(content[offset + prefix - 4 : offset + prefix].tobytes(), "little")
    return (prefix, size) if size <= len(content) - offset - prefix else (0, 0)


def _read_header(path: Path) -> _Header:
    """Read the header (little-endian, packed without gaps); allocate nothing larger than the file."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        kind, header_size, compression, _, _, _, first, count, at_bitmap, at_setup, at_table, trigger = _unpack(
            path, file, 0, FILE_HEADER
        )
        if kind != b"CI" or header_size < FILE_HEADER.size:
            raise refused(path, "a .cine file, which begins with CI", f"{kind!r}", "name a movie of a Phantom camera")
        _, width, height, _, bits, packing, *_ = _unpack(path, file, at_bitmap, BITMAP_HEADER)
        if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
            do = "export it again; its header is damaged"
            raise refused(path, "the size of a picture", f"{width} x {height}", do)
        rate_16, mark, length = _unpack(path, file, at_setup, SETUP_START)
        if mark != b"ST":  # older than any version whose fields are known
            length = 0
        file.seek(at_setup)
        setup = file.read(length)
        file.seek(at_table)
        offsets = np.frombuffer(file.read(8 * min(count, max(0, size - at_table) // 8)), "<i8").astype(np.int64)
        stamps = _read_stamps(file, at_setup + length, min(at_table, size)) if length else None

    def field(offset: int, form: str) -> int:
        there = offset + struct.calcsize(form) <= len(setup)
        return int(struct.unpack_from(form, setup, offset)[0]) if there else 0

    return _Header(
        compression=compression,
        packing=packing,
        bits=bits,
        width=width,
        height=height,
        stated=count,
        offsets=offsets,
        first_number=first,
        times_s=None if stamps is None else _seconds(stamps, trigger),
        frame_rate_hz=field(768, "<I") or int(rate_16),  # the short field stops at 65535
        flip_horizontal=bool(field(756, "<i")),
        flip_vertical=bool(field(760, "<i")),
        rotate_deg=field(884, "<i"),
        real_bits=field(896, "<I"),
    )


def _unpack(path: Path, file: BinaryIO, at: int, layout: struct.Struct) -> tuple[Any, ...]:
    file.seek(at)
    content = file.read(layout.size)
    if len(content) < layout.size:
        raise refused(path, "a .cine file with its header", "a cut off or empty one", COPY_AGAIN)
    return layout.unpack(content)


def _read_stamps(file: BinaryIO, at: int, end: int) -> NDArray[np.uint64] | None:
    """Return the TIME64 of each image from the tagged blocks between `at` and `end`; None without."""
    for _ in range(MAX_BLOCKS):
        if at + BLOCK_HEADER.size > end:
            break
        file.seek(at)
        size, kind, _ = BLOCK_HEADER.unpack(file.read(BLOCK_HEADER.size))
        if size < BLOCK_HEADER.size or at + size > end:
            break
        if kind == TIME_BLOCK:
            return np.frombuffer(file.read((size - BLOCK_HEADER.size) // 8 * 8), "<u8").astype(np.uint64)
        at += size
    return None


def _seconds(stamps: NDArray[np.uint64], trigger: int) -> NDArray[np.float64]:
    since = (stamps & ~FLAG_BITS) - (np.uint64(trigger) & ~FLAG_BITS)  # may wrap round; right again as signed
    return since.view(np.int64) / 2.0**32


def _times(header: _Header, count: int) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Return the time (count,), s, of each frame from the trigger, by stamps or frame rate, and a remark."""
    remark = "it has no time stamps"
    if header.times_s is not None and len(header.times_s) >= count:
        times_s = header.times_s[:count]
        if (np.diff(times_s) > 0).all():
            return times_s, ()
        remark = "its time stamps do not increase"
    rate = header.frame_rate_hz
    if not rate:
        return None, (f"{remark} and no frame rate",)
    numbers = header.first_number + np.arange(count, dtype=np.float64)
    return numbers / rate, (f"{remark}: times are by its frame rate, {rate} Hz",)


def _layout(path: Path, header: _Header) -> _Layout:
    if header.compression == FILTER_ARRAY:
        do = "export it from the camera's software as interpolated colour or grey"
        raise refused(path, "grey or colour pixels", "raw colours of a filter array, one a pixel", do)
    if header.compression == JPEG:
        do = "export it uncompressed from the camera's software"
        raise refused(path, "uncompressed or packed images", "JPEG in .cine, which cannot be decoded", do)
    layout = LAYOUTS.get((header.packing, header.bits))
    if layout is None or header.compression != 0:
        got = f"{header.bits} bit, compression {header.compression}, packing {header.packing}"
        do = "export it uncompressed from the camera's software, or as grey .avi"
        raise refused(path, "8 or 16 bit grey, colour, or packed 10 or 12 bit", got, do)
    return layout


def _sixteen(rows: Rows, width: int) -> NDArray[Any]:
    return np.ascontiguousarray(rows[:, : 2 * width]).view("<u2")


def _colour_8(rows: Rows, width: int) -> NDArray[Any]:
    blue, green, red = np.moveaxis(rows[:, : 3 * width].reshape(len(rows), width, 3), 2, 0)
    return luma(red, green, blue)


def _colour_16(rows: Rows, width: int) -> NDArray[Any]:
    values = _sixteen(rows, 3 * width).reshape(len(rows), width, 3)
    blue, green, red = np.moveaxis(values.astype(np.uint16), 2, 0)
    return luma(red, green, blue)


def _ten_packed(rows: Rows, width: int) -> NDArray[Any]:
    """Unpack four pixels from five bytes, the most significant bits first."""
    b = _groups(rows, width, pixels=4, size=5)
    first = (b[..., 0] << 2) | (b[..., 1] >> 6)
    second = ((b[..., 1] & 0x3F) << 4) | (b[..., 2] >> 4)
    third = ((b[..., 2] & 0x0F) << 6) | (b[..., 3] >> 2)
    fourth = ((b[..., 3] & 0x03) << 8) | b[..., 4]
    return np.stack([first, second, third, fourth], axis=-1).reshape(len(rows), -1)[:, :width]


def _twelve_packed(rows: Rows, width: int) -> NDArray[Any]:
    """Unpack two pixels from three bytes, the most significant bits first."""
    b = _groups(rows, width, pixels=2, size=3)
    first = (b[..., 0] << 4) | (b[..., 1] >> 4)
    second = ((b[..., 1] & 0x0F) << 8) | b[..., 2]
    return np.stack([first, second], axis=-1).reshape(len(rows), -1)[:, :width]


def _groups(rows: Rows, width: int, pixels: int, size: int) -> NDArray[np.uint16]:
    """Return (H, n, size) bytes of the groups of pixels in a row, as 16-bit numbers, the last one zero-padded."""
    count = -(-width // pixels)
    whole = np.zeros((len(rows), count * size), np.uint16)
    there = min(rows.shape[1], count * size)
    whole[:, :there] = rows[:, :there]
    return whole.reshape(len(rows), count, size)


_TEN = _Layout("packed 10 bit", 10, np.uint16, _ten_packed, packed=True)
_TWELVE = _Layout("packed 12 bit", 12, np.uint16, _twelve_packed, packed=True)
LAYOUTS: dict[tuple[int, int], _Layout] = {  # by biCompression and biBitCount
    (0, 8): _Layout("8 bit", 8, np.uint8, lambda rows, width: rows[:, :width]),
    (0, 16): _Layout("16 bit", 16, np.uint16, _sixteen),
    (0, 24): _Layout("colour, 8 bit", 24, np.uint8, _colour_8, colour=True),
    (0, 48): _Layout("colour, 16 bit", 48, np.uint16, _colour_16, colour=True),
    **{(256, bits): _TEN for bits in (10, 16)},
    **{(1024, bits): _TWELVE for bits in (12, 16)},
}
