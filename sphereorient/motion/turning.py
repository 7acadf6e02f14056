"""Tracks as chains of states: places on R^3, and orientations on SO(3) whatever the turn between frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sphereorient.motion.chain import Chain, wiener_noise

Floats = NDArray[np.float64]

STATES = 5  # the value and four derivatives; white noise drives the fifth: as smooth as a path in turbulence
AXES = 3


def skew(v: Floats) -> Floats:
    """Return the matrices [v]x (..., 3, 3) of vectors (..., 3)."""
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)


def left_jacobian(v: Floats) -> Floats:
    """Return the left Jacobian of exp at rotation vectors (M, 3): exp(v + dv) = exp(J dv) exp(v)."""
    angle = np.linalg.norm(v, axis=-1)[:, None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    K = skew(v)
    J: Floats = np.eye(3) + first * K + second * K @ K
    return J


def _mean_variance(covariance: Floats, measured: NDArray[np.bool_]) -> Floats:
    return np.where(measured, np.trace(covariance, axis1=1, axis2=2) / 3, np.nan)


def _distance(away: Floats, covariance: Floats, measured: NDArray[np.bool_]) -> Floats:
    """Squared distances (N,) in sigmas, NaN where nothing is measured."""
    safe = np.where(measured[:, None, None], covariance, np.eye(AXES))
    return np.where(measured, np.einsum("ni,ni->n", away, np.linalg.solve(safe, away[..., None])[..., 0]), np.nan)


def _tied(step: Floats, density: float) -> tuple[Floats, Floats]:
    """Transitions of the whole state and their noise, (M, D, D)."""
    transition, noise = wiener_noise(step, STATES)
    eye = np.eye(AXES)
    size = STATES * AXES
    tied: list[Floats] = [
        np.asarray(np.kron(part, eye)).reshape(-1, size, size) for part in (transition, density * noise)
    ]
    return tied[0], tied[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class Moving:
    """Places of one segment."""

    time: Floats  # (N,), any unit
    value: Floats  # (N, 3), NaN where not measured
    covariance: Floats  # (N, 3, 3)
    state: Floats  # (N, D)

    @classmethod
    def of(cls, time: Floats, value: Floats, covariance: Floats) -> Self:
        """Return the places without states."""
        return cls(time=time, value=value, covariance=covariance, state=np.zeros((len(time), STATES * AXES)))

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(N,), frames with a measurement."""
        return np.asarray(np.isfinite(self.value).all(1) & np.isfinite(self.covariance).all((1, 2)))

    @property
    def variance(self) -> Floats:
        """(N,), mean variance per axis of the measurements, NaN where there is none."""
        return _mean_variance(self.covariance, self.measured)

    def part(self, count: int) -> Self:
        """Return the first frames, at most `count`."""
        return type(self).of(self.time[:count], self.value[:count], self.covariance[:count])

    def start(self) -> Self:
        """Return the track about its mean, the derivatives at nothing."""
        state = np.zeros_like(self.state)
        state[:, :AXES] = np.nanmean(self.value[self.measured], axis=0)
        return type(self)(time=self.time, value=self.value, covariance=self.covariance, state=state)

    def chain(self, density: float, looseness: Floats) -> Chain:
        """Return the problem that is linear in steps from the present states.

        Args:
            density: of the white noise that drives the motion.
            looseness: (N,), factors on the measurements' covariances.
        """
        transition, noise = _tied(np.diff(self.time), density)
        residual = self.state[1:] - (transition @ self.state[:-1, :, None])[..., 0]
        spread = (
            float(np.nanmax(np.ptp(self.value[self.measured], axis=0)))
            + 1e3 * float(np.nanmedian(self.variance)) ** 0.5
        )
        return Chain(
            transition=transition,
            residual=residual,
            noise=noise,
            measured=self.measured,
            value=np.where(self.measured[:, None], self.value - self.state[:, :AXES], 0.0),
            value_noise=looseness[:, None, None] * self.covariance,
            start_variance=np.full(STATES * AXES, (10 * spread) ** 2),
        )

    def timed(self, factor: float) -> Self:
        """Return the same track in a unit of time that is `factor` times shorter."""
        order = np.repeat(np.arange(STATES), AXES)
        state = self.state * factor ** -order.astype(float)
        return type(self)(time=self.time * factor, value=self.value, covariance=self.covariance, state=state)

    def moved(self, step: Floats) -> Self:
        """Return the track with its states moved."""
        return type(self)(time=self.time, value=self.value, covariance=self.covariance, state=self.state + step)

    def misfit(self) -> Floats:
        """Squared distance (N,) of measurements from states in sigmas; NaN where there is none."""
        away = np.where(self.measured[:, None], self.value - self.state[:, :AXES], 0.0)
        return _distance(away, self.covariance, self.measured)


@dataclass(frozen=True, kw_only=True, eq=False)
class Turning:
    """Orientations of one segment."""

    time: Floats  # (N,), any unit
    value: Floats  # (N, 3, 3), R_lab_body, NaN where not measured
    covariance: Floats  # (N, 3, 3), rad^2, lab
    R: Floats  # (N, 3, 3), the states' orientations
    rates: Floats  # (N, D - 3): omega and its derivatives, lab, rad per power of that unit

    @classmethod
    def of(cls, time: Floats, value: Floats, covariance: Floats) -> Self:
        """Return the orientations without states."""
        count = len(time)
        rates = np.zeros((count, (STATES - 1) * AXES))
        return cls(time=time, value=value, covariance=covariance, R=np.tile(np.eye(3), (count, 1, 1)), rates=rates)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(N,), frames with a measurement."""
        return np.asarray(np.isfinite(self.value).all((1, 2)) & np.isfinite(self.covariance).all((1, 2)))

    @property
    def variance(self) -> Floats:
        """(N,), mean variance per axis of the measurements, NaN where there is none."""
        return _mean_variance(self.covariance, self.measured)

    def _with(self, R: Floats, rates: Floats) -> Self:
        return type(self)(time=self.time, value=self.value, covariance=self.covariance, R=R, rates=rates)

    def part(self, count: int) -> Self:
        """Return the first frames, at most `count`."""
        return type(self).of(self.time[:count], self.value[:count], self.covariance[:count])

    def start(self) -> Self:
        """Return the track with constant turns between its measurements."""
        seen = np.flatnonzero(self.measured)
        turns = turns_between(self.time[seen], self.value[seen])
        place = np.clip(np.searchsorted(seen, np.arange(len(self.time)), side="right") - 1, 0, max(len(seen) - 2, 0))
        omega = turns[place] / np.diff(self.time[seen])[place, None] if len(turns) else np.zeros((len(self.time), 3))
        since = self.time - self.time[seen[place]]
        R = Rotation.from_rotvec(omega * since[:, None]).as_matrix() @ self.value[seen[place]]
        rates = np.zeros_like(self.rates)
        rates[:, :AXES] = omega
        return self._with(R, rates)

    def chain(self, density: float, looseness: Floats) -> Chain:
        """Return the problem that is linear in steps from the present states; arguments as in Moving."""
        step = np.diff(self.time)
        transition, noise = _tied(step, density)
        h = step[:, None]
        w, a, j, s = np.split(self.rates[:-1], STATES - 1, axis=1)
        # The axis moves: Magnus' second term, in the orders that matter between neighbouring frames.
        turn = w * h + a * h**2 / 2 + j * h**3 / 6 + s * h**4 / 24
        turn = turn + (np.cross(a, w) * h**3 / 12 + np.cross(j, w) * h**4 / 24)
        still = np.concatenate([np.zeros((len(h), AXES)), self.rates[:-1]], axis=1)
        grown = (transition @ still[..., None])[..., 0]
        ahead = Rotation.from_rotvec(turn).as_matrix()
        J = left_jacobian(turn)
        H = h[..., None]
        eye = np.eye(AXES)
        parts = (
            H * eye + (H**3 / 12) * skew(a) + (H**4 / 24) * skew(j),
            (H**2 / 2) * eye - (H**3 / 12) * skew(w),
            (H**3 / 6) * eye - (H**4 / 24) * skew(w),
            (H**4 / 24) * eye,
        )
        transition[:, :AXES, :AXES] = ahead
        for k, part in enumerate(parts, 1):
            transition[:, :AXES, k * AXES : (k + 1) * AXES] = J @ part
        missed = Rotation.from_matrix(self.R[1:] @ (ahead @ self.R[:-1]).swapaxes(1, 2)).as_rotvec()
        return Chain(
            transition=transition,
            residual=np.concatenate([missed, self.rates[1:] - grown[:, AXES:]], axis=1),
            noise=noise,
            measured=self.measured,
            value=self._away(),
            value_noise=looseness[:, None, None] * self.covariance,
            start_variance=np.full(STATES * AXES, 100.0),
        )

    def _away(self) -> Floats:
        """Rotation vectors (N, 3), lab, from the states to the measurements, 0 where there is none."""
        seen = self.measured
        away = np.zeros((len(seen), 3))
        away[seen] = Rotation.from_matrix(self.value[seen] @ self.R[seen].swapaxes(1, 2)).as_rotvec()
        return away

    def timed(self, factor: float) -> Self:
        """Return the same track in a unit of time that is `factor` times shorter."""
        order = np.repeat(np.arange(1, STATES), AXES)
        rates = self.rates * factor ** -order.astype(float)
        return type(self)(time=self.time * factor, value=self.value, covariance=self.covariance, R=self.R, rates=rates)

    def moved(self, step: Floats) -> Self:
        """Return the track with its states moved, orientations on the sphere of rotations."""
        R = Rotation.from_rotvec(step[:, :AXES]).as_matrix() @ self.R
        return self._with(R, self.rates + step[:, AXES:])

    def misfit(self) -> Floats:
        """Squared distance (N,) of measurements from states in sigmas; NaN where there is none."""
        return _distance(self._away(), self.covariance, self.measured)


def turns_between(time: Floats, R: Floats) -> Floats:
    """Return the rotation vectors (M - 1, 3), lab, that lead from each orientation to the next.

    Over a gap the turn may exceed half a turn: of those that fit, the one nearest to the omega before it.
    """
    if len(R) < 2:
        return np.zeros((0, 3))
    turns = Rotation.from_matrix(R[1:] @ R[:-1].swapaxes(1, 2)).as_rotvec()
    step = np.diff(time)
    for k in np.flatnonzero(step > 1.5 * np.median(step)):
        if not k:
            continue
        expected = turns[k - 1] / step[k - 1] * step[k]
        angle = np.linalg.norm(turns[k])
        axis = turns[k] / angle if angle > 1e-9 else expected / max(float(np.linalg.norm(expected)), 1e-9)
        whole = round((float(expected @ axis) - angle) / (2 * np.pi))
        turns[k] = axis * (angle + 2 * np.pi * whole)
    return np.asarray(turns)
