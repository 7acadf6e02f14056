"""Autocorrelations within segments, and integral times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.statistics.bootstrap import Interval, bootstrap, scattered
from sphereorient.statistics.lags import Pairs
from sphereorient.statistics.segments import Ensemble
from sphereorient.statistics.settings import BootstrapSettings

Floats = NDArray[np.float64]

LEAST_PAIRS = 0.02  # of the samples: longer lags are known from too few segments
EVERY_LAG, MORE_LAGS = 40, 40  # the first ones, and how many more


@dataclass(frozen=True, kw_only=True, eq=False)
class Correlation:
    """Autocorrelation of one quantity; made by `correlation`. Columns: x, y, z, and the vector's (their sum)."""

    quantity: str
    lag_s: Floats  # (L,), from 0
    value: Interval  # (L, 4)
    pairs: NDArray[np.int64]  # (L,)
    integral_time_s: Interval  # (4,), of the curve up to its first zero
    reached_zero: NDArray[np.bool_]  # (4,); False: the segments are too short, the time is a lower bound


def correlation(
    ensemble: Ensemble, quantity: str, longest_s: float | None = None, settings: BootstrapSettings | None = None
) -> Correlation:
    """Return the autocorrelation of a quantity about its mean over the ensemble.

    Each lag is a mean over the pairs there are, of the product over the mean square of the same pairs: unbiased by the
    lengths of the segments, and 1 for a constant. Pairs over a gap count by their true lag.

    Args:
        ensemble: the samples.
        quantity: a name in UNITS.
        longest_s: longest lag, s; None goes as far as a fiftieth of the samples has a partner.
        settings: of the bootstrap.

    Returns:
        The curve and the integral times, to the first zero (trapezoids, the last one cut at the zero).

    Source: textbook; the paper's T_L is the first column set of `velocity`.
    """
    pairs = Pairs(ensemble)
    x = ensemble.values[quantity] - ensemble.values[quantity].mean(0)
    lags = _lags(pairs, ensemble, longest_s)
    sums, counts = zip(*(_products(x, pairs, lag, ensemble) for lag in lags.tolist()), strict=True)
    lag_s = np.asarray(lags * ensemble.step_s, np.float64)
    found = bootstrap(np.stack(sums, axis=1), lambda totals: _curve_and_times(totals, lag_s), settings)
    curve = found.part(slice(0, -1))
    return Correlation(
        quantity=quantity,
        lag_s=lag_s,
        value=curve,
        pairs=np.array(counts),
        integral_time_s=found.part(-1),
        reached_zero=np.asarray((curve.value <= 0).any(0)),
    )


def _lags(pairs: Pairs, ensemble: Ensemble, longest_s: float | None) -> NDArray[np.int64]:
    """Return lags in frames, thinned."""
    most = pairs.longest if longest_s is None else min(pairs.longest, int(longest_s / ensemble.step_s))
    if longest_s is None:
        length = np.sort(np.bincount(ensemble.segment))
        reached = np.array([np.maximum(length - k, 0).sum() for k in range(most + 1)])
        most = max(1, int(np.flatnonzero(reached >= LEAST_PAIRS * len(ensemble))[-1]))
    return thinned(most)


def thinned(most: int) -> NDArray[np.int64]:
    """Return lags 0 .. most: each one at first, then ever sparser."""
    sparse = np.geomspace(EVERY_LAG, max(most, EVERY_LAG), MORE_LAGS).round().astype(np.int64)
    lags = np.unique(np.concatenate([np.arange(EVERY_LAG), sparse]))
    return lags[lags <= most]


def _products(x: Floats, pairs: Pairs, lag: int, ensemble: Ensemble) -> tuple[Floats, int]:
    """Return sums by segment (S, 3, 2) of the products and of the mean squares of their factors."""
    first, second = pairs.at(lag)
    a, b = x[first], x[second]
    products = np.stack([a * b, (a * a + b * b) / 2], axis=-1)
    return scattered(products, ensemble.segment[first], ensemble.segments), len(first)


def _curve_and_times(totals: Floats, lag_s: Floats) -> Floats:
    """Return the curve and below it the integral times, (..., L + 1, 4), of sums (..., L, 3, 2)."""
    whole = np.concatenate([totals, totals.sum(-2, keepdims=True)], axis=-2)
    curve = whole[..., 0] / whole[..., 1]
    return np.concatenate([curve, integral_time(curve, lag_s)[..., None, :]], axis=-2)


def integral_time(curve: Floats, lag_s: Floats) -> Floats:
    """Return the integral up to the first zero, (..., C), of curves (..., L, C) at lags (L,); it ends before a NaN."""
    a, b = curve[..., :-1, :], curve[..., 1:, :]
    step = np.diff(lag_s)[:, None]
    before = np.logical_and.accumulate((a > 0) & np.isfinite(b), axis=-2)
    share = np.where(b > 0, 1.0, a / np.where(b > 0, 1.0, np.maximum(a - b, 1e-300)))  # of the step before the zero
    area = share * step * np.where(b > 0, a + b, a) / 2
    return np.asarray(np.where(before, area, 0.0).sum(-2))
