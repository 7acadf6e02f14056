"""Rates forward in time, from each measurement and those before it: the smoother's prior, with a Kalman filter for each
of a grid of parameters; the likeliest is used.
"""

from dataclasses import dataclass

import numpy as np

from sphereorient.motion.estimate import FIRST_TRIES
from sphereorient.motion.kalman import ORDER, STATIONARY, Floats, Prior, grown, integral
from sphereorient.motion.settings import SmoothSettings
from sphereorient.motion.smooth import LONGEST_STEP

SPREADS = (0.1, 1.0, 10.0, 100.0, 1000.0)  # of the rate per frame, in sigmas of a measurement
POLES, DEVIATIONS = np.array([(pole, spread) for pole in FIRST_TRIES for spread in SPREADS]).T  # (K,) each
UNKNOWN_RATE = 1e4  # sigmas of a measurement per frame: prior standard deviation of an unknown constant rate
FIRST_STEPS = 8  # from which the usual step and covariance are learnt
FEWEST = 3  # consecutive measurements from which a rate is returned
JUDGED = 16  # measurements from which the parameters are estimated
REMEMBERED = 300  # memory of the likelihood, measurements
MOST_MISFIT = 1e3  # of a measurement, to limit the effect of a jump
BETTER = 3.0  # gain of log-likelihood for a change of parameters
MOST_STEPS = 10.0  # usual steps; a longer step has no information on the motion
TICKS = 128  # of a usual step; times are rounded to ticks, so that few transitions are needed and cached
DELTA, MEAN, RATE, SIZE = 0, 1, 2, 2 + ORDER  # delta from the measurement, the constant rate, w, w' / pole, ...
ON, BACK = [1, 2, 0], [2, 0, 1]  # a cross b = a[ON] b[BACK] - a[BACK] b[ON]; numpy's takes 30 us
SCALES = SmoothSettings().least_scale, SmoothSettings().most_scale
CONTRADICTS = SmoothSettings().outlier_sigma ** 2


@dataclass(frozen=True, kw_only=True, eq=False)
class Rate:
    """A rate with its standard deviations, (3,) each, lab, per s; NaN if unknown."""

    value: Floats
    sigma: Floats


UNKNOWN = Rate(value=np.full(3, np.nan), sigma=np.full(3, np.nan))


class ForwardRate:
    """The rate of a position, or of an orientation, at each of its measurements, causally, in constant memory.
    The prior is that of `smooth_motion`. Its parameters, in units of the usual step and sigma, and the factor on the
    sigmas of the measurements maximise the recent likelihood. There is a filter for each principal axis of the usual
    covariance. A measurement that contradicts the motion restarts the filters.
    """

    def __init__(self) -> None:
        self._first: list[tuple[float, Floats]] = []  # steps, s, and covariances, until the usual values are known
        self._frame_s = self._sigma = 0.0
        self._axes = np.eye(3)  # columns, lab
        self._count = 0  # consecutive measurements
        self._late_s = 0.0  # time of the last measurement less that of the states
        self._x, self._P = np.zeros((len(POLES), 3, SIZE)), np.zeros((len(POLES), 3, SIZE, SIZE))
        self._misfit, self._logs, self._number = np.zeros(len(POLES)), np.zeros(len(POLES)), 0.0
        self._best, self._judged = 0, 0
        self._transitions: dict[int, tuple[Floats, Floats, Floats]] = {}

    def restart(self) -> None:
        """Forget the motion: the next measurement is independent of those before."""
        self._count = 0

    def measured(self, step_s: float, step: Floats, covariance: Floats, turn: Floats | None = None) -> Rate:
        """Return the rate at a measurement of a covariance (3, 3), `step_s`, s, after the last one. `step` (3,) leads
        to it from there: for orientations a rotation vector, rad, lab, and `turn` (3, 3) is its rotation. At the first
        measurement, also after `restart`, these three are not used.
        """
        if not self._frame_s:
            self._look(step_s, covariance)
            return UNKNOWN
        variance = ((covariance @ self._axes) * self._axes).sum(0)
        length = (step_s + self._late_s) / self._frame_s
        if not self._count or not 0 < length < MOST_STEPS:
            self._begin(variance)
            return UNKNOWN
        self._carry(length, step, turn)
        self._update(variance)
        return self._rate() if self._count >= FEWEST and self._judged >= JUDGED else UNKNOWN

    def _look(self, step_s: float, covariance: Floats) -> None:
        """Learn usual step and covariance."""
        if self._count and step_s > 0:
            self._first.append((step_s, covariance))
        self._count += 1
        if len(self._first) == FIRST_STEPS:
            usual = np.median([of for _, of in self._first], axis=0)
            self._frame_s = float(np.median([one for one, _ in self._first]))
            self._sigma, self._axes = float(np.sqrt(np.trace(usual) / 3)), np.linalg.eigh(usual)[1]
            self._count = 0

    def _begin(self, variance: Floats) -> None:
        self._x[:], self._P[:] = 0.0, 0.0
        self._P[..., DELTA, DELTA] = variance
        self._P[..., MEAN, MEAN] = (UNKNOWN_RATE * self._sigma) ** 2
        self._P[..., RATE:, RATE:] = ((DEVIATIONS * self._sigma) ** 2)[:, None, None, None] * STATIONARY
        self._late_s, self._count = 0.0, 1

    def _carry(self, length: float, step: Floats, turn: Floats | None) -> None:
        """Propagate the states to the next measurement, `length` usual steps ahead."""
        parts = int(np.ceil(length / LONGEST_STEP))
        ticks = max(1, round(length / parts * TICKS))
        self._late_s = (length - parts * ticks / TICKS) * self._frame_s
        if turn is not None:
            # The rotation vector is not the integral of omega: Magnus expansion to third order in the step.
            x = self._x[self._best]
            omega, change = self._axes @ (x[:, MEAN] + x[:, RATE]), POLES[self._best] * self._axes @ x[:, RATE + 1]
            step = step + length**3 / 12 * (omega[ON] * change[BACK] - omega[BACK] * change[ON])
            self._x[..., DELTA] = self._x[..., DELTA] @ (self._axes.T @ turn.T @ self._axes)
        F, back, Q = self._transition(ticks)
        for _ in range(parts):
            self._x = self._x @ back
            self._P = F[:, None] @ self._P @ back[:, None]
            self._P += Q[:, None]
        self._x[..., DELTA] -= step @ self._axes

    def _transition(self, ticks: int) -> tuple[Floats, Floats, Floats]:
        """Return transitions over a part of a step, transposed ones, and added covariances, (K, SIZE, SIZE) each."""
        if ticks not in self._transitions:
            tau = ticks / TICKS
            F, Q = np.zeros((2, len(POLES), SIZE, SIZE))
            F[:, DELTA, DELTA] = F[:, MEAN, MEAN] = 1.0
            F[:, DELTA, MEAN], F[:, DELTA, RATE:] = tau, integral(tau * POLES) / POLES[:, None]
            F[:, RATE:, RATE:] = grown(tau * POLES)
            own = np.r_[DELTA, RATE:SIZE]
            noise = [Prior(pole=pole, deviation=self._sigma).step_noise(np.array([tau]))[0] for pole in FIRST_TRIES]
            Q[:, own[:, None], own] = np.repeat(noise, len(SPREADS), 0) * DEVIATIONS[:, None, None] ** 2
            self._transitions[ticks] = F, np.ascontiguousarray(F.mT), Q
        return self._transitions[ticks]

    def _update(self, variance: Floats) -> None:
        """Apply the measurement, from which delta is counted, and rate the parameters by it."""
        innovation, spread = -self._x[..., DELTA], self._P[..., DELTA, DELTA] + variance  # (K, 3)
        misfit = (innovation**2 / spread).sum(1)
        self._count += 1
        if self._count >= FEWEST:  # before, nothing is determined
            self._judge(misfit, np.log(spread).sum(1))
            if misfit[self._best] > CONTRADICTS * self._scale2()[self._best]:
                self._begin(variance)
                return
        row = self._P[..., DELTA, :]
        gain = row / spread[..., None]
        self._x += gain * innovation[..., None]
        self._P -= gain[..., None] * row[..., None, :]
        self._P += self._P.mT  # against growing asymmetry by rounding
        self._P *= 0.5

    def _judge(self, misfit: Floats, logs: Floats) -> None:
        """Choose the parameters by the innovations: their squares and logarithms of determinants, (K,) each."""
        keep = 1 - 1 / REMEMBERED
        self._misfit = keep * self._misfit + misfit.clip(max=MOST_MISFIT)
        self._logs = keep * self._logs + logs
        self._number, self._judged = keep * self._number + 3, self._judged + 1
        scale2 = self._scale2()
        cost = 0.5 * (self._logs + self._number * np.log(scale2) + self._misfit / scale2)
        best = int(cost.argmin())
        if self._judged <= JUDGED or cost[best] < cost[self._best] - BETTER:
            self._best = best

    def _scale2(self) -> Floats:
        """Return the likeliest factors on all variances, (K,)."""
        low, high = SCALES
        return np.asarray((self._misfit / self._number).clip(low**2, high**2))

    def _rate(self) -> Rate:
        x, P = self._x[self._best], self._P[self._best]
        variance = P[:, MEAN, MEAN] + 2 * P[:, MEAN, RATE] + P[:, RATE, RATE]
        per_s = 1 / self._frame_s
        sigma = np.sqrt(self._axes**2 @ variance * self._scale2()[self._best])
        return Rate(value=self._axes @ (x[:, MEAN] + x[:, RATE]) * per_s, sigma=sigma * per_s)
