"""A smooth stationary random rate whose rms and flatness, and those of its derivative, are known in closed form.

rate = rms (sqrt(1 - b) g1 + sqrt(b / <A^2>) A g2): two independent Gaussian processes, the second swollen and calmed
by A, whose logarithm is a sum of DEPTH cos(phase) over phases that turn evenly from random starts. Given the phases
everything is Gaussian, so that all moments are means over them. Nearly the log-normal factor of turbulence, and so
nearly the stretched exponential, but bounded: the flatness of 300 segments would else hang on the largest event in
them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import i0e, ndtri

Floats = NDArray[np.float64]

TURNS = (0.25, 0.4)  # rates of the phases over that of g2: a burst holds a few swings
DEPTH = 0.66  # of each phase's part in ln A; 0.63 would not reach a flatness of 7.6 in the derivative
WAVES = 24  # sines of each Gaussian process
GAUSSIAN = 3.0  # its flatness
NODES = 64  # of each phase: means over so many are exact to rounding for these smooth periodic functions


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
        modulation, growth, flat = _burst()
        share = math.sqrt(max(flatness - GAUSSIAN, 0.0) / (modulation - GAUSSIAN))
        steep = math.sqrt(max(derivative_flatness - GAUSSIAN, 0.0) / (flat - GAUSSIAN))
        whole = (derivative_rms / rms) ** 2
        slow = math.sqrt((1 - steep) * whole / (1 - share))
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
        # <exp(c cos p) exp(c cos(p + d))> = I0(2 c cos(d / 2)); i0e(x) = exp(-|x|) I0(x)
        angle = np.abs(np.cos(self.fast * np.array(TURNS) * np.asarray(lag_s)[..., None] / 2))
        log_burst = np.log(i0e(2 * DEPTH * angle) / i0e(2 * DEPTH)) - 2 * DEPTH * (1 - angle)
        burst = np.exp(log_burst.sum(-1))
        slow, fast = (
            np.cos(rate * _spectrum() * np.asarray(lag_s)[..., None]).mean(-1) for rate in (self.slow, self.fast)
        )
        return np.asarray((1 - self.share) * slow + self.share * burst * fast)

    def draw(self, segments: int, rng: np.random.Generator) -> Draw:
        """Draw independent realisations, one a segment."""
        coefficients = rng.standard_normal((segments, 2, 2, WAVES)) / math.sqrt(WAVES)
        return Draw(law=self, coefficients=coefficients, phase=rng.uniform(0.0, 2 * np.pi, (segments, len(TURNS))))


@dataclass(frozen=True, kw_only=True, eq=False)
class Draw:
    """Realisations of a `Law` in S segments."""

    law: Law
    coefficients: Floats  # (S, 2 processes, cosine and sine, WAVES)
    phase: Floats  # (S, 2), of the bursts at time 0

    def at(self, time_s: Floats, segment: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """Return the rate and its derivative, (M,) each, at times (M,) since the start of their segments."""
        law = self.law
        g1, g1_slope = self._gaussian(0, law.slow, time_s, segment)
        g2, g2_slope = self._gaussian(1, law.fast, time_s, segment)
        turn = law.fast * np.array(TURNS)
        angle = self.phase[segment] + turn * time_s[:, None]
        burst = np.exp(DEPTH * np.cos(angle).sum(1))
        rise = -DEPTH * burst * (np.sin(angle) @ turn)
        calm = law.rms * math.sqrt(1 - law.share)
        strong = law.rms * math.sqrt(law.share) / float(i0e(2 * DEPTH) * math.exp(2 * DEPTH)) ** (len(TURNS) / 2)
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


@cache
def _burst() -> tuple[float, float, float]:
    """Return the flatness of A g2, the mean square of its derivative over that of A g2' alone, and its flatness."""
    angle = np.linspace(0.0, 2 * np.pi, NODES, endpoint=False)
    phases = np.meshgrid(*(angle for _ in TURNS), indexing="ij")
    var = np.exp(2 * DEPTH * sum(np.cos(phase) for phase in phases))
    own = DEPTH * sum(turn * np.sin(phase) for turn, phase in zip(TURNS, phases, strict=True))  # A' / A
    slope_var = var * (1 + own**2)
    flat, slope_flat = (GAUSSIAN * float((v**2).mean() / v.mean() ** 2) for v in (var, slope_var))
    return flat, float(slope_var.mean() / var.mean()), slope_flat
