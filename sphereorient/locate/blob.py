from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.locate.settings import LocateSettings


@dataclass(frozen=True, kw_only=True)
class Blob:
    """Approximate position of the sphere; made by `find_blobs`."""

    u_px: float
    v_px: float
    merit: float  # variance inside times similarity to a disk


def _reduce(picture: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Average by an integer factor, cropping right and lower borders (other ratios are 40 times slower)."""
    height, width = (side // factor * factor for side in picture.shape)
    if factor == 1:
        return picture
    return np.asarray(
        cv2.resize(picture[:height, :width], (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    )


def find_blobs(
    difference: NDArray[np.float32], noise: NDArray[np.float32], diameter_px: float, settings: LocateSettings
) -> list[Blob]:
    """Return at most `settings.blob_candidates` round blobs of about `diameter_px`, best first.

    `difference` is |frame - background|, `noise` the background's sigma, (H, W), grey levels. The blob filter is a
    difference of two box filters.

    Source: paper section III A.
    """
    factor = settings.reduction
    small = np.maximum(_reduce(difference - settings.noise_factor * noise, factor), 0)
    # Clip near the sphere's brightness: a bright reflection must not dominate.
    lit = small[small > 0]
    if lit.size == 0:
        return []
    small = np.minimum(small, np.float32(np.percentile(lit, 95)))
    size = diameter_px / factor
    inner, outer = (max(3, round(size * share) | 1) for share in (0.85, 1.5))
    area_ratio = (inner / outer) ** 2
    mean_in = cv2.boxFilter(small, -1, (inner, inner), borderType=cv2.BORDER_CONSTANT)
    mean_out = cv2.boxFilter(small, -1, (outer, outer), borderType=cv2.BORDER_CONSTANT)
    ring = (mean_out - area_ratio * mean_in) / (1 - area_ratio)
    response = mean_in - ring
    blobs = []
    reach = max(1, round(0.6 * size))
    for _ in range(settings.blob_candidates):
        row, column = np.unravel_index(int(response.argmax()), response.shape)
        if response[row, column] <= 0:
            break
        u, v, merit = _judge(small, float(column), float(row), size / 2)
        blobs.append(Blob(u_px=(u + 0.5) * factor - 0.5, v_px=(v + 0.5) * factor - 0.5, merit=merit))
        response[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1] = 0
    return sorted(blobs, key=lambda blob: -blob.merit)


def _judge(small: NDArray[np.float32], u: float, v: float, radius: float) -> tuple[float, float, float]:
    """Centre a blob on its foreground; return (u, v, merit)."""
    merit = 0.0
    for _ in range(2):
        reach = int(np.ceil(1.5 * radius))
        top, left = max(0, int(v) - reach), max(0, int(u) - reach)
        window = small[top : int(v) + reach + 1, left : int(u) + reach + 1]
        grid = np.indices(window.shape, dtype=np.float32)
        rows, columns = grid[0] + top, grid[1] + left
        inside = (rows - v) ** 2 + (columns - u) ** 2 <= (1.1 * radius) ** 2
        weight = (window > 0) & inside
        total, count = int(np.count_nonzero(window)), int(np.count_nonzero(weight))
        if count == 0:
            return u, v, 0.0
        merit = float(window[inside].var()) * (count / total) ** 2
        u, v = float(columns[weight].mean()), float(rows[weight].mean())
    return u, v, merit
