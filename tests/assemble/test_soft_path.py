"""The soft path of the first order: against all paths, its derivatives, its limits, and where nothing goes."""

from __future__ import annotations

import itertools

import pytest
import torch
from conftest import assert_close
from torch import Tensor
from trellis_examples import enumerated, random_costs

from sphereorient import so3
from sphereorient.assemble import SoftPath, expected_orientation, shortest_path, soft_path
from sphereorient.errors import SettingsError, ShapeError

SEEDS = range(6)


@pytest.mark.parametrize("temperature", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_everything_agrees_with_the_sum_over_all_paths(seed, temperature):
    costs = random_costs((7,), 3, seed, order=1, walls=0.2 * (seed % 2))
    soft = soft_path(costs.pair, costs.mask, temperature, costs.node)
    free, marginals, pairs = enumerated(costs, temperature)
    assert_close(soft.free_energy, free, 1e-11)
    assert_close(soft.marginals, marginals, 1e-12)
    assert_close(soft.pair_marginals, pairs, 1e-12)


def test_two_candidates_by_hand():
    # Paths into the second step: cost 0 to the first candidate, log 3 to the second: weights 1 and 1/3.
    edges = torch.tensor([[[0.0, 3.0]]], dtype=torch.float64).log1p().expand(1, 2, 2).clone()
    edges[0, 1] = torch.inf
    edges[0, 0] = torch.tensor([0.0, 3.0], dtype=torch.float64).clamp_min(1).log()
    soft = soft_path(edges, torch.ones(2, 2, dtype=torch.bool))
    assert_close(soft.marginals, torch.tensor([[1.0, 0.0], [0.75, 0.25]], dtype=torch.float64))
    assert_close(soft.free_energy, -torch.tensor(4 / 3, dtype=torch.float64).log())
    colder = soft_path(edges, torch.ones(2, 2, dtype=torch.bool), temperature=0.5)
    assert_close(colder.marginals[1], torch.tensor([0.9, 0.1], dtype=torch.float64))  # weights are squared


@pytest.mark.parametrize("seed", SEEDS)
def test_marginals_are_the_gradient_of_the_free_energy(seed):
    costs = random_costs((3, 9), 4, seed, order=1)
    node, edges = costs.node.clone().requires_grad_(), costs.pair.clone().requires_grad_()
    soft = soft_path(edges, costs.mask, 0.7, node)
    of_node, of_edge = torch.autograd.grad(soft.free_energy.sum(), (node, edges))
    assert_close(of_node, soft.marginals.detach())
    assert_close(of_edge, soft.pair_marginals.detach())


@pytest.mark.parametrize("seed", SEEDS)
def test_marginals_are_probabilities_and_pairs_add_up_to_them(seed):
    costs = random_costs((2, 30), 5, seed, order=1, scale=3.0)
    soft = soft_path(costs.pair, costs.mask, node_cost=costs.node)
    visited = costs.mask.any(-1)
    assert_close(soft.marginals.sum(-1), visited.double())
    assert not soft.marginals[~costs.mask].any()
    entered = visited[..., 1:] & (visited.cumsum(-1)[..., :-1] > 0)
    assert_close(soft.pair_marginals.sum(-2)[entered], soft.marginals[..., 1:, :][entered])
    assert not soft.pair_marginals[~entered].any()


def gradients_agree(temperature: float, seed: int) -> None:
    costs = random_costs((2, 5), 3, seed, order=1)
    inputs = costs.pair.clone().requires_grad_(), costs.node.clone().requires_grad_()

    def path(edges: Tensor, node: Tensor) -> SoftPath:
        return soft_path(edges, costs.mask, temperature, node)

    assert torch.autograd.gradcheck(lambda *x: path(*x).free_energy, inputs)
    assert torch.autograd.gradgradcheck(lambda *x: path(*x).free_energy, inputs)
    assert torch.autograd.gradcheck(lambda *x: path(*x).marginals, inputs)
    assert torch.autograd.gradcheck(lambda *x: path(*x).pair_marginals, inputs)


@pytest.mark.slow
@pytest.mark.parametrize("temperature", [0.5, 1.0, 4.0])
def test_first_and_second_derivatives_agree_with_differences(temperature):
    gradients_agree(temperature, seed=1)


@pytest.mark.parametrize("seed", SEEDS)
def test_towards_temperature_zero_only_the_shortest_path_is_left(seed):
    costs = random_costs((20,), 4, seed, order=1)
    path = shortest_path(costs.pair, costs.mask)
    soft = soft_path(costs.pair, costs.mask, temperature=1e-4)
    assert_close(soft.free_energy, path.cost, 1e-3)
    there = path.choice >= 0
    assert_close(soft.marginals[there].gather(1, path.choice[there, None]), torch.ones(int(there.sum()), 1).double())


def test_at_great_temperature_all_candidates_are_alike():
    costs = random_costs((20,), 4, 0, order=1)
    soft = soft_path(costs.pair, costs.mask, temperature=1e9)
    share = costs.mask / costs.mask.sum(-1, keepdim=True).clamp_min(1)
    assert_close(soft.marginals, share.double(), 1e-7)


def test_a_batch_is_the_stack_of_its_movies(batch, dtype, tolerance):
    costs = random_costs((*batch, 12), 4, 3, order=1)
    edges, node = costs.pair.to(dtype), costs.node.to(dtype)
    soft = soft_path(edges, costs.mask, 1.0, node)
    assert soft.free_energy.shape == batch
    assert soft.marginals.shape == (*batch, 12, 4)
    assert soft.pair_marginals.shape == (*batch, 11, 4, 4)
    assert {soft.free_energy.dtype, soft.marginals.dtype, soft.pair_marginals.dtype} == {dtype}
    for at in itertools.product(*map(range, batch)):
        single = soft_path(edges[at], costs.mask[at], 1.0, node[at])
        assert_close(soft.free_energy[at], single.free_energy, 10 * tolerance)
        assert_close(soft.marginals[at], single.marginals, tolerance)
        assert_close(soft.pair_marginals[at], single.pair_marginals, tolerance)


def test_movies_of_different_length_and_different_holes_give_in_a_batch_what_they_give_alone():
    lengths = [20, 13, 1, 17]
    singles = [random_costs((n,), 4, seed, order=1) for seed, n in enumerate(lengths)]
    edges = torch.full((4, 19, 4, 4), -50.0, dtype=torch.float64)  # padding that would be cheap
    mask, node = torch.zeros(4, 20, 4, dtype=torch.bool), torch.full((4, 20, 4), -50.0, dtype=torch.float64)
    for row, (n, costs) in enumerate(zip(lengths, singles, strict=True)):
        edges[row, : n - 1], mask[row, :n], node[row, :n] = costs.pair, costs.mask, costs.node
    together = soft_path(edges, mask, node_cost=node)
    for row, (n, costs) in enumerate(zip(lengths, singles, strict=True)):
        alone = soft_path(costs.pair, costs.mask, node_cost=costs.node)
        assert_close(together.free_energy[row], alone.free_energy)
        assert_close(together.marginals[row, :n], alone.marginals)
        assert not together.marginals[row, n:].any()


def test_an_edge_over_an_empty_step_leads_from_the_step_before_it():
    edges = torch.zeros(2, 2, 2, dtype=torch.float64)
    edges[0] = torch.inf  # leads into the empty step: does not count
    edges[1, 0, 1] = torch.inf
    mask = torch.tensor([[True, False], [False, False], [True, True]])
    soft = soft_path(edges, mask)
    assert soft.marginals.tolist() == [[1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]
    assert float(soft.free_energy) == 0.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [1e4, 1e-6])
def test_huge_costs_walls_and_empty_movies_have_finite_values_and_gradients(scale, dtype):
    costs = random_costs((4, 60), 4, 5, order=1, scale=scale, walls=0.2)
    mask = costs.mask.clone()
    mask[0] = False
    edges, node = costs.pair.to(dtype).requires_grad_(), costs.node.to(dtype).requires_grad_()
    soft = soft_path(edges, mask, node_cost=node)
    assert float(soft.free_energy[0].detach()) == 0.0
    assert not soft.free_energy.isnan().any()
    loss = soft.marginals.square().sum() + soft.free_energy[~soft.free_energy.isinf()].sum()
    loss.backward()
    for part in (soft.marginals, soft.pair_marginals, edges.grad, node.grad):
        assert torch.isfinite(part).all()


def test_where_no_path_is_left_there_is_no_probability_and_no_gradient():
    edges = torch.ones(2, 3, 2, 2, dtype=torch.float64)
    edges[0, 1] = torch.inf
    edges.requires_grad_()
    soft = soft_path(edges, torch.ones(2, 4, 2, dtype=torch.bool))
    assert torch.isinf(soft.free_energy[0])
    assert not soft.marginals[0].any()
    (soft.marginals.sum() + soft.free_energy.sum()).backward()
    assert not edges.grad[0].any()
    assert torch.isfinite(edges.grad[1]).all()
    assert edges.grad[1].any()


@pytest.mark.parametrize("poison", [torch.inf, torch.nan, -1e5], ids=str)
def test_what_stands_at_masked_candidates_does_not_matter(poison):
    costs = random_costs((30,), 4, 1, order=1)
    clean = soft_path(costs.pair, costs.mask, node_cost=costs.node)
    edges = torch.where(costs.mask[1:, None, :], costs.pair, poison).requires_grad_()
    node = torch.where(costs.mask, costs.node, poison).requires_grad_()
    dirty = soft_path(edges, costs.mask, node_cost=node)
    assert_close(dirty.marginals, clean.marginals)
    dirty.marginals[3].square().sum().backward()
    assert torch.isfinite(edges.grad).all()
    assert torch.isfinite(node.grad).all()


def test_long_movies_keep_their_digits_in_single_precision():
    rng = torch.Generator().manual_seed(0)
    edges = 20 * torch.rand(3000, 3, 3, generator=rng, dtype=torch.float64) + 50
    mask = torch.ones(3001, 3, dtype=torch.bool)
    soft, exact = soft_path(edges.float(), mask), soft_path(edges, mask)
    assert_close(soft.marginals.double(), exact.marginals, 2e-5)  # of plain sums, 1.5e5 each, 1e-2 would be left
    assert_close(soft.free_energy.double() / exact.free_energy, torch.ones((), dtype=torch.float64), 1e-6)


def test_the_same_graph_gives_the_same_bytes_each_time():
    costs = random_costs((3, 40), 5, 4, order=1)
    edges = costs.pair.clone().requires_grad_()
    results = []
    for _ in range(3):
        soft = soft_path(edges, costs.mask)
        (slope,) = torch.autograd.grad(soft.marginals[:, ::3].square().sum(), edges)
        results.append((soft.marginals.detach(), soft.pair_marginals.detach(), slope))
    for again in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], again, strict=True))


@pytest.mark.parametrize(("steps", "width"), [(0, 3), (1, 3), (4, 0), (5, 1)])
def test_movies_without_steps_links_or_choice_are_data(steps, width):
    soft = soft_path(torch.ones(max(steps - 1, 0), width, width), torch.ones(steps, width, dtype=torch.bool))
    assert soft.marginals.shape == (steps, width)
    assert soft.pair_marginals.shape == (max(steps - 1, 0), width, width)
    if steps and width:
        assert_close(soft.marginals, torch.full((steps, width), 1 / width), 1e-6)
        assert float(soft.free_energy) == pytest.approx(steps - 1 - torch.tensor(width).log().item(), abs=1e-6)


def test_costs_that_do_not_fit_and_impossible_temperatures_are_refused():
    mask = torch.ones(4, 3, dtype=torch.bool)
    with pytest.raises(ShapeError, match="edge_cost: expected"):
        soft_path(torch.ones(4, 3, 3), mask)
    with pytest.raises(ShapeError, match="node_cost: expected"):
        soft_path(torch.ones(3, 3, 3), mask, node_cost=torch.ones(4, 2))
    for temperature in (0.0, -1.0, float("nan")):
        with pytest.raises(SettingsError, match="temperature: expected"):
            soft_path(torch.ones(3, 3, 3), mask, temperature)


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
