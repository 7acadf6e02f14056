"""A chain of states, each tied to the next, some measured: Kalman's filter and the smoother that goes back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MEASURED = 3  # components of a state that are measured: the first


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """A linear problem of N states of size D; made by the tracks, read by `solve`.

    x[k + 1] = F[k] x[k] - e[k] + noise of covariance Q[k]; y[k] = the first three of x[k] + noise of covariance R[k].
    """

    transition: Floats  # F, (N - 1, D, D)
    residual: Floats  # e, (N - 1, D)
    noise: Floats  # Q, (N - 1, D, D)
    measured: NDArray[np.bool_]  # (N,)
    value: Floats  # y, (N, 3)
    value_noise: Floats  # R, (N, 3, 3)
    start_variance: Floats  # (D,), of the first state about nothing


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """States of a chain, given all its measurements; made by `solve`."""

    state: Floats  # (N, D)
    covariance: Floats  # (N, D, D), of each state by itself
    innovation: Floats  # (N, 3), what each measurement adds to those before it, whitened
    log_determinant: Floats  # (N,), of that prediction's covariance; both NaN where nothing is measured


def solve(chain: Chain) -> Solution:
    """Filter forwards, smooth backwards.

    Source: Kalman 1960; Rauch, Tung and Striebel 1965; Joseph's form of the update keeps covariances positive.
    """
    count, size = len(chain.measured), len(chain.start_variance)
    states, covariances = np.empty((count, size)), np.empty((count, size, size))
    ahead, ahead_covariances = np.empty_like(states), np.empty_like(covariances)
    innovation, log_determinant = np.full((count, MEASURED), np.nan), np.full(count, np.nan)
    x, P = np.zeros(size), np.diag(chain.start_variance)
    eye = np.eye(size)
    # A recursion: each state needs the one before.
    for k in range(count):
        if k:
            F = chain.transition[k - 1]
            x = F @ x - chain.residual[k - 1]
            P = F @ P @ F.T + chain.noise[k - 1]
        ahead[k], ahead_covariances[k] = x, P
        if chain.measured[k]:
            R = chain.value_noise[k]
            S = P[:MEASURED, :MEASURED] + R
            inverse = np.linalg.inv(S)
            gain = P[:, :MEASURED] @ inverse
            miss = chain.value[k] - x[:MEASURED]
            x = x + gain @ miss
            left = eye.copy()
            left[:, :MEASURED] -= gain
            P = left @ P @ left.T + gain @ R @ gain.T
            root = np.linalg.cholesky(S)
            innovation[k] = np.linalg.solve(root, miss)
            log_determinant[k] = 2.0 * np.log(np.diag(root)).sum()
        states[k], covariances[k] = x, P
    for k in range(count - 2, -1, -1):
        gain = np.linalg.solve(ahead_covariances[k + 1], chain.transition[k] @ covariances[k]).T
        states[k] = states[k] + gain @ (states[k + 1] - ahead[k + 1])
        P = covariances[k] + gain @ (covariances[k + 1] - ahead_covariances[k + 1]) @ gain.T
        covariances[k] = 0.5 * (P + P.T)
    return Solution(state=states, covariance=covariances, innovation=innovation, log_determinant=log_determinant)


def wiener_noise(step: Floats, order: int) -> tuple[Floats, Floats]:
    """Return transitions and noise of an integrated Wiener process, (M, n, n) each.

    Args:
        step: (M,), time between the states.
        order: n, number of derivatives in the state, itself included; white noise drives the n-th.

    Returns:
        Transitions, and covariances for noise of unit density.

    Source: Sarkka and Solin 2019, section 6.5 (closed form).
    """
    powers = np.arange(order)
    lag = powers[None, :] - powers[:, None]
    factorial = np.array([1.0, *np.cumprod(np.arange(1.0, 2 * order))])
    h = np.asarray(step, float)[:, None, None]
    transition = np.where(lag >= 0, h ** np.maximum(lag, 0) / factorial[np.maximum(lag, 0)], 0.0)
    left = order - 1 - powers
    total = left[:, None] + left[None, :] + 1
    noise = h**total / (total * factorial[left][:, None] * factorial[left][None, :])
    return transition, noise
