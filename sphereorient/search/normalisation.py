import torch
from torch import Tensor

from sphereorient.sphere.view import disk_offsets

RIM = 0.12  # of the radius: over this distance from the limb a pixel's share in averages grows from 0 to 1
RIM_WEIGHT_MIN = 0.02  # of the outermost pixels in the comparison


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
        # Near the limb a small error of the outline is a large rotation: weigh pixels by foreshortening.
        depth = (1 - radius.square()).clamp_min(0).sqrt().float()
        self._root_weight = (depth * rim_share(size_px).clamp_min(RIM_WEIGHT_MIN)).reshape(-1)[self._inside]
        self._unit = self._root_weight / self._root_weight.norm()

    def __call__(self, pictures: Tensor) -> Tensor:
        """Return normalised pictures (B, S, S) as vectors (B, P) of length 1; a picture of one grey gives rounding."""
        seen = self._detail(pictures)
        mean = (seen * self._share).sum((1, 2), keepdim=True)
        deviation = ((seen - mean).square() * self._share).sum((1, 2), keepdim=True).sqrt()
        local = (seen - self._window(seen)) / deviation.clamp_min(1e-12)  # no unit from here on
        even = local.clamp(-self._clip, self._clip).flatten(1)[:, self._inside] * self._root_weight
        even = even - (even @ self._unit)[:, None] * self._unit
        return torch.nn.functional.normalize(even, dim=1)
