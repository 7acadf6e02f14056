"""A smooth stationary random rate whose rms and flatness, and those of its derivative, are known in closed form.

rate = rms (sqrt(1 - b) g1 + sqrt(b / <A^2>) A g2): two independent Gaussian processes, the second switched on and off
by A = cos^BURST of a phase that turns evenly from a random start. Given the phase everything is Gaussian, so that all
moments are means over the phase. Bounded bursts and not a log-normal factor: the flatness of 300 segments would else
hang on the largest event in them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

Floats = NDArray[np.float64]

BURST = 6  # power of the cosine; 4 would not reach a flatness of 7.6 in the derivative
TURN = 0.25  # rate of the phase over that of g2: a burst holds a few swings
WAVES = 24  # sines of each Gaussian process
GAUSSIAN = 3.0  # its flatness
_PHASE = np.linspace(0.0, 2 * np.pi, 256, endpoint=False)  # means over it are exact for these polynomials


@dataclass(frozen=True, kw_only=True)
class Law:
    """Statistics of one component; made by `Law.of`, read by the samplers and the tests."""

    rms: float
    derivative_rms: float
    flatness: float
    derivative_flatness: float
    share: float  # b, of the bursts in the variance
    slow: float  # rms rate of g1, rad/s
    fast: float  # rms rate of g2, rad/s

    @classmethod
    def of(cls, rms: float, derivative_rms: float, flatness: float = 3.0, derivative_flatness: float = 3.0) -> Self:
        """Find the process with these statistics.

        Args:
            rms: of the rate, any unit.
            derivative_rms: the same unit / s.
            flatness: of the rate, 3 or more.
            derivative_flatness: of its derivative; 3 where the flatness is 3, else up to about 9.
        """
        modulation, burst, slope, flat = _burst()
        share = math.sqrt(max(flatness - GAUSSIAN, 0.0) / (modulation - GAUSSIAN))
        steep = math.sqrt(max(derivative_flatness - GAUSSIAN, 0.0) / (flat - GAUSSIAN))
        whole = (derivative_rms / rms) ** 2
        slow = math.sqrt((1 - steep) * whole / (1 - share))
        growth = 1 + TURN**2 * slope / burst  # of the burst's derivative by its own rise and fall
        fast = math.sqrt(steep * whole / (max(share, 1e-12) * growth))
        return cls(
            rms=rms,
            derivative_rms=derivative_rms,
            flatness=flatness,
            derivative_flatness=derivative_flatness,
            share=share,
            slow=slow,
            fast=fast,
        )

    def correlation(self, lag_s: Floats) -> Floats:
        """Return the autocorrelation of the rate at lags (...), s."""
        values = np.cos(_PHASE) ** BURST
        turned = np.cos(_PHASE + self.fast * TURN * np.asarray(lag_s)[..., None]) ** BURST
        burst = (values * turned).mean(-1) / (values**2).mean()
        slow, fast = (
            np.cos(rate * _spectrum() * np.asarray(lag_s)[..., None]).mean(-1) for rate in (self.slow, self.fast)
        )
        return np.asarray((1 - self.share) * slow + self.share * burst * fast)

    def draw(self, segments: int, rng: np.random.Generator) -> Draw:
        """Draw independent realisations, one a segment."""
        coefficients = rng.standard_normal((segments, 2, 2, WAVES)) / math.sqrt(WAVES)
        return Draw(law=self, coefficients=coefficients, phase=rng.uniform(0.0, 2 * np.pi, segments))


@dataclass(frozen=True, kw_only=True, eq=False)
class Draw:
    """Realisations of a `Law` in S segments."""

    law: Law
    coefficients: Floats  # (S, 2 processes, cosine and sine, WAVES)
    phase: Floats  # (S,), of the bursts at time 0

    def at(self, time_s: Floats, segment: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """Return the rate and its derivative, (M,) each, at times (M,) since the start of their segments."""
        law = self.law
        g1, g1_slope = self._gaussian(0, law.slow, time_s, segment)
        g2, g2_slope = self._gaussian(1, law.fast, time_s, segment)
        turn = law.fast * TURN
        angle = self.phase[segment] + turn * time_s
        burst = np.cos(angle) ** BURST
        rise = -BURST * turn * np.cos(angle) ** (BURST - 1) * np.sin(angle)
        calm, strong = law.rms * math.sqrt(1 - law.share), law.rms * math.sqrt(law.share / _burst()[1])
        return calm * g1 + strong * burst * g2, calm * g1_slope + strong * (rise * g2 + burst * g2_slope)

    def integral(self, time_s: Floats, segment: NDArray[np.int64]) -> Floats:
        """Return the integral of the calm part from each segment's start, (M,); for laws without bursts."""
        rate = self.law.slow * _spectrum()
        cosine, sine = self.coefficients[segment, 0, 0], self.coefficients[segment, 0, 1]
        angle = rate * time_s[:, None]
        whole = (cosine * np.sin(angle) + sine * (1 - np.cos(angle))) / rate
        return np.asarray(self.law.rms * math.sqrt(1 - self.law.share) * whole.sum(1))

    def _gaussian(self, which: int, rate: float, time_s: Floats, segment: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """Return a Gaussian process of unit variance and its derivative."""
        rates = rate * _spectrum()
        angle = rates * time_s[:, None]
        cosine, sine = self.coefficients[segment, which, 0], self.coefficients[segment, which, 1]
        c, s = np.cos(angle), np.sin(angle)
        return (cosine * c + sine * s).sum(1), ((sine * c - cosine * s) * rates).sum(1)


def _spectrum() -> Floats:
    """Return the rates of the sines, mean square 1, by the quantiles of a half normal law: C(t) near exp(-t^2/2)."""
    rates = ndtri(0.5 + (np.arange(WAVES) + 0.5) / (2 * WAVES))
    return np.asarray(rates / np.sqrt((rates**2).mean()))


def _burst() -> tuple[float, float, float, float]:
    """Return flatness of A g2, <A^2>, <A'^2> (per phase) and the flatness of the derivative of A g2."""
    A, A_slope = np.cos(_PHASE) ** BURST, -BURST * np.cos(_PHASE) ** (BURST - 1) * np.sin(_PHASE)
    var, slope_var = A**2, TURN**2 * A_slope**2 + A**2
    flat, slope_flat = (GAUSSIAN * (v**2).mean() / v.mean() ** 2 for v in (var, slope_var))
    return float(flat), float(var.mean()), float((A_slope**2).mean()), float(slope_flat)
