"""How much of a quantity is noise: by the track's own sigmas, and by increments over many lags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import TrackError, refusal
from sphereorient.statistics.bootstrap import Interval, bootstrap, scattered
from sphereorient.statistics.moments import WARN_SHARE, Moments
from sphereorient.statistics.settings import BootstrapSettings
from sphereorient.trajectory import Trajectory

Floats = NDArray[np.float64]

RATES = {"acceleration": ("position", 1e-3), "alpha_lab": ("orientation", 1.0)}  # source, and its unit in SI
LAGS = (1, 2, 3, 4, 5, 6)  # frames; on Table I's motion longer ones are past the fit's reach


@dataclass(frozen=True, kw_only=True)
class NoiseWarning:
    """A variance of which more than 10 % is noise; made by `noise_warnings`, printed by the report."""

    quantity: str
    component: str
    share: float
    words: str


def noise_warnings(table: dict[str, Moments], error: str) -> list[NoiseWarning]:
    """Return a record for each component of which too much is noise.

    Args:
        table: moments by quantity.
        error: the ensemble's, "added" or "removed".
    """
    what = {"added": "noise", "removed": "smoothed away"}[error]
    found = []
    for quantity, part in table.items():
        for i, component in enumerate("xyz"):
            share = float(part.noise_share.value[i])
            if share > WARN_SHARE:
                words = f"{quantity} {component}: {100 * share:.0f} % of the variance is {what}"
                found.append(NoiseWarning(quantity=quantity, component=component, share=share, words=words))
    return found


@dataclass(frozen=True, kw_only=True, eq=False)
class MultiLag:
    """Variance of a second or first derivative without noise; made by `multi_lag`. Three columns: x, y, z."""

    quantity: str
    lag_s: Floats  # (L,)
    naive: Floats  # (L, 3), variance of the difference quotient, noise and low-pass loss included
    variance: Interval  # (3,), at zero lag and without noise
    noise_variance: Interval  # (3,), of the measured position (m^2) or orientation (rad^2)

    @property
    def rms(self) -> Floats:
        """(3,), of the motion itself."""
        return np.sqrt(np.maximum(self.variance.value, 0.0))


def multi_lag(
    tracks: Trajectory | list[Trajectory],
    quantity: str,
    lags: tuple[int, ...] = LAGS,
    settings: BootstrapSettings | None = None,
) -> MultiLag:
    """Estimate the variance of acceleration or alpha from the raw measurements, without their noise.

    The second difference over n frames has the variance of the motion, (n dt)^4 <a^2> (1 - c n^2), plus 6 times the
    noise variance, which does not depend on n. A straight fit of the two and of the loss separates them: neither a
    filter nor the track's own sigmas enter. Noise must be white. For alpha the difference is that of two turns,
    R_{k+n} R_k^T and R_k R_{k-n}^T.

    Args:
        tracks: with `position` and `orientation` as measured.
        quantity: "acceleration" or "alpha_lab".
        lags: n, frames; at least four.
        settings: of the bootstrap over segments.

    Returns:
        Variances with intervals.

    Raises:
        TrackError: too few segments or lags to fit.

    Source: second-order statistics of increments over several time steps: Machicoane, Lopez-Caballero, Bourgoin,
    Aliseda and Volk 2017, Meas. Sci. Technol. 28, 107002.
    """
    many = [tracks] if isinstance(tracks, Trajectory) else list(tracks)
    step_s = float(np.median(np.concatenate([np.diff(t.time) for t in many])))
    sums = [np.concatenate([_second_differences(t, quantity, n, step_s) for t in many]) for n in lags]
    whole = np.stack(sums, axis=1)  # (S, L, 3, 2)
    whole = whole[(whole[..., 1] > 0).any((1, 2))]
    if len(whole) < 2 or len(lags) < 4:
        got = f"{len(whole)} segments and {len(lags)} lags"
        do = "pass more tracks"
        raise TrackError(refusal("multi_lag", expected="at least two segments and four lags", got=got, do=do))
    lag_s = step_s * np.array(lags)
    found = bootstrap(whole, lambda totals: _extrapolated(totals[..., 0] / totals[..., 1], lag_s), settings)
    total = whole.sum(0)
    return MultiLag(
        quantity=quantity,
        lag_s=lag_s,
        naive=total[..., 0] / total[..., 1] / lag_s[:, None] ** 4,
        variance=found.part(0),
        noise_variance=found.part(1),
    )


def _second_differences(track: Trajectory, quantity: str, n: int, step_s: float) -> Floats:
    """Return by segment (S, 3, 2) the sum of squared second differences over n frames, and their number."""
    source, unit = RATES[quantity]
    values = getattr(track, source)
    k = np.arange(n, len(track) - n)
    segments = int(track.segment.max(initial=-1)) + 1
    same = (track.segment[k - n] == track.segment[k + n]) & (track.segment[k] == track.segment[k - n])
    even = np.abs(track.time[k + n] + track.time[k - n] - 2 * track.time[k]) < 0.1 * step_s
    even &= np.abs(track.time[k + n] - track.time[k - n] - 2 * n * step_s) < 0.1 * step_s
    k = k[same & even & (track.segment[k] >= 0)]
    difference = _turn_difference(values, k, n) if source == "orientation" else _bend(values, k, n) * unit
    there = np.isfinite(difference).all(1)
    square, segment = np.square(difference[there]), track.segment[k[there]]
    order = np.argsort(segment, kind="stable")
    return scattered(np.stack([square, np.ones_like(square)], axis=-1)[order], segment[order], segments)


def _bend(x: Floats, k: NDArray[np.int64], n: int) -> Floats:
    return np.asarray(x[k + n] - 2 * x[k] + x[k - n])


def _turn_difference(R: Floats, k: NDArray[np.int64], n: int) -> Floats:
    """Return the later turn's vector less the earlier one's, lab."""
    from scipy.spatial.transform import Rotation

    there = np.isfinite(R[k + n] + R[k] + R[k - n]).all((1, 2))
    out = np.full((len(k), 3), np.nan)
    if there.any():
        before, now, after = (Rotation.from_matrix(R[k[there] + j]) for j in (-n, 0, n))
        out[there] = (after * now.inv()).as_rotvec() - (now * before.inv()).as_rotvec()
    return out


def _extrapolated(square: Floats, lag_s: Floats) -> Floats:
    """Return variance of the motion and of the noise, (..., 2, 3), of mean squares (..., L, 3).

    Least squares for square = 6 noise + variance lag^4 - loss lag^6 + more lag^8, relative to each lag's own size.
    """
    scale = lag_s / lag_s[-1]
    powers = np.stack([np.full_like(scale, 6.0), scale**4, scale**6, scale**8], axis=1)[:, : min(4, len(lag_s) - 1)]
    weight = 1 / square.mean(-1, keepdims=True)
    design = powers * weight[..., 0][..., None]
    normal = np.einsum("...lp,...lq->...pq", design, design)
    right = np.einsum("...lp,...li->...pi", design, square * weight)
    found = np.linalg.solve(normal, right)
    return np.stack([found[..., 1, :] / lag_s[-1] ** 4, found[..., 0, :]], axis=-2)
