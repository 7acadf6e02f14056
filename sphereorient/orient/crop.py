"""The disk of the ball, cut out of a frame at a common size."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.sphere.view import disk_offsets


def crop_disk(
    frame: NDArray[np.generic], u_px: float, v_px: float, radius_px: float, size_px: int
) -> NDArray[np.float32]:
    """Resample the square about a disk, bilinear, to the canonical view's pixels.

    Args:
        frame: (H, W), grey levels; beyond its border the nearest pixel is repeated.
        u_px, v_px: centre of the disk.
        radius_px: its radius; becomes half the picture.
        size_px: side of the picture, px.

    Returns:
        (S, S) float32, grey levels.
    """
    offset = disk_offsets(size_px).numpy() * radius_px
    # The window first: a map over the whole frame would convert all of it to float.
    reach = int(np.ceil(radius_px)) + 2
    left, top = max(0, int(u_px) - reach), max(0, int(v_px) - reach)
    window = frame[top : int(v_px) + reach + 2, left : int(u_px) + reach + 2].astype(np.float32)
    return np.asarray(
        cv2.remap(
            window,
            (offset[..., 0] + (u_px - left)).astype(np.float32),
            (offset[..., 1] + (v_px - top)).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
    )
