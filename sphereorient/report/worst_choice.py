"""Which frames of a track are the worst, and why, in words."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.report.doubts import FLAG_WORDS, doubts
from sphereorient.trajectory import Flag, Trajectory

FAR = 4.0  # robust standard deviations from the usual: worth a look
APART_FRAMES = 3  # frames nearer than this show the same thing
Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class BadFrame:
    """A frame to look at; made by `choose_worst`, read by the sheet."""

    k: int  # row of the track
    words: tuple[str, ...]  # why


def choose_worst(track: Trajectory, count: int) -> list[BadFrame]:
    """Choose the worst frames of a track, the kinds of trouble taking turns, so that one long gap hides no other.

    Looked at: gaps (the first frame lost, the first one found again), flags, scores, stated errors, distance of the
    cameras' orientations, distance from the smoother. Frames within three of each other show the same thing: one of
    them is taken. Where fewer are bad, those of the lowest scores fill up, and their words say so.

    Args:
        track: what was measured.
        count: at most so many.

    Returns:
        Worst first.
    """
    kinds = [list(kind(track)) for kind in KINDS]
    taken: list[int] = []
    why: dict[int, list[str]] = {}
    for ranked in kinds:
        for k, words in ranked:
            why.setdefault(k, []).append(words)
    for turn in range(max((len(ranked) for ranked in kinds), default=0)):
        if len(taken) >= count:
            break
        for ranked in kinds:
            if turn < len(ranked) and _is_new(ranked[turn][0], taken):
                taken.append(ranked[turn][0])
    for k, words in _lowest(track):
        if len(taken) < count and k not in why and _is_new(k, taken):
            taken.append(k)
            why[k] = [words]
    return [BadFrame(k=k, words=tuple(dict.fromkeys(why[k]))) for k in taken[:count]]


def _is_new(k: int, taken: Sequence[int]) -> bool:
    return all(abs(k - other) >= APART_FRAMES for other in taken)


Ranked = Iterator[tuple[int, str]]


def _gaps(track: Trajectory) -> Ranked:
    """The first frame of every gap, longest gap first, and the first one after it."""
    for first, last in sorted(_runs(~track.valid), key=lambda run: run[0] - run[1]):
        lasts = "1 frame" if last - first == 1 else f"{last - first} frames"
        told = [words for words in doubts(track, first) if words != "not valid"]
        yield first, f"gap of {lasts} begins" + (f": {', '.join(told)}" if told else "")
        if last < len(track):
            yield last, f"first frame after a gap of {lasts}"


def _flags(track: Trajectory) -> Ranked:
    """Flagged frames that are valid, the rarest flags first; of each run the one of the lowest score."""
    score = _score(track)
    ignored = 0 if len(track.cameras) > 1 else int(Flag.ONE_CAMERA)
    counted = [(int((track.flags & flag > 0).sum()), flag) for flag in FLAG_WORDS if not flag & ignored]
    for _, flag in sorted(counted):
        runs = list(_runs((track.flags & flag > 0) & track.valid))
        for first, last in sorted(runs, key=lambda run: _least(score[run[0] : run[1]])):
            yield first + int(np.nan_to_num(score[first:last], nan=np.inf).argmin()), FLAG_WORDS[flag]


def _scores(track: Trajectory) -> Ranked:
    """Frames in which a camera explains less than it usually does."""
    for name, camera in track.cameras.items():
        yield from _outliers(-camera.score, f"{name}: score {{:.3f}}, usually {{:.3f}}", sign=-1)


def _sigmas(track: Trajectory) -> Ranked:
    """Frames whose stated errors are larger than usual."""
    degrees = np.rad2deg(np.sqrt(np.trace(track.orientation_cov, axis1=1, axis2=2) / 3))
    yield from _outliers(degrees, "stated error of the orientation {:.2g}\u00b0, usually {:.2g}\u00b0")
    length = np.sqrt(np.trace(track.position_cov, axis1=1, axis2=2) / 3)
    yield from _outliers(length, "stated error of the position {:.2g} mm, usually {:.2g} mm")


def _cameras_apart(track: Trajectory) -> Ranked:
    """Frames in which the cameras by themselves see different orientations."""
    seen = [torch.from_numpy(camera.orientation) for camera in track.cameras.values()]
    if len(seen) == 2:
        apart = np.rad2deg(so3.geodesic_distance(*seen).numpy())
        yield from _outliers(apart, "cameras {:.2g}\u00b0 apart, usually {:.2g}\u00b0")


def _off_the_smoother(track: Trajectory) -> Ranked:
    """Frames whose measurement lies off the smoother's."""
    measured, smooth = torch.from_numpy(track.orientation), torch.from_numpy(track.orientation_smooth)
    off = np.rad2deg(so3.geodesic_distance(measured, smooth).numpy())
    yield from _outliers(off, "{:.2g}\u00b0 off the smooth motion, usually {:.2g}\u00b0")


KINDS: tuple[Callable[[Trajectory], Ranked], ...] = (
    _gaps,
    _flags,
    _cameras_apart,
    _scores,
    _off_the_smoother,
    _sigmas,
)


def _lowest(track: Trajectory) -> Ranked:
    """All measured frames, the lowest scores first."""
    score = _score(track)
    for k in np.argsort(np.where(np.isfinite(score) & track.valid, score, np.inf), kind="stable").tolist():
        if np.isfinite(score[k]) and track.valid[k]:
            yield k, f"not in doubt; among the lowest scores: {score[k]:.3f}, usually {np.nanmedian(score):.3f}"


def _outliers(values: Floats, words: str, sign: int = 1) -> Ranked:
    """Frames far above the usual value, farthest first; `words` are told `sign` times the value and the usual one."""
    there = np.isfinite(values)
    if there.sum() < 2:
        return
    usual = float(np.median(values[there]))
    spread = 1.4826 * float(np.median(np.abs(values[there] - usual)))
    # Where most values are the same the spread is nothing: rounding errors are then no outliers.
    far = np.where(there, (values - usual) / max(spread, 1e-3 * abs(usual), 1e-12), -np.inf)
    for k in np.argsort(-far, kind="stable").tolist():
        if far[k] < FAR:
            return
        yield k, words.format(sign * float(values[k]), sign * usual)


def _score(track: Trajectory) -> Floats:
    """The lowest of the cameras' scores, (N,); NaN where no camera has one."""
    scores = np.stack([np.full(len(track), np.inf), *(camera.score for camera in track.cameras.values())])
    lowest = np.fmin.reduce(scores)
    return np.asarray(np.where(np.isfinite(lowest), lowest, np.nan), np.float64)


def _least(values: Floats) -> float:
    return float(np.nan_to_num(values, nan=np.inf).min())


def _runs(mask: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield first and last + 1 of the runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    yield from ((first, last) for first, last in edges.reshape(-1, 2).tolist())
