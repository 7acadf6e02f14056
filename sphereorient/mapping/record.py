from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.mapping.grid import texel_areas
from sphereorient.pose.fitter import CameraView
from sphereorient.pose.model import Light


@dataclass(frozen=True, kw_only=True, eq=False)
class Closure:
    """The effect of closing the loops; angles in rad."""

    pairs: int  # of neighbouring instants
    loops: int  # tried
    closed: int  # accepted and kept by the graph
    drift_before_rad: float  # rms error of the closed loops in the chain
    drift_after_rad: float  # and afterwards
    moved_rad: float  # rms move of the orientations, the body frame's own turn removed


@dataclass(frozen=True, kw_only=True, eq=False)
class Iteration:
    """One iteration of orientations, light and map."""

    moved_rad: float  # rms move of the orientations
    misfit: float  # chi^2 per pixel, before the map is solved anew
    blur_px: float


@dataclass(frozen=True, kw_only=True, eq=False)
class LearntMap:
    """A texture map learnt from movies or photographs; the body frame is the lab at the first known orientation.

    Through a mirror it is mirrored, which one camera or parallel ones cannot detect: set `flip:` in the experiment.
    """

    texture: Tensor  # (H, 2 H) float32, 0 black .. 1 white; NaN where never seen
    seen: Tensor  # (H, 2 H) int64, pictures that show each texel
    sigma: Tensor  # (H, 2 H) float32, standard deviation of the texture by noise alone; infinite where never seen
    R_lab_body: Tensor  # (N, 3, 3) float64, NaN where the sphere was not found
    position_lab_mm: Tensor  # (N, 3) float64, NaN likewise
    valid: Tensor  # (N,) bool, frames with an orientation
    fitted: Tensor  # (N,) bool, frames that the map was fitted to; the others follow them
    score: Tensor  # (N, C), share of each picture's variance that the map explains; NaN where not fitted
    views: Sequence[CameraView]  # with the scenes without the ball
    light: Light
    blur_px: float  # estimated with the map
    closure: Closure
    rounds: tuple[Iteration, ...]
    arrived: bool  # whether the last iteration moved orientations by less than the setting `arrived_deg`

    @property
    def seen_share(self) -> float:
        """Return the share of the sphere that was seen at all."""
        areas = texel_areas(len(self.texture))
        return float((areas * (self.seen > 0)).sum() / areas.sum())


def attitude_change_rad(before: Tensor, after: Tensor) -> float:
    """Return the rms angle, rad, between orientations (N, 3, 3) without a common rotation of the body frame."""
    Q = so3.nearest_rotation((before.mT @ after).sum(0))
    return rms(so3.log(after @ (before @ Q).mT))


def rms(vectors: Tensor) -> float:
    """Return the root mean square length of vectors (E, 3); 0 for none."""
    return float(vectors.square().sum(-1).mean().sqrt()) if len(vectors) else 0.0


def evenly_spread(rows: Tensor, count: int) -> Tensor:
    """Return at most `count` of the rows, evenly spread, ends included."""
    if len(rows) <= count:
        return rows
    return rows[torch.linspace(0, len(rows) - 1, count).round().long()]
