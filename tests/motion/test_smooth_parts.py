import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from sphereorient.motion import kalman
from sphereorient.motion.kalman import (
    ORDER,
    STATIONARY,
    Prior,
    StateSpace,
    grown,
    grown_rate,
    integral,
    nodes,
    prior_of_band,
    run_filter,
    smooth,
)
from sphereorient.motion.path import RotationTrack, propagated, rotation_of, rotvec_between


def test_growth_agrees_with_the_matrix_exponential() -> None:
    companion = np.eye(ORDER, k=1)
    companion[-1] = -np.poly(-np.ones(ORDER))[:0:-1]  # all poles at -1
    for tau in (0.0, 0.03, 0.7, 4.0):
        expected = expm(companion * tau)
        np.testing.assert_allclose(grown(np.array(tau)), expected, atol=1e-10)
        np.testing.assert_allclose(grown_rate(np.array(tau)), expected[0], atol=1e-10)


def test_the_integral_of_the_rate_agrees_with_quadrature() -> None:
    at, weight = nodes(np.array([0.8]))
    np.testing.assert_allclose(integral(np.array(0.8)), (weight[0, :, None] * grown_rate(at[0])).sum(0), atol=1e-12)


def test_a_step_keeps_the_process_stationary() -> None:
    prior = Prior(pole=0.4, deviation=0.02)
    for step in (0.3, 1.0, 20.0):
        F, noise = grown(np.array(step * prior.pole)), prior.step_noise(np.array([step]))[0]
        whole = prior.deviation**2 * STATIONARY
        if step < 10:  # eight nodes serve steps shorter than the memory
            np.testing.assert_allclose(F @ whole @ F.T + noise[1:, 1:], whole, atol=1e-9 * prior.deviation**2)
        assert (np.linalg.eigvalsh(noise) > -1e-18).all()


def test_a_band_is_where_signal_and_noise_are_equally_strong() -> None:
    prior = prior_of_band(0.08, noise=0.5)
    rate = 2 * np.pi * 0.08
    lags = np.arange(-400, 401) * 0.25
    covariance = prior.deviation**2 * np.array(
        [(grown(np.array(abs(lag) * prior.pole)) @ STATIONARY)[0, 0] for lag in lags]
    )
    density = float((covariance * np.cos(rate * lags)).sum() * 0.25)
    # the sum over lags cancels to 1e-5 of its terms
    assert density == pytest.approx(0.5**2 * rate**2, rel=2e-2)


@pytest.fixture(params=["numpy", "compiled"])
def body(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both forms of the recursions."""
    if request.param == "numpy":
        monkeypatch.setattr(kalman, "kalman_library", lambda: None)
    elif kalman.kalman_library() is None:
        pytest.skip("needs compiled code: `make setup` with a compiler")
    return str(request.param)


@pytest.mark.parametrize("hidden", [(), (0,), (3, 4), (9,)], ids=str)
def test_filter_and_smoother_agree_with_dense_least_squares(hidden: tuple[int, ...], body: str) -> None:
    rng = np.random.default_rng(5)
    count, size = 10, 7
    spread = lambda n: (lambda A: A @ A.swapaxes(-1, -2) + 0.1 * np.eye(n))(rng.standard_normal((n, n)))  # noqa: E731
    used = ~np.isin(np.arange(count), hidden)
    chain = StateSpace(
        carried=0.3 * rng.standard_normal((count - 1, 3, size)),
        drift=rng.standard_normal((count - 1, 3)),
        kind=rng.integers(0, 2, count - 1),
        grown=0.5 * rng.standard_normal((2, size - 3, size - 3)),
        noise=np.stack([spread(size), spread(size)]),
        start=10 * spread(size),
        measured=rng.standard_normal((count, 3)),
        covariance=np.stack([spread(3) for _ in range(count)]),
        used=used,
    )
    # all states as a linear map of start and noises
    mean, maps, noises = [np.zeros(size)], [np.zeros((size, size * count))], np.zeros((size * count, size * count))
    maps[0][:, :size], noises[:size, :size] = np.eye(size), chain.start
    for k in range(1, count):
        F = chain.transition(k - 1, np.zeros((size, size)))
        mean.append(F @ mean[-1] + np.r_[chain.drift[k - 1], np.zeros(size - 3)])
        maps.append(F @ maps[-1])
        part = slice(k * size, (k + 1) * size)
        maps[-1][:, part], noises[part, part] = np.eye(size), chain.noise[chain.kind[k - 1]]
    joint = np.concatenate(maps) @ noises @ np.concatenate(maps).T

    def believed(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        at = (rows[:, None] * size + np.arange(3)).ravel()
        S = joint[np.ix_(at, at)]
        for i, row in enumerate(rows):
            S[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += chain.covariance[row]
        gain = joint[:, at] @ np.linalg.inv(S)
        off = (chain.measured[rows] - np.stack(mean)[rows, :3]).ravel()
        return np.concatenate(mean) + gain @ off, joint - gain @ joint[at], S, off

    states, covariance, S, off = believed(np.flatnonzero(used))
    filtered = run_filter(chain)
    result = smooth(chain, filtered, np.eye(size))
    np.testing.assert_allclose(result.state.ravel(), states, atol=1e-8)
    for k in range(count):
        part = slice(k * size, (k + 1) * size)
        np.testing.assert_allclose(result.covariance[k], covariance[part, part], atol=1e-8)
    assert filtered.misfit == pytest.approx(off @ np.linalg.solve(S, off))
    assert filtered.log_determinant == pytest.approx(np.linalg.slogdet(S)[1])
    # the mahalanobis of one measurement is its distance from the estimate of all others
    others, doubt, _, _ = believed(np.flatnonzero(used & (np.arange(count) != 6)))
    away = chain.measured[6] - others[6 * size : 6 * size + 3]
    whole = doubt[6 * size : 6 * size + 3, 6 * size : 6 * size + 3] + chain.covariance[6]
    assert result.mahalanobis[6] == pytest.approx(away @ np.linalg.solve(whole, away))


def test_a_turn_about_a_moving_axis_agrees_with_the_differential_equation() -> None:
    rng = np.random.default_rng(1)
    mean, pole = np.array([0.5, -0.3, 0.4]), 0.3
    rate = 0.2 * rng.standard_normal((1, ORDER, 3))

    def slope(t: float, R: np.ndarray) -> np.ndarray:
        omega = mean + grown_rate(np.array(t * pole)) @ rate[0]
        return np.cross(omega, R.reshape(3, 3).T).T.ravel()

    expected = solve_ivp(slope, (0, 1), np.eye(3).ravel(), rtol=1e-12, atol=1e-12).y[:, -1].reshape(3, 3)
    np.testing.assert_allclose(propagated(mean, rate, pole, np.ones(1))[0], expected, atol=2e-6)


def test_the_linear_problem_of_turns_has_the_derivatives_of_the_true_one() -> None:
    rng = np.random.default_rng(2)
    time, prior = np.arange(3.0), Prior(pole=0.4, deviation=0.1)
    omega = np.array([0.6, 0.3, -0.4])
    R = rotation_of(time[:, None] * omega)
    path = RotationTrack.of(time, R, np.tile(1e-6 * np.eye(3), (3, 1, 1)), np.ones(3, dtype=bool))
    F = path.chain(prior).transition(0, np.zeros((6 + 3 * ORDER, 6 + 3 * ORDER)))
    small = 1e-6 * rng.standard_normal(6 + 3 * ORDER)
    delta, mean, rate = small[:3], path.mean + small[3:6], path.scaled(prior)[:1] + small[6:].reshape(1, ORDER, 3)
    still = propagated(path.mean, path.scaled(prior)[:1], prior.pole, np.ones(1))[0] @ R[0]
    moved = propagated(mean, rate, prior.pole, np.ones(1))[0] @ rotation_of(delta[None])[0] @ R[0]
    np.testing.assert_allclose(rotvec_between(still[None], moved[None])[0], F[:3] @ small, atol=1e-9)


@pytest.mark.skipif(kalman.kalman_library() is None, reason="needs compiled code: `make setup` with a compiler")
def test_compiled_recursions_are_those_of_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    count = 3 * kalman.EVERY + 7
    time = np.cumsum(rng.choice([1.0, 1.0, 2.5], count))
    turns = np.cumsum(0.1 * rng.standard_normal((count, 3)), axis=0)
    spread = 1e-4 * np.eye(3) + 1e-4 * np.outer([1.0, -1.0, 0.5], [1.0, -1.0, 0.5])
    seen = rng.random(count) > 0.2
    value = np.stack([rotation_of(turn[None])[0] for turn in turns])
    value[~seen] = np.nan
    covariance = np.broadcast_to(spread, (count, 3, 3))
    chain = RotationTrack.of(time, value, covariance, seen).chain(Prior(pole=0.3, deviation=0.05))
    wanted = np.eye(len(chain.start))[:9] + np.eye(len(chain.start))[5]
    compiled = run_filter(chain)
    behind = smooth(chain, compiled, wanted)
    with monkeypatch.context() as patch:
        patch.setattr(kalman, "kalman_library", lambda: None)
        plain = run_filter(chain)
        expected = smooth(chain, plain, wanted)
    assert compiled.misfit == pytest.approx(plain.misfit, rel=1e-9)
    assert compiled.log_determinant == pytest.approx(plain.log_determinant, rel=1e-9)
    for name in ("state", "stored", "gain", "innovation", "inverse"):
        one, other = getattr(compiled, name), getattr(plain, name)
        np.testing.assert_allclose(one, other, atol=1e-9 * np.abs(other).max(), err_msg=name)
    for name in ("state", "covariance", "mahalanobis"):
        one, other = getattr(behind, name), getattr(expected, name)
        np.testing.assert_allclose(one, other, atol=1e-7 * np.abs(other).max(), err_msg=name)
