"""Table I: mean, rms, skewness and flatness of every quantity, with intervals and corrected for noise."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sphereorient.statistics.bootstrap import Floats, Interval, segment_sums, studentized
from sphereorient.statistics.segments import UNITS, Ensemble
from sphereorient.statistics.settings import BootstrapSettings
from sphereorient.trajectory.datasets import in_length

COMPONENTS = ("x", "y", "z", "norm")
STATISTICS = ("mean", "rms", "skewness", "flatness", "corrected_rms", "corrected_flatness", "noise_share")
POSITIVE = np.array([False, True, False, True, True, True, True])
LET_THROUGH = 0.65  # share of noise in the variance of a smoother's error, by scripts/ensemble_coverage.py
WARN_SHARE = 0.1  # share of noise in a variance that causes a warning


@dataclass(frozen=True, kw_only=True, eq=False)
class Moments:
    """Moments of one quantity. Four columns: x, y, z, norm."""

    quantity: str
    units: str
    mean: Interval  # (4,) each
    rms: Interval  # about the mean
    skewness: Interval
    flatness: Interval
    corrected_rms: Interval  # of the motion alone, by the track's sigmas; NaN for the norm
    corrected_flatness: Interval
    noise_share: Interval  # of the variance: noise, or motion removed by the smoother
    samples: int
    segments: int

    @property
    def noisy(self) -> bool:
        """Whether more than 10 % of a component's variance is noise."""
        return bool(np.any(self.noise_share.value[:3] > WARN_SHARE))


def table_of_moments(ensemble: Ensemble, settings: BootstrapSettings | None = None) -> Mapping[str, Moments]:
    """Return the moments of v, a, omega and alpha in lab and body, by name; the paper's Table I."""
    return {quantity: moments(ensemble, quantity, settings) for quantity in ensemble.values}


def moments(ensemble: Ensemble, quantity: str, settings: BootstrapSettings | None = None) -> Moments:
    """Return moments of a quantity (a name in UNITS) and its norm. Source: the paper, Table I; docs/errata.md E6."""
    x = ensemble.values[quantity]
    x = np.concatenate([x, np.linalg.norm(x, axis=1, keepdims=True)], axis=1)
    sigma = np.concatenate([ensemble.sigmas[quantity], np.full((len(x), 1), np.nan)], axis=1)
    sign = 1.0 if ensemble.error == "added" else -1.0
    centre, deviation, largest = (x.mean(0), x.std(0), np.abs(x).max(0)) if len(x) else np.full((3, 4), np.nan)
    scale = np.where(deviation > 1e-12 * largest, deviation, 1.0)  # 1 for values equal to rounding
    x, sigma = (x - centre) / scale, sigma / scale
    x2, s2 = x * x, sigma * sigma
    powers = np.stack([np.ones_like(x), x, x2, x2 * x, x2 * x2, s2, s2 * s2, x2 * s2], axis=-1)
    sums = segment_sums(powers, ensemble.segment, ensemble.segments)  # (S, 4, 8)
    found = studentized(sums, lambda totals: _statistics(totals, sign), POSITIVE, settings)
    parts = {}
    for k, name in enumerate(STATISTICS):  # back to the quantity's own units
        factor = scale if name in ("mean", "rms", "corrected_rms") else 1.0
        parts[name] = found.part((slice(None), k)).scaled(factor, centre if name == "mean" else 0.0)
    units = in_length(UNITS[quantity], ensemble.length_unit)
    return Moments(quantity=quantity, units=units, **parts, samples=len(ensemble), segments=ensemble.segments)


def _statistics(totals: Floats, sign: float) -> Floats:
    """Return STATISTICS (..., 4, 7) of total sums (..., 4, 8) of normalised values."""
    mean, m2, m3, m4, s2, s4, x2s2 = np.moveaxis(totals[..., 1:] / totals[..., :1], -1, 0)
    var = m2 - mean**2
    third = m3 - 3 * mean * m2 + 2 * mean**3
    fourth = m4 - 4 * mean * m3 + 6 * mean**2 * m2 - 3 * mean**4
    mixed = x2s2 - mean**2 * s2  # the mean is small, as it was subtracted before
    true_var, true_fourth = without_noise(var, fourth, s2, s4, mixed, sign)
    share = s2 / np.where(sign > 0, var, true_var)
    return np.stack(
        [mean, np.sqrt(var), third / var**1.5, fourth / var**2, np.sqrt(true_var), true_fourth / true_var**2, share],
        axis=-1,
    )


def without_noise(
    var: Floats, fourth: Floats, s2: Floats, s4: Floats, mixed: Floats, sign: float
) -> tuple[Floats, Floats]:
    """Return variance and fourth moment (...) of the motion from the measured ones.
    `s2`, `s4` and `mixed` (...) are the means of sigma^2, sigma^4 and (x - mean)^2 sigma^2. Sign 1 subtracts
    independent normal noise; -1 adds motion removed by a smoother, assumed as intermittent as the rest.
    """
    part = 1.0 if sign > 0 else LET_THROUGH
    clean_var = var - part * s2
    # <x'^2 s^2> = <x^2 s^2> - <s^4>
    clean_fourth = fourth - 6 * (part * mixed - part**2 * s4) - 3 * part**2 * s4
    if sign > 0:
        return clean_var, clean_fourth
    return var + s2, clean_fourth * ((var + s2) / clean_var) ** 2


def noise_let_through(ensemble: Ensemble, quantity: str, component: int) -> float:
    """Return the share of noise in a component's measured variance, 0 .. 0.9; 0 if the errors are unknown."""
    var = float(ensemble.values[quantity][:, component].var())
    noise = float(np.square(ensemble.sigmas[quantity][:, component]).mean())
    if not (np.isfinite(noise) and var > 0):
        return 0.0
    return min((1.0 if ensemble.error == "added" else LET_THROUGH) * noise / var, 0.9)
