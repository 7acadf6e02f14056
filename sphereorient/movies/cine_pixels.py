"""Grey values out of the bytes of one image of a .cine file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.movies.luma import luma

Rows = NDArray[np.uint8]  # (H, stride), as they are in the file


@dataclass(frozen=True)
class Layout:
    """How the pixels of one row are stored."""

    name: str
    bits: int  # of a pixel in the file
    dtype: type[np.uint8] | type[np.uint16]
    grey: Callable[[Rows, int], NDArray[Any]]  # rows and width -> (H, W)
    colour: bool = False
    packed: bool = False

    def row_bytes(self, width: int) -> int:
        """Return the least bytes of a row."""
        return -(-width * self.bits // 8)


def _eight(rows: Rows, width: int) -> NDArray[Any]:
    return rows[:, :width]


def _sixteen(rows: Rows, width: int) -> NDArray[Any]:
    return np.ascontiguousarray(rows[:, : 2 * width]).view("<u2")


def _colour_8(rows: Rows, width: int) -> NDArray[Any]:
    blue, green, red = np.moveaxis(rows[:, : 3 * width].reshape(len(rows), width, 3), 2, 0)
    return luma(red, green, blue)


def _colour_16(rows: Rows, width: int) -> NDArray[Any]:
    values = np.ascontiguousarray(rows[:, : 6 * width]).view("<u2").reshape(len(rows), width, 3)
    blue, green, red = np.moveaxis(values.astype(np.uint16), 2, 0)
    return luma(red, green, blue)


def _ten_packed(rows: Rows, width: int) -> NDArray[Any]:
    """Four pixels in five bytes, the most significant bits first."""
    b = _groups(rows, width, pixels=4, size=5)
    first = (b[..., 0] << 2) | (b[..., 1] >> 6)
    second = ((b[..., 1] & 0x3F) << 4) | (b[..., 2] >> 4)
    third = ((b[..., 2] & 0x0F) << 6) | (b[..., 3] >> 2)
    fourth = ((b[..., 3] & 0x03) << 8) | b[..., 4]
    return np.stack([first, second, third, fourth], axis=-1).reshape(len(rows), -1)[:, :width]


def _twelve_packed(rows: Rows, width: int) -> NDArray[Any]:
    """Two pixels in three bytes, the most significant bits first."""
    b = _groups(rows, width, pixels=2, size=3)
    first = (b[..., 0] << 4) | (b[..., 1] >> 4)
    second = ((b[..., 1] & 0x0F) << 8) | b[..., 2]
    return np.stack([first, second], axis=-1).reshape(len(rows), -1)[:, :width]


def _groups(rows: Rows, width: int, pixels: int, size: int) -> NDArray[np.uint16]:
    """Return (H, n, size) bytes, as 16-bit numbers, of the groups of pixels in a row, the last one filled up."""
    count = -(-width // pixels)
    whole = np.zeros((len(rows), count * size), np.uint16)
    there = min(rows.shape[1], count * size)
    whole[:, :there] = rows[:, :there]
    return whole.reshape(len(rows), count, size)


LAYOUTS: dict[tuple[int, int], Layout] = {  # by biCompression and biBitCount
    (0, 8): Layout("8 bit", 8, np.uint8, _eight),
    (0, 16): Layout("16 bit", 16, np.uint16, _sixteen),
    (0, 24): Layout("colour, 8 bit", 24, np.uint8, _colour_8, colour=True),
    (0, 48): Layout("colour, 16 bit", 48, np.uint16, _colour_16, colour=True),
    (256, 16): Layout("packed 10 bit", 10, np.uint16, _ten_packed, packed=True),
    (256, 10): Layout("packed 10 bit", 10, np.uint16, _ten_packed, packed=True),
    (1024, 16): Layout("packed 12 bit", 12, np.uint16, _twelve_packed, packed=True),
    (1024, 12): Layout("packed 12 bit", 12, np.uint16, _twelve_packed, packed=True),
}
