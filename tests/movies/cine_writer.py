"""A writer of .cine files for tests, from the format's description alone (it shares nothing with the reader)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

U16, U32, I32, I64, U64 = "<u2", "<u4", "<i4", "<i8", "<u8"
SETUP_LENGTH = 10412  # of software version 781


class Bytes(bytearray):
    """Bytes with numbers put at offsets, little-endian."""

    def put(self, at: int, kind: str, *values: int) -> None:
        content = np.array(values, kind).tobytes()
        self[at : at + len(content)] = content


@dataclass
class Cine:
    """Content of the file; the defaults are a plain recording whose rows are stored bottom-up."""

    frames: NDArray[Any]  # (N, H, W) or (N, H, W, 3) in R, G, B, as they are to be seen
    first_number: int = 0
    total: int | None = None  # images recorded in the camera; those written if None
    frame_rate: int = 1000
    flip_v: int = 0
    flip_h: int = 0
    annotation: int = 8
    pad_to: int = 1  # row bytes are a multiple of it
    stamps_s: NDArray[np.float64] | None = None  # from the trigger
    trigger_s: float = 1_700_000_000.25
    blocks: Sequence[tuple[int, bytes]] = ()  # further tagged blocks, before the time stamps
    blocks_after: Sequence[tuple[int, bytes]] = ()
    setup_length: int = SETUP_LENGTH
    real_bits: int = 0
    compression: int = 0  # of the header: 1: JPEG, 2: raw colours of a filter array
    packed_bits: int = 0  # 10 or 12
    gap: int = 0  # bytes between images that belong to none
    rotate: int = 0
    order: Sequence[int] = field(default_factory=tuple)  # order in which the images lie in the file


def write_cine(path: Path, cine: Cine) -> Path:
    """Write a .cine file."""
    frames = cine.frames
    count, height, width = frames.shape[:3]
    coded = [image_bytes(cine, picture) for picture in frames]
    bits = {1: 8, 2: 16}[frames.itemsize] * (3 if frames.ndim == 4 else 1)
    packing = {0: 0, 10: 256, 12: 1024}[cine.packed_bits]
    tagged = b"".join(tagged_block(kind, content, True) for kind, content in cine.blocks)
    if cine.stamps_s is not None:
        tagged += tagged_block(1002, time64(cine.stamps_s + cine.trigger_s % 1, int(cine.trigger_s)), True)
    tagged += b"".join(tagged_block(kind, content, False) for kind, content in cine.blocks_after)

    at_bitmap, at_setup = 44, 84
    at_table = at_setup + cine.setup_length + len(tagged)
    at_images = at_table + 8 * count

    head = Bytes(at_setup)
    head[0:2] = b"CI"
    head.put(2, U16, 44, cine.compression, 1)
    head.put(8, I32, cine.first_number - 3)
    head.put(12, U32, count if cine.total is None else cine.total)
    head.put(16, I32, cine.first_number)
    head.put(20, U32, count, at_bitmap, at_setup, at_table)
    head[36:44] = time64(np.array([cine.trigger_s % 1]), int(cine.trigger_s))
    head.put(at_bitmap, U32, 40)
    head.put(at_bitmap + 4, I32, width, height)
    head.put(at_bitmap + 12, U16, 1, bits)
    head.put(at_bitmap + 16, U32, packing, len(coded[0]))
    head.put(at_bitmap + 36, U32, 2 ** (cine.real_bits or 8))

    setup = Bytes(max(cine.setup_length, 144))
    setup.put(0, U16, min(cine.frame_rate, 65535))
    setup[140:142] = b"ST"
    setup.put(142, U16, cine.setup_length)
    if cine.setup_length > 900:
        setup.put(737, U16, width, height)
        setup.put(756, I32, cine.flip_h, cine.flip_v)
        setup.put(768, U32, cine.frame_rate)
        setup.put(800, U32, 781)
        setup.put(884, I32, cine.rotate)
        setup.put(896, U32, cine.real_bits or bits)

    order = list(cine.order) or list(range(count))
    offsets, images = np.zeros(count, I64), Bytes()
    for number in order:
        offsets[number] = at_images + len(images)
        note = Bytes(cine.annotation)
        note.put(0, U32, cine.annotation)
        note[4 : cine.annotation - 4] = b"\xa5" * (cine.annotation - 8)
        note.put(cine.annotation - 4, U32, len(coded[number]))
        images += note + coded[number] + b"\x5a" * cine.gap
    path.write_bytes(bytes(head) + bytes(setup[: cine.setup_length]) + tagged + offsets.tobytes() + bytes(images))
    return path


def image_bytes(cine: Cine, picture: NDArray[Any]) -> bytes:
    """Return one image as it is stored: rows reversed by the rule, colours as B, G, R, bits packed."""
    if cine.flip_h:
        picture = picture[:, ::-1]
    bottom_up = (cine.flip_v == 0) != bool(cine.packed_bits)
    rows = picture[::-1] if bottom_up else picture
    if rows.ndim == 3:
        rows = rows[..., ::-1]
    return b"".join(padded(row_bytes(row, cine.packed_bits), cine.pad_to) for row in rows)


def row_bytes(row: NDArray[Any], packed_bits: int) -> bytes:
    if not packed_bits:
        return np.ascontiguousarray(row).astype(row.dtype.newbyteorder("<")).tobytes()
    text = "".join(format(int(value), f"0{packed_bits}b") for value in row)  # most significant bit first
    text += "0" * (-len(text) % (40 if packed_bits == 10 else 24))
    return int(text, 2).to_bytes(len(text) // 8, "big")


def padded(row: bytes, multiple: int) -> bytes:
    return row + b"\xee" * (-len(row) % multiple)


def tagged_block(kind: int, content: bytes, more: bool) -> bytes:
    block = Bytes(8)
    block.put(0, U32, 8 + len(content))
    block.put(4, U16, kind, int(more))
    return bytes(block) + content


def time64(since_s: NDArray[np.float64], whole_s: int) -> bytes:
    """Times since `whole_s` as fractions of 2^-32 s and whole seconds; the two lowest bits are flags, set here."""
    ticks = np.round(since_s * 2.0**32).astype(np.int64) + (np.int64(whole_s) << 32)
    return ((ticks.view(np.uint64) & ~np.uint64(3)) | np.uint64(3)).astype(U64).tobytes()
