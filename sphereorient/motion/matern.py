"""The prior of the smoother: a smooth random rate of change and its integral, in closed form between two instants.

The rate is u = m + w: an unknown constant m, and a stationary Gaussian process w of Matern's kernel with ORDER - 1
continuous derivatives. An integrated Wiener process doubles the error of acceleration on the shared experiment.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.special import betaln, gammainc

from sphereorient.motion.kalman import Floats

ORDER = 10  # poles; on turbulence-like motion 6 loses 20 % in acceleration, 3 loses 80 %, 11 gains 1 %
NODES = 8  # of Gauss's quadrature over a step; exact for what Taylor's series of a step can show


_M = np.diag(np.ones(ORDER - 1), 1)  # d(state)/dt of w, w', ... with all poles at -1
_M[-1] = [-math.comb(ORDER, k) for k in range(ORDER)]
# (M + 1) is nilpotent, so that exp(M tau) is exp(-tau) times a polynomial: no matrix exponential is needed
_POWERS = np.stack([np.linalg.matrix_power(_M + np.eye(ORDER), k) for k in range(ORDER)])


def _stationary() -> Floats:
    """Return the covariance of w of unit variance and its derivatives: moments of the spectrum (1 + x^2)^-ORDER."""
    order = np.arange(ORDER)
    half = (order[:, None] + order) / 2
    moment = np.exp(betaln(half + 0.5, ORDER - half - 0.5) - betaln(0.5, ORDER - 0.5))
    difference = order[:, None] - order
    return np.where(difference % 2 == 0, (-1.0) ** (difference // 2) * moment, 0.0)


STATIONARY = _stationary()  # (ORDER, ORDER), per pole
_DENSITY = 2 * np.pi / np.exp(betaln(0.5, ORDER - 0.5))  # of the white noise that sustains w of unit variance
_AT, _WEIGHT = leggauss(NODES)
_FACTORIAL = np.array([math.factorial(k) for k in range(ORDER)], dtype=np.float64)


def grown(tau: Floats) -> Floats:
    """Return exp(M tau), (..., ORDER, ORDER), the free evolution of the state over tau (...), time times pole."""
    terms = np.exp(-tau)[..., None] * tau[..., None] ** np.arange(ORDER) / _FACTORIAL
    return np.asarray(np.tensordot(terms, _POWERS, axes=1), dtype=np.float64)


def grown_rate(tau: Floats) -> Floats:
    """Return w after the time tau from the initial state, (..., ORDER): the first row of `grown`."""
    terms = np.exp(-tau)[..., None] * tau[..., None] ** np.arange(ORDER) / _FACTORIAL
    return np.asarray(terms @ _POWERS[:, 0, :], dtype=np.float64)


def integral(tau: Floats) -> Floats:
    """Return the integral of w over the time tau from the initial state, (..., ORDER), times pole."""
    terms = gammainc(np.arange(1, ORDER + 1), tau[..., None])
    return np.asarray(terms @ _POWERS[:, 0, :], dtype=np.float64)


def nodes(step: Floats) -> tuple[Floats, Floats]:
    """Return Gauss's instants within steps and their weights, (M, NODES) each, in the unit of `step` (M,)."""
    return 0.5 * step[:, None] * (1 + _AT), 0.5 * step[:, None] * _WEIGHT


@dataclass(frozen=True, kw_only=True)
class Prior:
    """Prior of a rate, estimated by `estimate_process`; in units of the value per frame."""

    pole: float  # per frame; the spectrum of w falls beyond it
    deviation: float  # standard deviation of w by axis, value per frame

    def step_noise(self, step: Floats) -> Floats:
        """Return the covariance of (integral of w, w, w' / pole, ...) that a step adds, (M, ORDER + 1, ORDER + 1)."""
        since, weight = nodes(step * self.pole)
        response = np.concatenate([integral(since)[..., -1:] / self.pole, grown(since)[..., :, -1]], axis=-1)
        strength = self.deviation**2 * _DENSITY
        return np.asarray(strength * (response * weight[..., None]).mT @ response, dtype=np.float64)


def prior_of_band(band: float, noise: float) -> Prior:
    """Return the prior whose spectrum equals white noise of sigma `noise` a frame at the band (cycles per frame)."""
    rate = 2 * np.pi * band
    pole = 0.75 * rate  # as estimated from turbulence-like motion: the fall begins a little before the band ends
    density = _DENSITY / pole * (1 + (rate / pole) ** 2) ** -ORDER  # of w of unit variance at the band
    return Prior(pole=pole, deviation=float(noise * rate / np.sqrt(density)))
