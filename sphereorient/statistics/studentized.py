"""Error bars of moments: the studentized bootstrap, for statistics whose sampling is skewed by a few large events."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sphereorient.statistics.bootstrap import Interval, Statistic, bootstrap, resampled_weights
from sphereorient.statistics.settings import BootstrapSettings

Floats = NDArray[np.float64]

ENOUGH = 20  # segments; of fewer the resampled errors are themselves too rough
STEP = 0.01  # of the root of the sum of squares of what segments contribute, for derivatives by differences
AT_ONCE = 200  # resamples


def studentized(
    sums: Floats, statistic: Statistic, positive: NDArray[np.bool_], settings: BootstrapSettings | None = None
) -> Interval:
    """Return a statistic of sums over segments, with intervals from resampled segments, each with its own error.

    What is resampled is t = (resampled value - value) / (resampled error). Where a flatness comes out low, for want of
    large events, its error does too, and t knows it: percentiles of the values themselves, corrected ones too, end too
    low. Positive quantities are taken in logarithms. Errors come from the derivative by each segment's weight. Below
    20 segments the intervals are those of `bootstrap`.

    Args:
        sums: (S, G, K), what each independent segment contributes to G groups.
        statistic: takes totals (..., G, K) to values (..., G, Q); each group by itself, and the same for twice the
            totals.
        positive: (Q,), which values are positive by nature.
        settings: resamples, level, seed.

    Returns:
        Values and intervals, (G, Q); NaN where the statistic is.

    Source: Efron and Tibshirani 1993, An Introduction to the Bootstrap, chapters 12 and 14.
    """
    settings = settings or BootstrapSettings()
    if len(sums) < ENOUGH:
        return bootstrap(sums, statistic, settings)

    def at(totals: Floats) -> Floats:
        with np.errstate(all="ignore"):
            values = np.asarray(statistic(totals), np.float64)
            return np.where(positive, np.log(values), values)

    value = at(sums.sum(0))
    error = _error(at, sums.sum(0), np.einsum("sgk,sgl->gkl", sums, sums))
    drawn, drawn_error = _drawn(at, sums, settings)
    with np.errstate(all="ignore"):
        t = (drawn - value) / drawn_error
    t = np.where(drawn_error > 0, t, 0.0)
    known = np.isfinite(drawn).all(0) & np.isfinite(value)
    tail = (1 - settings.level) / 2
    late, early = (np.quantile(np.where(known, t, 0.0), share, axis=0) for share in (1 - tail, tail))

    def back(x: Floats) -> Floats:
        with np.errstate(over="ignore"):
            return np.where(known, np.where(positive, np.exp(x), x), np.nan)

    plain = np.where(positive, np.exp(value), value)
    spread = np.where(positive, plain * error, error)
    return Interval(
        value=plain,
        low=back(value - late * error),
        high=back(value - early * error),
        error=np.where(known, spread, np.nan),
    )


def _drawn(at: Statistic, sums: Floats, settings: BootstrapSettings) -> tuple[Floats, Floats]:
    """Return the values of the resampled ensembles and their errors, (B, G, Q) each."""
    segments, groups, size = sums.shape
    flat = sums.reshape(segments, -1)
    products = (sums[..., :, None] * sums[..., None, :]).reshape(segments, -1)
    parts = []
    for first in range(0, settings.resamples, AT_ONCE):
        rows = np.arange(first, min(first + AT_ONCE, settings.resamples))
        weights = resampled_weights(segments, rows, settings)
        totals = (weights @ flat).reshape(-1, groups, size)
        squares = (weights @ products).reshape(-1, groups, size, size)
        parts.append((at(totals), _error(at, totals, squares)))
    values, errors = zip(*parts, strict=True)
    return np.concatenate(values), np.concatenate(errors)


def _error(at: Statistic, totals: Floats, squares: Floats) -> Floats:
    """Return the standard deviation of a statistic (..., G, Q) by the scatter of what the segments contribute.

    The statistic of totals T varies with a segment's weight by its gradient times the segment's sums; since twice the
    totals give the same value, the gradient is orthogonal to T and these contributions have mean zero.

    Args:
        at: the statistic.
        totals: (..., G, K).
        squares: (..., G, K, K), sums over the segments of the products of their sums.
    """
    squares = np.nan_to_num(squares)  # what is not known of a group enters only statistics that are NaN anyway
    slopes = []
    for k in range(totals.shape[-1]):
        step = STEP * np.sqrt(squares[..., k, k])
        step = np.where(step > 0, step, 1.0)  # of what no segment contributes to: multiplied by 0 below
        moved = np.zeros_like(totals)
        moved[..., k] = step
        with np.errstate(all="ignore"):
            slopes.append((at(totals + moved) - at(totals - moved)) / (2 * step[..., None]))
    gradient = np.stack(slopes, axis=-1)  # (..., G, Q, K)
    with np.errstate(all="ignore"):
        variance = np.einsum("...gqk,...gkl,...gql->...gq", gradient, squares, gradient)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
