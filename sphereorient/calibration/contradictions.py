"""Whether cameras agree: in a whole movie, with likely causes, and frame by frame."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sphereorient.calibration.comparison import (
    Cause,
    Comparison,
    Gaps,
    Limits,
    Seen,
    likely_causes,
    limits_of,
    misfit,
    typical,
)
from sphereorient.cameras import Camera, centre_lab_mm
from sphereorient.errors import Flag, Reason
from sphereorient.so3 import hat, log, solve_damped
from sphereorient.trajectory import Trajectory

FEWEST = 3  # least number of frames for a comparison
EXPLAINS = 0.3  # largest share of the misfit left by a cause
EQUALLY = 2.0  # causes that leave at most this many times the least misfit are named too
SIMPLER = 0.5  # a cause of fewer parameters is preferred if its misfit, in units of the limits, is below this
OUTLINES = Limits(gap_px=1.5, turn_deg=1.0, size=0.01)  # for outlines alone: dark paint makes them jump
ELSEWHERE = [str(Reason.CONTRADICTS), str(Reason.SECOND_BALL)]  # of a camera that sees the sphere elsewhere
OWN = ("centre_px", "radius_px", "orientation", "orientation_cov")  # of each camera of a track
CONTRADICTS_SIGMAS = 5.0  # of the difference of two cameras alone: above, it is not noise


@dataclass(frozen=True, kw_only=True)
class Consistency:
    """Typical disagreement of cameras, and its causes, likeliest first."""

    frames: int  # with two cameras; no verdict below `FEWEST`
    gap_px: float = math.nan  # between the lines of sight
    turn_deg: float = math.nan  # between the attitudes
    size: float = math.nan  # measured over expected, less 1, of the camera where it is farthest from 0
    contradicts: bool = False
    causes: tuple[Cause, ...] = ()

    @property
    def deadly(self) -> bool:
        """Whether the likeliest cause must be corrected first."""
        return any(cause.deadly for cause in self.causes[:1])

    @property
    def advice(self) -> str:
        """The causes as text."""
        unknown = "no single cause explains it: check the cameras, the movies and sphere.diameter"
        return "; or ".join(cause.words for cause in self.causes) or unknown

    def __str__(self) -> str:
        parts = {f"lines of sight {self.gap_px:.2f} px apart": self.gap_px}
        parts |= {f"attitudes {self.turn_deg:.2g} degrees apart": self.turn_deg}
        parts |= {f"size {round(100 * self.size, 1) + 0.0:+.1f} %": self.size}
        return ", ".join(words for words, value in parts.items() if math.isfinite(value))


def compare_cameras(seen: Seen, limits: Limits) -> Consistency:
    """Compare the cameras in pairs; if they contradict each other, find the causes with the least misfit."""
    compare = Comparison(seen, limits)
    found = compare(compare.sights())
    count = int(torch.isfinite(found[..., 0]).sum(1).amax()) if len(found) else 0
    if count < FEWEST:
        return Consistency(frames=count)
    usual = typical(found)
    usual = usual.gather(0, usual.nan_to_num().abs().argmax(0, keepdim=True))[0]  # of the most different pair
    known = Consistency(
        frames=count,
        gap_px=limits.gap_px * float(usual[0]),
        turn_deg=limits.turn_deg * float(usual[1]),
        size=math.expm1(limits.size * float(usual[2])),
        contradicts=bool((usual.nan_to_num().abs() > 1).any()),
    )
    if not known.contradicts:
        return known
    causes = sorted((c for c in likely_causes(compare, found) if c.left < EXPLAINS), key=lambda cause: cause.left)
    agree = {*_majority(compare, found)} if len(compare.cameras) > 2 else set()
    causes = [cause for cause in causes if not agree & {*cause.cameras}] or causes
    if causes:
        enough = EQUALLY * causes[0].left + SIMPLER / max(misfit(found), 1e-9)
        causes = [cause for cause in causes if cause.left < enough]
        fewest = min(cause.parameters for cause in causes)
        causes = [cause for cause in causes if cause.parameters == fewest]
    return replace(known, causes=tuple(causes))


def majority(seen: Seen, limits: Limits = OUTLINES) -> tuple[int, ...]:
    """Return the largest set of cameras that agree in pairs, if it is more than half of three or more; else ().
    Among sets of one size, that with the best agreement of lines of sight and sizes. Sizes decide along a direction
    that two cameras alone measure: a camera that looks along it shows it as size.
    """
    if len(seen.cameras) < 3:
        return ()
    compare = Comparison(seen, limits)
    return _majority(compare, compare(compare.sights()))


def _majority(compare: Comparison, found: Tensor) -> tuple[int, ...]:
    count = len(compare.cameras)
    if not found.shape[1]:
        return ()
    gap, turn, size = typical(found).unbind(1)
    agree = (gap <= 1) & (turn.nan_to_num(0.0) <= 1)  # without paint in view the rotation is unknown
    worse = torch.where(agree, gap.square() + size.square(), torch.inf)
    apart = dict(zip(compare.pairs, worse.tolist(), strict=True))
    for several in range(count, count // 2, -1):
        sets = combinations(range(count), several)
        worst = {some: max(apart[pair] for pair in combinations(some, 2)) for some in sets}
        best = min(worst, key=lambda some: worst[some])
        if math.isfinite(worst[best]):
            return best
    return ()


def said_alone(
    track: Trajectory, cameras: Mapping[str, Camera], diameter_mm: float, consecutive: bool
) -> tuple[Seen, Limits]:
    """Return the measurements by each camera of a track alone, and the allowed differences."""
    centre_px, radius_px, R, covariance = (_of_cameras(track, name) for name in OWN)
    seen = Seen(cameras=cameras, centre_px=centre_px, radius_px=radius_px, R_lab_body=R, diameter_mm=diameter_mm)
    return replace(seen, frame=torch.arange(len(track)) if consecutive else None), limits_of(seen, covariance)


def with_contradictions(
    track: Trajectory,
    cameras: Mapping[str, Camera],
    diameter_mm: float,
    consecutive: bool,
    lasting_rad2: Tensor | float = 0.0,
) -> tuple[Trajectory, Consistency]:
    """Mark frames in which two cameras contradict each other, and add their disagreement to the covariances.
    Rotation errors that last in each camera, `lasting_rad2` (C, 3, 3), allow disagreement without a contradiction. A
    camera that contradicts more others than agree with it is not used. A contradiction widens the covariances of its
    frame. All covariances are scaled if cameras disagree more than stated in most frames. Return also how well the
    cameras agree in the whole movie.
    """
    seen, limits = said_alone(track, cameras, diameter_mm, consecutive)
    elsewhere = np.stack([np.isin(one.reason, ELSEWHERE) for one in track.cameras.values()], 1)
    believed = track.believed.sum(1)
    outvoted = torch.from_numpy(elsewhere & (believed > elsewhere.sum(1))[:, None])
    wrong = torch.from_numpy(elsewhere.any(1)) & ~outvoted.any(1)
    centre_px, R = seen.centre_px.clone(), seen.R_lab_body.clone()
    centre_px[outvoted], R[outvoted] = torch.nan, torch.nan
    counted = replace(seen, centre_px=centre_px, R_lab_body=R)
    pairs = [_compared(track, counted, lasting_rad2, *two) for two in seen.pairs]
    for pair in pairs:
        wrong |= pair.turned | (pair.gaps.signed_px.abs() > limits.gap_px)
    turns = torch.cat([pair.away[pair.both & ~wrong] for pair in pairs])
    places = torch.cat([pair.apart[pair.both & ~wrong] for pair in pairs])
    turn_scale, place_scale = _excess(turns, 3), _excess(places, 1)
    unit = torch.eye(3, dtype=torch.float64)
    rolls = _rolls_by_move(track, cameras, diameter_mm / 2)
    scaled: dict[str, Tensor] = {}
    for kind in ("_cov", "_smooth_cov"):
        place, turn = (torch.from_numpy(getattr(track, name + kind)) for name in ("position", "orientation"))
        rolled = (place_scale**2 - 1) * (rolls @ place[:, None] @ rolls.mT).sum(1)
        scaled["position" + kind] = place_scale**2 * place
        scaled["orientation" + kind] = turn_scale**2 * turn + rolled.nan_to_num()
    place_cov, turn_cov = scaled["position_cov"], scaled["orientation_cov"]
    share = 1 / torch.from_numpy(believed).clamp_min(2).to(torch.float64)
    for pair in pairs:
        # If either camera is wrong, the error is half the contradiction for a mean, all of it for one camera.
        turn = torch.where(pair.both, share, 1.0)[:, None] * pair.turned[:, None] * pair.turn.nan_to_num()
        gap_mm = torch.where(pair.both, share, 0.5) * pair.gaps.signed_mm.nan_to_num()
        gap_mm = gap_mm * (pair.apart > CONTRADICTS_SIGMAS * place_scale)
        shift_mm = (pair.gaps.position_lab_mm - torch.from_numpy(track.position)).nan_to_num()
        shift_mm = torch.where(pair.both[:, None], 0.0, shift_mm)
        # A pose between two pictures is rotated to match their paint; one camera's own pose is not.
        rolled = torch.where(pair.both, gap_mm, 0.0)[:, None] / (diameter_mm / 2)
        for whole, off in ((turn_cov, turn), (turn_cov, rolled), (place_cov, gap_mm[:, None]), (place_cov, shift_mm)):
            # In all directions: the direction of the error is less certain than its size.
            whole += off.square().sum(-1)[:, None, None] * unit
    flags = track.flags | np.where(wrong.numpy() & track.valid, np.uint32(Flag.CONTRADICTION), np.uint32(0))
    stated: dict[str, Any] = {name: whole.numpy() for name, whole in scaled.items()}
    return replace(track, flags=flags, **stated), compare_cameras(seen, limits)


def _rolls_by_move(track: Trajectory, cameras: Mapping[str, Camera], radius_mm: float) -> Tensor:
    """Return the rotation (N, C, 3, 3), rad/mm, that keeps the same paint in each camera's view of a moved sphere,
    weighted so that squares add up to their mean over the cameras in use. It is 0 along the line of sight.
    """
    X, count = torch.from_numpy(track.position), torch.from_numpy(track.believed)
    sight = torch.stack([X - centre_lab_mm(camera) for camera in cameras.values()], 1)
    weight = (count / count.sum(1, keepdim=True).clamp_min(1)).sqrt()
    return weight[..., None, None] * hat(torch.nn.functional.normalize(sight, dim=-1)) / radius_mm


@dataclass(frozen=True, kw_only=True, eq=False)
class _Compared:
    """Differences between two cameras alone in each frame; distances in units of stated errors, NaN: unknown."""

    both: Tensor  # (N,) bool, both are used
    turn: Tensor  # (N, 3), rad, from the second camera's rotation to the first one's
    away: Tensor  # (N,), Mahalanobis distance of the rotations
    gaps: Gaps
    apart: Tensor  # (N,), the gap over its standard deviation

    @property
    def turned(self) -> Tensor:
        return self.away > CONTRADICTS_SIGMAS


def _compared(track: Trajectory, seen: Seen, lasting_rad2: Tensor | float, k: int, m: int) -> _Compared:
    """Compare the cameras k and m of a track."""
    spread = (_of_cameras(track, "orientation_cov") + lasting_rad2)[:, [k, m]].sum(1)
    turn, gaps = log(seen.R_lab_body[:, k] @ seen.R_lab_body[:, m].mT), seen.gaps((k, m))
    across, known = gaps.across_lab[..., None], torch.from_numpy(np.nan_to_num(track.position_systematic_cov))
    # The gap of two equally certain lines of sight has twice the deviation of their middle.
    variance = 4 * (across.mT @ known @ across)[:, 0, 0]
    for c in (k, m):
        sigma = _of_cameras(track, "centre_sigma_px") / seen.radius_px
        variance = variance + sigma[:, c].square() * (seen.diameter_mm / 2) ** 2
    return _Compared(
        both=torch.from_numpy(track.believed[:, [k, m]].all(1)),
        turn=turn,
        away=(turn * solve_damped(spread, turn)).sum(-1).sqrt(),
        gaps=gaps,
        apart=gaps.signed_mm.abs() / variance.sqrt(),
    )


def _excess(distance: Tensor, dimensions: int) -> float:
    """Return the rms of distances (n,) over the expected one, at least 1; distances above five medians are left out."""
    kept = distance[distance <= CONTRADICTS_SIGMAS * distance.nanmedian()]
    return max(1.0, float((kept.square().mean() / dimensions).sqrt().nan_to_num(1.0)))


def _of_cameras(track: Trajectory, name: str) -> Tensor:
    """Return a dataset of all cameras, (N, C, ...); NaN for a camera without an orientation."""
    whole = np.stack([getattr(camera, name) for camera in track.cameras.values()], 1)
    whole[np.isnan([camera.orientation[:, 0, 0] for camera in track.cameras.values()]).T] = np.nan
    return torch.from_numpy(whole)
