"""The usable segments of one or many tracks, as flat arrays, and their durations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import Flag, TrackError, refusal
from sphereorient.motion import RATE_UNITS
from sphereorient.statistics.bootstrap import FEWEST, Floats, Interval, Rows
from sphereorient.statistics.settings import SegmentSettings
from sphereorient.trajectory import Trajectory
from sphereorient.trajectory.datasets import stored_fields

UNITS = {name: spec.units for name, spec in stored_fields(Trajectory) if name in RATE_UNITS}  # of the six quantities
TRANSLATION = ("velocity", "acceleration")
COLUMNS = {"time_s": "time", "R_lab_body": "orientation_smooth", "label": "segment"}
COLUMNS |= {name: name for quantity in UNITS for name in (quantity, f"{quantity}_sigma")}


@dataclass(frozen=True, kw_only=True, eq=False)
class Ensemble:
    """M samples in S segments. Rows are sorted by segment."""

    time_s: Floats  # (M,)
    frame: Rows  # (M,), rounded time in typical steps from the segment's first frame; a gap is a jump
    segment: Rows  # (M,), 0 .. S - 1, increasing
    track: Rows  # (S,), number of the track of a segment
    span_s: Floats  # (S,), from a segment's first frame to its last, plus one step
    step_s: float  # typical time between frames
    R_lab_body: Floats  # (M, 3, 3), smooth
    values: Mapping[str, Floats]  # (M, 3) by name, UNITS; without TRANSLATION for a fixed centre
    sigmas: Mapping[str, Floats]  # (M, 3), standard deviations of the values; NaN if unknown
    error: Literal["added", "removed"]  # sigma is noise passed by a kernel, or motion removed by a smoother
    length_unit: str = "mm"  # of the tracks

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def segments(self) -> int:
        """Number of segments, S."""
        return len(self.span_s)

    @property
    def starts(self) -> Rows:
        """First row of each segment and the end, (S + 1,): segment n has the rows starts[n] .. starts[n + 1]."""
        return np.searchsorted(self.segment, np.arange(self.segments + 1)).astype(np.int64)

    def at(self, kept: NDArray[np.bool_]) -> Self:
        """Return the ensemble of the segments marked in `kept` (S,); TrackError if fewer than two remain."""
        _refuse_few(int(kept.sum()), "the segments kept")
        rows = kept[self.segment]
        parts = {name: getattr(self, name)[rows] for name in ("time_s", "frame", "R_lab_body")}
        parts |= {name: {q: x[rows] for q, x in getattr(self, name).items()} for name in ("values", "sigmas")}
        segment = (np.cumsum(kept) - 1)[self.segment[rows]]
        return replace(self, **parts, segment=segment, track=self.track[kept], span_s=self.span_s[kept])


def ensemble_of(
    tracks: Trajectory | Sequence[Trajectory],
    settings: SegmentSettings | None = None,
    name: str = "tracks",
    fewest: int = FEWEST,
) -> Ensemble:
    """Collect the usable segments of one or many tracks; `name` is for messages.
    A frame is usable if all six quantities and the smooth pose are finite, and it was not extrapolated. A segment is
    used if it has enough usable frames; frames with larger errors at its ends are left out. Raises TrackError (no
    usable frame, fewer than `fewest` segments, or tracks of kernels and smoothers together).
    Source: the paper, section IV: segments above 0.25 T_L; docs/errata.md, settings of the paper: 50 frames.
    """
    settings = settings or SegmentSettings()
    many = [tracks] if isinstance(tracks, Trajectory) else list(tracks)
    methods, units = ({getattr(track, key) for track in many} for key in ("method", "length_unit"))
    for kinds, of in ((methods if "paper" in methods else (), "method"), (units, "unit of length")):
        if len(kinds) > 1:
            got, do = ", ".join(sorted(kinds)), "report each kind separately"
            raise TrackError(refusal(name, expected=f"tracks of one {of}", got=got, do=do))
    pieces = [_usable(track, number, settings) for number, track in enumerate(many)]
    there = [len(piece["time_s"]) if fewest else track.valid.any() for piece, track in zip(pieces, many, strict=True)]
    if not any(there):
        do = "look at the track's reasons with `sphereorient check`"
        raise TrackError(refusal(name, expected="frames with a motion", got="no valid frame", do=do))
    whole = {key: np.concatenate([piece[key] for piece in pieces]) for key in pieces[0]}
    time_s = whole["time_s"]
    steps = [np.diff(t.time)[(t.segment[1:] == t.segment[:-1]) & (t.segment[1:] >= 0)] for t in many if len(t)]
    step_s = float(np.median(np.concatenate(steps))) if sum(map(len, steps)) else 1.0
    first = _first_rows(whole, settings.max_duration_s)
    number, begin = np.cumsum(first) - 1, np.flatnonzero(first)
    frames = np.bincount(number)
    span_s = time_s[begin + frames - 1] - time_s[begin] + step_s
    least_s = settings.min_integral_times * (settings.integral_time_s or 0.0)
    kept = (frames >= settings.min_frames) & (span_s >= least_s)
    _refuse_few(int(kept.sum()), name, f"of at least {settings.min_frames} frames and {least_s:.3g} s", fewest)
    kept &= np.bincount(number, weights=whole["sure"], minlength=len(kept)) > 0
    which = "with frames whose errors are not larger than usual (statistics.max_sigma)"
    _refuse_few(int(kept.sum()), name, which, fewest)
    rows = kept[number] & whole["sure"]
    taken = [quantity for quantity in UNITS if quantity not in TRANSLATION or not all(track.held for track in many)]
    return Ensemble(
        time_s=time_s[rows],
        frame=np.rint((time_s - time_s[begin][number]) / step_s).astype(np.int64)[rows],
        segment=(np.cumsum(kept) - 1)[number[rows]],
        track=whole["track"][begin][kept],
        span_s=span_s[kept],
        step_s=step_s,
        R_lab_body=whole["R_lab_body"][rows],
        values={quantity: whole[quantity][rows] for quantity in taken},
        sigmas={quantity: whole[f"{quantity}_sigma"][rows] for quantity in taken},
        length_unit=many[0].length_unit,
        error="added" if many[0].method == "paper" else "removed",
    )


def _usable(track: Trajectory, number: int, settings: SegmentSettings) -> dict[str, NDArray[Any]]:
    """Return `COLUMNS` of the usable frames, sorted; which have no unusually large errors; the track's number."""
    usable = (track.segment >= 0) & np.isfinite(track.orientation_smooth).all((1, 2)) & np.isfinite(track.time)
    for name in ("position_smooth", *UNITS):
        usable &= np.isfinite(getattr(track, name)).all(1)
    if not settings.keep_extrapolated:
        usable &= (track.flags & np.uint32(Flag.EXTRAPOLATED)) == 0
    rows = np.flatnonzero(usable)
    rows = rows[np.lexsort((track.time[rows], track.segment[rows]))]
    sure = np.ones(len(rows), dtype=bool)
    for name in ("acceleration_sigma", "alpha_lab_sigma"):
        size = np.linalg.norm(getattr(track, name)[rows], axis=1)
        known = size[np.isfinite(size)]
        if len(known):
            sure &= ~(size > settings.max_sigma * np.median(known))  # keep unknown ones
    parts = {key: getattr(track, name)[rows] for key, name in COLUMNS.items()}
    return parts | {"sure": sure, "track": np.full(len(rows), number)}


def _first_rows(whole: dict[str, NDArray[Any]], longest_s: float | None) -> NDArray[np.bool_]:
    time_s = whole["time_s"]
    first = np.ones(len(time_s), dtype=bool)
    first[1:] = (np.diff(whole["label"]) != 0) | (np.diff(whole["track"]) != 0)
    if longest_s is not None and len(time_s):
        number, begin = np.cumsum(first) - 1, np.flatnonzero(first)
        span_s = time_s[np.append(begin[1:], len(time_s)) - 1] - time_s[begin]
        pieces = np.maximum(np.ceil(span_s / longest_s * (1 - 1e-9)), 1)
        share = (time_s - time_s[begin][number]) / np.maximum(span_s, 1e-300)[number]
        first[1:] |= np.diff(np.minimum(np.floor(share * pieces[number]), pieces[number] - 1)) != 0
    return first


def _refuse_few(count: int, name: str, which: str = "", fewest: int = FEWEST) -> None:
    if count < fewest:
        expected = " ".join([f"at least {'two segments' if fewest > 1 else 'one segment'}", which]).strip()
        do = "pass more tracks, lower statistics.min_frames, or cut long ones with statistics.max_duration_s"
        raise TrackError(refusal(name, expected=expected, got=str(count), do=do))


@dataclass(frozen=True, kw_only=True, eq=False)
class Durations:
    """Histogram of segment durations."""

    edges_s: Floats  # (B + 1,)
    counts: Rows  # (B,)
    truncated_s: float  # shorter ones are left out
    decay_time_s: Interval  # scalar; exponential law beyond the truncation
    segments: int

    def law(self, decay_s: float) -> Floats:
        """Return the counts (B,) of an exponential law with this decay time."""
        return np.asarray(self.segments * -np.diff(np.exp(-(self.edges_s - self.truncated_s) / max(decay_s, 1e-300))))

    @property
    def expected(self) -> Floats:
        """Counts of the fitted law, (B,)."""
        return self.law(float(self.decay_time_s.value))


def durations(span_s: Floats, truncated_s: float, *, bins: int = 20, level: float = 0.95) -> Durations:
    """Return the histogram of durations (S,), s, and their exponential decay time with its exact interval.
    Raises TrackError (fewer than two durations are `truncated_s` or longer).
    Source: textbook (Epstein and Sobel 1953), maximum likelihood; the paper, section IV.
    """
    from scipy.stats import chi2

    kept = span_s[span_s >= truncated_s * (1 - 1e-9)]
    if len(kept) < 2:
        do = "pass more tracks, or lower statistics.min_frames"
        expected = f"at least two segments of {truncated_s:.3g} s"
        raise TrackError(refusal("durations", expected=expected, got=str(len(kept)), do=do))
    excess = float((kept - truncated_s).sum())
    mean, tail = excess / len(kept), (1 - level) / 2
    low, high = (np.array(2 * excess / float(chi2.ppf(share, 2 * len(kept)))) for share in (1 - tail, tail))
    edges = np.linspace(truncated_s, float(kept.max()) * (1 + 1e-9) + 1e-12, bins + 1)
    return Durations(
        edges_s=edges,
        counts=np.histogram(kept, edges)[0],
        truncated_s=truncated_s,
        decay_time_s=Interval(value=np.array(mean), low=low, high=high, error=np.array(mean / np.sqrt(len(kept)))),
        segments=len(kept),
    )
