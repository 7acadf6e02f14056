"""Increments over time lags, from one frame to the integral time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.statistics.bootstrap import Interval, scattered
from sphereorient.statistics.density import Density, density_of
from sphereorient.statistics.lags import Pairs
from sphereorient.statistics.segments import Ensemble
from sphereorient.statistics.settings import BootstrapSettings
from sphereorient.statistics.studentized import studentized

Floats = NDArray[np.float64]

FEWEST_SEGMENTS = 10  # a lag that fewer reach has no error bar to speak of


@dataclass(frozen=True, kw_only=True, eq=False)
class Increments:
    """Increments x(t + lag) - x(t) of one quantity; made by `increments`. Columns: x, y, z, and all three together."""

    quantity: str
    lag_s: Floats  # (L,)
    lag_frames: NDArray[np.int64]  # (L,)
    rms: Interval  # (L, 4); together: of one component
    flatness: Interval  # (L, 4)
    pairs: NDArray[np.int64]  # (L,)


def increments(
    ensemble: Ensemble,
    quantity: str = "omega_lab",
    lags_s: Sequence[float] | None = None,
    integral_time_s: float | None = None,
    settings: BootstrapSettings | None = None,
) -> Increments:
    """Return rms and flatness of increments over lags.

    At short lags an increment is the derivative times the lag, with its flatness; far beyond the integral time it is
    the difference of two independent values, with flatness 3 + (F - 3) / 2.

    Args:
        ensemble: the samples.
        quantity: a name in UNITS.
        lags_s: lags, s; rounded to frames. None: twelve, from a frame to the integral time, geometric.
        integral_time_s: the longest of these twelve; None: half the median segment.
        settings: of the bootstrap.

    Returns:
        Statistics by lag; lags that fewer than ten segments reach are left out.

    Source: the paper, section IV, with ERRATA E7.
    """
    pairs = Pairs(ensemble)
    wanted = _lags(ensemble, pairs, lags_s, integral_time_s)
    x = ensemble.values[quantity]
    sums, counts, lags = [], [], []
    for lag in wanted.tolist():
        first, second = pairs.at(lag)
        segment = ensemble.segment[first]
        if len(np.unique(segment)) < min(FEWEST_SEGMENTS, ensemble.segments):
            continue
        d2 = np.square(x[second] - x[first])
        sums.append(scattered(np.stack([np.ones_like(d2), d2, d2 * d2], axis=-1), segment, ensemble.segments))
        counts.append(len(first))
        lags.append(lag)
    whole = np.stack(sums, axis=1)  # (S, L, 3, 3)
    found = studentized(whole.reshape(*whole.shape[:2], 9), _statistics, np.ones(8, bool), settings)
    frames = np.array(lags, dtype=np.int64)
    return Increments(
        quantity=quantity,
        lag_s=np.asarray(frames * ensemble.step_s, np.float64),
        lag_frames=frames,
        rms=found.part((..., slice(0, 4))),
        flatness=found.part((..., slice(4, 8))),
        pairs=np.array(counts),
    )


def increment_density(
    ensemble: Ensemble,
    lag_frames: int,
    quantity: str = "omega_lab",
    component: int = 0,
    settings: BootstrapSettings | None = None,
) -> Density:
    """Return the PDF of the increments over one lag, in their standard deviations.

    Args:
        ensemble: the samples.
        lag_frames: the lag; some segment must be longer.
        quantity: a name in UNITS.
        component: 0, 1, 2.
        settings: of the bootstrap.
    """
    first, second = Pairs(ensemble).at(lag_frames)
    x = ensemble.values[quantity][:, component]
    there, segment = np.unique(ensemble.segment[first], return_inverse=True)
    return density_of(x[second] - x[first], segment, len(there), settings=settings)


def _lags(
    ensemble: Ensemble, pairs: Pairs, lags_s: Sequence[float] | None, integral_time_s: float | None
) -> NDArray[np.int64]:
    """Return lags in frames, each once."""
    if lags_s is None:
        longest = (integral_time_s or float(np.median(ensemble.span_s)) / 2) / ensemble.step_s
        frames = np.geomspace(1, max(longest, 1), 12)
    else:
        frames = np.asarray(lags_s) / ensemble.step_s
    return np.unique(np.clip(np.rint(frames).astype(np.int64), 1, max(pairs.longest, 1)))


def _statistics(totals: Floats) -> Floats:
    """Return rms, and behind them flatness, (..., L, 8) of sums (..., L, 9): by component number, square, fourth."""
    parts = totals.reshape(*totals.shape[:-1], 3, 3)
    whole = np.concatenate([parts, parts.sum(-2, keepdims=True)], axis=-2)
    count, second, fourth = np.moveaxis(whole, -1, 0)
    return np.concatenate([np.sqrt(second / count), fourth * count / second**2], axis=-1)
