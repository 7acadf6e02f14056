"""Share of noise in a quantity: by the track's sigmas, by increments over many lags, by the kernel's width."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sphereorient.errors import TrackError, refusal
from sphereorient.motion import gaussian_kernel, rotvec_between
from sphereorient.statistics.bootstrap import Floats, Interval, Rows, bootstrap, segment_sums, studentized
from sphereorient.statistics.lags import places
from sphereorient.statistics.moments import WARN_SHARE, Moments, without_noise
from sphereorient.statistics.settings import BootstrapSettings
from sphereorient.trajectory import Trajectory

RATES = {"acceleration": "position", "alpha_lab": "orientation"}  # source
LAGS = (1, 2, 3, 4, 5, 6)  # frames; on Table I's motion the fit does not hold for longer ones
WIDTHS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)  # sigma of the Gaussian, frames
CENTRAL = np.array([0.5, 0.0, -0.5])  # omega from the rotation of frame k - 1 to k + 1, for np.convolve


def noise_warnings(table: dict[str, Moments], error: str) -> list[str]:
    """Return a sentence for each component with over 10 % of noise; `error` is the ensemble's, "added" or "removed"."""
    what = {"added": "noise", "removed": "smoothed away"}[error]
    return [
        f"{quantity} {component}: {100 * share:.0f} % of the variance is {what}"
        for quantity, part in table.items()
        for component, share in zip("xyz", part.noise_share.value[:3].tolist(), strict=True)
        if share > WARN_SHARE
    ]


@dataclass(frozen=True, kw_only=True, eq=False)
class MultiLag:
    """Variance of a second or first derivative without noise. Three columns: x, y, z."""

    quantity: str
    lag_s: Floats  # (L,)
    naive: Floats  # (L, 3), variance of the difference quotient, with noise and low-pass loss
    variance: Interval  # (3,), at lag zero without noise
    noise_variance: Interval  # (3,), of the measured position (m^2) or orientation (rad^2)

    @property
    def rms(self) -> Floats:
        """Rms of the motion alone, (3,)."""
        return np.sqrt(np.maximum(self.variance.value, 0.0))


def multi_lag(tracks: Sequence[Trajectory], quantity: str, settings: BootstrapSettings | None = None) -> MultiLag:
    """Estimate the variance of "acceleration" or "alpha_lab" from the raw measurements, without their white noise.
    The second difference over n frames has variance (n dt)^4 <a^2> (1 - c n^2) + 6 times the noise variance; a linear
    fit over some lags n separates them. For alpha it is the difference of R_{k+n} R_k^T and R_k R_{k-n}^T. Raises
    TrackError (too few segments for the fit, or tracks of several frame rates).
    Source: Machicoane, Lopez-Caballero, Bourgoin, Aliseda and Volk 2017, Meas. Sci. Technol. 28, 107002.
    """
    step_s = float(np.median(np.concatenate([np.diff(t.time) for t in tracks])))
    others = [_step(t) for t in tracks if len(t) > 1 and abs(_step(t) / step_s - 1) > 0.1]
    if others:
        expected, got = "tracks of one frame rate", f"steps of {step_s:.3g} and {others[0]:.3g} s"
        raise TrackError(refusal("multi_lag", expected=expected, got=got, do="pass those of one rate"))
    sums = [np.concatenate([_second_differences(t, quantity, n, step_s) for t in tracks]) for n in LAGS]
    whole = np.stack(sums, axis=1)  # (S, L, 3, 2)
    whole = whole[(whole[..., 1] > 0).any((1, 2))]
    if len(whole) < 2:
        got, do = f"{len(whole)}", "pass more tracks"
        raise TrackError(refusal("multi_lag", expected="at least two segments", got=got, do=do))
    lag_s = step_s * np.array(LAGS)
    found = bootstrap(whole, lambda totals: _extrapolated(totals[..., 0] / totals[..., 1], lag_s), settings)
    total = whole.sum(0)
    naive = total[..., 0] / total[..., 1] / lag_s[:, None] ** 4
    return MultiLag(quantity=quantity, lag_s=lag_s, naive=naive, variance=found.part(0), noise_variance=found.part(1))


def _second_differences(track: Trajectory, quantity: str, n: int, step_s: float) -> Floats:
    """Return by segment (S, 3, 2) the sum of squared second differences over n frames, and their number."""
    source = RATES[quantity]
    values = getattr(track, source)
    k = np.arange(n, len(track) - n)
    segments = int(track.segment.max(initial=-1)) + 1
    same = (track.segment[k - n] == track.segment[k + n]) & (track.segment[k] == track.segment[k - n])
    even = np.abs(track.time[k + n] + track.time[k - n] - 2 * track.time[k]) < 0.1 * step_s
    even &= np.abs(track.time[k + n] - track.time[k - n] - 2 * n * step_s) < 0.1 * step_s
    k = k[same & even & (track.segment[k] >= 0)]
    if source == "orientation":
        difference = _rotation(values, k, k + n) - _rotation(values, k - n, k)
    else:
        difference = np.asarray(values[k + n] - 2 * values[k] + values[k - n]) * track.rate_scale
    there = np.isfinite(difference).all(1)
    square, segment = np.square(difference[there]), track.segment[k[there]]
    order = np.argsort(segment, kind="stable")
    return segment_sums(np.stack([square, np.ones_like(square)], axis=-1)[order], segment[order], segments)


def _rotation(R: Floats, first: Rows, second: Rows) -> Floats:
    """Return the rotation vectors from rows `first` to `second`, lab, (K, 3); NaN where either is NaN."""
    there = np.isfinite(R[first] + R[second]).all((1, 2))
    out = np.full((len(first), 3), np.nan)
    out[there] = rotvec_between(R[first[there]], R[second[there]])
    return out


def _extrapolated(square: Floats, lag_s: Floats) -> Floats:
    """Fit square (..., L, 3) = 6 noise + variance lag^4 - loss lag^6 + more lag^8; return variance and noise."""
    scale = lag_s / lag_s[-1]
    powers = np.stack([np.full_like(scale, 6.0), scale**4, scale**6, scale**8], axis=1)
    weight = 1 / square.mean(-1, keepdims=True)
    design = powers * weight[..., 0][..., None]
    normal = np.einsum("...lp,...lq->...pq", design, design)
    right = np.einsum("...lp,...li->...pi", design, square * weight)
    found = np.linalg.solve(normal, right)
    return np.stack([found[..., 1, :] / lag_s[-1] ** 4, found[..., 0, :]], axis=-2)


@dataclass(frozen=True, kw_only=True, eq=False)
class WidthCurve:
    """Rms and flatness by kernel width. Columns: x, y, z."""

    quantity: str
    width_s: Floats  # (W,), sigma of the Gaussian
    rms: Interval  # (W, 3)
    flatness: Interval  # (W, 3)
    corrected_rms: Interval  # (W, 3), without the noise expected from the measurements' sigmas
    corrected_flatness: Interval  # (W, 3)
    noise_share: Interval  # (W, 3), of the variance
    length_unit: str = "mm"


def width_curve(
    tracks: Sequence[Trajectory],
    quantity: str,
    widths_frames: Sequence[float] = WIDTHS,
    settings: BootstrapSettings | None = None,
) -> WidthCurve:
    """Differentiate the measurements to velocity, acceleration or alpha_lab with Gaussian kernels (sigma, frames; of
    tracks of several rates: frames of the slowest).
    Narrow kernels pass noise, wide ones remove motion; a plateau between them is the rms. All widths use the frames
    possible for the widest one; NaN if all segments are shorter. White noise and regular times are assumed.
    Source: Voth, La Porta, Crawford, Alexander and Bodenschatz 2002, J. Fluid Mech. 469, 121; the paper, section III.
    """
    step_s = max((_step(track) for track in tracks if len(track) > 1), default=math.nan)
    sums = np.concatenate([_by_width(track, quantity, np.array(widths_frames) * step_s) for track in tracks])
    if not len(sums):
        sums = np.zeros((1, len(widths_frames), 3, 6))  # 0 / 0 is NaN
    found = studentized(sums.reshape(len(sums), -1, 6), _width_statistics, np.ones(5, bool), settings)
    names = ("rms", "flatness", "corrected_rms", "corrected_flatness", "noise_share")
    rows = np.arange(3 * len(widths_frames)).reshape(-1, 3)
    return WidthCurve(
        quantity=quantity,
        width_s=np.array(widths_frames) * step_s,
        length_unit=tracks[0].length_unit,
        **{name: found.part((rows, k)) for k, name in enumerate(names)},
    )


def _step(track: Trajectory) -> float:
    return float(np.median(np.diff(track.time)))


def _by_width(track: Trajectory, quantity: str, widths_s: Floats) -> Floats:
    """Return by segment (S, W, 3, 6): number, x^2, x^4, sigma^2, sigma^4, x^2 sigma^2."""
    if len(track) < 2 or not (track.segment >= 0).any():
        return np.zeros((0, len(widths_s), 3, 6))
    rows, place, number = _grid(track)
    rotating = quantity == "alpha_lab"
    cov = (track.orientation_cov if rotating else track.position_cov * track.rate_scale**2)[rows]
    noise, values = np.full((2, len(number), 3), np.nan)
    noise[place] = np.diagonal(cov, axis1=1, axis2=2)
    if rotating:
        row = np.full(len(number) + 2, -1, dtype=np.int64)
        row[place + 1] = np.arange(len(rows))
        there = np.flatnonzero((row[:-2] >= 0) & (row[2:] >= 0))
        values[there] = _rotation(track.orientation[rows], row[there], row[there + 2]) / 2  # omega
    else:
        values[place] = track.position[rows] * track.rate_scale
    order: Literal[1, 2] = 2 if quantity == "acceleration" else 1
    scale = _step(track) ** -(2 if quantity != "velocity" else 1)
    parts = []
    for width in (widths_s / _step(track)).tolist():
        kernel = gaussian_kernel(width, order).numpy()[::-1]  # reversed for `np.convolve`
        x2 = np.square(_convolved(values, kernel) * scale)
        s2 = _convolved(noise, np.square(np.convolve(kernel, CENTRAL) if rotating else kernel)) * scale**2
        parts.append(np.stack([np.ones_like(x2), x2, x2 * x2, s2, s2 * s2, x2 * s2], axis=-1))
    whole = np.stack(parts, axis=1)
    known = np.isfinite(whole).all((1, 2, 3)) & (number >= 0)
    sums = segment_sums(whole[known], number[known], int(number.max()) + 1)
    return sums[sums[:, 0, 0, 0] > 0]


def _grid(track: Trajectory) -> tuple[Rows, Rows, Rows]:
    """Return rows, their places on a regular grid, and the segment of each place; -1: empty, between segments."""
    rows = np.flatnonzero(track.segment >= 0)
    rows = rows[np.lexsort((track.time[rows], track.segment[rows]))]
    _, segment = np.unique(track.segment[rows], return_inverse=True)
    begin = np.searchsorted(segment, np.arange(segment.max() + 1))
    frame = np.rint((track.time[rows] - track.time[rows][begin][segment]) / _step(track)).astype(np.int64)
    place = places(frame, segment)
    number = np.full(int(place[-1]) + 2, -1, dtype=np.int64)
    number[place] = segment
    return rows, place, number


def _convolved(x: Floats, kernel: Floats) -> Floats:
    """Return each column's convolution, (K, 3); NaN where the kernel reaches an empty place."""
    wider = np.pad(x, ((len(kernel) // 2,) * 2, (0, 0)), constant_values=np.nan)
    return np.stack([np.convolve(column, kernel, mode="valid") for column in wider.T], axis=1)


def _width_statistics(totals: Floats) -> Floats:
    """Return rms, flatness, both corrected, and the share of noise, (..., 3 W, 5), of sums (..., 3 W, 6)."""
    var, fourth, s2, s4, mixed = np.moveaxis(totals[..., 1:] / totals[..., :1], -1, 0)
    true_var, true_fourth = without_noise(var, fourth, s2, s4, mixed, 1.0)
    true_flatness = np.where(s2 < var / 2, true_fourth / true_var**2, np.nan)  # else its errors are too large
    return np.stack([np.sqrt(var), fourth / var**2, np.sqrt(true_var), true_flatness, s2 / var], axis=-1)
