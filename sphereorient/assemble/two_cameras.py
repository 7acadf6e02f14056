"""Two cameras, one sphere: repair of the one from the other, and the weighted mean on SO(3)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble.path import Path, links
from sphereorient.assemble.segments import find_spikes, moving, number_segments
from sphereorient.assemble.settings import AssembleSettings
from sphereorient.orient import Candidates
from sphereorient.trajectory import Flag

CHI2_3_MEDIAN = 2.366  # median of a sum of three squared standard normals


@dataclass(frozen=True, kw_only=True, eq=False)
class Fused:
    """The sphere's orientation in N frames from all cameras; made by assemble, read by motion and the pipeline."""

    R_lab_body: Tensor  # (N, 3, 3), NaN where no camera has one
    sigma_rad: Tensor  # (N,), standard deviation per axis; NaN where there is nothing to measure it by
    disagreement_rad: Tensor  # (N,), distance of the two cameras' orientations after repair; NaN with one
    segment: Tensor  # (N,) int64, -1 outside any
    spike: Tensor  # (N,) bool
    flags: Tensor  # (N,) int64


@dataclass(frozen=True, kw_only=True, eq=False)
class _Track:
    """One camera's orientations while they are repaired."""

    R: Tensor  # (N, 3, 3)
    score: Tensor  # (N,)
    present: Tensor  # (N,) bool


def fuse(
    paths: Mapping[str, Path], candidates: Mapping[str, Candidates], time_s: Tensor, settings: AssembleSettings
) -> Fused:
    """Join the cameras' paths, both in the lab frame, into one.

    Stretches in which they are more than `repair_deg` apart are repaired; then each frame is the mean of both,
    weighted with the inverse moving variance of xi. The variances are relative; their common scale comes from how far
    the cameras are apart over the whole movie.

    Args:
        paths: of one or two cameras, N frames.
        candidates: of the same cameras.
        time_s: (N,).
        settings: of the room.

    Returns:
        The fused track. Frames of one camera only carry its orientation and `ONE_CAMERA`.

    Source: paper section III E; ERRATA A7 (which camera is right) and A8 (what the weights measure).
    """
    names = list(paths)
    tracks = [_Track(R=p.R_lab_body.clone(), score=p.score.clone(), present=p.present.clone()) for p in paths.values()]
    flags = torch.zeros(len(time_s), dtype=torch.int64)
    if len(tracks) == 2:
        graphs = (candidates[names[0]], candidates[names[1]])
        tracks, flags = _repair((tracks[0], tracks[1]), graphs, settings)
    variance = [_moving_variance(links(t.R, t.score, time_s)[0], settings.weight_window_frames) for t in tracks]
    R, sigma, apart = _mean(tracks, variance)
    present = torch.stack([t.present for t in tracks])
    flags = flags | torch.where(present.sum(0) == 1, int(Flag.ONE_CAMERA), 0)
    score = torch.stack([torch.where(t.present, t.score, 0.0) for t in tracks]).sum(0) / present.sum(0)
    xi, turn = links(R, score, time_s)
    spike = find_spikes(xi, turn, settings)
    return Fused(
        R_lab_body=R,
        sigma_rad=sigma,
        disagreement_rad=apart,
        segment=number_segments(present.any(0), spike, settings.gap_frames_max),
        spike=spike,
        flags=flags | torch.where(spike, int(Flag.SPIKE), 0),
    )


def _moving_variance(xi: Tensor, window: int) -> Tensor:
    """Variance of xi about each frame, (N,); the movie's own where too few links are near; never 0."""
    windows = moving(xi, window)
    count = torch.isfinite(windows).sum(-1)
    mean = windows.nanmean(-1, keepdim=True)
    variance = (windows - mean).square().nansum(-1) / (count - 1).clamp_min(1)
    typical = variance[count >= 3].median() if (count >= 3).any() else torch.ones((), dtype=xi.dtype)
    typical = typical if typical > 0 else torch.ones_like(typical)
    # Within a factor of ten of the typical one: a quiet stretch of xi is no proof of a perfect camera.
    return torch.where(count >= 3, variance.clamp(0.1 * typical, 10 * typical), typical)


def _mean(tracks: list[_Track], variance: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Weighted mean, sigma per axis, and the cameras' distance."""
    if len(tracks) == 1:
        unknown = torch.full_like(tracks[0].score, torch.nan)
        return tracks[0].R, unknown, unknown
    a, b = tracks
    both = a.present & b.present
    eye = torch.eye(3, dtype=a.R.dtype)
    safe_a, safe_b = (torch.where(both[:, None, None], t.R, eye) for t in tracks)
    weight = torch.stack([1 / variance[0], 1 / variance[1]], dim=-1)
    mean = so3.weighted_mean(torch.stack([safe_a, safe_b], dim=-3), weight)
    R = torch.where(both[:, None, None], mean, torch.where(a.present[:, None, None], a.R, b.R))
    apart = torch.where(both, so3.geodesic_distance(safe_a, safe_b), torch.nan)
    # E d^2 = 3 (s_a^2 + s_b^2) for independent errors per axis; the median is blind to what repair left wrong.
    scale = (apart.square() / (variance[0] + variance[1])).nanmedian() / CHI2_3_MEDIAN
    fused = 1 / weight.sum(-1)
    relative = torch.where(both, fused, torch.where(a.present, variance[0], variance[1]))
    sigma = torch.where(a.present | b.present, (scale * relative).sqrt(), torch.nan)
    return R, sigma, apart


def _repair(
    tracks: tuple[_Track, _Track], graphs: tuple[Candidates, Candidates], settings: AssembleSettings
) -> tuple[list[_Track], Tensor]:
    """Repair each stretch in which the cameras contradict each other, the better supported one leading.

    Nothing tells beforehand which camera is right (A7). Each in turn is supposed to be: the other then takes, in
    every frame, its candidate nearest to that orientation, if there is one within `repair_deg`. The supposition under
    which both pictures are explained better, by mean T, holds; where they are equal, the steadier one, and the frames
    are ambiguous.
    """
    limit = math.radians(settings.repair_deg)
    a, b = tracks
    both = a.present & b.present
    flags = torch.zeros(len(both), dtype=torch.int64)
    apart = torch.where(both, so3.geodesic_distance(a.R, b.R), 0.0)
    for frames in _stretches(apart > limit):
        # (leader, follower): either way round.
        options = [
            (leader, _nearest(tracks[leader].R[frames], graphs[1 - leader], frames, limit, settings.quality_min))
            for leader in (0, 1)
        ]
        merit = [
            float((tracks[leader].score[frames] + follower.score.nan_to_num(0.0)).mean() / 2)
            for leader, follower in options
        ]
        close = abs(merit[0] - merit[1]) < settings.repair_margin
        if close:
            rough = [_roughness(tracks[leader], frames) for leader, _ in options]
            winner = int(rough[1] < rough[0])
        else:
            winner = int(merit[1] > merit[0])
        _, follower = options[winner]
        loser = tracks[1 - winner]
        loser.R[frames], loser.score[frames], loser.present[frames] = follower.R, follower.score, follower.present
        flags[frames] |= torch.where(follower.present, int(Flag.REPAIRED_FROM_OTHER_CAMERA), 0)
        flags[frames] |= int(Flag.AMBIGUOUS) if close else 0
    return list(tracks), flags


def _stretches(wrong: Tensor) -> list[Tensor]:
    """Runs of consecutive True, as frame numbers."""
    frame = torch.nonzero(wrong)[:, 0]
    cuts = torch.nonzero(frame.diff() > 1)[:, 0] + 1
    return [part for part in torch.tensor_split(frame, cuts) if len(part)]


def _nearest(R: Tensor, graph: Candidates, frames: Tensor, limit: float, quality_min: float) -> _Track:
    """A camera's candidates nearest to given orientations; absent where none is within the limit."""
    R_all, score_all, mask = graph.padded()
    distance = so3.geodesic_distance(R[:, None], R_all[frames])
    distance = torch.where(mask[frames] & (score_all[frames] >= quality_min), distance, torch.inf)
    near, which = distance.min(-1)
    present = near <= limit
    score = torch.where(present, score_all[frames, which], torch.nan)
    return _Track(R=torch.where(present[:, None, None], R_all[frames, which], torch.nan), score=score, present=present)


def _roughness(track: _Track, frames: Tensor) -> float:
    """Largest turn per frame of a track over a stretch and its two neighbours, rad."""
    first, last = max(int(frames[0]) - 1, 0), min(int(frames[-1]) + 2, len(track.score))
    R = track.R[first:last][track.present[first:last]]
    return float(so3.geodesic_distance(R[:-1], R[1:]).max()) if len(R) > 1 else 0.0
