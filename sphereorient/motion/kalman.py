"""Kalman filter and modified Bryson-Frazier smoother: linear in time, without inverse covariances of states.

`kalman.c`, where built, does the same, three times faster.
"""

import ctypes
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from scipy.special import betaln, gammainc

from sphereorient.files.compiled import compiled, record

ORDER = 10  # poles; on turbulence-like motion 6 loses 20 % in acceleration, 3 loses 80 %, 11 gains 1 %
NODES = 8  # of Gauss's quadrature over a step; exact for the Taylor series of a step


_M = np.diag(np.ones(ORDER - 1), 1)  # d(state)/dt of w, w', ... with all poles at -1
_M[-1] = [-math.comb(ORDER, k) for k in range(ORDER)]
# (M + 1) is nilpotent: exp(M tau) is exp(-tau) times a polynomial, without a matrix exponential
_POWERS = np.stack([np.linalg.matrix_power(_M + np.eye(ORDER), k) for k in range(ORDER)])
_DENSITY = 2 * np.pi / np.exp(betaln(0.5, ORDER - 0.5))  # of the white noise for w of unit variance
_AT, _WEIGHT = leggauss(NODES)
_FACTORIAL = np.array([math.factorial(k) for k in range(ORDER)], dtype=np.float64)
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
SOURCE = Path(__file__).with_suffix("")
_Chain = record(SOURCE, "Chain")
EVERY = 64  # states between stored covariances; the smoother recomputes the others, to the same bits


def _stationary() -> Floats:
    """Return the covariance of w of unit variance and its derivatives: moments of the spectrum (1 + x^2)^-ORDER."""
    order = np.arange(ORDER)
    half = (order[:, None] + order) / 2
    moment = np.exp(betaln(half + 0.5, ORDER - half - 0.5) - betaln(0.5, ORDER - 0.5))
    difference = order[:, None] - order
    return np.where(difference % 2 == 0, (-1.0) ** (difference // 2) * moment, 0.0)


STATIONARY = _stationary()  # (ORDER, ORDER), per pole


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
        """Return the covariance of (integral of w, w, w' / pole, ...) added in a step, (M, ORDER + 1, ORDER + 1)."""
        since, weight = nodes(step * self.pole)
        response = np.concatenate([integral(since)[..., -1:] / self.pole, grown(since)[..., :, -1]], axis=-1)
        strength = self.deviation**2 * _DENSITY
        return np.asarray(strength * (response * weight[..., None]).mT @ response, dtype=np.float64)


def prior_of_band(band: float, noise: float) -> Prior:
    """Return the prior whose spectrum equals white noise of sigma `noise` a frame at the band (cycles per frame)."""
    rate = 2 * np.pi * band
    pole = 0.75 * rate  # from turbulence-like motion: the spectrum falls a little below the end of the band
    density = _DENSITY / pole * (1 + (rate / pole) ** 2) ** -ORDER  # of w of unit variance at the band
    return Prior(pole=pole, deviation=float(noise * rate / np.sqrt(density)))


@dataclass(frozen=True, kw_only=True, eq=False)
class StateSpace:
    """A linear problem of N states of size D whose first three numbers are measured.
    A step takes these to `carried` times the state plus `drift`; all else depends on the step's kind (its length).
    """

    carried: Floats  # (N - 1, 3, D)
    drift: Floats  # (N - 1, 3)
    kind: NDArray[np.int64]  # (N - 1,)
    grown: Floats  # (kinds, D - 3, D - 3)
    noise: Floats  # (kinds, D, D), covariance added in a step
    start: Floats  # (D, D), covariance of the first state about zero
    measured: Floats  # (N, 3); arbitrary if not used
    covariance: Floats  # (N, 3, 3), of the measurements
    used: Bools  # (N,)

    def transition(self, k: int, into: Floats) -> Floats:
        """Write the transition from state k to the next into a (D, D) of zeros or of another step, and return it."""
        into[:3] = self.carried[k]
        into[3:, 3:] = self.grown[self.kind[k]]
        return into


@dataclass(frozen=True, kw_only=True, eq=False)
class Filtered:
    """Estimates from the past, frame by frame."""

    state: Floats  # (N, D), after the frame's own measurement
    stored: Floats  # (M, D, D), covariance of every EVERY-th state from the first on, to save memory
    gain: Floats  # (N, D, 3)
    innovation: Floats  # (N, 3)
    inverse: Floats  # (N, 3, 3), inverse covariance of the innovation
    misfit: float  # sum of squared whitened innovations
    log_determinant: float  # sum over the innovations' covariances


def run_filter(chain: StateSpace) -> Filtered:
    """Run Kalman's filter (Kalman 1960)."""
    count, size = len(chain.measured), chain.start.shape[0]
    found = {
        "state": np.empty((count, size)),
        "stored": np.empty((-(-count // EVERY), size, size)),
        "gain": np.zeros((count, size, 3)),
        "innovation": np.zeros((count, 3)),
        "inverse": np.zeros((count, 3, 3)),
    }
    code = kalman_library()
    if code is not None:
        sums = np.zeros(2)
        _run(code, "kalman_filter", chain, **found, sums=sums)
        return Filtered(**found, misfit=float(sums[0]), log_determinant=float(sums[1]))
    states, covariances, gains, innovations, inverses = found.values()
    x, P, F = np.zeros(size), chain.start, np.zeros((size, size))
    for k in range(count):  # recursive in the frames
        if k:
            F = chain.transition(k - 1, F)
            x = F @ x
            x[:3] += chain.drift[k - 1]
            P = _carried(chain, k, P, F)
        if chain.used[k]:
            inverse = np.linalg.inv(P[:3, :3] + chain.covariance[k])
            gain = P[:, :3] @ inverse
            innovation = chain.measured[k] - x[:3]
            x = x + gain @ innovation
            P = _updated(P, gain)
            gains[k], innovations[k], inverses[k] = gain, innovation, inverse
        states[k] = x
        if k % EVERY == 0:
            covariances[k // EVERY] = P
    misfit = float(np.einsum("ni,nij,nj->", innovations, inverses, innovations))
    return Filtered(**found, misfit=misfit, log_determinant=-float(np.linalg.slogdet(inverses[chain.used])[1].sum()))


def _carried(chain: StateSpace, k: int, P: Floats, F: Floats) -> Floats:
    """Return the covariance before the measurement of state k, from the one before it; F: the transition to k."""
    carried: Floats = F @ P @ F.T + chain.noise[chain.kind[k - 1]]
    return carried


def _updated(P: Floats, gain: Floats) -> Floats:
    P = P - gain @ P[:3]
    return 0.5 * (P + P.T)


def _covariances(chain: StateSpace, filtered: Filtered, first: int) -> Floats:
    """Recompute the covariances of the states from a stored one to the next."""
    count = min(EVERY, len(filtered.state) - first)
    P = filtered.stored[first // EVERY]
    F = np.zeros_like(P)
    found = np.empty((count, *P.shape))
    found[0] = P
    for k in range(first + 1, first + count):
        P = _carried(chain, k, P, chain.transition(k - 1, F))
        if chain.used[k]:
            P = _updated(P, filtered.gain[k])
        found[k - first] = P
    return found


@dataclass(frozen=True, kw_only=True, eq=False)
class SmoothedStates:
    """Estimates from past and future."""

    state: Floats  # (N, D)
    covariance: Floats  # (N, K, K), of the wanted combinations of each state
    mahalanobis: Floats  # (N,), squared Mahalanobis distance of a used measurement from all others' estimate; else 0


def smooth(chain: StateSpace, filtered: Filtered, wanted: Floats) -> SmoothedStates:
    """Run backwards over a filtered chain; `wanted` (K, D) holds the rows whose covariance is returned.
    Source: Bierman 1973 (modified Bryson-Frazier); the distance from the others: de Jong 1988.
    """
    count, size = filtered.state.shape
    state, mahalanobis = filtered.state.copy(), np.zeros(count)
    covariance = np.empty((count, len(wanted), len(wanted)))
    code = kalman_library()
    if code is not None:
        given = {key: array for key, array in vars(filtered).items() if isinstance(array, np.ndarray)}
        found = {"smoothed": state, "spread": covariance, "mahalanobis": mahalanobis}
        _run(code, "kalman_smooth", chain, **given, wanted=np.ascontiguousarray(wanted), **found)
        return SmoothedStates(state=state, covariance=covariance, mahalanobis=mahalanobis)
    F = np.zeros((size, size))
    pull, hold = np.zeros(size), np.zeros((size, size))  # gradient and curvature from the future
    for k in range(count - 1, -1, -1):
        if k == count - 1 or k % EVERY == EVERY - 1:
            block = _covariances(chain, filtered, k - k % EVERY)
        P = block[k % EVERY]
        state[k] -= P @ pull
        half = wanted @ P
        covariance[k] = half @ wanted.T - half @ hold @ half.T
        if chain.used[k]:
            K, inverse = filtered.gain[k], filtered.inverse[k]
            held = hold @ K
            whole = inverse @ filtered.innovation[k] + K.T @ pull
            own = inverse + K.T @ held
            mahalanobis[k] = whole @ np.linalg.solve(own, whole)
            pull[:3] -= whole
            # C' hold C + H' S^-1 H with C = 1 - K H, written out: only three rows and columns change
            hold[:3] -= held.T
            hold[:, :3] -= held
            hold[:3, :3] += own
        if k:
            F = chain.transition(k - 1, F)
            pull, hold = F.T @ pull, F.T @ hold @ F
            hold = 0.5 * (hold + hold.T)  # against growth of asymmetry by rounding
    return SmoothedStates(state=state, covariance=covariance, mahalanobis=mahalanobis)


def kalman_library() -> ctypes.CDLL | None:
    """Return the compiled recursions; None if there are none."""
    return compiled(SOURCE, _Chain)


def _run(code: ctypes.CDLL, name: str, chain: StateSpace, **arrays: Floats) -> None:
    """Call a function of the compiled code on a chain, and on contiguous input and output arrays."""
    given = {key: np.ascontiguousarray(getattr(chain, key)) for key in StateSpace.__dataclass_fields__} | arrays
    numbers = {"count": len(chain.measured), "size": len(chain.start), "every": EVERY}
    numbers["wanted_rows"] = len(arrays.get("wanted", ()))
    task = _Chain(**numbers, **{key: array.ctypes.data for key, array in given.items()})
    if code[name](ctypes.byref(task)):
        raise MemoryError
