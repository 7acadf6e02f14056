"""The trellis of pairs: against all paths, against the first order, its derivatives, holes and walls."""

from __future__ import annotations

import itertools

import pytest
import torch
from conftest import assert_close
from torch import Tensor
from trellis_examples import all_paths, enumerated, random_costs

from sphereorient.assemble import ShortestPath, SoftPath, shortest_path, soft_path
from sphereorient.errors import ShapeError

SEEDS = range(8)


def shortest_path_of_pairs(
    triple: Tensor, mask: Tensor, pair_cost: Tensor | None = None, node_cost: Tensor | None = None
) -> ShortestPath:
    return shortest_path(pair_cost, mask, node_cost, triple)


def soft_path_of_pairs(
    triple: Tensor,
    mask: Tensor,
    temperature: float = 1.0,
    pair_cost: Tensor | None = None,
    node_cost: Tensor | None = None,
) -> SoftPath:
    return soft_path(pair_cost, mask, temperature, node_cost, triple)


@pytest.mark.parametrize("temperature", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_everything_agrees_with_the_sum_over_all_paths(seed, temperature):
    costs = random_costs((7,), 3, seed, order=2, walls=0.15 * (seed % 2))
    soft = soft_path_of_pairs(costs.triple, costs.mask, temperature, costs.pair, costs.node)
    free, marginals, pairs = enumerated(costs, temperature)
    assert_close(soft.free_energy, free, 1e-11)
    assert_close(soft.marginals, marginals)
    assert_close(soft.pair_marginals, pairs)


@pytest.mark.parametrize("seed", SEEDS)
def test_no_path_of_all_paths_is_cheaper(seed):
    costs = random_costs((7,), 3, seed, order=2, walls=0.15 * (seed % 2))
    path = shortest_path_of_pairs(costs.triple, costs.mask, costs.pair, costs.node)
    steps, every = all_paths(costs)
    least = min(every.values())
    assert_close(path.cost, torch.tensor(least, dtype=torch.float64), 1e-11)
    expected = torch.full((7,), -1)
    if least < float("inf"):
        expected[steps] = torch.tensor(min(every, key=every.__getitem__))
    assert torch.equal(path.choice, expected)


@pytest.mark.parametrize("seed", SEEDS)
def test_of_equally_cheap_paths_the_one_with_the_lowest_indices_from_the_end_is_taken(seed):
    costs = random_costs((6,), 3, seed, order=2)
    triple = costs.triple.round().clamp(0, 1)
    path = shortest_path_of_pairs(triple, costs.mask)
    zero = type(costs)(mask=costs.mask, pair=0 * costs.pair, node=0 * costs.node, triple=triple)
    _, every = all_paths(zero)
    least = min(every.values())
    lowest = min((places for places, cost in every.items() if cost == least), key=lambda places: places[::-1])
    assert tuple(path.choice[path.choice >= 0].tolist()) == lowest


def test_the_axes_of_a_triple_are_in_the_order_of_time():
    triple = torch.full((1, 2, 2, 2), 5.0)
    triple[0, 0, 1, 1] = 1.0
    mask = torch.ones(3, 2, dtype=torch.bool)
    assert shortest_path_of_pairs(triple, mask).choice.tolist() == [0, 1, 1]  # read backwards it would be 1, 1, 0
    soft = soft_path_of_pairs(triple, mask, temperature=0.01)
    assert_close(soft.marginals, torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]), 1e-6)


@pytest.mark.parametrize("seed", SEEDS[:4])
def test_without_costs_of_triples_it_is_the_first_order(seed):
    costs = random_costs((2, 15), 4, seed, order=2, walls=0.1)
    none = torch.zeros_like(costs.triple)
    first = soft_path(costs.pair, costs.mask, 0.7, costs.node)
    second = soft_path_of_pairs(none, costs.mask, 0.7, costs.pair, costs.node)
    assert_close(second.free_energy, first.free_energy, 1e-11)
    assert_close(second.marginals, first.marginals)
    assert_close(second.pair_marginals, first.pair_marginals)
    cheapest = shortest_path(costs.pair, costs.mask)
    assert torch.equal(shortest_path_of_pairs(none, costs.mask, costs.pair).choice, cheapest.choice)


def test_a_motion_that_goes_on_evenly_wins_over_one_that_stands_which_the_first_order_takes():
    # docs/errata.md A6 in one dimension: place 0 stands at 5, place 1 moves by 1 each step from 0.
    steps = 8
    at = torch.stack([torch.full((steps,), 5.0), torch.arange(float(steps))], -1)
    mask = torch.ones(steps, 2, dtype=torch.bool)
    pair = (at[1:, None, :] - at[:-1, :, None]).abs()
    speed = at[1:, None, :] - at[:-1, :, None]
    triple = (speed[1:, None, :, :] - speed[:-1, :, :, None]).abs()
    assert shortest_path(pair, mask).choice.tolist() == [0] * steps
    soft = soft_path_of_pairs(triple, mask)
    assert_close(soft.marginals[0, 0], soft.marginals[0, 1], 1e-6)  # neither of them accelerates: they are even
    late = triple + torch.tensor([0.4, 0.0])  # and a little from the pictures decides
    assert shortest_path_of_pairs(late, mask).choice.tolist() == [1] * steps


def test_marginals_are_the_gradient_of_the_free_energy():
    costs = random_costs((3, 9), 3, 1, order=2)
    node, pair = costs.node.clone().requires_grad_(), costs.pair.clone().requires_grad_()
    soft = soft_path_of_pairs(costs.triple, costs.mask, 0.7, pair, node)
    of_node, of_pair = torch.autograd.grad(soft.free_energy.sum(), (node, pair))
    assert_close(of_node, soft.marginals.detach())
    assert_close(of_pair, soft.pair_marginals.detach())


@pytest.mark.slow
@pytest.mark.parametrize("temperature", [0.5, 1.0, 4.0])
def test_first_and_second_derivatives_agree_with_differences(temperature):
    costs = random_costs((2, 5), 2, 3, order=2)
    inputs = tuple(part.clone().requires_grad_() for part in (costs.triple, costs.pair, costs.node))

    def path(triple: Tensor, pair: Tensor, node: Tensor) -> SoftPath:
        return soft_path_of_pairs(triple, costs.mask, temperature, pair, node)

    assert torch.autograd.gradcheck(lambda *x: path(*x).free_energy, inputs)
    assert torch.autograd.gradgradcheck(lambda *x: path(*x).free_energy, inputs)
    assert torch.autograd.gradcheck(lambda *x: path(*x).marginals, inputs)
    assert torch.autograd.gradcheck(lambda *x: path(*x).pair_marginals, inputs)


def test_gradient_of_the_least_cost_is_one_on_what_the_path_pays():
    costs = random_costs((3, 6), 2, 2, order=2)
    inputs = tuple(part.clone().requires_grad_() for part in (costs.triple, costs.pair, costs.node))
    path = shortest_path_of_pairs(inputs[0], costs.mask, inputs[1], inputs[2])
    path.cost.sum().backward()
    taken = torch.nn.functional.one_hot(path.choice.clamp_min(0), 2) * (path.choice >= 0)[..., None]
    assert_close(inputs[2].grad, taken.double())
    assert torch.autograd.gradcheck(lambda *x: shortest_path_of_pairs(x[0], costs.mask, x[1], x[2]).cost, inputs)


@pytest.mark.parametrize("seed", SEEDS[:4])
def test_towards_temperature_zero_only_the_shortest_path_is_left(seed):
    costs = random_costs((20,), 3, seed, order=2)
    path = shortest_path_of_pairs(costs.triple, costs.mask)
    soft = soft_path_of_pairs(costs.triple, costs.mask, temperature=1e-4)
    assert_close(soft.free_energy, path.cost, 1e-3)
    there = path.choice >= 0
    assert_close(soft.marginals[there].gather(1, path.choice[there, None]), torch.ones(int(there.sum()), 1).double())


def test_a_batch_is_the_stack_of_its_movies(batch, dtype, tolerance):
    costs = random_costs((*batch, 9), 3, 3, order=2)
    triple, pair, node = (part.to(dtype) for part in (costs.triple, costs.pair, costs.node))
    soft, path = soft_path_of_pairs(triple, costs.mask, 1.0, pair, node), shortest_path_of_pairs(triple, costs.mask)
    assert soft.marginals.shape == (*batch, 9, 3)
    assert path.choice.shape == (*batch, 9)
    assert path.cost.dtype == soft.marginals.dtype == dtype
    for at in itertools.product(*map(range, batch)):
        single = soft_path_of_pairs(triple[at], costs.mask[at], 1.0, pair[at], node[at])
        assert_close(soft.free_energy[at], single.free_energy, 10 * tolerance)
        assert_close(soft.marginals[at], single.marginals, tolerance)
        assert torch.equal(path.choice[at], shortest_path_of_pairs(triple[at], costs.mask[at]).choice)


def test_movies_of_different_length_and_different_holes_give_in_a_batch_what_they_give_alone():
    lengths = [12, 2, 1, 9, 7]
    singles = [random_costs((n,), 3, seed, order=2) for seed, n in enumerate(lengths)]
    triple, pair = torch.full((5, 10, 3, 3, 3), -9.0).double(), torch.full((5, 11, 3, 3), -9.0).double()
    mask = torch.zeros(5, 12, 3, dtype=torch.bool)
    for row, (n, costs) in enumerate(zip(lengths, singles, strict=True)):
        triple[row, : max(n - 2, 0)], pair[row, : n - 1], mask[row, :n] = costs.triple, costs.pair, costs.mask
    together, path = soft_path_of_pairs(triple, mask, 1.0, pair), shortest_path_of_pairs(triple, mask, pair)
    for row, (n, costs) in enumerate(zip(lengths, singles, strict=True)):
        alone = soft_path_of_pairs(costs.triple, costs.mask, 1.0, costs.pair)
        assert_close(together.free_energy[row], alone.free_energy)
        assert_close(together.marginals[row, :n], alone.marginals)
        assert not together.marginals[row, n:].any()
        least = shortest_path_of_pairs(costs.triple, costs.mask, costs.pair)
        assert torch.equal(path.choice[row, :n], least.choice)
        assert_close(path.cost[row], least.cost)


def test_huge_costs_walls_and_empty_movies_have_finite_values_and_gradients(dtype):
    costs = random_costs((4, 30), 3, 5, order=2, scale=1e4, walls=0.1)
    mask = costs.mask.clone()
    mask[0] = False
    triple, node = costs.triple.to(dtype).requires_grad_(), costs.node.to(dtype).requires_grad_()
    soft = soft_path_of_pairs(triple, mask, node_cost=node)
    assert not soft.free_energy.isnan().any()
    (soft.marginals.square().sum() + soft.free_energy[~soft.free_energy.isinf()].sum()).backward()
    for part in (soft.marginals, soft.pair_marginals, triple.grad, node.grad):
        assert torch.isfinite(part).all()


def test_where_no_path_is_left_there_is_no_probability_and_no_choice():
    triple = torch.full((2, 2, 2, 2), torch.inf, dtype=torch.float64, requires_grad=True)
    mask = torch.ones(4, 2, dtype=torch.bool)
    soft, path = soft_path_of_pairs(triple, mask), shortest_path_of_pairs(triple, mask)
    assert torch.isinf(soft.free_energy)
    assert torch.isinf(path.cost)
    assert not soft.marginals.any()
    assert path.choice.tolist() == [-1] * 4
    soft.marginals.sum().backward()
    assert not triple.grad.any()


def test_single_precision_is_close_to_double_in_long_movies():
    rng = torch.Generator().manual_seed(0)
    triple = 20 * torch.rand(2000, 3, 3, 3, generator=rng, dtype=torch.float64) + 50
    mask = torch.ones(2002, 3, dtype=torch.bool)
    soft, exact = soft_path_of_pairs(triple.float(), mask), soft_path_of_pairs(triple, mask)
    assert_close(soft.marginals.double(), exact.marginals, 2e-5)


@pytest.mark.parametrize(("steps", "width"), [(0, 3), (1, 3), (2, 2), (4, 0), (5, 1)])
def test_movies_without_steps_links_or_choice_are_data(steps, width):
    triple = torch.ones(max(steps - 2, 0), width, width, width)
    mask = torch.ones(steps, width, dtype=torch.bool)
    soft, path = soft_path_of_pairs(triple, mask), shortest_path_of_pairs(triple, mask)
    assert soft.marginals.shape == (steps, width)
    assert path.choice.tolist() == [0 if width else -1] * steps
    if steps and width:
        assert_close(soft.marginals, torch.full((steps, width), 1 / width), 1e-6)
    assert float(path.cost) == (max(steps - 2, 0) if width else 0)


def test_costs_that_do_not_fit_the_mask_are_refused():
    with pytest.raises(ShapeError, match="triple_cost: expected"):
        soft_path_of_pairs(torch.ones(4, 3, 3, 3), torch.ones(4, 3, dtype=torch.bool))
    with pytest.raises(ShapeError, match="edge_cost: expected"):
        shortest_path_of_pairs(
            torch.ones(2, 3, 3, 3), torch.ones(4, 3, dtype=torch.bool), pair_cost=torch.ones(2, 3, 3)
        )


def test_a_path_without_edges_and_triples_is_refused():
    with pytest.raises(ShapeError, match="edge_cost: expected costs of edges or triples"):
        shortest_path(None, torch.ones(4, 3, dtype=torch.bool))
