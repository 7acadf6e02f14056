"""The model of the path of pairs: its costs against a slow loop, its places for none, its gradients, its learning."""

from __future__ import annotations

import doctest
import itertools
import math
from dataclasses import fields, replace

import pytest
import torch
from assemble_examples import RATE_HZ, times, turning
from conftest import REPO, assert_close
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_t
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble import path_weights
from sphereorient.assemble.path_weights import Frames, PathWeights, Weights
from sphereorient.errors import SettingsError, ShapeError

SIGMA = math.radians(0.3)
WEIGHTS = Weights(acceleration_rad_s2=math.radians(0.3) * RATE_HZ**2)


def movie(R: Tensor, *others: Tensor, nll: Tensor | None = None, seed: int = 0) -> Frames:
    """The true candidate, in place 0, with noise, and others."""
    rng = torch.Generator().manual_seed(seed)
    noise = so3.exp(SIGMA * torch.randn(len(R), 3, generator=rng, dtype=torch.float64))
    every = torch.stack([noise @ R, *others], 1)
    shape = every.shape[:2]
    return Frames(
        R_lab_body=every,
        nll=torch.zeros(shape, dtype=torch.float64) if nll is None else nll,
        variance_rad2=torch.full(shape, SIGMA**2, dtype=torch.float64),
        mask=torch.ones(shape, dtype=torch.bool),
        time_s=times(len(R)),
    )


def slow_cost(R: list[Rotation], variance: list[float], t: list[float], still: float, w: Weights) -> float:
    """Cost of three orientations in a row; `still`: ratio by which the third stands where one stood before."""
    span, dt = t[1] - t[0], t[2] - t[1]
    turn = (R[1] * R[0].inv()).as_rotvec()
    expected = Rotation.from_rotvec(turn * dt / span) * R[1]
    angle = (R[2] * expected.inv()).magnitude()
    drift = w.acceleration_rad_s2 * (span + dt) / 2 * dt
    r = dt / span
    spread = drift**2 + w.noise**2 * (variance[2] + (1 + r) ** 2 * variance[1] + r**2 * variance[0])
    chord = 2 * math.sin(angle / 2)
    ratio = 8 * math.pi**2 * multivariate_t.pdf([chord, 0, 0], shape=spread * torch.eye(3).numpy(), df=w.tail)
    ratio = ratio if spread < 1 else 1.0
    follows = (1 - w.outlier_probability) * ratio + w.outlier_probability
    return math.log((1 - w.stuck_probability) + w.stuck_probability * min(still, follows)) - math.log(follows)


def slow_still(R: list[Rotation], after: Rotation, variance: list[float], here: float, dt: float, w: Weights) -> float:
    ratios = []
    for before, error in zip(R, variance, strict=True):
        chord = 2 * math.sin((after * before.inv()).magnitude() / 2)
        spread = (w.acceleration_rad_s2 * dt**2) ** 2 + 3 * w.noise**2 * (error + here)
        ratios.append(
            8 * math.pi**2 * multivariate_t.pdf([chord, 0, 0], shape=spread * torch.eye(3).numpy(), df=w.tail)
        )
    return max(ratios)


def test_costs_of_triples_agree_with_a_slow_loop_at_uneven_times_and_over_a_hole(rng):
    w = replace(WEIGHTS, noise=1.3, tail=3.0, outlier_probability=0.02, stuck_probability=0.2)
    R = so3.exp(0.2 * torch.randn(5, 2, 3, generator=rng, dtype=torch.float64))
    variance = SIGMA**2 * (1 + torch.rand(5, 2, generator=rng, dtype=torch.float64))
    time = torch.tensor([0.0, 1.0, 2.5, 3.0, 4.0], dtype=torch.float64) / RATE_HZ
    mask = torch.ones(5, 2, dtype=torch.bool)
    mask[2] = False
    got = PathWeights(w).triple_costs(R, variance, time, mask).detach()
    turned = [[Rotation.from_matrix(each.numpy()) for each in frame] for frame in R]
    for a, b, c in ((0, 1, 3), (1, 3, 4)):
        for i, j, k in itertools.product(range(2), repeat=3):
            dt = float(time[c] - time[b])
            still = slow_still(turned[b], turned[c][k], variance[b].tolist(), float(variance[c, k]), dt, w)
            three = [turned[a][i], turned[b][j], turned[c][k]]
            errors = [float(variance[a, i]), float(variance[b, j]), float(variance[c, k])]
            expected = slow_cost(three, errors, [float(time[x]) for x in (a, b, c)], still, w)
            assert float(got[c - 2, i, j, k]) == pytest.approx(expected, abs=1e-7), (a, b, c, i, j, k)  # log's eps


def test_costs_do_not_depend_on_how_many_are_computed_at_once(rng, monkeypatch):
    R = so3.random_rotations((2, 7, 3), generator=rng)
    variance, time = torch.full((2, 7, 3), 1e-3, dtype=torch.float64), times(7).expand(2, 7)
    mask = torch.rand(2, 7, 3, generator=rng) < 0.8
    whole = PathWeights(WEIGHTS).triple_costs(R, variance, time, mask)
    monkeypatch.setattr(path_weights, "TRIPLES_AT_ONCE", 1)
    assert_close(PathWeights(WEIGHTS).triple_costs(R, variance, time, mask), whole)


@pytest.mark.parametrize("steps", [0, 1, 2])
def test_movies_too_short_for_a_triple_have_no_costs(steps):
    cost = PathWeights(WEIGHTS).triple_costs(
        torch.eye(3).expand(steps, 2, 3, 3), torch.ones(steps, 2), torch.arange(float(steps)), torch.ones(steps, 2) > 0
    )
    assert cost.shape == (0, 2, 2, 2)


def test_costs_are_the_same_in_single_precision_where_errors_are_small(rng):
    every = movie(turning(20, 20.0), so3.random_rotations(20, generator=rng))
    model = PathWeights(WEIGHTS)
    exact = model.triple_costs(every.R_lab_body, every.variance_rad2, every.time_s, every.mask)
    late = every.time_s + 20_000.0
    single = model.triple_costs(every.R_lab_body.float(), every.variance_rad2.float(), late, every.mask)
    assert single.dtype == torch.float32
    assert_close(single.double(), exact, 2e-3)


def test_the_true_candidate_is_found_among_false_ones_that_stand_and_that_are_anywhere(rng):
    R = turning(60, 4.0)
    standing = so3.random_rotations((), generator=rng).expand(60, 3, 3)
    every = movie(R, standing, so3.random_rotations(60, generator=rng))
    model = PathWeights(WEIGHTS)
    assert model.shortest_path(every).choice.tolist() == [0] * 60
    marginals = model.soft_path(every).marginals
    assert marginals.shape == (60, 4)
    assert (marginals[:, 0] > 0.97).all()


def test_frames_in_which_no_candidate_is_right_say_none_and_empty_frames_nothing(rng):
    R = turning(60, 4.0)
    R[20] = so3.random_rotations((), generator=rng)
    every = movie(R)
    every.mask[40:43] = False
    every.R_lab_body[40:43] = torch.eye(3, dtype=torch.float64)
    model = PathWeights(WEIGHTS)
    choice = model.shortest_path(every).choice
    assert choice[20] == 1
    assert choice[40:43].tolist() == [-1] * 3
    assert (choice == 0).sum() == 56
    marginals = model.soft_path(every).marginals
    assert marginals[20, 1] > 0.9
    assert not marginals[40:43].any()
    assert marginals[43, 0] > 0.9  # the motion goes on behind the hole


def test_what_the_pictures_say_decides_between_twins(rng):
    R = turning(30, 4.0)
    nll = torch.stack([torch.full((30,), 0.5), torch.zeros(30)], 1).double()
    half = so3.exp(torch.tensor([0.0, 0.0, torch.pi], dtype=torch.float64))
    every = movie(R, R @ half, nll=nll)
    every.R_lab_body[:, 1] = every.R_lab_body[:, 0] @ half  # exactly as smooth
    strong, weak = PathWeights(replace(WEIGHTS, quality=1.0)), PathWeights(replace(WEIGHTS, quality=1e-3))
    assert strong.shortest_path(every).choice.tolist() == [1] * 30
    assert strong.soft_path(every).marginals[15, 1] > 0.99
    assert abs(float(weak.soft_path(every).marginals[15, 1].detach()) - 0.5) < 0.02


def test_at_a_greater_temperature_less_is_sure(rng):
    every = movie(turning(30, 4.0), so3.random_rotations(30, generator=rng))
    sure = [
        float(PathWeights(replace(WEIGHTS, temperature=each)).soft_path(every).marginals[15, 0].detach())
        for each in (1.0, 4.0, 16.0)
    ]
    assert sure[0] > sure[1] > sure[2]


def test_a_batch_is_the_stack_of_its_movies(batch, rng):
    R = so3.random_rotations((*batch, 8, 2), generator=rng)
    parts = {
        "R_lab_body": R,
        "nll": torch.rand(*batch, 8, 2, generator=rng, dtype=torch.float64),
        "variance_rad2": torch.full((*batch, 8, 2), SIGMA**2, dtype=torch.float64),
        "mask": torch.rand(*batch, 8, 2, generator=rng) < 0.7,
        "time_s": (torch.arange(8) + 0.3 * torch.rand(*batch, 8, generator=rng)).double() / RATE_HZ,
    }
    model = PathWeights(WEIGHTS)
    together = model.soft_path(Frames(**parts)).marginals
    assert together.shape == (*batch, 8, 3)
    for at in itertools.product(*map(range, batch)):
        alone = model.soft_path(Frames(**{name: part[at] for name, part in parts.items()})).marginals
        assert_close(together[at], alone, 1e-10)


def test_gradients_of_all_weights_agree_with_differences(rng):
    nll = torch.rand(6, 2, generator=rng, dtype=torch.float64)
    every = movie(turning(6, 4.0), so3.random_rotations(6, generator=rng), nll=nll)
    every.mask[3] = False
    model = PathWeights(WEIGHTS)
    names = [entry.name for entry in fields(Weights)]
    raw = tuple(model.get_parameter(name).detach().clone().requires_grad_() for name in names)

    def marginals(*values: Tensor) -> Tensor:
        given = dict(zip(names, values, strict=True))
        return torch.func.functional_call(_Soft(model), {f"model.{name}": x for name, x in given.items()}, (every,))

    assert torch.autograd.gradcheck(marginals, raw)
    slopes = torch.autograd.grad(marginals(*raw).square().sum(), raw)
    assert [name for name, slope in zip(names, slopes, strict=True) if slope == 0] == []


class _Soft(torch.nn.Module):
    def __init__(self, model: PathWeights) -> None:
        super().__init__()
        self.model = model

    def forward(self, frames: Frames) -> Tensor:
        return self.model.soft_path(frames).marginals


def test_gradients_to_the_candidates_are_finite_also_where_they_coincide():
    R = torch.eye(3, dtype=torch.float64).repeat(5, 2, 1, 1).requires_grad_()
    nll = torch.zeros(5, 2, dtype=torch.float64, requires_grad=True)
    mask = torch.ones(5, 2, dtype=torch.bool)
    every = Frames(R_lab_body=R, nll=nll, variance_rad2=torch.full_like(nll, 1e-4).detach(), mask=mask, time_s=times(5))
    PathWeights(WEIGHTS).soft_path(every).marginals[:, 0].square().sum().backward()
    assert torch.isfinite(R.grad).all()
    assert torch.isfinite(nll.grad).all()


def test_a_noise_that_was_claimed_too_small_is_learnt(rng):
    every = movie(turning(150, 4.0), so3.random_rotations(150, generator=rng))
    claimed = replace(every, variance_rad2=every.variance_rad2 / 9)
    slow = replace(WEIGHTS, acceleration_rad_s2=1.0, tail=30.0)  # the motion is even: all misfit is noise
    model = PathWeights(slow)
    optimizer = torch.optim.Adam([model.get_parameter("noise")], lr=0.1)
    for _ in range(40):
        optimizer.zero_grad()
        soft = model.soft_path(claimed)
        soft.marginals[:, 0].log().mean().neg().backward()
        optimizer.step()
    first, last = PathWeights(slow).soft_path(claimed).marginals[:, 0], model.soft_path(claimed).marginals[:, 0]
    assert last.log().mean() > first.log().mean()
    assert model.weights().noise > 1.3


def test_weights_come_back_as_they_went_in_and_impossible_ones_are_refused():
    there = PathWeights(WEIGHTS).weights()
    for entry in fields(Weights):
        assert getattr(there, entry.name) == pytest.approx(getattr(WEIGHTS, entry.name), rel=1e-12)
    with pytest.raises(SettingsError, match="outlier_probability: expected above 0 and below 1, got 1"):
        replace(WEIGHTS, outlier_probability=1.0)
    with pytest.raises(SettingsError, match="noise: expected above 0, got -1"):
        replace(WEIGHTS, noise=-1.0)
    with pytest.raises(ShapeError, match=r"Frames\.nll: expected shape"):
        replace(movie(turning(4)), nll=torch.zeros(3, 1))


def test_the_example_of_the_page_runs():
    failed, tried = doctest.testfile(str(REPO / "docs" / "assembly.md"), module_relative=False)
    assert tried >= 12
    assert failed == 0
