"""The soft path of both orders: against all paths, its derivatives, its limits, and movies without a path."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
import torch
from conftest import assert_close
from torch import Tensor
from trellis_examples import ORDERS, Costs, cheapest, enumerated, random_costs, soft

from sphereorient import so3
from sphereorient.assemble import SoftPath, expected_orientation, shortest_path, soft_path
from sphereorient.errors import SettingsError

SEEDS = range(6)


@ORDERS
@pytest.mark.parametrize("temperature", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_everything_agrees_with_the_sum_over_all_paths(seed, temperature, order):
    costs = random_costs((7,), 3, seed, order=order, walls=0.2 * (seed % 2))
    found = soft(costs, temperature)
    free, marginals, pairs = enumerated(costs, temperature)
    assert_close(found.free_energy, free, 1e-11)
    assert_close(found.marginals, marginals)
    assert_close(found.pair_marginals, pairs)


def test_two_candidates_by_hand():
    # Paths into the second step: cost 0 to the first candidate, log 3 to the second: weights 1 and 1/3.
    edges = torch.full((1, 2, 2), torch.inf, dtype=torch.float64)
    edges[0, 0] = torch.tensor([1.0, 3.0], dtype=torch.float64).log()
    found = soft_path(edges, torch.ones(2, 2, dtype=torch.bool))
    assert_close(found.marginals, torch.tensor([[1.0, 0.0], [0.75, 0.25]], dtype=torch.float64))
    assert_close(found.free_energy, -torch.tensor(4 / 3, dtype=torch.float64).log())
    colder = soft_path(edges, torch.ones(2, 2, dtype=torch.bool), temperature=0.5)
    assert_close(colder.marginals[1], torch.tensor([0.9, 0.1], dtype=torch.float64))  # weights are squared


@ORDERS
@pytest.mark.parametrize("seed", SEEDS)
def test_marginals_are_the_gradient_of_the_free_energy(seed, order):
    costs = random_costs((3, 9), 4, seed, order=order).each(Tensor.requires_grad_)
    found = soft(costs, 0.7)
    of_node, of_pair = torch.autograd.grad(found.free_energy.sum(), (costs.node, costs.pair))
    assert_close(of_node, found.marginals.detach())
    assert_close(of_pair, found.pair_marginals.detach())


@ORDERS
@pytest.mark.parametrize("seed", SEEDS)
def test_marginals_are_probabilities_and_pairs_add_up_to_them(seed, order):
    costs = random_costs((2, 30), 5, seed, order=order, scale=3.0)
    found = soft(costs)
    visited = costs.mask.any(-1)
    assert_close(found.marginals.sum(-1), visited.double())
    assert not found.marginals[~costs.mask].any()
    entered = visited[..., 1:] & (visited.cumsum(-1)[..., :-1] > 0)
    assert_close(found.pair_marginals.sum(-2)[entered], found.marginals[..., 1:, :][entered])
    assert not found.pair_marginals[~entered].any()


@pytest.mark.slow
@ORDERS
@pytest.mark.parametrize("temperature", [0.5, 1.0, 4.0])
def test_first_and_second_derivatives_agree_with_differences(temperature, order):
    costs = random_costs((2, 5), 4 - order, order + 1, order=order).each(Tensor.requires_grad_)
    names, parts = zip(*costs.parts.items(), strict=True)

    def path(*given: Tensor) -> SoftPath:
        return soft(Costs(mask=costs.mask, **dict(zip(names, given, strict=True))), temperature)

    assert torch.autograd.gradcheck(lambda *x: path(*x).free_energy, parts)
    assert torch.autograd.gradgradcheck(lambda *x: path(*x).free_energy, parts)
    assert torch.autograd.gradcheck(lambda *x: path(*x).marginals, parts)
    assert torch.autograd.gradcheck(lambda *x: path(*x).pair_marginals, parts)


@pytest.mark.parametrize("seed", SEEDS[:4])
def test_without_costs_of_triples_the_second_order_is_the_first(seed):
    costs = random_costs((2, 15), 4, seed, order=1, walls=0.1)
    second = replace(costs, triple=torch.zeros(2, 13, 4, 4, 4, dtype=torch.float64))
    for name, value in vars(soft(second, 0.7)).items():
        assert_close(value, getattr(soft(costs, 0.7), name), 1e-11)
    assert torch.equal(cheapest(second).choice, cheapest(costs).choice)


def test_a_motion_that_goes_on_evenly_wins_over_one_that_stands_which_the_first_order_takes():
    # docs/errata.md A6 in one dimension: place 0 stands at 5, place 1 moves by 1 each step from 0.
    steps = 8
    at = torch.stack([torch.full((steps,), 5.0), torch.arange(float(steps))], -1)
    mask = torch.ones(steps, 2, dtype=torch.bool)
    speed = at[1:, None, :] - at[:-1, :, None]
    triple = (speed[1:, None, :, :] - speed[:-1, :, :, None]).abs()
    assert shortest_path(speed.abs(), mask).choice.tolist() == [0] * steps
    found = soft_path(None, mask, 1.0, None, triple)
    assert_close(found.marginals[0, 0], found.marginals[0, 1], 1e-6)  # neither of them accelerates: they are even
    late = triple + torch.tensor([0.4, 0.0])  # and a little from the pictures decides
    assert shortest_path(None, mask, None, late).choice.tolist() == [1] * steps


@ORDERS
@pytest.mark.parametrize("seed", SEEDS)
def test_towards_temperature_zero_only_the_shortest_path_is_left(seed, order):
    costs = random_costs((20,), 4, seed, order=order)
    path, found = cheapest(costs), soft(costs, 1e-5)
    assert_close(found.free_energy, path.cost, 1e-3)
    there = path.choice >= 0
    assert_close(found.marginals[there].gather(1, path.choice[there, None]), torch.ones(int(there.sum()), 1).double())


@ORDERS
def test_at_great_temperature_all_candidates_are_alike(order):
    costs = random_costs((20,), 4, 0, order=order)
    share = costs.mask / costs.mask.sum(-1, keepdim=True).clamp_min(1)
    assert_close(soft(costs, 1e9).marginals, share.double(), 1e-7)


@ORDERS
def test_a_batch_is_the_stack_of_its_movies(order, batch, dtype, tolerance):
    costs = random_costs((*batch, 12), 4, 3, order=order).each(lambda part: part.to(dtype))
    found = soft(costs)
    assert found.free_energy.shape == batch
    assert found.marginals.shape == (*batch, 12, 4)
    assert found.pair_marginals.shape == (*batch, 11, 4, 4)
    assert {found.free_energy.dtype, found.marginals.dtype, found.pair_marginals.dtype} == {dtype}
    for at in itertools.product(*map(range, batch)):
        for name, value in vars(soft(costs[at])).items():
            assert_close(getattr(found, name)[at], value, 10 * tolerance)


@ORDERS
@pytest.mark.parametrize("scale", [1e4, 1e-6])
def test_huge_costs_walls_and_empty_movies_have_finite_values_and_gradients(scale, order, dtype):
    costs = random_costs((4, 60), 4, 5, order=order, scale=scale, walls=0.1)
    costs.mask[0] = False
    costs = costs.each(lambda part: part.to(dtype).requires_grad_())
    found = soft(costs)
    assert float(found.free_energy[0].detach()) == 0.0
    assert not found.free_energy.isnan().any()
    loss = found.marginals.square().sum() + found.free_energy[~found.free_energy.isinf()].sum()
    loss.backward()
    for part in (found.marginals, found.pair_marginals, *(part.grad for part in costs.parts.values())):
        assert torch.isfinite(part).all()


@ORDERS
def test_where_no_path_is_left_there_is_no_probability_no_choice_and_no_gradient(order):
    costs = random_costs((2, 4), 2, 1, order=order)
    costs.mask[:] = True
    last = costs.triple if order == 2 else costs.pair
    last[0, 1] = torch.inf
    found, path = soft(costs.each(Tensor.requires_grad_)), cheapest(costs)
    assert torch.isinf(found.free_energy[0])
    assert torch.isinf(path.cost[0])
    assert not found.marginals[0].any()
    assert path.choice[0].tolist() == [-1] * 4
    (found.marginals.square().sum() + found.free_energy.sum()).backward()
    assert not last.grad[0].any()
    assert torch.isfinite(last.grad[1]).all()
    assert last.grad[1].any()


@pytest.mark.parametrize(("order", "poison"), [(1, torch.nan), *itertools.product((1, 2), (torch.inf, -1e5))], ids=str)
def test_values_at_masked_candidates_do_not_matter(poison, order):
    costs = random_costs((30,), 4, 1, order=order)

    def spoilt(part: Tensor) -> Tensor:
        into = costs.mask[30 - len(part) :, *[None] * (part.ndim - 2), :]
        return torch.where(into, part, poison).requires_grad_()

    dirty = costs.each(spoilt)
    found = soft(dirty)
    assert_close(found.marginals, soft(costs).marginals)
    found.marginals[3].square().sum().backward()
    assert all(torch.isfinite(part.grad).all() for part in dirty.parts.values())


@ORDERS
def test_long_movies_keep_their_digits_in_single_precision(order):
    rng = torch.Generator().manual_seed(0)
    costs = 20 * torch.rand(2000, *[3] * (order + 1), generator=rng, dtype=torch.float64) + 50
    mask = torch.ones(2000 + order, 3, dtype=torch.bool)

    def found(costs: Tensor) -> SoftPath:
        return soft_path(costs, mask) if order == 1 else soft_path(None, mask, triple_cost=costs)

    single, exact = found(costs.float()), found(costs)
    assert_close(single.marginals.double(), exact.marginals, 2e-5)  # of plain sums, 1e5 each, 1e-2 would be left
    assert_close(single.free_energy.double() / exact.free_energy, torch.ones((), dtype=torch.float64), 1e-6)


def test_the_same_graph_gives_the_same_bytes_each_time():
    costs = random_costs((3, 40), 5, 4, order=1).each(Tensor.requires_grad_)
    results = []
    for _ in range(3):
        found = soft(costs)
        (slope,) = torch.autograd.grad(found.marginals[:, ::3].square().sum(), costs.pair)
        results.append((found.marginals.detach(), found.pair_marginals.detach(), slope))
    for again in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], again, strict=True))


@pytest.mark.parametrize("temperature", [0.0, -1.0, float("nan")])
def test_impossible_temperatures_are_refused(temperature):
    with pytest.raises(SettingsError, match="temperature"):
        soft_path(torch.ones(3, 3, 3), torch.ones(4, 3, dtype=torch.bool), temperature)


def test_the_expected_orientation_of_a_sure_candidate_is_that_candidate(rng, dtype, tolerance):
    R = so3.random_rotations((2, 5, 3), generator=rng, dtype=dtype)
    sure = torch.nn.functional.one_hot(torch.tensor([0, 2, 1, 1, 0]), 3).to(dtype).expand(2, 5, 3)
    expected = torch.stack([R[:, k, int(sure[0, k].argmax())] for k in range(5)], 1)
    assert_close(expected_orientation(R, sure), expected, 5 * tolerance)


def test_the_expected_orientation_lies_between_its_candidates_by_their_weights():
    small = so3.exp(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.02]], dtype=torch.float64))
    mean = expected_orientation(small[None], torch.tensor([[0.25, 0.75]], dtype=torch.float64))
    assert_close(so3.log(mean[0]), torch.tensor([0.0, 0.0, 0.015], dtype=torch.float64), 1e-6)


def test_the_expected_orientation_turns_with_the_lab_and_is_nan_without_candidates(rng):
    R, weight = so3.random_rotations((6, 4), generator=rng), torch.rand(6, 4, generator=rng, dtype=torch.float64)
    turn = so3.random_rotations((), generator=rng)
    assert_close(expected_orientation(turn @ R, weight), turn @ expected_orientation(R, weight))
    weight[2] = 0
    R[3, 1] = torch.nan  # a place that is not in use
    weight[3, 1] = 0
    R.requires_grad_(), weight.requires_grad_()
    mean = expected_orientation(R, weight)
    assert mean[2].isnan().all()
    assert torch.isfinite(mean[[0, 1, 3, 4, 5]]).all()
    mean[[0, 1, 3, 4, 5]].sum().backward()
    assert torch.isfinite(R.grad).all()
    assert torch.isfinite(weight.grad).all()


def test_gradient_from_the_expected_orientation_to_the_costs_agrees_with_differences(rng):
    turn = 0.5 * torch.randn(5, 3, 3, generator=rng, dtype=torch.float64)
    edges = torch.randn(4, 3, 3, generator=rng, dtype=torch.float64)
    mask = torch.ones(5, 3, dtype=torch.bool)
    mask[2] = False

    def mean(turn: Tensor, edges: Tensor) -> Tensor:
        every = expected_orientation(so3.exp(turn), soft_path(edges, mask).marginals)
        return every[[0, 1, 3, 4]]

    assert torch.autograd.gradcheck(mean, (turn.requires_grad_(), edges.requires_grad_()))
