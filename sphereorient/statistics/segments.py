"""The usable segments of one or many tracks, as flat arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import TrackError, refusal
from sphereorient.statistics.bootstrap import FEWEST
from sphereorient.statistics.settings import SegmentSettings
from sphereorient.trajectory import Flag, Trajectory

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

UNITS = {
    "velocity": "m/s",
    "acceleration": "m/s^2",
    "omega_lab": "rad/s",
    "omega_body": "rad/s",
    "alpha_lab": "rad/s^2",
    "alpha_body": "rad/s^2",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Ensemble:
    """M samples in S segments; made by `ensemble_of`, read by all statistics. Rows of a segment follow each other."""

    time_s: Floats  # (M,)
    frame: Rows  # (M,), time in typical steps from the segment's first frame, rounded; a gap is a jump
    segment: Rows  # (M,), 0 .. S - 1, increasing
    track: Rows  # (S,), which of the tracks a segment comes from
    span_s: Floats  # (S,), from a segment's first frame to its last, one step included
    step_s: float  # typical time between frames
    position_mm: Floats  # (M, 3), smooth, lab
    R_lab_body: Floats  # (M, 3, 3), smooth
    values: Mapping[str, Floats]  # (M, 3) by name, UNITS
    sigmas: Mapping[str, Floats]  # (M, 3), standard deviations of the same; NaN where unknown
    error: Literal["added", "removed"]  # what a sigma is: noise on top of the motion, or motion that was smoothed away

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.time_s)

    @property
    def segments(self) -> int:
        """The number of segments."""
        return len(self.span_s)

    @property
    def starts(self) -> Rows:
        """(S + 1,), segment n has the rows starts[n] .. starts[n + 1]."""
        return np.searchsorted(self.segment, np.arange(self.segments + 1)).astype(np.int64)

    def at(self, kept: NDArray[np.bool_]) -> Self:
        """Return the ensemble of some segments, (S,) bool.

        Raises:
            TrackError: fewer than two segments are left.
        """
        _refuse_few(int(kept.sum()), "the segments kept")
        rows = kept[self.segment]
        number = np.cumsum(kept) - 1
        by_row = ("time_s", "frame", "position_mm", "R_lab_body")
        parts: dict[str, Any] = {name: getattr(self, name)[rows] for name in by_row}
        parts |= {name: {q: x[rows] for q, x in getattr(self, name).items()} for name in ("values", "sigmas")}
        parts |= {"segment": number[self.segment[rows]], "track": self.track[kept], "span_s": self.span_s[kept]}
        return replace(self, **parts)


def ensemble_of(
    tracks: Trajectory | Sequence[Trajectory],
    settings: SegmentSettings | None = None,
    name: str = "tracks",
    fewest: int = FEWEST,
) -> Ensemble:
    """Collect the usable segments of tracks.

    A frame is usable where all six quantities and the smoother's position and orientation are there, and it was not
    extrapolated; a segment, where enough usable frames are in it. Of a segment that counts, the frames at its ends,
    known from one side only and so with larger errors, are then left out: what they say is noise first.

    Args:
        tracks: one or many.
        settings: which frames and segments count; None takes the paper's.
        name: what the tracks are called in a message.
        fewest: segments that must be left; of one, statistics have no intervals.

    Returns:
        The ensemble. Its `error` is "removed" where the tracks come from a smoother, whose sigma is that of the motion
        it could not follow; "added" where from a kernel, whose sigma is that of the noise it let through.

    Raises:
        TrackError: no usable frame, too few segments, or tracks of kinds that do not go together.

    Source: the paper, section IV: segments above 0.25 T_L; ERRATA, settings of the paper: 50 frames.
    """
    settings = settings or SegmentSettings()
    many = [tracks] if isinstance(tracks, Trajectory) else list(tracks)
    methods = {track.method for track in many}
    if len({_error(method) for method in methods}) > 1:
        got, do = ", ".join(sorted(methods)), "report each kind by itself"
        raise TrackError(refusal(name, expected="tracks of one method", got=got, do=do))
    step_s = _step([track for track in many if len(track)])
    pieces = [_pieces(track, number, settings) for number, track in enumerate(many)]
    if not sum(len(piece["time_s"]) for piece in pieces):
        do = "look at the track's reasons with `sphereorient check`"
        raise TrackError(refusal(name, expected="frames with a motion", got="no valid frame", do=do))
    whole = {key: np.concatenate([piece[key] for piece in pieces]) for key in pieces[0]}
    return _chosen(whole, step_s, _error(many[0].method), settings, name, fewest)


def _error(method: str) -> Literal["added", "removed"]:
    return "added" if method == "paper" else "removed"


def _step(tracks: Sequence[Trajectory]) -> float:
    """Return the median time between neighbouring frames of one segment, s."""
    steps = [np.diff(t.time)[(t.segment[1:] == t.segment[:-1]) & (t.segment[1:] >= 0)] for t in tracks]
    whole = np.concatenate([*steps, np.empty(0)])
    return float(np.median(whole)) if len(whole) else 1.0


def _pieces(track: Trajectory, number: int, settings: SegmentSettings) -> dict[str, NDArray[Any]]:
    """Return the usable rows of one track, sorted by segment and time."""
    usable = (track.segment >= 0) & np.isfinite(track.position_smooth).all(1)
    usable &= np.isfinite(track.orientation_smooth).all((1, 2)) & np.isfinite(track.time)
    for quantity in UNITS:
        usable &= np.isfinite(getattr(track, quantity)).all(1)
    if not settings.keep_extrapolated:
        usable &= (track.flags & np.uint32(Flag.EXTRAPOLATED)) == 0
    rows = np.flatnonzero(usable)
    rows = rows[np.lexsort((track.time[rows], track.segment[rows]))]
    parts = {
        "time_s": track.time,
        "position_mm": track.position_smooth,
        "R_lab_body": track.orientation_smooth,
        "label": track.segment,
        **{quantity: getattr(track, quantity) for quantity in UNITS},
        **{f"{quantity}_sigma": getattr(track, f"{quantity}_sigma") for quantity in UNITS},
    }
    parts["sure"] = _sure(track, rows, settings.max_sigma)
    return {key: values[rows] for key, values in parts.items()} | {"track": np.full(len(rows), number)}


def _sure(track: Trajectory, rows: NDArray[np.int64], most: float) -> NDArray[np.bool_]:
    """Return which frames (N,) have errors of no more than `most` times the usual ones; unknown ones are taken."""
    sure = np.ones(len(track), dtype=bool)
    for name in ("acceleration_sigma", "alpha_lab_sigma"):
        size = np.linalg.norm(getattr(track, name), axis=1)
        known = rows[np.isfinite(size[rows])]
        if len(known):
            sure &= ~(size > most * np.median(size[known]))
    return sure


def _chosen(
    whole: dict[str, NDArray[Any]],
    step_s: float,
    error: Literal["added", "removed"],
    settings: SegmentSettings,
    name: str,
    fewest: int,
) -> Ensemble:
    """Number the segments, cut the long ones, leave out the short ones."""
    time_s = whole["time_s"]
    first = np.ones(len(time_s), dtype=bool)
    first[1:] = (np.diff(whole["label"]) != 0) | (np.diff(whole["track"]) != 0)
    if settings.max_duration_s is not None:
        first[1:] |= np.diff(_piece(time_s, first, settings.max_duration_s)) != 0
    number, begin = np.cumsum(first) - 1, np.flatnonzero(first)
    frames = np.bincount(number)
    last = begin + frames - 1
    span_s = time_s[last] - time_s[begin] + step_s
    least_s = settings.min_integral_times * (settings.integral_time_s or 0.0)
    kept = (frames >= settings.min_frames) & (span_s >= least_s)
    _refuse_few(int(kept.sum()), name, f"of at least {settings.min_frames} frames and {least_s:.3g} s", fewest)
    some = np.bincount(number, weights=whole["sure"], minlength=len(kept)) > 0
    kept &= some
    _refuse_few(
        int(kept.sum()), name, "with frames whose errors are not larger than usual (statistics.max_sigma)", fewest
    )
    rows = kept[number] & whole["sure"]
    return Ensemble(
        time_s=time_s[rows],
        frame=np.rint((time_s - time_s[begin][number]) / step_s).astype(np.int64)[rows],
        segment=(np.cumsum(kept) - 1)[number[rows]],
        track=whole["track"][begin][kept],
        span_s=span_s[kept],
        step_s=step_s,
        position_mm=whole["position_mm"][rows],
        R_lab_body=whole["R_lab_body"][rows],
        values={quantity: whole[quantity][rows] for quantity in UNITS},
        sigmas={quantity: whole[f"{quantity}_sigma"][rows] for quantity in UNITS},
        error=error,
    )


def _piece(time_s: Floats, first: NDArray[np.bool_], longest_s: float) -> Rows:
    """Return the number of the piece of its segment that each row is in, (M,): pieces equal, none above longest_s."""
    number, begin = np.cumsum(first) - 1, np.flatnonzero(first)
    end = np.append(begin[1:], len(time_s)) - 1
    span_s = time_s[end] - time_s[begin]
    pieces = np.maximum(np.ceil(span_s / longest_s * (1 - 1e-9)), 1)
    share = (time_s - time_s[begin][number]) / np.maximum(span_s, 1e-300)[number]
    return np.asarray(np.minimum(np.floor(share * pieces[number]), pieces[number] - 1), np.int64)


def _refuse_few(count: int, name: str, which: str = "", fewest: int = FEWEST) -> None:
    """Refuse an ensemble without scatter."""
    if count < fewest:
        expected = " ".join([f"at least {'two segments' if fewest > 1 else 'one segment'}", which]).strip()
        do = "pass more tracks, lower statistics.min_frames, or cut long ones with statistics.max_duration_s"
        raise TrackError(refusal(name, expected=expected, got=str(count), do=do))
