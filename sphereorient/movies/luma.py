"""From colour to grey, the same way for every format."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Thousandths that add up to 1000: R = G = B comes out as it is.
RED, GREEN, BLUE = 299, 587, 114
COLOUR_REMARK = "colour, made grey (0.299 R + 0.587 G + 0.114 B)"


def luma(red: NDArray[Any], green: NDArray[Any], blue: NDArray[Any]) -> NDArray[Any]:
    """Return the grey values of a colour picture, exact where the three colours are equal.

    Args:
        red: (...), uint8 or uint16; green and blue alike.
        green: see red.
        blue: see red.

    Returns:
        (...), of the same type, rounded to the nearest.

    Source: ITU-R BT.601, the weights of grey values as displays show them.
    """
    total = RED * red.astype(np.uint32) + GREEN * green.astype(np.uint32) + BLUE * blue.astype(np.uint32)
    return ((total + 500) // 1000).astype(red.dtype)
