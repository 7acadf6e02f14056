"""The cheapest path of both orders: against dijkstra and all paths, as a batch, and its gradient; the paper's edges."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import assert_close
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from torch import Tensor
from trellis_examples import ORDERS, Costs, all_paths, batched, cheapest, even_costs, random_costs, soft

from sphereorient import so3
from sphereorient.assemble import edge_costs, shortest_path, soft_path
from sphereorient.errors import ShapeError

SEEDS = range(6)
TIES = pytest.mark.parametrize("ties", [False, True], ids=["distinct", "ties"])


def by_dijkstra(edges: Tensor, mask: Tensor) -> float:
    """The same minimum from scipy: one node a candidate, a source before all and a sink behind."""
    steps, width = torch.nonzero(mask.any(-1))[:, 0].tolist(), mask.shape[1]
    if not steps:
        return 0.0
    source, sink = mask.numel(), mask.numel() + 1
    rows, columns, costs = [], [], []
    for a, b in itertools.pairwise(steps):
        for i, j in itertools.product(range(width), repeat=2):
            if mask[a, i] and mask[b, j]:
                rows.append(a * width + i)
                columns.append(b * width + j)
                costs.append(float(edges[b - 1, i, j]))
    for i in range(width):
        if mask[steps[0], i]:
            rows.append(source), columns.append(steps[0] * width + i), costs.append(1.0)
        if mask[steps[-1], i]:
            rows.append(steps[-1] * width + i), columns.append(sink), costs.append(1.0)
    graph = coo_matrix((np.array(costs), (rows, columns)), shape=(sink + 1, sink + 1)).tocsr()
    return float(dijkstra(graph, indices=source)[sink]) - 2.0


@TIES
@pytest.mark.parametrize("seed", SEEDS)
def test_cost_agrees_with_dijkstra_where_frames_are_empty_and_candidates_masked(seed, ties):
    costs = random_costs((60,), 5, seed, order=1)
    edges = costs.pair.abs() + 0.1
    edges = edges.round() if ties else edges
    path = shortest_path(edges, costs.mask)
    assert math.isclose(float(path.cost), by_dijkstra(edges, costs.mask), abs_tol=1e-10)
    there = path.choice >= 0
    assert torch.equal(there, costs.mask.any(-1))
    assert costs.mask[there].gather(1, path.choice[there, None]).all()


@ORDERS
@TIES
@pytest.mark.parametrize("seed", SEEDS)
def test_the_cheapest_path_is_taken_and_among_equal_ones_that_of_the_lowest_indices_from_the_end(seed, ties, order):
    costs = random_costs((7,), 3, seed, order=order, walls=0.15 * (seed % 2))
    costs = costs.each(torch.round) if ties else costs
    path, (steps, every) = cheapest(costs), all_paths(costs)
    least = min(every.values())
    assert_close(path.cost, torch.tensor(least, dtype=torch.float64), 1e-11)
    expected = torch.full((7,), -1)
    if least < float("inf"):
        best = [places for places, cost in every.items() if cost == least]
        expected[steps] = torch.tensor(min(best, key=lambda places: places[::-1]))
    assert torch.equal(path.choice, expected)


def test_edges_and_triples_are_in_the_order_of_time():
    pair = torch.full((1, 2, 2), 5.0)
    pair[0, 0, 1] = 1.0
    assert shortest_path(pair, torch.ones(2, 2) > 0).choice.tolist() == [0, 1]  # read backwards it would be 1, 0
    triple = torch.full((1, 2, 2, 2), 5.0)
    triple[0, 0, 1, 1] = 1.0
    assert shortest_path(None, torch.ones(3, 2) > 0, None, triple).choice.tolist() == [0, 1, 1]


def test_an_edge_over_an_empty_step_leads_from_the_step_before_it():
    edges = torch.full((2, 2, 2), 7.0)
    edges[0] = 0.0  # leads into the empty step: does not count
    edges[1, 1, 0] = 2.0
    mask = torch.tensor([[True, True], [False, False], [True, True]])
    path = shortest_path(edges, mask)
    assert path.choice.tolist() == [1, -1, 0]
    assert float(path.cost) == 2.0


@ORDERS
def test_a_batch_is_the_stack_of_its_movies(order, batch, dtype, tolerance):
    costs = random_costs((*batch, 12), 4, 3, order=order).each(lambda part: part.to(dtype))
    path = cheapest(costs)
    assert path.choice.shape == (*batch, 12)
    assert path.cost.shape == batch
    assert path.cost.dtype == dtype
    for at in itertools.product(*map(range, batch)):
        single = cheapest(costs[at])
        assert torch.equal(path.choice[at], single.choice)
        assert_close(path.cost[at], single.cost, 10 * tolerance)


@ORDERS
def test_movies_of_different_length_and_different_holes_give_in_a_batch_what_they_give_alone(order):
    singles = [random_costs((n,), 4, seed, order=order) for seed, n in enumerate([12, 9, 2, 1, 11])]
    whole = batched(singles)
    paths, softs = cheapest(whole), soft(whole)
    for row, costs in enumerate(singles):
        n, path, alone = len(costs.mask), cheapest(costs), soft(costs)
        assert torch.equal(paths.choice[row, :n], path.choice)
        assert (paths.choice[row, n:] == -1).all()
        assert_close(paths.cost[row], path.cost)
        assert_close(softs.free_energy[row], alone.free_energy)
        assert_close(softs.marginals[row, :n], alone.marginals)
        assert not softs.marginals[row, n:].any()


@ORDERS
@pytest.mark.parametrize("seed", SEEDS)
def test_single_precision_takes_the_same_path(order, seed):
    costs = random_costs((60,), 5, seed, order=order)
    path, expected = cheapest(costs.each(Tensor.float)), cheapest(costs)
    assert torch.equal(path.choice, expected.choice)
    assert path.cost.dtype == torch.float32
    assert_close(path.cost, expected.cost.float(), 1e-4)  # a sum of about 40 edges


@pytest.mark.parametrize("poison", [torch.inf, torch.nan, -100.0], ids=str)
def test_edges_of_masked_candidates_do_not_matter(poison):
    costs = random_costs((30,), 4, 1, order=1)
    edges, mask = costs.pair, costs.mask
    clean = shortest_path(edges, mask)
    held = torch.cummax(torch.where(mask.any(1), torch.arange(30), -1), 0).values[:-1]
    usable = mask[held.clamp_min(0)][:, :, None] & (held >= 0)[:, None, None] & mask[1:, None, :]
    spoilt = torch.where(usable, edges, poison).requires_grad_()
    dirty = shortest_path(spoilt, mask)
    assert torch.equal(dirty.choice, clean.choice)
    assert_close(dirty.cost.detach(), clean.cost)
    dirty.cost.backward()
    assert torch.isfinite(spoilt.grad).all()


@pytest.mark.parametrize("poison", [torch.inf, torch.nan, -100.0], ids=str)
def test_triples_of_masked_candidates_do_not_matter(poison, rng):
    cost = torch.rand(8, 3, 3, 3, dtype=torch.float64, generator=rng)
    mask = torch.arange(3) != torch.randint(0, 3, (10, 1), generator=rng)
    usable = mask[:-2, :, None, None] & mask[1:-1, None, :, None] & mask[2:, None, None, :]
    spoilt = torch.where(usable, cost, poison)
    clean, dirty = (soft_path(None, mask, triple_cost=one) for one in (cost, spoilt))
    assert_close(dirty.marginals, clean.marginals)
    assert torch.equal(*(shortest_path(None, mask, triple_cost=one).choice for one in (cost, spoilt)))


@ORDERS
@pytest.mark.parametrize(("steps", "width"), [(0, 3), (1, 3), (2, 2), (4, 0), (5, 1)])
def test_movies_without_steps_links_or_choice_are_data(order, steps, width):
    costs = even_costs(steps, width, order=order)
    path, found = cheapest(costs), soft(costs)
    least = max(steps - 1, 0) + max(steps - 2, 0) * (order - 1) if width else 0
    assert path.choice.tolist() == [0 if width else -1] * steps
    assert float(path.cost) == least
    assert found.marginals.shape == (steps, width)
    assert found.pair_marginals.shape == (max(steps - 1, 0), width, width)
    if steps and width:
        assert_close(found.marginals, torch.full((steps, width), 1 / width).double(), 1e-6)
        assert float(found.free_energy) == pytest.approx(least - steps * math.log(width), abs=1e-6)


@ORDERS
def test_costs_that_do_not_fit_the_mask_are_refused(order):
    costs = even_costs(4, 3, order=order)
    for name in costs.parts:
        for path in (cheapest, soft):
            with pytest.raises(ShapeError, match=f"{'edge' if name == 'pair' else name}_cost: expected"):
                path(replace(costs, **{name: torch.ones(7, *costs.parts[name].shape[1:])}))


def test_a_path_without_edges_and_triples_is_refused():
    with pytest.raises(ShapeError, match="edge_cost: expected costs"):
        shortest_path(None, torch.ones(4, 3, dtype=torch.bool))


@ORDERS
def test_gradient_of_the_least_cost_is_one_on_the_costs_of_the_path(order):
    costs = random_costs((2, 6), 2, 5, order=order).each(Tensor.requires_grad_)
    path = cheapest(costs)
    path.cost.sum().backward()
    taken = torch.nn.functional.one_hot(path.choice.clamp_min(0), 2) * (path.choice >= 0)[..., None]
    assert_close(costs.node.grad, taken.double())
    names, parts = zip(*costs.parts.items(), strict=True)
    assert torch.autograd.gradcheck(
        lambda *given: cheapest(Costs(mask=costs.mask, **dict(zip(names, given, strict=True)))).cost, parts
    )


def test_edge_cost_is_angle_times_doubt_over_seconds():
    turn = so3.exp(torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]], dtype=torch.float64))[:, None]
    score = torch.tensor([[0.9], [0.7]], dtype=torch.float64)
    cost = edge_costs(turn, score, torch.tensor([0.0, 0.01], dtype=torch.float64))
    assert_close(cost[0, 0, 0], torch.tensor(0.3 * (2 - 0.9 - 0.7) / 0.01, dtype=torch.float64))
    assert abs(float(cost[0, 0, 0]) - 0.3 * (2 - 0.9 - 0.7)) > 1.0  # a cost per frame, without the time


def test_edge_costs_agree_with_a_slow_loop_and_keep_dtype(rng, dtype):
    R = so3.random_rotations((4, 3), generator=rng, dtype=dtype)
    score = torch.rand(4, 3, generator=rng, dtype=torch.float64).to(dtype)
    time = torch.tensor([0.0, 0.1, 0.4, 0.5], dtype=dtype)
    cost = edge_costs(R, score, time)
    assert cost.dtype == dtype
    for k, i, j in itertools.product(range(3), range(3), range(3)):
        angle = so3.geodesic_distance(R[k, i], R[k + 1, j])
        expected = angle * (2 - score[k, i] - score[k + 1, j]) / (time[k + 1] - time[k])
        assert_close(cost[k, i, j], expected, 1e-4 if dtype == torch.float32 else 1e-12)


def test_edge_costs_of_a_batch_are_the_stack_of_single_ones(batch, rng):
    R = so3.random_rotations((*batch, 5, 2), generator=rng)
    score = torch.rand(*batch, 5, 2, generator=rng, dtype=torch.float64)
    time = torch.rand(*batch, 5, generator=rng, dtype=torch.float64).cumsum(-1) + torch.arange(5)
    cost = edge_costs(R, score, time)
    assert cost.shape == (*batch, 4, 2, 2)
    for at in itertools.product(*map(range, batch)):
        assert_close(cost[at], edge_costs(R[at], score[at], time[at]))


def test_edge_costs_do_not_depend_on_how_many_are_computed_at_once(rng):
    R = so3.random_rotations((6, 200), generator=rng)  # so many that one link is a piece of its own
    score, time = torch.rand(6, 200, generator=rng, dtype=torch.float64), torch.arange(6.0, dtype=torch.float64)
    few = slice(0, 3)
    assert_close(edge_costs(R, score, time)[:, few, few], edge_costs(R[:, few], score[:, few], time))


@pytest.mark.parametrize("steps", [0, 1])
def test_movies_too_short_for_a_link_have_no_edge_costs(steps):
    cost = edge_costs(torch.eye(3).expand(steps, 2, 3, 3), torch.ones(steps, 2), torch.arange(float(steps)))
    assert cost.shape == (0, 2, 2)


def test_edge_costs_have_finite_gradients_where_candidates_coincide():
    R = torch.eye(3, dtype=torch.float64).repeat(3, 2, 1, 1).requires_grad_()
    score = torch.full((3, 2), 0.8, dtype=torch.float64, requires_grad=True)
    edge_costs(R, score, torch.arange(3.0, dtype=torch.float64)).sum().backward()
    assert torch.isfinite(R.grad).all()
    assert torch.isfinite(score.grad).all()


def test_gradient_of_the_whole_movie_agrees_with_differences(rng):
    turn = 0.3 * torch.randn(5, 3, 3, generator=rng, dtype=torch.float64)  # rotation vectors, 5 frames, 3 candidates
    score = 0.5 + 0.4 * torch.rand(5, 3, generator=rng, dtype=torch.float64)
    time = torch.tensor([0.0, 1.0, 1.5, 3.0, 4.0], dtype=torch.float64)
    mask = torch.ones(5, 3, dtype=torch.bool)
    mask[1, 0], mask[3, 2] = False, False

    def cost(turn: Tensor, score: Tensor) -> Tensor:
        return shortest_path(edge_costs(so3.exp(turn), score, time), mask).cost

    assert torch.autograd.gradcheck(cost, (turn.requires_grad_(), score.requires_grad_()))


def test_edge_costs_keep_single_precision_beside_times_in_double(rng):
    R = so3.random_rotations((4, 3), generator=rng, dtype=torch.float32)
    late = 20_000.0 + torch.arange(4, dtype=torch.float64) / 600  # s; lost in single precision
    cost = edge_costs(R, torch.full((4, 3), 0.8), late)
    assert cost.dtype == torch.float32
    angle = so3.geodesic_distance(R[:-1, :, None], R[1:, None])
    assert_close(cost, angle * 0.4 * 600, 1e-2)  # rad/s of some hundred; whole steps of dt would be half off


def test_edge_costs_refuse_scores_of_other_frames():
    with pytest.raises(ShapeError, match="score: expected"):
        edge_costs(torch.eye(3).expand(4, 2, 3, 3), torch.ones(5, 2), torch.arange(4.0))
