"""Intervals from independent segments: the BCa bootstrap, and the studentized one for skewed statistics."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from sphereorient.statistics.settings import BootstrapSettings

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Statistic = Callable[[Floats], Floats]  # sums (..., K) over segments to values (..., Q)

FEWEST = 2  # segments; one has no scatter
AT_ONCE = 4_000_000  # numbers of a block of weights
ENOUGH = 20  # segments of the studentized bootstrap; fewer give rough resampled errors
STEP = 0.01  # of a derivative by differences, relative to the root of the sum of squares over the segments
RESAMPLES_AT_ONCE = 200  # bounds memory


@dataclass(frozen=True, kw_only=True, eq=False)
class Interval:
    """Values with their intervals, all of one shape."""

    value: Floats
    low: Floats
    high: Floats
    error: Floats  # standard deviation of the resampled values

    def part(self, key: Any) -> "Interval":
        """Return some of the values, selected by an array index."""
        value, low, high, error = (np.asarray(x)[key] for x in (self.value, self.low, self.high, self.error))
        return Interval(value=value, low=low, high=high, error=error)

    def scaled(self, factor: Floats | float, shift: Floats | float = 0.0) -> "Interval":
        """Return factor (positive) times the values, plus a shift."""
        value, low, high = (np.asarray(x * factor + shift) for x in (self.value, self.low, self.high))
        return Interval(value=value, low=low, high=high, error=np.asarray(self.error * factor))


def segment_sums(values: Floats, segment: Rows, segments: int) -> Floats:
    """Return the sums (S, ...) over the rows (M, ...) of each segment; `segment` (M,) is increasing, 0 .. S - 1."""
    out = np.zeros((segments, *values.shape[1:]))
    if len(values):
        there = np.unique(segment)
        out[there] = np.add.reduceat(values, np.searchsorted(segment, there), axis=0)
    return out


def segment_counts(place: Rows, bins: int, segment: Rows, segments: int) -> Rows:
    """Return the number of rows (M,) of each segment in each of some bins, (S, bins)."""
    return np.bincount(segment * bins + place, minlength=segments * bins).reshape(segments, bins)


def bootstrap(sums: Floats, statistic: Statistic, settings: BootstrapSettings | None = None) -> Interval:
    """Return a statistic of the total of `sums` (S, ...) over segments, with BCa intervals from resampled segments.
    `statistic` maps totals (..., *sums.shape[1:]) to values with the same leading shape; values are NaN where it is.
    The intervals of a single segment are NaN; without segments, the values too.
    Source: Efron and Tibshirani 1993, An Introduction to the Bootstrap, chapter 14.
    """
    settings = settings or BootstrapSettings()
    flat = sums.reshape(len(sums), math.prod(sums.shape[1:]))
    total = flat.sum(0)

    @np.errstate(all="ignore")
    def at(totals: Floats) -> Floats:
        return np.asarray(statistic(totals.reshape(*totals.shape[:-1], *sums.shape[1:])), np.float64)

    value = at(total)
    if len(sums) < FEWEST:
        unknown = np.full_like(value, np.nan)
        return Interval(value=value, low=unknown, high=unknown, error=unknown)
    some = max(1, AT_ONCE // len(flat))
    drawn = _by_blocks(lambda rows: at(_weights(len(flat), rows, settings) @ flat), settings.resamples, some)
    some = max(1, AT_ONCE // (len(flat) + flat.shape[1]))
    without = _by_blocks(lambda rows: at(total - flat[rows]), len(flat), some)
    below, rest = ((drawn < value).mean(0) + (drawn <= value).mean(0)) / 2, 0.5 / len(drawn)
    bias = ndtri(np.clip(below, rest, 1 - rest))
    pull = without.mean(0) - without
    with np.errstate(all="ignore"):
        skew = np.nan_to_num((pull**3).sum(0) / (6 * (pull**2).sum(0) ** 1.5))
    ends = (bias + ndtri((1 + sign * settings.level) / 2) for sign in (-1, 1))
    low, high = (_quantiles(drawn, ndtr(bias + z / (1 - skew * z))) for z in ends)
    return Interval(value=value, low=low, high=high, error=np.asarray(drawn.std(0, ddof=1), np.float64))


def _by_blocks(part: Callable[[Rows], Floats], count: int, size: int) -> Floats:
    """Compute the rows 0 .. count - 1 in blocks that fit into memory."""
    return np.concatenate([part(np.arange(k, min(k + size, count))) for k in range(0, count, size)])


def _weights(segments: int, rows: Rows, settings: BootstrapSettings) -> Floats:
    """Return the number of times that each segment is in the resamples `rows` (B,), (B, segments)."""
    weights = np.empty((len(rows), segments))
    for place, row in enumerate(rows.tolist()):
        # One seed per resample: the block size does not change the numbers.
        draw = np.random.default_rng([settings.seed, row]).integers(0, segments, segments)
        weights[place] = np.bincount(draw, minlength=segments)
    return weights


def _quantiles(drawn: Floats, share: Floats) -> Floats:
    """Return the quantile of each column at its own share; NaN if a drawn value is not finite."""
    ordered = np.sort(drawn, axis=0)
    place = np.clip(share * (len(drawn) - 1), 0, len(drawn) - 1)
    left = np.floor(place).astype(np.int64)
    right = np.minimum(left + 1, len(drawn) - 1)
    a, b = (np.take_along_axis(ordered, k[None], axis=0)[0] for k in (left, right))
    return np.where(np.isfinite(drawn).all(0), a + (place - left) * (b - a), np.nan)


def studentized(
    sums: Floats, statistic: Statistic, positive: NDArray[np.bool_], settings: BootstrapSettings | None = None
) -> Interval:
    """Return a statistic of the total of `sums` (S, G, K) over segments, with studentized bootstrap intervals.
    For statistics skewed by a few large events, such as the flatness. `statistic` maps totals (..., G, K) to values
    (..., G, Q) and gives the same for twice the totals; values are NaN where it is. `positive` (Q,) marks values that
    are positive by definition. Fewer than 20 segments: as `bootstrap`.
    Source: Efron and Tibshirani 1993, An Introduction to the Bootstrap, chapters 12 and 14.
    """
    settings = settings or BootstrapSettings()
    if len(sums) < ENOUGH:
        return bootstrap(sums, statistic, settings)

    @np.errstate(all="ignore")
    def at(totals: Floats) -> Floats:
        values = np.asarray(statistic(totals), np.float64)
        return np.where(positive, np.log(values), values)

    value = at(sums.sum(0))
    error = _error(at, sums.sum(0), np.einsum("sgk,sgl->gkl", sums, sums))
    flat = sums.reshape(len(sums), -1)
    products = (sums[..., :, None] * sums[..., None, :]).reshape(len(sums), -1)

    def resampled(rows: Rows) -> Floats:
        weights = _weights(len(sums), rows, settings)
        totals = (weights @ flat).reshape(-1, *sums.shape[1:])
        squares = (weights @ products).reshape(*totals.shape, -1)
        return np.stack([at(totals), _error(at, totals, squares)], axis=1)

    drawn, drawn_error = np.moveaxis(_by_blocks(resampled, settings.resamples, RESAMPLES_AT_ONCE), 1, 0)
    with np.errstate(all="ignore"):
        t = np.where(drawn_error > 0, (drawn - value) / drawn_error, 0.0)
    known = np.isfinite(drawn).all(0) & np.isfinite(value)
    tail = (1 - settings.level) / 2
    late, early = (np.quantile(np.where(known, t, 0.0), share, axis=0) for share in (1 - tail, tail))

    @np.errstate(over="ignore")
    def back(x: Floats) -> Floats:
        return np.where(known, np.where(positive, np.exp(x), x), np.nan)

    plain = np.where(positive, np.exp(value), value)
    spread = np.where(known, np.where(positive, plain * error, error), np.nan)
    return Interval(value=plain, low=back(value - late * error), high=back(value - early * error), error=spread)


def _error(at: Statistic, totals: Floats, squares: Floats) -> Floats:
    """Return the error (..., G, Q) of a statistic, by its gradient; `squares` (..., G, K, K): products of the sums."""
    squares = np.nan_to_num(squares)  # NaN sums of a group enter only statistics that are NaN
    # Scaled totals give the same value: the gradient is orthogonal to them, and segments contribute 0 on average.
    slopes = []
    with np.errstate(all="ignore"):
        for k in range(totals.shape[-1]):
            step = STEP * np.sqrt(squares[..., k, k])
            step = np.where(step > 0, step, 1.0)  # without contributions the slope is multiplied by 0 below
            moved = np.zeros_like(totals)
            moved[..., k] = step
            slopes.append((at(totals + moved) - at(totals - moved)) / (2 * step[..., None]))
        gradient = np.stack(slopes, axis=-1)  # (..., G, Q, K)
        variance = np.einsum("...gqk,...gkl,...gql->...gq", gradient, squares, gradient)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
