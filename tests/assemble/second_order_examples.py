"""Movies of pooled candidates whose truth is known, for the path with physics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from assemble_examples import noisy, turned_deg
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble import Chosen, PathLayer, PathSettings

SIGMA = 1.0e-3  # rad per axis, of every candidate


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypotheses:
    """Candidates of N frames, C places each; masked places may hold anything."""

    R_lab_body: Tensor  # (N, C, 3, 3)
    nll: Tensor  # (N, C)
    variance_rad2: Tensor  # (N, C)
    mask: Tensor  # (N, C) bool


@dataclass(frozen=True, kw_only=True, eq=False)
class Solved(Chosen):
    """A history with its orientations (N, 3, 3), NaN where none is right."""

    R_lab_body: Tensor


def physical_path(hypotheses: Hypotheses, time_s: Tensor, settings: PathSettings) -> Solved:
    """The most probable history by the layer that `track` calls, and the orientations that it chooses."""
    h = hypotheses
    chosen: Chosen = PathLayer(2, settings=settings)(h.R_lab_body, -h.nll, time_s, h.variance_rad2, h.mask)
    there = chosen.present
    R = torch.full((len(h.mask), 3, 3), torch.nan, dtype=torch.float64)
    R[there] = hypotheses.R_lab_body[there, chosen.choice[there]].double()
    return Solved(**vars(chosen), R_lab_body=R)


def pooled(*tracks: Tensor, nll: Sequence[float] | Tensor | None = None, mask: Tensor | None = None) -> Hypotheses:
    """Tracks (N, 3, 3) side by side; of equal likelihood by default."""
    R = torch.stack(tracks, 1)
    shape = R.shape[:2]
    given = torch.zeros(shape[1], dtype=torch.float64) if nll is None else torch.as_tensor(nll, dtype=torch.float64)
    return Hypotheses(
        R_lab_body=R,
        nll=given.expand(shape),
        variance_rad2=torch.full(shape, SIGMA**2, dtype=torch.float64),
        mask=torch.ones(shape, dtype=torch.bool) if mask is None else mask,
    )


def seen(R: Tensor, rng: torch.Generator) -> Tensor:
    """R as the pictures give it."""
    return noisy(R, SIGMA, rng)


def without(R: Tensor, frames: Sequence[int] | range) -> Hypotheses:
    """One candidate a frame, none in some."""
    mask = torch.ones(len(R), 1, dtype=torch.bool)
    mask[list(frames)] = False
    return pooled(R, mask=mask)


def standing(frames: int) -> Tensor:
    """An orientation that does not change."""
    start = torch.eye(3, dtype=torch.float64)
    return turned_deg(start, 0.0, 0.0, 120.0).expand(frames, 3, 3)


def wrong_frames(path: Solved, R: Tensor) -> list[int]:
    """Frames with an orientation more than 1 degree from the truth."""
    apart = so3.geodesic_distance(path.R_lab_body, R)
    return torch.nonzero(apart > math.radians(1.0)).flatten().tolist()


def lost_frames(path: Chosen) -> list[int]:
    """Frames without an orientation."""
    return torch.nonzero(~path.present).flatten().tolist()


def flagged(path: Chosen, flag: int) -> list[int]:
    """Frames that carry a flag."""
    return torch.nonzero(path.flags & int(flag)).flatten().tolist()
