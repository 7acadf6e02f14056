import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.sphere.view import disk_offsets


def crop_disk(
    frame: NDArray[np.generic], u_px: float, v_px: float, radius_px: float, size_px: int
) -> NDArray[np.float32]:
    """Return the square about a disk of a frame (H, W), resampled bilinearly to (S, S) float32 grey levels.
    u_px, v_px: column and row of the disk's centre; radius_px becomes S / 2. Beyond the border the nearest pixel
    repeats.
    """
    offset = disk_offsets(size_px).numpy() * radius_px
    # The window first: a map over the whole frame would convert all of it to float.
    left, right = _span(u_px, radius_px, frame.shape[1])
    top, bottom = _span(v_px, radius_px, frame.shape[0])
    window = frame[top:bottom, left:right].astype(np.float32)
    return np.asarray(
        cv2.remap(
            window,
            (offset[..., 0] + (u_px - left)).astype(np.float32),
            (offset[..., 1] + (v_px - top)).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
    )


def _span(centre_px: float, radius_px: float, length: int) -> tuple[int, int]:
    """Return first and last + 1 of the columns or rows that hold a disk's pixels; at least the nearest one."""
    reach = int(np.ceil(radius_px)) + 2
    first = min(max(int(centre_px) - reach, 0), length - 1)
    return first, max(int(centre_px) + reach + 2, first + 1)
