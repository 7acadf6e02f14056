"""How long segments last."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import TrackError, refusal
from sphereorient.statistics.bootstrap import Interval

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Durations:
    """Histogram of segment durations; made by `durations`, drawn by the report."""

    edges_s: Floats  # (B + 1,)
    counts: NDArray[np.int64]  # (B,)
    truncated_s: float  # shorter ones do not count
    decay_time_s: Interval  # scalar; exponential law beyond the truncation
    expected: Floats  # (B,), counts by that law
    segments: int


def durations(span_s: Floats, truncated_s: float, *, bins: int = 20, level: float = 0.95) -> Durations:
    """Return the histogram of durations and their exponential decay by maximum likelihood.

    The exponential law has no memory: beyond the truncation the mean excess is its decay time, and twice the sum of
    the excesses over that time follows chi-squared with two degrees of freedom a segment, so the interval is exact.

    Args:
        span_s: (S,), durations, s.
        truncated_s: shorter ones were left out, or are left out here.
        bins: of the histogram.
        level: probability that the interval is to hold the true decay time.

    Returns:
        Histogram, decay time, and the law's own counts.

    Raises:
        TrackError: fewer than two segments are long enough.

    Source: textbook (Epstein and Sobel 1953); the paper, section IV.
    """
    from scipy.stats import chi2

    kept = span_s[span_s >= truncated_s * (1 - 1e-9)]
    if len(kept) < 2:
        do = "pass more tracks, or lower statistics.min_frames"
        expected = f"at least two segments of {truncated_s:.3g} s"
        raise TrackError(refusal("durations", expected=expected, got=str(len(kept)), do=do))
    excess = float((kept - truncated_s).sum())
    degrees = 2 * len(kept)
    tail = (1 - level) / 2
    mean = excess / len(kept)
    low, high = (2 * excess / float(chi2.ppf(share, degrees)) for share in (1 - tail, tail))
    edges = np.linspace(truncated_s, float(kept.max()) * (1 + 1e-9) + 1e-12, bins + 1)
    counts, _ = np.histogram(kept, edges)
    survived = np.exp(-(edges - truncated_s) / max(mean, 1e-300))
    return Durations(
        edges_s=edges,
        counts=counts,
        truncated_s=truncated_s,
        decay_time_s=Interval(
            value=np.array(mean), low=np.array(low), high=np.array(high), error=np.array(mean / np.sqrt(len(kept)))
        ),
        expected=len(kept) * -np.diff(survived),
        segments=len(kept),
    )
