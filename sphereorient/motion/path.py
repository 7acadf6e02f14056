"""Segments as chains of small deviations from a reference: positions on R^3, orientations on SO(3) for any rotation.

The state has 3 (2 + ORDER) numbers: delta from the reference, the deviation of the constant rate, and the random rate
w, w' / pole, w'' / pole^2, ... itself. Time is in frames.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from sphereorient.motion.kalman import (
    NODES,
    ORDER,
    STATIONARY,
    Bools,
    Floats,
    Prior,
    StateSpace,
    grown,
    grown_rate,
    integral,
    nodes,
)

SIZE = 3 * (2 + ORDER)
UNKNOWN = 100.0  # standard deviation of the start from its reference, in sigmas of a measurement: hardly a constraint
BY_INSTANT = ("time", "covariance", "seen", "used", "rate", "value", "reference")
TOGETHER = 1024  # steps computed at once, to save memory
VOTES = 5  # neighbouring rotations whose median is typical
LEFT_OUT = 6  # most consecutive frames left out of the first estimate
DELTA, MEAN, RATE = slice(0, 3), slice(3, 6), slice(6, SIZE)


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentTrack:
    """The measurements of one segment, positions in mm, lab, and the reference of the states."""

    time: Floats  # (N,), frames, increasing
    covariance: Floats  # (N, 3, 3), of the measurements
    seen: Bools  # (N,), measured
    used: Bools  # (N,), measured and not rejected
    unknown_rate: float  # standard deviation of the constant rate from the reference's: hardly a constraint
    mean: Floats  # (3,), the reference's constant rate, value per frame
    rate: Floats  # (N, ORDER, 3), the reference's w, w' / pole, ...
    pole: float  # per frame, the scale of `rate`
    value: Floats  # (N, 3) or (N, 3, 3), the measurements
    reference: Floats  # like value

    @staticmethod
    def between(begin: Floats, end: Floats) -> Floats:
        """Return the steps (M, 3) from values (M, ...) to others."""
        return end - begin

    @staticmethod
    def stepped(value: Floats, step: Floats) -> Floats:
        """Return the values (M, ...) after steps (M, 3)."""
        return value + step

    @classmethod
    def first_guess(cls, time: Floats, value: Floats, seen: Bools) -> tuple[Floats, Floats, Bools]:
        """Return values, gaps interpolated, and rates (N, 3) per frame, at all instants; the trusted frames (N,)."""
        frames = np.flatnonzero(seen)
        if len(frames) > 1:
            steps = np.diff(value[frames], axis=0)
            velocity = _typical(time, time[frames], steps)
            gone = np.cumsum((velocity[1:] + velocity[:-1]) / 2 * np.diff(time)[:, None], axis=0)
            still = value[frames] - np.concatenate([np.zeros((1, 3)), gone])[frames]
            frames = frames[_consistent(cls.between, still, steps)]
        reference = np.stack([np.interp(time, time[frames], value[frames, axis]) for axis in range(3)], axis=1)
        velocity = np.gradient(reference, time, axis=0) if len(time) > 1 else np.zeros_like(reference)
        return reference, velocity, np.isin(np.arange(len(time)), frames)

    def jumps(self, prior: Prior) -> tuple[Floats, Floats]:
        """Return rotations (N - 1, NODES + 1, 3, 3) from nodes and begin of a step to its end, and jumps (N - 1, 3).
        The jumps are the steps less the integral of the reference's rate.
        """
        step = np.diff(self.time)
        gone = (integral(step * prior.pole)[:, None] / prior.pole @ self.scaled(prior)[:-1])[:, 0]
        carry = np.broadcast_to(np.eye(3), (len(step), NODES + 1, 3, 3))
        return carry, np.diff(self.reference, axis=0) - step[:, None] * self.mean - gone

    @classmethod
    def of(cls, time: Floats, value: Floats, covariance: Floats, seen: Bools) -> Self:
        """Return the segment about a first estimate: consistent measurements, gaps interpolated."""
        reference, velocity, trusted = cls.first_guess(time, value, seen)
        mean = velocity.mean(0)
        rate = np.zeros((len(time), ORDER, 3))
        rate[:, 0] = velocity - mean
        given: dict[str, Any] = {"time": time, "value": value, "covariance": covariance, "seen": seen}
        guess = {"used": trusted, "mean": mean, "rate": rate, "reference": reference}
        unknown_rate = 2 * float(np.sqrt((rate[:, 0] ** 2).mean()))
        return cls(**given, **guess, unknown_rate=unknown_rate, pole=1.0)

    def moved(self, state: Floats, prior: Prior) -> Self:
        """Return the path about the states (N, SIZE)."""
        reference, rate = self.stepped(self.reference, state[:, DELTA]), state[:, RATE].reshape(-1, ORDER, 3)
        return replace(self, reference=reference, mean=self.mean + state[0, MEAN], rate=rate, pole=prior.pole)

    def away(self) -> Floats:
        """Return the measurements as deviations (N, 3) from the reference; 0 if not measured."""
        seen = self.seen.reshape(-1, *(1,) * (self.value.ndim - 1))
        return self.between(self.reference, np.where(seen, self.value, self.reference))

    def rates(self) -> Floats:
        """Return the rates (M, 3), per frame, between neighbouring measurements."""
        seen = np.flatnonzero(self.used)
        return self.between(self.value[seen[:-1]], self.value[seen[1:]]) / np.diff(self.time[seen])[:, None]

    @property
    def sigma(self) -> float:
        """Typical standard deviation of a measurement by axis."""
        return float(np.sqrt(np.median(np.trace(self.covariance[self.seen], axis1=1, axis2=2)) / 3))

    def scaled(self, prior: Prior) -> Floats:
        """Return the reference's random rate (N, ORDER, 3) in the units of another pole."""
        return self.rate * (self.pole / prior.pole) ** np.arange(ORDER)[:, None]

    def part(self, instants: slice) -> Self:
        """Return some instants of the segment."""
        return replace(self, **{name: getattr(self, name)[instants] for name in BY_INSTANT})

    def steps(self, prior: Prior, weight: Floats, by_rate: Floats) -> tuple[Floats, Floats]:
        """Return the transition of a step from the state, (M, 3, SIZE), and its drift (M, 3).
        `weight` (M, NODES): of the nodes; `by_rate` (M, NODES, ORDER): the same times the growth of the rate's state.
        """
        count = len(weight)
        carry, jump = self.jumps(prior)
        turned = carry[:, :NODES].reshape(count, NODES, 9).mT
        from_mean = (turned @ weight[..., None]).reshape(count, 3, 3)
        from_rate = (turned @ by_rate).reshape(count, 3, 3, ORDER).mT.reshape(count, 3, 3 * ORDER)
        drift = -jump - (from_rate @ self.scaled(prior)[:-1].reshape(count, -1, 1))[..., 0]
        return np.concatenate([carry[:, NODES], from_mean, from_rate], axis=2), drift

    def chain(self, prior: Prior) -> StateSpace:
        """Return the state space model, linear about the reference.
        Source: Barfoot 2017, State Estimation for Robotics, sections 7.2 and 7.3: perturbations from the left.
        """
        step = np.diff(self.time)
        count = len(step)
        lengths, kind = np.unique(np.round(step, 9), return_inverse=True)
        at, weight = nodes(lengths)
        by_rate = weight[..., None] * grown_rate(at * prior.pole)
        carried, drift = np.zeros((count, 3, SIZE)), np.zeros((count, 3))
        for k in range(0, count, TOGETHER):
            some = slice(k, min(k + TOGETHER, count))
            piece = self.part(slice(some.start, some.stop + 1))
            carried[some], drift[some] = piece.steps(prior, weight[kind[some]], by_rate[kind[some]])
        view = np.eye(3)
        grown_by = np.zeros((len(lengths), SIZE - 3, SIZE - 3))
        grown_by[:, :3, :3], grown_by[:, 3:, 3:] = view, _by_axis(grown(lengths * prior.pole))
        keep = np.r_[0:3, 6:SIZE]
        noise = np.zeros((len(lengths), SIZE, SIZE))
        noise[:, keep[:, None], keep] = _by_axis(prior.step_noise(lengths))
        start = np.zeros((SIZE, SIZE))
        # a weak prior about the reference, which follows the states: it damps steps without bias at convergence
        start[DELTA, DELTA] = (UNKNOWN * self.sigma) ** 2 * view
        start[MEAN, MEAN] = (self.unknown_rate + self.sigma) ** 2 * view
        start[RATE, RATE] = prior.deviation**2 * np.kron(STATIONARY, view)
        steps: dict[str, Any] = {"carried": carried, "drift": drift, "kind": kind, "grown": grown_by, "noise": noise}
        return StateSpace(**steps, start=start, measured=self.away(), covariance=self.covariance, used=self.used)


def mahalanobis2(off: Floats, covariance: Floats) -> Floats:
    """Return the squared Mahalanobis distances (n,) of deviations (n, 3) of covariances (n, 3, 3)."""
    return np.asarray(np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off))


def _by_axis(blocks: Floats) -> Floats:
    """Return matrices (M, n, n) of one axis for all three axes, (M, 3 n, 3 n)."""
    count, size = blocks.shape[:2]
    return np.asarray(np.einsum("mij,ab->miajb", blocks, np.eye(3)).reshape(count, 3 * size, 3 * size))


@dataclass(frozen=True, kw_only=True, eq=False)
class RotationTrack(SegmentTrack):
    """Orientations of one segment, R_lab_body (N, 3, 3); steps are rotation vectors, lab."""

    @staticmethod
    def between(begin: Floats, end: Floats) -> Floats:
        """Return the rotation vectors, lab."""
        return rotvec_between(begin, end)

    @staticmethod
    def stepped(value: Floats, step: Floats) -> Floats:
        """Return the orientations rotated in the lab."""
        return rotation_of(step) @ value

    @classmethod
    def first_guess(cls, time: Floats, value: Floats, seen: Bools) -> tuple[Floats, Floats, Bools]:
        """Return orientations, gaps interpolated along the typical rotation, and omega_lab."""
        frames = np.flatnonzero(seen)
        if len(frames) < 2:
            return np.broadcast_to(value[frames[0]], value.shape).copy(), np.zeros((len(time), 3)), seen
        steps = rotvec_between(value[frames[:-1]], value[frames[1:]])
        omega = _typical(time, time[frames], steps)
        gone = np.concatenate([np.eye(3)[None], rotation_of((omega[1:] + omega[:-1]) / 2 * np.diff(time)[:, None])])
        for k in range(1, len(time)):  # a running product, compared over short spans only, so that it need not be exact
            gone[k] = gone[k] @ gone[k - 1]
        still = gone[frames].mT @ value[frames]  # constant for the typical rotation
        trusted = frames[_consistent(cls.between, still, steps)]
        at = np.interp(np.arange(len(time)), trusted, np.arange(len(trusted)))
        left = np.minimum(at.astype(int), max(len(trusted) - 2, 0))
        share = np.clip(at - left, 0.0, 1.0)
        before, after = trusted[left], trusted[np.minimum(left + 1, len(trusted) - 1)]
        ahead = gone @ gone[before].mT @ value[before]
        missed = rotvec_between(gone[after] @ gone[before].mT @ value[before], value[after])
        carried = gone @ gone[after].mT @ rotation_of(missed)  # the correction grows in the rotating frame
        along = rotvec_between(ahead, carried @ gone[after] @ gone[before].mT @ value[before])
        reference = rotation_of(share[:, None] * along) @ ahead
        reference[trusted] = value[trusted]
        return reference, omega, np.isin(np.arange(len(time)), trusted)

    def jumps(self, prior: Prior) -> tuple[Floats, Floats]:
        """Return the rotations of the reference, exact for any angle, and the jumps."""
        step, rate, pole = np.diff(self.time), self.scaled(prior)[:-1], prior.pole
        at, _ = nodes(step)
        to_end = np.concatenate([step[:, None] - at, step[:, None]], axis=1)
        over_step = integral(step * pole)[:, None]
        gone = np.concatenate([over_step - integral(at * pole), over_step], axis=1) / pole
        carry = rotation_of(to_end[..., None] * self.mean + gone @ rate)
        carry[:, NODES] = whole = propagated(self.mean, rate, pole, step)
        return carry, rotvec_between(whole @ self.reference[:-1], self.reference[1:])


def rotation_of(rotvec: Floats) -> Floats:
    """Return the rotations (..., 3, 3) of rotation vectors (..., 3), rad."""
    matrices = Rotation.from_rotvec(rotvec.reshape(-1, 3)).as_matrix()
    return np.asarray(matrices, dtype=np.float64).reshape(*rotvec.shape, 3)


def rotvec_between(begin: Floats, end: Floats) -> Floats:
    """Return the rotation vectors (M, 3), lab, from orientations (M, 3, 3) to others."""
    if len(begin) == 0:
        return np.zeros((0, 3))
    return np.asarray(Rotation.from_matrix(end @ begin.swapaxes(-1, -2)).as_rotvec(), dtype=np.float64)


def propagated(mean: Floats, rate: Floats, pole: float, step: Floats, parts: int = 3) -> Floats:
    """Return the rotations (M, 3, 3) over steps (M,) by omega_lab = mean + w(t), from the state of w (M, ORDER, 3).
    Source: Magnus expansion of fourth order at the two Gauss nodes (Iserles and Norsett 1999).
    """
    h = step[:, None] / parts
    begin = h * np.arange(parts)
    early, late = (mean + grown_rate((begin + h * (0.5 + side * np.sqrt(3) / 6)) * pole) @ rate for side in (-1, 1))
    turns = rotation_of(h[..., None] * (early + late) / 2 - np.sqrt(3) / 12 * h[..., None] ** 2 * np.cross(early, late))
    whole = turns[:, 0]
    for k in range(1, parts):
        whole = turns[:, k] @ whole
    return whole


def _typical(time: Floats, seen_time: Floats, steps: Floats) -> Floats:
    """Return rates (N, 3) at all instants from the steps between neighbours, robust to two wrong ones in five."""
    step = np.diff(seen_time)
    near = np.flatnonzero(step <= 1.5 * np.median(step))
    rates, middle = steps[near] / step[near, None], ((seen_time[:-1] + seen_time[1:]) / 2)[near]
    if len(near) < VOTES:
        return np.broadcast_to(np.median(rates, axis=0), (len(time), 3)).copy()
    slope = np.median(_around(np.diff(rates, axis=0) / np.diff(middle)[:, None], 2 * VOTES - 2), axis=1)
    slope = np.stack([slope[0], *(slope[1:] + slope[:-1]) / 2, slope[-1]])
    away = _around(middle[:, None], VOTES) - middle[:, None, None]
    voted = np.median(_around(rates, VOTES) - slope[:, None] * away, axis=1)
    return np.asarray(PchipInterpolator(middle, voted)(time.clip(middle[0], middle[-1])), dtype=np.float64)


def _around(x: Floats, width: int) -> Floats:
    """Return the neighbours (n, width, d) of every row (n, d); at the ends, on one side."""
    width = min(width, len(x))
    first = (np.arange(len(x)) - width // 2).clip(0, len(x) - width)
    return np.asarray(x[first[:, None] + np.arange(width)])


def _consistent(between: Callable[[Floats, Floats], Floats], still: Floats, steps: Floats) -> NDArray[np.int64]:
    """Return the frames that are consistent with each other, by dynamic programming, with a cost for frames left out.
    `still`: measurements (n, ...) less the typical motion; `between`: the steps (m, 3) from values to others.
    """
    count = len(still)
    reach = min(LEFT_OUT + 1, count - 1)
    kinks = [np.linalg.norm(between(still[:-lag], still[lag:]), axis=1) / lag for lag in range(1, reach + 1)]
    way = float(np.median(np.linalg.norm(steps, axis=1)))  # the typical step
    typical = max(float(np.median(kinks[0])), 0.03 * way, 1e-9)
    links = [np.minimum((size / (8 * typical)) ** 2, 25.0) for size in kinks]
    price, before = np.full(count, np.inf), np.full(count, -1)
    for k in range(count):
        price[k] = 4.0 * k if k <= LEFT_OUT else np.inf
        for lag in range(1, min(reach, k) + 1):
            total = price[k - lag] + links[lag - 1][k - lag] + 4.0 * (lag - 1)
            if total < price[k]:
                price[k], before[k] = total, k - lag
    tail = min(LEFT_OUT + 1, count)
    last = count - tail + int(np.argmin(price[-tail:] + 4.0 * np.arange(tail - 1, -1, -1)))
    chain = [last]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])
