from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.errors import ExperimentError, ShapeError, refusal
from sphereorient.trajectory import Reason


@dataclass(frozen=True, kw_only=True, eq=False)
class Sightings:
    """Outlines of the sphere in N frames of one camera; NaN where neither found nor interpolated."""

    centre_px: Tensor  # (N, 2) float64, (u, v)
    radius_px: Tensor  # (N,) float64
    outline_rms_px: Tensor  # (N,) float64, distance of edges from the circle, NaN if not measured in the frame
    coverage: Tensor  # (N,) float64, share of directions with an edge
    flags: Tensor  # (N,) int64, POSITION_INTERPOLATED and POSITION_OUTLIER_REPLACED
    reason: tuple[Reason, ...]  # N; Reason.OK if measured

    def __post_init__(self) -> None:
        lengths = {len(part) for part in (self.centre_px, self.radius_px, self.outline_rms_px, self.coverage)}
        if lengths | {len(self.flags), len(self.reason)} != {len(self.reason)}:
            got = f"parts of {sorted(lengths)}, {len(self.flags)} flags, {len(self.reason)} reasons"
            raise ShapeError(refusal("Sightings", expected="one row a frame", got=got, do="pass equal lengths"))

    def __len__(self) -> int:
        return len(self.reason)

    @property
    def placed(self) -> Tensor:
        """Frames with a centre, measured or interpolated, (N,) bool."""
        return torch.isfinite(self.radius_px)


def check_seen(sightings: Mapping[str, Sightings]) -> None:
    """Raise ExperimentError, with the frames' reasons, if no camera found the sphere in any frame."""
    if any(bool(seen.placed.any()) for seen in sightings.values()):
        return
    reasons = ", ".join(sorted({str(why) for seen in sightings.values() for why in seen.reason}))
    do = "check sphere.diameter and the cameras, or set locate.diameter_px"
    raise ExperimentError(refusal("movies", expected="the sphere in some frame", got=f"none ({reasons})", do=do))


def size_of(sightings: Sightings, size_px: int | None) -> int:
    """Return the side of the normalised disks, px: the setting, or the movie's median diameter."""
    if size_px is not None:
        return size_px
    return max(16, round(2 * float(sightings.radius_px[sightings.placed].median())))
