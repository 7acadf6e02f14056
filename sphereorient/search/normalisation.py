"""Disks cut out of frames, and their normalisation for any smooth light."""

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.sphere.view import disk_offsets

RIM = 0.12  # of the radius: distance from the limb over which a pixel's weight in averages grows from 0 to 1
RIM_WEIGHT_MIN = 0.02  # of the outermost pixels in the comparison


def crop_disk(
    frame: NDArray[np.generic], u_px: float, v_px: float, radius_px: float, size_px: int
) -> NDArray[np.float32]:
    """Return the square about a disk of a frame (H, W), resampled bilinearly to (S, S) float32 grey levels.
    u_px, v_px: column and row of the disk's centre; radius_px becomes S / 2. Beyond the border, border pixels repeat.
    """
    offset = disk_offsets(size_px).numpy() * radius_px
    # Cut the window first, not to convert the whole frame to float.
    left, right = _span(u_px, radius_px, frame.shape[1])
    top, bottom = _span(v_px, radius_px, frame.shape[0])
    window = frame[top:bottom, left:right].astype(np.float32)
    at = np.add(offset, [u_px - left, v_px - top]).astype(np.float32)
    found = cv2.remap(window, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found)


def _span(centre_px: float, radius_px: float, length: int) -> tuple[int, int]:
    """Return first and last + 1 of the columns or rows with a disk's pixels; at least the nearest one."""
    reach = int(np.ceil(radius_px)) + 2
    first = min(max(int(centre_px) - reach, 0), length - 1)
    return first, max(int(centre_px) + reach + 2, first + 1)


def rim_share(size_px: int) -> Tensor:
    """Return the weight (S, S), 0 .. 1, of a disk's pixels by their distance from the limb."""
    from_limb: Tensor = 1 - disk_offsets(size_px).norm(dim=-1)
    return (from_limb / RIM).clamp(0, 1).float()


class Blur:
    """A Gaussian over disks that fill (S, S) pictures, without the pixels beyond the limb; `deviation` in radii."""

    def __init__(self, size_px: int, deviation: float) -> None:
        at = (torch.arange(size_px, dtype=torch.float64) + 0.5) * (2.0 / size_px)
        self._along = torch.exp(-0.5 * ((at[:, None] - at) / deviation).square()).float()
        self._share = rim_share(size_px)
        self._total = (self._along @ self._share @ self._along).clamp_min(1e-6)

    def __call__(self, pictures: Tensor) -> Tensor:
        """Blur pictures (B, S, S)."""
        return self._along @ (pictures * self._share) @ self._along / self._total


class LocalNormalisation:
    """Makes pictures under any smooth light comparable: grey less the local mean, clipped.
    Disks fill (S, S) pictures; `detail`, the first blur, and `window`, the neighbourhood, are standard deviations in
    radii; `clip` is in deviations of the disk (reflections, uneven light).
    """

    def __init__(self, size_px: int, *, detail: float, window: float, clip: float) -> None:
        radius = disk_offsets(size_px).norm(dim=-1)
        self._inside = torch.nonzero((radius < 1).reshape(-1))[:, 0]
        self._share = rim_share(size_px) / rim_share(size_px).sum()
        self._detail, self._window = Blur(size_px, detail), Blur(size_px, window)
        self._clip = clip
        # Near the limb a small error of the outline is a large rotation: weight pixels by foreshortening.
        depth = (1 - radius.square()).clamp_min(0).sqrt().float()
        self._root_weight = (depth * rim_share(size_px).clamp_min(RIM_WEIGHT_MIN)).reshape(-1)[self._inside]
        self._unit = self._root_weight / self._root_weight.norm()

    def __call__(self, pictures: Tensor) -> Tensor:
        """Return normalised pictures (B, S, S) as vectors (B, P) of length 1; a uniform one gives rounding errors."""
        seen = self._detail(pictures)
        mean = (seen * self._share).sum((1, 2), keepdim=True)
        deviation = ((seen - mean).square() * self._share).sum((1, 2), keepdim=True).sqrt()
        local = (seen - self._window(seen)) / deviation.clamp_min(1e-12)  # dimensionless from here
        even = local.clamp(-self._clip, self._clip).flatten(1)[:, self._inside] * self._root_weight
        even = even - (even @ self._unit)[:, None] * self._unit
        return torch.nn.functional.normalize(even, dim=1)
