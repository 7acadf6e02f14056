"""What a method makes of one scene, in numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import chi2

from sphereorient import so3
from sphereorient.evaluate.score import Score, score_track
from sphereorient.evaluate.truth import true_orientations
from sphereorient.trajectory import CameraTrack, Trajectory

WRONG_DEG = 10.0
FIRST = (1, 3, 10)  # candidates among which the right one is looked for
INSIDE = 0.95  # of the stated errors: how often the truth is to lie within
DIGITS = 5
Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One method on one scene; made by `measure` and `refused`, kept as JSON. None: not measured."""

    scene: str
    kind: str
    level: int
    seed: int
    degradations: Mapping[str, int]
    method: str
    refused: str  # the message, where the method gave no track
    frames: int
    orientation_deg: tuple[float | None, ...]  # error after assembly, frame by frame
    position_mm: tuple[float | None, ...]
    confidence: tuple[float | None, ...]  # of the chosen orientation
    looks: int  # cameras times frames
    looks_wrong: int  # whose own best candidate is off by more than 10 degrees, or which have none
    recall: Mapping[str, float]  # share of the looks with the right orientation among the first K candidates, by K
    stated: int  # frames with a covariance of the orientation
    inside: int  # of these, with the truth inside the 95 % region
    seconds: float

    @property
    def errors_deg(self) -> Floats:
        """(frames,), NaN where there is no orientation."""
        return np.array([np.nan if x is None else x for x in self.orientation_deg], np.float64)

    @property
    def wrong(self) -> int:
        """Frames off by more than 10 degrees after assembly."""
        return int((np.nan_to_num(self.errors_deg) > WRONG_DEG).sum())

    @property
    def lost(self) -> int:
        """Frames without an orientation."""
        return int(np.isnan(self.errors_deg).sum())


def measure(track: Trajectory, truth_path: Path, seconds: float) -> dict[str, Any]:
    """Return the measured fields of `Outcome`.

    Args:
        track: what the method gave.
        truth_path: truth.h5 of the scene.
        seconds: that the method took, movies included.
    """
    score = score_track(track, truth_path)
    R_true = true_orientations(truth_path, track.time)
    ranks = np.concatenate([_ranks(seen, R_true) for seen in track.cameras.values()] or [np.zeros(0)])
    stated, inside = _inside(track, R_true)
    return {
        "refused": "",
        "frames": len(track),
        "orientation_deg": _numbers(np.where(score.valid, score.orientation_deg, np.nan)),
        "position_mm": _numbers(_position(score)),
        "confidence": _numbers(np.where(score.valid, track.confidence, np.nan)),
        "looks": len(ranks),
        "looks_wrong": int((ranks >= 1).sum()),
        "recall": {str(first): float((ranks < first).mean()) if len(ranks) else 0.0 for first in FIRST},
        "stated": stated,
        "inside": inside,
        "seconds": round(seconds, 2),
    }


def no_track(frames: int, message: str, seconds: float) -> dict[str, Any]:
    """Return the measured fields of `Outcome` where a method refused the scene."""
    nothing = (None,) * frames
    return {
        "refused": message,
        "frames": frames,
        "orientation_deg": nothing,
        "position_mm": nothing,
        "confidence": nothing,
        "looks": 2 * frames,
        "looks_wrong": 2 * frames,
        "recall": {str(first): 0.0 for first in FIRST},
        "stated": 0,
        "inside": 0,
        "seconds": round(seconds, 2),
    }


def _position(score: Score) -> Floats:
    return np.where(score.valid, score.position_mm, np.nan)


def _numbers(values: Floats) -> tuple[float | None, ...]:
    return tuple(round(x, DIGITS) if math.isfinite(x) else None for x in values.tolist())


def _ranks(seen: CameraTrack, R_true: Floats) -> Floats:
    """Return at which place, 0 the best, a camera's candidates have the right orientation, (N,); inf: nowhere."""
    counts = np.diff(seen.candidate_offset)
    frame = np.repeat(np.arange(len(counts)), counts)
    pair = (torch.from_numpy(seen.candidate_orientation), torch.from_numpy(R_true[frame]))
    off_deg = np.rad2deg(so3.geodesic_distance(*pair).numpy())
    order = np.lexsort((-np.nan_to_num(seen.candidate_score, nan=-np.inf), frame))
    place = np.empty(len(frame))
    place[order] = np.arange(len(frame)) - seen.candidate_offset[:-1][frame[order]]
    ranks = np.full(len(counts), np.inf)
    right = off_deg <= WRONG_DEG
    np.minimum.at(ranks, frame[right], place[right])
    return ranks


def _inside(track: Trajectory, R_true: Floats) -> tuple[int, int]:
    """Return the frames with a covariance, and those whose truth lies within its 95 % region."""
    known = track.valid & np.isfinite(track.orientation_cov).all((1, 2)) & np.isfinite(track.orientation).all((1, 2))
    R, cov = torch.from_numpy(track.orientation[known]), track.orientation_cov[known]
    delta = so3.log(torch.from_numpy(R_true[known]) @ R.mT).numpy()
    off = np.einsum("ni,ni->n", delta, np.linalg.solve(cov, delta[..., None])[..., 0]) if len(delta) else np.zeros(0)
    return int(known.sum()), int((off <= chi2.ppf(INSIDE, 3)).sum())
