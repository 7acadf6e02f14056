"""Autocorrelations with integral times, and increments, over lags within segments."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.statistics.bootstrap import Floats, Interval, Rows, bootstrap, segment_sums, studentized
from sphereorient.statistics.density import Density, density_of
from sphereorient.statistics.segments import Ensemble
from sphereorient.statistics.settings import BootstrapSettings

LEAST_PAIRS = 0.02  # of the samples: longer lags have pairs in too few segments
EVERY_LAG, MORE_LAGS = 40, 40  # number of consecutive lags, and of sparser ones after them
FEWEST_SEGMENTS = 10  # of a lag; fewer give no useful error bar


def places(frame: Rows, segment: Rows) -> Rows:
    """Return the places of rows (M,), sorted by segment, on one regular grid; an empty place ends each segment."""
    lengths = frame[np.flatnonzero(np.append(np.diff(segment), 1))] + 2
    return np.asarray(frame + (np.cumsum(lengths) - lengths)[segment], np.int64)


class Pairs:
    """Pairs of samples of one segment at a given lag, on a regular grid with empty places for lost frames."""

    def __init__(self, ensemble: Ensemble) -> None:
        self.longest = int(ensemble.frame.max())  # lag, frames
        self._segment = ensemble.segment
        self._place = places(ensemble.frame, ensemble.segment)
        self._row = np.full(int(self._place[-1]) + 1 + self.longest, -1, dtype=np.int64)
        self._row[self._place] = np.arange(len(self._place))

    def at(self, lag: int) -> tuple[Rows, Rows]:
        """Return the rows of all pairs (earlier, later) that are `lag` frames apart, sorted by segment."""
        if lag > self.longest:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        later = self._row[self._place + lag]
        there = (later >= 0) & (self._segment[later] == self._segment)
        return np.flatnonzero(there), later[there]


@dataclass(frozen=True, kw_only=True, eq=False)
class Correlation:
    """Autocorrelation of one quantity. Columns: x, y, z, and the vector's (their sum)."""

    quantity: str
    lag_s: Floats  # (L,), from 0
    value: Interval  # (L, 4)
    pairs: Rows  # (L,)
    integral_time_s: Interval  # (4,), of the curve up to its first zero
    reached_zero: NDArray[np.bool_]  # (4,); False: the segments are too short, the time is a lower bound


def correlation(ensemble: Ensemble, quantity: str, settings: BootstrapSettings | None = None) -> Correlation:
    """Return the autocorrelation of a quantity (a name in UNITS) about its ensemble mean, and its integral times.
    A value is the mean product of pairs over their mean square: unbiased by the lengths of segments. Pairs over a gap
    have their true lag. At the longest lag a fiftieth of the samples has a partner.
    Source: textbook; the paper's T_L is the integral time of `velocity`, up to the first zero.
    """
    pairs = Pairs(ensemble)
    x = ensemble.values[quantity] - ensemble.values[quantity].mean(0)
    sums, counts, lags = [], [], _correlation_lags(pairs, ensemble)
    for lag in lags.tolist():
        first, second = pairs.at(lag)
        a, b = x[first], x[second]
        products = np.stack([a * b, (a * a + b * b) / 2], axis=-1)
        sums.append(segment_sums(products, ensemble.segment[first], ensemble.segments))
        counts.append(len(first))
    lag_s, number = np.asarray(lags * ensemble.step_s, np.float64), np.array(counts)
    found = bootstrap(np.stack(sums, axis=1), lambda totals: _curve_and_times(totals, lag_s), settings)
    curve, times = found.part(slice(0, -1)), found.part(-1)
    zero = np.asarray((curve.value <= 0).any(0))
    return Correlation(
        quantity=quantity, lag_s=lag_s, value=curve, pairs=number, integral_time_s=times, reached_zero=zero
    )


def _correlation_lags(pairs: Pairs, ensemble: Ensemble) -> Rows:
    length = np.bincount(ensemble.segment)
    reached = np.array([np.maximum(length - k, 0).sum() for k in range(pairs.longest + 1)])
    most = max(1, int(np.flatnonzero(reached >= LEAST_PAIRS * len(ensemble))[-1]))
    sparse = np.geomspace(EVERY_LAG, max(most, EVERY_LAG), MORE_LAGS).round().astype(np.int64)
    lags = np.unique(np.concatenate([np.arange(EVERY_LAG), sparse]))
    return np.asarray(lags[lags <= most], np.int64)


def _curve_and_times(totals: Floats, lag_s: Floats) -> Floats:
    """Return the curve and, as last row, the integral times, (..., L + 1, 4), of sums (..., L, 3, 2)."""
    whole = np.concatenate([totals, totals.sum(-2, keepdims=True)], axis=-2)
    curve = whole[..., 0] / whole[..., 1]
    return np.concatenate([curve, integral_time(curve, lag_s)[..., None, :]], axis=-2)


def integral_time(curve: Floats, lag_s: Floats) -> Floats:
    """Return the integrals (..., C) of curves (..., L, C) over lags (L,), up to the first zero or NaN."""
    a, b = curve[..., :-1, :], curve[..., 1:, :]
    step = np.diff(lag_s)[:, None]
    before = np.logical_and.accumulate((a > 0) & np.isfinite(b), axis=-2)
    share = np.where(b > 0, 1.0, a / np.where(b > 0, 1.0, np.maximum(a - b, 1e-300)))  # of the step before the zero
    area = share * step * np.where(b > 0, a + b, a) / 2
    return np.asarray(np.where(before, area, 0.0).sum(-2))


@dataclass(frozen=True, kw_only=True, eq=False)
class Increments:
    """Increments of omega_lab over a lag. Columns: x, y, z, and all three pooled."""

    lag_s: Floats  # (L,)
    lag_frames: Rows  # (L,)
    rms: Interval  # (L, 4); pooled: of one component
    flatness: Interval  # (L, 4)
    pairs: Rows  # (L,)


def increments(
    ensemble: Ensemble,
    lags_s: Sequence[float] | None = None,
    integral_time_s: float | None = None,
    settings: BootstrapSettings | None = None,
) -> Increments:
    """Return rms and flatness of increments of omega_lab, for lags within ten segments or more.
    `lags_s`, s, are rounded to frames; None: twelve, geometric, from one frame to `integral_time_s` (None: half the
    median segment). The flatness goes from the derivative's to 3 + (F - 3) / 2 at long lags.
    Source: the paper, section IV, with docs/errata.md E7.
    """
    pairs = Pairs(ensemble)
    if lags_s is None:
        longest = (integral_time_s or float(np.median(ensemble.span_s)) / 2) / ensemble.step_s
        frames = np.geomspace(1, max(longest, 1), 12)
    else:
        frames = np.asarray(lags_s) / ensemble.step_s
    wanted = np.unique(np.clip(np.rint(frames).astype(np.int64), 1, max(pairs.longest, 1)))
    x = ensemble.values["omega_lab"]
    sums, counts, lags = list[Floats](), list[int](), list[int]()
    for lag in wanted.tolist():
        first, second = pairs.at(lag)
        segment = ensemble.segment[first]
        if lags and len(np.unique(segment)) < min(FEWEST_SEGMENTS, ensemble.segments):
            continue
        d2 = np.square(x[second] - x[first])
        sums.append(segment_sums(np.stack([np.ones_like(d2), d2, d2 * d2], axis=-1), segment, ensemble.segments))
        counts.append(len(first))
        lags.append(lag)
    whole, lag_frames = np.stack(sums, axis=1), np.array(lags, dtype=np.int64)  # (S, L, 3, 3), (L,)
    found = studentized(whole.reshape(*whole.shape[:2], 9), _rms_and_flatness, np.ones(8, bool), settings)
    return Increments(
        lag_s=np.asarray(lag_frames * ensemble.step_s, np.float64),
        lag_frames=lag_frames,
        rms=found.part((..., slice(0, 4))),
        flatness=found.part((..., slice(4, 8))),
        pairs=np.array(counts),
    )


def _rms_and_flatness(totals: Floats) -> Floats:
    """Return rms, then flatness, (..., L, 8), of sums (..., L, 9): number, square, fourth power of each component."""
    parts = totals.reshape(*totals.shape[:-1], 3, 3)
    whole = np.concatenate([parts, parts.sum(-2, keepdims=True)], axis=-2)
    count, second, fourth = np.moveaxis(whole, -1, 0)
    return np.concatenate([np.sqrt(second / count), fourth * count / second**2], axis=-1)


def increment_density(ensemble: Ensemble, lag_frames: int, settings: BootstrapSettings | None = None) -> Density:
    """Return the PDF of increments of omega_lab's x over one lag, standard deviations; some segment must be longer."""
    first, second = Pairs(ensemble).at(lag_frames)
    x = ensemble.values["omega_lab"][:, 0]
    there, segment = np.unique(ensemble.segment[first], return_inverse=True)
    return density_of(x[second] - x[first], segment, len(there), settings=settings)
