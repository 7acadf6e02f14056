"""What the header of a .cine file says: sizes, offsets, times, and how pixels are stored."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, refusal

FILE_HEADER = struct.Struct("<2s3HiIiI3IQ")
BITMAP_HEADER = struct.Struct("<IiiHHIIiiII")
BLOCK_HEADER = struct.Struct("<IHH")
TIME_BLOCK = 1002  # a TIME64 for each image
MAX_BLOCKS = 10_000  # tagged blocks; recorders write a handful
FLAG_BITS = np.uint64(3)  # the two lowest bits of a TIME64 are no part of the time
MAX_SIDE = 1 << 16  # px; no sensor comes near it


@dataclass(frozen=True)
class Setup:
    """Fields of the structure SETUP, 0 where this version of it does not have them yet."""

    length: int
    frame_rate_hz: int
    flip_horizontal: bool
    flip_vertical: bool
    rotate_deg: int
    real_bits: int


@dataclass(frozen=True, eq=False)
class CineHeader:
    """The header of a .cine file, checked against the size of the file."""

    compression: int  # 0 none, 1 JPEG, 2 colours of a filter array, one a pixel
    packing: int  # 0 none, 256: 10 bit, 1024: 12 bit
    bits: int  # stored, of a pixel
    width: int
    height: int
    told: int  # images that the header tells of
    offsets: NDArray[np.int64]  # (told or fewer,), of images in the file
    setup: Setup
    first_number: int  # of the first image, counted from the trigger
    times_s: NDArray[np.float64] | None  # (n,) by the block of time stamps, from the trigger
    file_size: int


def read_header(path: Path) -> CineHeader:
    """Read the header of a .cine file; nothing larger than the file is allocated, whatever it claims.

    Raises:
        MovieError: not a .cine file, or its header is cut off or contradicts itself.

    Source: the vendor's description of the format; all numbers little-endian, packed without gaps.
    """
    with path.open("rb") as file:
        size = file.seek(0, 2)
        kind, header_size, compression, _, _, _, first, count, at_bitmap, at_setup, at_table, trigger = _unpack(
            path, file, 0, FILE_HEADER
        )
        if kind != b"CI" or header_size < FILE_HEADER.size:
            raise refuse(path, "a .cine file, which begins with CI", f"{kind!r}", "name a movie of a Phantom camera")
        _, width, height, _, bits, packing, *_ = _unpack(path, file, at_bitmap, BITMAP_HEADER)
        if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
            raise refuse(path, "the size of a picture", f"{width} x {height}", "export it again; its header is damaged")
        setup = _read_setup(path, file, at_setup)
        entries = min(count, max(0, size - at_table) // 8)
        file.seek(at_table)
        offsets = np.frombuffer(file.read(8 * entries), "<i8").astype(np.int64)
        stamps = _read_stamps(file, at_setup + setup.length, min(at_table, size)) if setup.length else None
        times_s = None if stamps is None else _seconds(stamps, trigger)
    return CineHeader(compression, packing, bits, width, height, count, offsets, setup, first, times_s, size)


def refuse(path: Path, expected: str, got: str, do: str) -> MovieError:
    """Word the refusal of a .cine file."""
    return MovieError(refusal(str(path), expected=expected, got=got, do=do))


def _unpack(path: Path, file: BinaryIO, at: int, layout: struct.Struct) -> tuple[Any, ...]:
    file.seek(at)
    content = file.read(layout.size)
    if len(content) < layout.size:
        raise refuse(path, "a .cine file with its header", "a cut off or empty one", "copy it from the camera again")
    return layout.unpack(content)


def _read_setup(path: Path, file: BinaryIO, at: int) -> Setup:
    """Read what this version of SETUP has: fields that lie before its Length."""
    rate_16, mark, length = _unpack(path, file, at, struct.Struct("<H138x2sH"))
    if mark != b"ST":  # older than any version whose fields are known
        length = 0
    file.seek(at)
    content = file.read(length)

    def field(offset: int, form: str) -> int:
        there = offset + struct.calcsize(form) <= len(content)
        return int(struct.unpack_from(form, content, offset)[0]) if there else 0

    return Setup(
        length=length,
        frame_rate_hz=field(768, "<I") or int(rate_16),  # the short field stops at 65535
        flip_horizontal=bool(field(756, "<i")),
        flip_vertical=bool(field(760, "<i")),
        rotate_deg=field(884, "<i"),
        real_bits=field(896, "<I"),
    )


def _read_stamps(file: BinaryIO, at: int, end: int) -> NDArray[np.uint64] | None:
    """Return the TIME64 of each image out of the tagged blocks between `at` and `end`, None where there are none."""
    for _ in range(MAX_BLOCKS):
        if at + BLOCK_HEADER.size > end:
            break
        file.seek(at)
        size, kind, _ = BLOCK_HEADER.unpack(file.read(BLOCK_HEADER.size))
        if size < BLOCK_HEADER.size or at + size > end:
            break
        if kind == TIME_BLOCK:
            count = (size - BLOCK_HEADER.size) // 8
            return np.frombuffer(file.read(8 * count), "<u8").astype(np.uint64)
        at += size
    return None


def _seconds(stamps: NDArray[np.uint64], trigger: int) -> NDArray[np.float64]:
    """Return times from the trigger; differences are taken in whole 2^-32 s, so that nothing is rounded before."""
    since = (stamps & ~FLAG_BITS) - (np.uint64(trigger) & ~FLAG_BITS)  # may wrap round; as signed it is right again
    return since.view(np.int64) / 2.0**32
