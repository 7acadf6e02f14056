"""The effect of the smoothing kernel's width on rms and flatness of v, a and alpha."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.statistics.bootstrap import Interval, scattered
from sphereorient.statistics.moments import without_noise
from sphereorient.statistics.settings import BootstrapSettings
from sphereorient.statistics.studentized import studentized
from sphereorient.trajectory import Trajectory

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

WIDTHS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)  # sigma of the Gaussian, frames
SI = 1e-3  # m per mm
CENTRAL = np.array([0.5, 0.0, -0.5])  # omega by the turn from frame k - 1 to k + 1, as np.convolve takes it


@dataclass(frozen=True, kw_only=True, eq=False)
class WidthCurve:
    """Rms and flatness by kernel width; made by `width_curve`, drawn by the report. Columns: x, y, z."""

    quantity: str
    width_s: Floats  # (W,), sigma of the Gaussian
    rms: Interval  # (W, 3)
    flatness: Interval  # (W, 3)
    corrected_rms: Interval  # (W, 3), without the noise that the measurements' sigmas foretell
    corrected_flatness: Interval  # (W, 3)
    noise_share: Interval  # (W, 3), of the variance


def width_curve(
    tracks: Trajectory | Sequence[Trajectory],
    quantity: str,
    widths_frames: Sequence[float] = WIDTHS,
    settings: BootstrapSettings | None = None,
) -> WidthCurve:
    """Differentiate the measured positions or orientations with kernels of many widths.

    Narrow kernels let noise through, wide ones lose the motion; between them lies a plateau, or there is none and the
    rms is not known well. All widths use the frames that the widest one reaches too. Noise is taken to be white, times
    even within a segment. Alpha is the derivative of omega from the turns over two frames.

    Args:
        tracks: with positions, orientations and their covariances.
        quantity: velocity, acceleration or alpha_lab.
        widths_frames: sigma of the Gaussian, frames.
        settings: of the bootstrap over segments.

    Returns:
        The curve; NaN where no segment is as long as the widest kernel.

    Source: Voth, La Porta, Crawford, Alexander and Bodenschatz 2002, J. Fluid Mech. 469, 121; the paper, section III.
    """
    many = [tracks] if isinstance(tracks, Trajectory) else list(tracks)
    sums = np.concatenate([_by_width(track, quantity, widths_frames) for track in many])
    if not len(sums):
        sums = np.zeros((1, len(widths_frames), 3, 6))  # 0 / 0: nothing is known
    found = studentized(sums.reshape(len(sums), -1, 6), _statistics, np.ones(5, bool), settings)
    names = ("rms", "flatness", "corrected_rms", "corrected_flatness", "noise_share")
    return WidthCurve(
        quantity=quantity,
        width_s=np.array(widths_frames) * _step(many[0]),
        **{name: _by_component(found.part((slice(None), k))) for k, name in enumerate(names)},
    )


def _by_component(found: Interval) -> Interval:
    """Return values (3 W,) as (W, 3)."""
    value, low, high, error = (x.reshape(-1, 3) for x in (found.value, found.low, found.high, found.error))
    return Interval(value=value, low=low, high=high, error=error)


def _step(track: Trajectory) -> float:
    """Return the time between frames, s."""
    return float(np.median(np.diff(track.time)))


def _by_width(track: Trajectory, quantity: str, widths: Sequence[float]) -> Floats:
    """Return what each segment contributes, (S, W, 3, 6): number, x^2, x^4, sigma^2, sigma^4, x^2 sigma^2."""
    rows, place, number = _grid(track)
    turning = quantity == "alpha_lab"
    cov = (track.orientation_cov if turning else track.position_cov * SI**2)[rows]
    noise = np.full((len(number), 3), np.nan)
    noise[place] = np.diagonal(cov, axis1=1, axis2=2)
    values = np.full((len(number), 3), np.nan)
    values[place] = track.position[rows] * SI if not turning else 0.0
    if turning:
        values = _turns(track.orientation[rows], place, len(number))
    order = 2 if quantity == "acceleration" else 1
    power = 2 if quantity != "velocity" else 1
    scale = _step(track) ** -power
    parts = []
    for width in widths:
        kernel = _kernel(width, order)
        x2 = np.square(_convolved(values, kernel) * scale)
        s2 = _convolved(noise, np.square(np.convolve(kernel, CENTRAL) if turning else kernel)) * scale**2
        parts.append(np.stack([np.ones_like(x2), x2, x2 * x2, s2, s2 * s2, x2 * s2], axis=-1))
    whole = np.stack(parts, axis=1)
    there = np.isfinite(whole).all((1, 2, 3)) & (number >= 0)
    sums = scattered(whole[there], number[there], int(number.max(initial=-1)) + 1)
    return sums[sums[:, 0, 0, 0] > 0]


def _grid(track: Trajectory) -> tuple[Rows, Rows, Rows]:
    """Return the rows of segments, their places on an even grid, and every place's segment, -1 where it is empty.

    Between segments at least one place is empty, over which no kernel gives anything.
    """
    rows = np.flatnonzero(track.segment >= 0)
    rows = rows[np.lexsort((track.time[rows], track.segment[rows]))]
    _, segment = np.unique(track.segment[rows], return_inverse=True)
    begin = np.searchsorted(segment, np.arange(segment.max(initial=-1) + 1))
    frame = np.rint((track.time[rows] - track.time[rows][begin][segment]) / _step(track)).astype(np.int64)
    lengths = np.maximum.reduceat(frame, begin) + 2 if len(rows) else frame
    place = frame + np.concatenate([[0], np.cumsum(lengths)])[:-1][segment]
    number = np.full(int(lengths.sum()), -1, dtype=np.int64)
    number[place] = segment
    return rows, place, number


def _turns(R: Floats, place: Rows, size: int) -> Floats:
    """Return omega_lab per frame on the grid, (size, 3), from the turns over two frames; NaN where there is none."""
    from scipy.spatial.transform import Rotation

    row = np.full(size + 2, -1, dtype=np.int64)
    known = np.isfinite(R).all((1, 2))
    row[place[known] + 1] = np.flatnonzero(known)
    before, after = row[:-2], row[2:]
    there = (before >= 0) & (after >= 0)
    out = np.full((size, 3), np.nan)
    if there.any():
        turn = Rotation.from_matrix(R[after[there]]) * Rotation.from_matrix(R[before[there]]).inv()
        out[there] = turn.as_rotvec() / 2
    return out


def _kernel(width: float, order: int) -> Floats:
    """Return the weights of the project's Gaussian derivative, per frame^order, as np.convolve takes them."""
    import torch

    from sphereorient.motion import gaussian_derivative

    half = max(1, int(np.ceil(3.0 * width)))
    impulse = torch.zeros(4 * half + 1, 1, dtype=torch.float64)
    impulse[2 * half] = 1.0
    answer = gaussian_derivative(impulse, 1.0, width, 2 if order == 2 else 1)[:, 0].numpy()
    return np.asarray(answer[half : 3 * half + 1], np.float64)


def _convolved(x: Floats, kernel: Floats) -> Floats:
    """Return each column's convolution, NaN where the kernel reaches something empty, (K, 3)."""
    if len(x) < len(kernel):
        return np.full_like(x, np.nan)
    half = len(kernel) // 2
    out = np.full_like(x, np.nan)
    for i in range(x.shape[1]):
        out[half : len(x) - half, i] = np.convolve(x[:, i], kernel, mode="valid")
    return out


def _statistics(totals: Floats) -> Floats:
    """Return rms, flatness, both corrected, and the share of noise, (..., 3 W, 5), of sums (..., 3 W, 6)."""
    var, fourth, s2, s4, mixed = np.moveaxis(totals[..., 1:] / totals[..., :1], -1, 0)
    true_var, true_fourth = without_noise(var, fourth, s2, s4, mixed, 1.0)
    return np.stack([np.sqrt(var), fourth / var**2, np.sqrt(true_var), true_fourth / true_var**2, s2 / var], axis=-1)
