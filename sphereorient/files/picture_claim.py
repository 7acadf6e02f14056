"""How many pixels a picture file claims to have, told before anything is decoded: a small file may claim billions."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.files.picture_size import claimed_bytes

LITTLE, BIG = b"II*\0", b"MM\0*"  # first bytes of TIFF, by the order of its bytes
WIDTH, HEIGHT, SHORT = 256, 257, 3  # tags of TIFF, and its type of 16 bits
ENTRY = 12  # bytes of an entry of TIFF's directory: tag, type, count, value


def claimed_pixels(content: bytes) -> int | None:
    """Return the pixels that a PNG, JPEG, BMP, PNM or TIFF file claims to have; None for anything else."""
    if content.startswith((LITTLE, BIG)):
        return _tiff(content, content.startswith(LITTLE))
    return claimed_bytes(content) or None


def decoded_grey(content: bytes) -> NDArray[Any] | None:
    """Return the grey values of a picture file, (H, W), in its own depth; None where it does not decode.

    Args:
        content: the file; ask `claimed_pixels` first, for room is made for as many.
    """
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    except cv2.error:  # how an empty file comes out, and a header with impossible numbers
        return None
    return None if picture is None or picture.ndim != 2 else np.asarray(picture)


def _tiff(content: bytes, little: bool) -> int | None:
    def number(at: int, size: int) -> int:
        return int.from_bytes(content[at : at + size], "little" if little else "big")

    start = number(4, 4)
    sides = {}
    for k in range(number(start, 2)):
        at = start + 2 + ENTRY * k
        if number(at, 2) in (WIDTH, HEIGHT):
            sides[number(at, 2)] = number(at + 8, 2 if number(at + 2, 2) == SHORT else 4)
    return sides.get(WIDTH, 0) * sides.get(HEIGHT, 0) or None
