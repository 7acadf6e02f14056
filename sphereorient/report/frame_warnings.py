"""The warnings of a frame as text, and the choice of the worst frames of a track with the reasons."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.trajectory import Flag, Reason, Trajectory

FLAG_WORDS = {
    Flag.POSITION_INTERPOLATED: "position interpolated over a gap",
    Flag.POSITION_OUTLIER_REPLACED: "position was off and was replaced",
    Flag.ONE_CAMERA: "one camera only",
    Flag.REPAIRED_FROM_OTHER_CAMERA: "the cameras disagreed; one was repaired from the other",
    Flag.AMBIGUOUS: "another orientation fits nearly as well",
    Flag.DOUBTFUL_FIT: "picture explained less well than usual",
    Flag.RECOVERED: "found again after a loss",
    Flag.SPIKE: "the orientation jumps",
    Flag.EXTRAPOLATED: "not measured; the smoother's value",
}
REASON_WORDS = {
    Reason.OK: "measured",
    Reason.NOT_FOUND: "no ball found",
    Reason.OUTLINE: "no clear outline",
    Reason.DARK: "too dark",
    Reason.SATURATED: "too bright",
    Reason.REPEATED: "same picture as before",
    Reason.RUNAWAY: "too many possible orientations",
    Reason.LOW_SCORE: "no orientation explains the picture",
    Reason.AMBIGUOUS: "orientation ambiguous",
    Reason.CONTRADICTS: "contradicts the other camera",
    Reason.UNDECODABLE: "picture damaged",
    Reason.MISSING: "no picture",
}
FAR = 4.0  # robust standard deviations from the usual value: an outlier
APART_FRAMES = 3  # frames nearer than this show the same problem
Floats = NDArray[np.float64]
Ranked = Iterator[tuple[int, str]]  # rows with the reason, worst first


def flag_words(track: Trajectory, k: int) -> list[str]:
    """Return the flags of frame k as text, without ONE_CAMERA in an experiment of one camera."""
    bits = int(track.flags[k])
    if len(track.cameras) < 2:
        bits &= ~Flag.ONE_CAMERA
    return [words for flag, words in FLAG_WORDS.items() if bits & flag]


def reason_words(track: Trajectory, k: int) -> dict[str, str]:
    """Return the reason of every camera in frame k as text, by name."""
    said = {name: camera.reason[k] for name, camera in track.cameras.items()}
    return {name: REASON_WORDS.get(Reason(why), why) if why in set(Reason) else str(why) for name, why in said.items()}


def lost_cameras(track: Trajectory, k: int) -> dict[str, str]:
    """Return the reasons of the cameras without an orientation in frame k, by name."""
    words = reason_words(track, k)
    return {name: why for name, why in words.items() if track.cameras[name].reason[k] != Reason.OK}


def frame_warnings(track: Trajectory, k: int) -> list[str]:
    """Return all warnings of frame k as text; empty for a good frame."""
    found = [] if track.valid[k] else ["not valid"]
    return [*found, *flag_words(track, k), *(f"{name}: {why}" for name, why in lost_cameras(track, k).items())]


def stated_error(cov: Floats) -> Floats:
    """Return sigma along or about an axis, (N,), the mean of three, of covariances (N, 3, 3)."""
    return np.asarray(np.sqrt(np.trace(cov, axis1=1, axis2=2) / 3), np.float64)


def distance_deg(one: Floats, other: Floats) -> Floats:
    """Return the angle between orientations (N, 3, 3), (N,), degrees."""
    angle_rad = so3.geodesic_distance(torch.from_numpy(one), torch.from_numpy(other))
    return np.asarray(np.rad2deg(angle_rad.numpy()), np.float64)


@dataclass(frozen=True, kw_only=True)
class BadFrame:
    """A frame to look at; made by `choose_worst`, read by the sheet."""

    k: int  # row of the track
    words: tuple[str, ...]  # reasons


def choose_worst(track: Trajectory, count: int) -> list[BadFrame]:
    """Choose at most `count` of the worst frames of a track, worst first, the kinds of problem in turn.

    Of frames less than three apart one is taken. If fewer frames are bad, those with the lowest scores follow.
    """
    kinds = [list(kind(track)) for kind in KINDS]
    taken: list[int] = []
    why: dict[int, list[str]] = {}

    def take(k: int) -> None:
        if len(taken) < count and all(abs(k - other) >= APART_FRAMES for other in taken):
            taken.append(k)

    for ranked in kinds:
        for k, words in ranked:
            why.setdefault(k, []).append(words)
    for place in range(max((len(ranked) for ranked in kinds), default=0)):
        for ranked in kinds:
            if place < len(ranked):
                take(ranked[place][0])
    for k, words in _lowest(track):
        if k not in why:
            take(k)
            why[k] = [words]
    return [BadFrame(k=k, words=tuple(dict.fromkeys(why[k]))) for k in taken]


def _gaps(track: Trajectory) -> Ranked:
    """Yield the first frame of every gap, longest gap first, and the first one after it."""
    for first, last in sorted(_runs(~track.valid), key=lambda run: run[0] - run[1]):
        lasts = "1 frame" if last - first == 1 else f"{last - first} frames"
        found = [words for words in frame_warnings(track, first) if words != "not valid"]
        yield first, f"gap of {lasts} begins" + (f": {', '.join(found)}" if found else "")
        if last < len(track):
            yield last, f"first frame after a gap of {lasts}"


def _flags(track: Trajectory) -> Ranked:
    """Yield flagged valid frames, the rarest flags first; of each run the one with the lowest score."""
    score = np.nan_to_num(_score(track), nan=np.inf)
    ignored = 0 if len(track.cameras) > 1 else int(Flag.ONE_CAMERA)
    counted = [(int((track.flags & flag > 0).sum()), flag) for flag in FLAG_WORDS if not flag & ignored]
    for _, flag in sorted(counted):
        runs = list(_runs((track.flags & flag > 0) & track.valid))
        for first, last in sorted(runs, key=lambda run: float(score[run[0] : run[1]].min())):
            yield first + int(score[first:last].argmin()), FLAG_WORDS[flag]


def _cameras_apart(track: Trajectory) -> Ranked:
    seen = [camera.orientation for camera in track.cameras.values()]
    if len(seen) == 2:
        yield from _outliers(distance_deg(*seen), "cameras {:.2g}\u00b0 apart, usually {:.2g}\u00b0")


def _scores(track: Trajectory) -> Ranked:
    for name, camera in track.cameras.items():
        yield from _outliers(-camera.score, f"{name}: score {{:.3f}}, usually {{:.3f}}", sign=-1)


def _off_the_smoother(track: Trajectory) -> Ranked:
    off = distance_deg(track.orientation, track.orientation_smooth)
    yield from _outliers(off, "{:.2g}\u00b0 off the smooth motion, usually {:.2g}\u00b0")


def _sigmas(track: Trajectory) -> Ranked:
    degrees = np.rad2deg(stated_error(track.orientation_cov))
    yield from _outliers(degrees, "stated error of the orientation {:.2g}\u00b0, usually {:.2g}\u00b0")
    yield from _outliers(stated_error(track.position_cov), "stated error of the position {:.2g} mm, usually {:.2g} mm")


KINDS: tuple[Callable[[Trajectory], Ranked], ...] = (
    _gaps,
    _flags,
    _cameras_apart,
    _scores,
    _off_the_smoother,
    _sigmas,
)


def _lowest(track: Trajectory) -> Ranked:
    score = _score(track)
    for k in np.argsort(np.where(np.isfinite(score) & track.valid, score, np.inf), kind="stable").tolist():
        if np.isfinite(score[k]) and track.valid[k]:
            yield k, f"not in doubt; among the lowest scores: {score[k]:.3f}, usually {np.nanmedian(score):.3f}"


def _outliers(values: Floats, words: str, sign: int = 1) -> Ranked:
    """Yield frames far above the usual value, farthest first; `words` get `sign` times value and usual value."""
    there = np.isfinite(values)
    if there.sum() < 2:
        return
    usual = float(np.median(values[there]))
    spread = 1.4826 * float(np.median(np.abs(values[there] - usual)))
    # If most values are equal the spread is zero; rounding errors are no outliers.
    far = np.where(there, (values - usual) / max(spread, 1e-3 * abs(usual), 1e-12), -np.inf)
    for k in np.argsort(-far, kind="stable").tolist():
        if far[k] < FAR:
            return
        yield k, words.format(sign * float(values[k]), sign * usual)


def _score(track: Trajectory) -> Floats:
    """Return the lowest score of the cameras, (N,); NaN without scores."""
    scores = np.stack([np.full(len(track), np.inf), *(camera.score for camera in track.cameras.values())])
    lowest = np.fmin.reduce(scores)
    return np.asarray(np.where(np.isfinite(lowest), lowest, np.nan), np.float64)


def _runs(mask: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield first and last + 1 of the runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    yield from ((first, last) for first, last in edges.reshape(-1, 2).tolist())
