"""Pictures of the ball freed of light: what neighbouring places differ by, in units of how much they differ there."""

from __future__ import annotations

import torch
from torch import Tensor

from sphereorient.sphere.view import disk_offsets

RIM = 0.12  # of the radius: over this distance from the limb a pixel's share in averages grows from 0 to 1
RIM_WEIGHT_MIN = 0.02  # of the outermost pixels in the comparison


def rim_share(size_px: int) -> Tensor:
    """Return how far the pixels of a disk's picture may be trusted not to show what is beside the ball, (S, S)."""
    from_limb: Tensor = 1 - disk_offsets(size_px).norm(dim=-1)
    return (from_limb / RIM).clamp(0, 1).float()


class Blur:
    """A Gaussian over the pictures of disks, in which pixels beyond the limb have no share.

    Args:
        size_px: side S of the pictures, px; the disk fills them.
        deviation: standard deviation, radii.
    """

    def __init__(self, size_px: int, deviation: float) -> None:
        at = (torch.arange(size_px, dtype=torch.float64) + 0.5) * (2.0 / size_px)
        self._along = torch.exp(-0.5 * ((at[:, None] - at) / deviation).square()).float()
        self._share = rim_share(size_px)
        self._total = (self._along @ self._share @ self._along).clamp_min(1e-6)

    def __call__(self, pictures: Tensor) -> Tensor:
        """Blur pictures (B, S, S)."""
        return self._along @ (pictures * self._share) @ self._along / self._total


class Evening:
    """Makes pictures under any smooth light comparable: local mean taken off, divided by the local deviation.

    The same is done to templates and to pictures, so that both lose the same; all sizes in radii of the disk.

    Args:
        size_px: side S of the pictures, px; the disk fills them.
        detail: standard deviation of the Gaussian laid over a picture first; what is finer does not count.
        window: standard deviation of the neighbourhood.
        floor: deviation, as a share of the whole disk's, below which a neighbourhood counts as of one paint.
        clip: values beyond this many deviations are cut off: reflections.
    """

    def __init__(self, size_px: int, *, detail: float, window: float, floor: float, clip: float) -> None:
        radius = disk_offsets(size_px).norm(dim=-1)
        self._inside = torch.nonzero((radius < 1).reshape(-1))[:, 0]
        self._share = rim_share(size_px)
        self._detail, self._window = Blur(size_px, detail), Blur(size_px, window)
        self._floor2, self._clip = floor**2, clip
        # Near the limb a small error of the outline turns far: pixels count by their foreshortening.
        depth = (1 - radius.square()).clamp_min(0).sqrt().float()
        self._root_weight = (depth * self._share.clamp_min(RIM_WEIGHT_MIN)).reshape(-1)[self._inside]

    def __call__(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Return evened pictures, (B, P) of length 1, and their contrast (B,): deviation over deviation plus mean."""
        seen = self._detail(pictures)
        share, total = self._share, self._share.sum()
        mean = (seen * share).sum((1, 2), keepdim=True) / total
        seen = seen - mean
        deviation = ((seen.square() * share).sum((1, 2), keepdim=True) / total).sqrt()
        seen = seen / deviation.clamp_min(1e-12)  # the numbers below have no unit
        local = seen - self._window(seen)
        even = (local * (self._window(local.square()) + self._floor2).rsqrt()).clamp(-self._clip, self._clip)
        even = even.flatten(1)[:, self._inside] * self._root_weight
        even = even - (even @ self._root_weight / self._root_weight.square().sum())[:, None] * self._root_weight
        return even / even.norm(dim=1, keepdim=True).clamp_min(1e-12), (
            deviation / (deviation + mean.abs()).clamp_min(1e-12)
        )[:, 0, 0]
