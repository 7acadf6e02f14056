"""The noun that comes out: a learnt map, and all that was learnt with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from sphereorient.mapping.grid import texel_areas
from sphereorient.pose.fitter import CameraView
from sphereorient.pose.light import Light


@dataclass(frozen=True, kw_only=True, eq=False)
class Closure:
    """What closing the loops did; angles in rad."""

    pairs: int  # of neighbouring instants
    loops: int  # tried
    closed: int  # accepted and kept by the graph
    drift_before_rad: float  # rms of what the closed loops were off in the chain
    drift_after_rad: float  # and afterwards
    moved_rad: float  # rms of how far attitudes were moved, the body frame's own turn taken off


@dataclass(frozen=True, kw_only=True, eq=False)
class Round:
    """One round of attitudes, light and map."""

    moved_rad: float  # rms of the attitudes' moves
    misfit: float  # mean square of the residuals over the noise expected, the map not yet solved anew
    blur_px: float


@dataclass(frozen=True, kw_only=True, eq=False)
class LearntMap:
    """A map learnt from movies; made by `learn_map`.

    The body frame of a learnt map is arbitrary; it is the lab's at the first instant that has an attitude:
    R_lab_body = identity there.

    Pictures through a mirror give the mirrored map and mirrored turns: one camera cannot tell, nor can two whose
    pictures' horizontal axes are one line in the lab; the others then contradict each other and are refused. Say
    `flip:` in the experiment.
    """

    texture: Tensor  # (H, 2 H) float32, 0 black .. 1 white; NaN where never seen
    seen: Tensor  # (H, 2 H) int64, pictures that show each texel
    sigma: Tensor  # (H, 2 H) float32, standard deviation of the paint by noise alone; infinite where never seen
    R_lab_body: Tensor  # (N, 3, 3) float64, NaN where the sphere was not found
    position_lab_mm: Tensor  # (N, 3) float64, NaN likewise
    valid: Tensor  # (N,) bool, frames with an attitude
    fitted: Tensor  # (N,) bool, frames that the map was fitted to; the others follow them
    score: Tensor  # (N, C), share of each picture's variance that the map explains; NaN where not fitted
    views: Sequence[CameraView]  # with the scenes without the ball
    light: Light
    blur_px: float  # with which the map was learnt
    closure: Closure
    rounds: tuple[Round, ...]
    arrived: bool  # whether the last round moved attitudes by less than the setting

    @property
    def seen_share(self) -> float:
        """Share of the sphere that was seen at all."""
        areas = texel_areas(len(self.texture))
        return float((areas * (self.seen > 0)).sum() / areas.sum())
