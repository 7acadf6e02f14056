"""The record between locate and orient: where is the sphere, frame by frame, in one camera."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.errors import ShapeError, refusal
from sphereorient.trajectory import Reason


@dataclass(frozen=True, kw_only=True, eq=False)
class Sightings:
    """Outline of the sphere in N frames of one camera; made by locate, read by orient and the pipeline.

    Centre and radius are NaN where the sphere was not found and not interpolated; `outline_rms_px` is NaN wherever
    they were not measured in the frame itself.
    """

    centre_px: Tensor  # (N, 2) float64, (u, v)
    radius_px: Tensor  # (N,) float64
    outline_rms_px: Tensor  # (N,) float64, deviation of the edges from the circle
    coverage: Tensor  # (N,) float64, share of the outline's directions with an edge
    flags: Tensor  # (N,) int64, POSITION_INTERPOLATED and POSITION_OUTLIER_REPLACED of trajectory.Flag
    reason: tuple[Reason, ...]  # N, why the sphere was not measured; Reason.OK where it was

    def __post_init__(self) -> None:
        """Compare the lengths of the parts."""
        lengths = {len(part) for part in (self.centre_px, self.radius_px, self.outline_rms_px, self.coverage)}
        if lengths | {len(self.flags), len(self.reason)} != {len(self.reason)}:
            got = f"parts of {sorted(lengths)}, {len(self.flags)} flags, {len(self.reason)} reasons"
            raise ShapeError(refusal("Sightings", expected="one row a frame", got=got, do="pass equal lengths"))

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.reason)

    @property
    def placed(self) -> Tensor:
        """Frames with a centre, measured, interpolated or replaced; (N,) bool."""
        return torch.isfinite(self.radius_px)
