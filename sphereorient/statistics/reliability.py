"""Calibration of probabilities: the observed frequency of outcomes against their predicted probability."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sphereorient.errors import ShapeError, refusal
from sphereorient.statistics.bootstrap import Floats, Rows

Z95 = 1.959964  # normal quantile of a two-sided interval of 95 %


@dataclass(frozen=True, kw_only=True, eq=False)
class Reliability:
    """A reliability curve in B bins of increasing probability; made by `reliability`."""

    probability: Floats  # (B,), mean of the predictions
    share: Floats  # (B,), of the outcomes that are true
    low: Floats  # (B,), of the 95 % interval of the share
    high: Floats  # (B,)
    count: Rows  # (B,), outcomes in the bin
    error: float  # expected calibration error: mean |share - probability| over outcomes; NaN without outcomes
    chance: float  # the error expected by scatter alone if the probabilities are perfect


def reliability(probability: ArrayLike, outcome: ArrayLike, bins: int = 10) -> Reliability:
    """Compare probabilities (N,), 0 .. 1 or NaN (left out), with outcomes (N,), bool, in at most `bins` bins.
    Bins have equal counts, but equal probabilities stay in one bin.
    Raises ShapeError (unequal numbers of outcomes and probabilities, probabilities outside 0 .. 1, or no bin).
    Source: Naeini et al. 2015 (expected calibration error) with bins of equal count; interval: Wilson 1927.
    """
    said, came = np.asarray(probability, np.float64), np.asarray(outcome, np.bool_)
    if said.ndim != 1 or said.shape != came.shape:
        got, do = f"{said.shape} and {came.shape}", "pass one outcome for each probability"
        raise ShapeError(refusal("probability and outcome", expected="shapes (N,) and (N,)", got=got, do=do))
    known = np.isfinite(said)
    said, came = said[known], came[known]
    if bins < 1 or np.any((said < 0) | (said > 1 + 1e-9)):
        expected = "a bin or more, probabilities in 0 .. 1"
        got = f"{bins} bins, probabilities to {said.max(initial=0.0):g}"
        raise ShapeError(refusal("reliability", expected=expected, got=got, do="correct the arguments"))
    order = np.argsort(said, kind="stable")
    said, came = said[order], came[order]
    wanted = said[np.rint(np.linspace(0, len(said), bins + 1)[1:-1]).astype(np.int64)] if len(said) >= bins else said
    inner = np.searchsorted(said, wanted, side="left")
    edges = np.unique(np.concatenate([[0], inner, [len(said)]])).astype(np.int64)
    count = np.diff(edges)
    columns = np.stack([said, said * (1 - said), came.astype(np.float64)])
    sums = np.add.reduceat(columns, edges[:-1], axis=1) if len(edges) > 1 else np.zeros((3, 0))
    mean, spread, share = sums / count
    low, high = wilson(share, count)
    # The mean absolute deviation of a normal variable is sqrt(2 / pi) sigma.
    off = np.abs(share - mean), np.sqrt(2 / math.pi * np.maximum(spread, 0) / count)
    error, chance = (float((count / len(said) * each).sum()) if len(said) else math.nan for each in off)
    return Reliability(probability=mean, share=share, low=low, high=high, count=count, error=error, chance=chance)


def wilson(share: Floats, count: Rows) -> tuple[Floats, Floats]:
    """Return the ends of the 95 % interval of shares (B,) of `count` outcomes each (Wilson 1927)."""
    middle = (share + Z95**2 / (2 * count)) / (1 + Z95**2 / count)
    half = Z95 / (1 + Z95**2 / count) * np.sqrt(share * (1 - share) / count + Z95**2 / (4 * count**2))
    return np.maximum(middle - half, 0.0), np.minimum(middle + half, 1.0)
