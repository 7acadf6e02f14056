"""Motions whose truth is known, and candidates around them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.search import Candidates
from sphereorient.trajectory import Reason

RATE_HZ = 600.0
Frame = Sequence[tuple[Tensor, float]]  # (R_lab_body, T) of each candidate


def times(frames: int) -> Tensor:
    return torch.arange(frames, dtype=torch.float64) / RATE_HZ


def turning(frames: int, deg_per_frame: float = 1.2) -> Tensor:
    """A smooth rotation whose axis slowly changes, (N, 3, 3)."""
    k = torch.arange(frames, dtype=torch.float64)
    axis = torch.stack([torch.cos(k / 40), torch.sin(k / 40), 0.5 * torch.ones_like(k)], dim=-1)
    steps = so3.exp(math.radians(deg_per_frame) * axis / axis.norm(dim=-1, keepdim=True))
    R = [torch.eye(3, dtype=torch.float64)]
    for step in steps[1:]:
        R.append(step @ R[-1])
    return torch.stack(R)


def turned_deg(R: Tensor, *degrees: float) -> Tensor:
    """R rotated further by a rotation vector in lab components."""
    return so3.exp(torch.deg2rad(torch.tensor(degrees, dtype=R.dtype))) @ R


def noisy(R: Tensor, sigma_rad: float | Tensor, rng: torch.Generator) -> Tensor:
    """R with Gaussian errors of the same size on each axis."""
    noise = torch.randn(*R.shape[:-2], 3, generator=rng, dtype=R.dtype)
    return so3.exp(noise * torch.as_tensor(sigma_rad, dtype=R.dtype)[..., None]) @ R


def candidates_of(frames: Sequence[Frame]) -> Candidates:
    """Candidates, best first in each frame."""
    ordered = [sorted(frame, key=lambda pair: -pair[1]) for frame in frames]
    rows = [pair for frame in ordered for pair in frame]
    counts = torch.tensor([0, *map(len, ordered)])
    return Candidates(
        offset=counts.cumsum(0),
        R_view_body=torch.stack([R for R, _ in rows]) if rows else torch.zeros(0, 3, 3, dtype=torch.float64),
        R_lab_view=torch.eye(3, dtype=torch.float64).expand(len(frames), 3, 3),
        score=torch.tensor([score for _, score in rows], dtype=torch.float64),
        reason=tuple(Reason.OK if frame else Reason.NOT_FOUND for frame in ordered),
    )


def single(R: Tensor, score: float | Mapping[int, float] = 0.9, without: Sequence[int] = ()) -> Candidates:
    """One candidate a frame, none in some."""
    scores = score if isinstance(score, Mapping) else dict.fromkeys(range(len(R)), score)
    return candidates_of([[] if k in without else [(R[k], scores[k])] for k in range(len(R))])
