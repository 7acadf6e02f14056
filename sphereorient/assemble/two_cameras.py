"""Two cameras, one sphere: repair of the one from the other, and the weighted mean on SO(3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble.path import Path, graph_of, links
from sphereorient.assemble.repair import Track, repair
from sphereorient.assemble.segments import find_spikes, moving, number_segments
from sphereorient.assemble.settings import AssembleSettings
from sphereorient.errors import ExperimentError, ShapeError, refusal
from sphereorient.search import Candidates
from sphereorient.trajectory import Flag

CHI2_3_MEDIAN = 2.366  # median of a sum of three squared standard normals
LINKS_MIN = 3  # in the window; fewer give no variance worth the name
VARIANCE_RANGE = 10.0  # a quiet stretch of xi is no proof of a perfect camera
CAMERAS_RATIO_MAX = 100.0  # of typical variances: a track whose xi never changes is not infinitely good


@dataclass(frozen=True, kw_only=True, eq=False)
class Fused:
    """The sphere's orientation in N frames from all cameras; made by assemble, read by motion and the pipeline."""

    R_lab_body: Tensor  # (N, 3, 3), NaN where no camera has one
    sigma_rad: Tensor  # (N,), standard deviation per axis; NaN where there is nothing to measure it by
    disagreement_rad: Tensor  # (N,), distance of the two cameras' orientations after repair; NaN with one
    segment: Tensor  # (N,) int64, -1 outside any
    spike: Tensor  # (N,) bool
    flags: Tensor  # (N,) int64, bits of trajectory.Flag
    weight: Mapping[str, Tensor]  # (N,) of each camera, its share in the mean: their sum is 1, or 0 where none has one
    repaired: Mapping[str, Tensor]  # (N,) bool of each camera
    R_lab_body_of: Mapping[str, Tensor]  # (N, 3, 3) of each camera after the repair, NaN where it has none


def fuse(
    paths: Mapping[str, Path], candidates: Mapping[str, Candidates], time_s: Tensor, settings: AssembleSettings
) -> Fused:
    """Join the cameras' paths, both in the lab frame, into one.

    Stretches in which they are more than `repair_deg` apart are repaired; then each frame is the mean of both,
    weighted with the inverse moving variance of xi. These variances are relative; their common scale comes from how
    far the cameras are apart over the whole movie, and with one camera there is none.

    Args:
        paths: of one or two cameras, N frames.
        candidates: of the same cameras.
        time_s: (N,).
        settings: of the room.

    Returns:
        The fused track. A frame that one camera only saw carries its orientation and `ONE_CAMERA`; so does every
        frame of an experiment with one camera. Frames of a repair that was a guess carry `AMBIGUOUS`.

    Raises:
        ExperimentError: no camera, or more than two.
        ShapeError: paths, candidates and times are not of the same cameras and frames.

    Source: the paper's two cameras; ERRATA A7 (which camera is right) and A8 (what the weights measure: xi's variance
        holds the motion's too, so that a sphere that turns unevenly draws the weights towards equal ones).
    """
    _check(paths, candidates, time_s)
    names = list(paths)
    tracks = [Track(R_lab_body=path.R_lab_body, score=path.score) for path in paths.values()]
    present = torch.stack([track.present for track in tracks])
    repaired, ambiguous = torch.zeros_like(present), torch.zeros_like(present[0])
    if len(tracks) == 2:
        first, second = (graph_of(candidates[name], settings.quality_min) for name in names)
        mended = repair((tracks[0], tracks[1]), (first, second), settings)
        tracks, repaired, ambiguous = list(mended.tracks), mended.repaired, mended.ambiguous
    present = torch.stack([track.present for track in tracks])
    linked = [links(track.R_lab_body, track.score, time_s) for track in tracks]
    variance = relative_variance([xi for xi, _ in linked], settings)
    calm = torch.stack([_calm(xi, turn, settings) for xi, turn in linked]).all(0)
    share = _shares(variance, present)
    R = _mean(tracks, share)
    apart = _apart(tracks)
    score = torch.stack([track.score for track in tracks]).nanmean(0)
    xi, turn = links(R, score, time_s)
    spike = find_spikes(xi, turn, settings)
    alone = present.sum(0) == 1 if len(tracks) == 2 else torch.ones_like(present[0])
    bits = {
        Flag.ONE_CAMERA: alone,
        Flag.REPAIRED_FROM_OTHER_CAMERA: repaired.any(0),
        Flag.AMBIGUOUS: ambiguous,
        Flag.SPIKE: spike,
    }
    return Fused(
        R_lab_body=R,
        sigma_rad=_sigma(variance, share, apart, calm),
        disagreement_rad=apart,
        segment=number_segments(present.any(0), spike, settings.gap_frames_max),
        spike=spike,
        flags=torch.stack([int(flag) * where.long() for flag, where in bits.items()]).sum(0),
        weight=dict(zip(names, share, strict=True)),
        repaired=dict(zip(names, repaired, strict=True)),
        R_lab_body_of={name: track.R_lab_body for name, track in zip(names, tracks, strict=True)},
    )


def relative_variance(xi: Sequence[Tensor], settings: AssembleSettings) -> Tensor:
    """Return the moving variance of each camera's xi, (K, N), above 0 everywhere; only their ratios mean something.

    It is kept within a factor of `VARIANCE_RANGE` of what is typical (the median) for the camera, which is taken
    where fewer than `LINKS_MIN` links are near.

    Args:
        xi: (N,) of each camera, rad/s, NaN where no link enters the frame.
        settings: the window.
    """
    windows = [moving(each, settings.weight_window_frames) for each in xi]
    count = torch.stack([torch.isfinite(window).sum(-1) for window in windows])
    squares = torch.stack([(window - window.nanmean(-1, keepdim=True)).square().nansum(-1) for window in windows])
    variance = torch.where(count >= LINKS_MIN, squares / (count - 1).clamp_min(1), torch.nan)
    typical = variance.nanmedian(-1, keepdim=True).values if variance.shape[1] else variance.new_ones(len(xi), 1)
    largest = typical.nan_to_num(0.0).max()
    # A camera without links, or all of them perfectly still: nothing speaks for one or the other.
    typical = torch.where(typical.isnan() | (largest == 0), torch.where(largest > 0, largest, 1.0), typical)
    typical = typical.clamp_min(typical.max() / CAMERAS_RATIO_MAX)
    within = torch.minimum(torch.maximum(variance, typical / VARIANCE_RANGE), typical * VARIANCE_RANGE)
    return torch.where(variance.isnan(), typical, within)


def _calm(xi: Tensor, turn: Tensor, settings: AssembleSettings) -> Tensor:
    """Frames without a spike in the window of their variance, (N,) bool."""
    spike = find_spikes(xi, turn, settings)
    return moving(spike.to(xi), settings.weight_window_frames).nansum(-1) == 0


def _shares(variance: Tensor, present: Tensor) -> Tensor:
    """Inverse variances of the cameras that have an orientation, (K, N), scaled to the sum 1; 0 where none has."""
    weight = torch.where(present, 1 / variance, 0.0)
    total = weight.sum(0)
    return weight / torch.where(total > 0, total, 1.0)


def _mean(tracks: Sequence[Track], share: Tensor) -> Tensor:
    """Weighted mean of the cameras, (N, 3, 3); exactly the one camera's where there is one; NaN where none."""
    present = torch.stack([track.present for track in tracks])[..., None, None]
    R = torch.stack([track.R_lab_body for track in tracks])
    view = torch.eye(3, dtype=R.dtype, device=R.device)
    several = present.sum(0) > 1
    mean = so3.weighted_mean(
        torch.where(several, R, view).movedim(0, -3), torch.where(several[..., 0, 0], share, 1.0).movedim(0, -1)
    )
    alone = torch.where(present, R, 0.0).sum(0)
    return torch.where(several, mean, torch.where(present.any(0), alone, torch.nan))


def _apart(tracks: Sequence[Track]) -> Tensor:
    """Distance of the two cameras' orientations, (N,), rad; NaN where fewer than two have one."""
    if len(tracks) == 1:
        return torch.full_like(tracks[0].score, torch.nan)
    first, second = tracks
    apart = so3.geodesic_distance(first.R_lab_body, second.R_lab_body)
    return torch.where(first.present & second.present, apart, torch.nan)


def _sigma(variance: Tensor, share: Tensor, apart: Tensor, calm: Tensor) -> Tensor:
    """Standard deviation per axis of the mean, (N,), rad.

    Errors with the variances s^2 variance_i per axis make d^2 / (s^2 (variance_1 + variance_2)) the sum of three
    squared standard normals. Its median gives s^2, blind to the few frames that the repair left wrong. Frames near a
    spike are left out where there are others: it raises the variance of all frames about it, not their d.
    """
    if not len(apart):
        return apart
    ratio = apart.square() / variance.sum(0)
    quiet = torch.where(calm, ratio, torch.nan)
    scale = (quiet if torch.isfinite(quiet).any() else ratio).nanmedian() / CHI2_3_MEDIAN
    relative = (share.square() * variance).sum(0)
    return torch.where(share.sum(0) > 0, (scale * relative).sqrt(), torch.nan)


def _check(paths: Mapping[str, Path], candidates: Mapping[str, Candidates], time_s: Tensor) -> None:
    """Refuse what is not one or two cameras of the same frames."""
    if not 1 <= len(paths) <= 2:
        do = "name one or two cameras"
        raise ExperimentError(refusal("paths", expected="one or two cameras", got=str(len(paths)), do=do))
    for name, path in paths.items():
        frames = len(candidates[name]) if name in candidates else 0
        if not len(path.choice) == frames == len(time_s):
            expected, got = f"{len(time_s)} frames", f"{len(path.choice)} in the path, {frames} in the candidates"
            do = "pass what assemble_paths was given and gave"
            raise ShapeError(refusal(f"camera {name!r}", expected=expected, got=got, do=do))
