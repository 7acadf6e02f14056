"""Error bars from independent segments: the bootstrap, with bias and acceleration corrected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from sphereorient.statistics.settings import BootstrapSettings

Floats = NDArray[np.float64]
Statistic = Callable[[Floats], Floats]  # sums (..., K) over segments to values (..., Q)

FEWEST = 2  # segments; of one nothing is known about the scatter
AT_ONCE = 4_000_000  # numbers of a block of weights


@dataclass(frozen=True, kw_only=True, eq=False)
class Interval:
    """Values with their intervals, any one shape; made by `bootstrap`."""

    value: Floats
    low: Floats
    high: Floats
    error: Floats  # standard deviation of the resampled values

    def part(self, key: Any) -> Interval:
        """Return some of the values, by an index as an array takes it."""
        value, low, high, error = (np.asarray(x)[key] for x in (self.value, self.low, self.high, self.error))
        return Interval(value=value, low=low, high=high, error=error)

    def scaled(self, factor: Floats | float, shift: Floats | float = 0.0) -> Interval:
        """Return factor (positive) times the values, plus a shift: other units."""
        value, low, high = (np.asarray(x * factor + shift) for x in (self.value, self.low, self.high))
        return Interval(value=value, low=low, high=high, error=np.asarray(self.error * factor))

    def holds(self, truth: Floats | float) -> NDArray[np.bool_]:
        """Say which intervals hold the truth."""
        return np.asarray((self.low <= truth) & (truth <= self.high))


def per_segment(values: Floats, segment: NDArray[np.int64], segments: int) -> Floats:
    """Return the sums over each segment's rows.

    Args:
        values: (M, ...).
        segment: (M,), 0 .. segments - 1, increasing.
        segments: their number.

    Returns:
        (segments, ...).
    """
    starts = np.searchsorted(segment, np.arange(segments))
    return np.add.reduceat(values, starts, axis=0)


def scattered(values: Floats, segment: NDArray[np.int64], segments: int) -> Floats:
    """Return the sums over each segment's rows where some segments may have none; arguments as of `per_segment`."""
    out = np.zeros((segments, *values.shape[1:]))
    if len(values):
        there = np.unique(segment)
        out[there] = np.add.reduceat(values, np.searchsorted(segment, there), axis=0)
    return out


def bootstrap(sums: Floats, statistic: Statistic, settings: BootstrapSettings | None = None) -> Interval:
    """Return a statistic of sums over segments, with intervals from resampled segments.

    Long segments weigh as much as they have samples, since the statistic sees sums. Intervals are corrected for bias
    and skewness (BCa), the latter from leaving out each segment in turn.

    Args:
        sums: (S, ...), what each independent segment contributes.
        statistic: takes total sums (..., *sums.shape[1:]) to values with any leading shape.
        settings: resamples, level, seed.

    Returns:
        Values and intervals, of the statistic's shape; NaN where the statistic is. One segment has no intervals.

    Source: Efron and Tibshirani 1993, An Introduction to the Bootstrap, chapter 14.
    """
    settings = settings or BootstrapSettings()
    flat = sums.reshape(len(sums), -1)
    total = flat.sum(0)

    def at(totals: Floats) -> Floats:
        with np.errstate(all="ignore"):
            return np.asarray(statistic(totals.reshape(*totals.shape[:-1], *sums.shape[1:])), np.float64)

    value = at(total)
    if len(sums) < FEWEST:
        unknown = np.full_like(value, np.nan)
        return Interval(value=value, low=unknown, high=unknown, error=unknown)
    drawn = _by_blocks(lambda rows: at(_resampled(flat, rows, settings)), settings.resamples, len(flat))
    without = _by_blocks(lambda rows: at(total - flat[rows]), len(flat), len(flat) + flat.shape[1])
    low, high = _bca(value, drawn, without, settings.level)
    return Interval(value=value, low=low, high=high, error=_deviation(drawn))


def _deviation(drawn: Floats) -> Floats:
    """Return the standard deviation of the resampled values; NaN where one of them is."""
    return np.asarray(drawn.std(0, ddof=1), np.float64)


def _by_blocks(part: Callable[[NDArray[np.int64]], Floats], count: int, width: int) -> Floats:
    """Compute row by row in blocks that fit into memory."""
    size = max(1, AT_ONCE // max(width, 1))
    return np.concatenate([part(np.arange(k, min(k + size, count))) for k in range(0, count, size)])


def _resampled(flat: Floats, rows: NDArray[np.int64], settings: BootstrapSettings) -> Floats:
    """Return the total sums of some of the resampled ensembles."""
    return np.asarray(resampled_weights(len(flat), rows, settings) @ flat, np.float64)


def resampled_weights(segments: int, rows: NDArray[np.int64], settings: BootstrapSettings) -> Floats:
    """Return how often each segment is in some of the resampled ensembles, (B, segments).

    Args:
        segments: their number.
        rows: (B,), numbers of the resamples; each has its own seed, so that blocks do not change the numbers.
        settings: the seed.
    """
    weights = np.empty((len(rows), segments))
    for place, row in enumerate(rows.tolist()):
        draw = np.random.default_rng([settings.seed, row]).integers(0, segments, segments)
        weights[place] = np.bincount(draw, minlength=segments)
    return weights


def _bca(value: Floats, drawn: Floats, without: Floats, level: float) -> tuple[Floats, Floats]:
    """Return the corrected quantiles of the drawn values."""
    below = ((drawn < value).mean(0) + (drawn <= value).mean(0)) / 2
    rest = 0.5 / len(drawn)
    bias = ndtri(np.clip(below, rest, 1 - rest))
    pull = without.mean(0) - without
    with np.errstate(all="ignore"):
        skew = np.nan_to_num((pull**3).sum(0) / (6 * (pull**2).sum(0) ** 1.5))
    ends = []
    for tail in ((1 - level) / 2, (1 + level) / 2):
        z = bias + ndtri(tail)
        share = ndtr(bias + z / (1 - skew * z))
        ends.append(_quantiles(drawn, share))
    return ends[0], ends[1]


def _quantiles(drawn: Floats, share: Floats) -> Floats:
    """Return each column's own quantile; NaN where a drawn value is none."""
    ordered = np.sort(drawn, axis=0)
    place = np.clip(share * (len(drawn) - 1), 0, len(drawn) - 1)
    left = np.floor(place).astype(np.int64)
    right = np.minimum(left + 1, len(drawn) - 1)
    a, b = (np.take_along_axis(ordered, k[None], axis=0)[0] for k in (left, right))
    return np.where(np.isfinite(drawn).all(0), a + (place - left) * (b - a), np.nan)
