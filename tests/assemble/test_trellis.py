"""The cheapest path: against dijkstra and against all paths, as a batch, at the edges, and its gradient."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from conftest import assert_close
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble import edge_costs, shortest_path, trellis
from sphereorient.errors import ShapeError

SEEDS = range(6)


def random_graph(
    shape: tuple[int, ...], width: int, seed: int, *, ties: bool = False, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor]:
    """Edge costs and mask with holes anywhere, the ends too; whole numbers where ties are wanted."""
    rng = torch.Generator().manual_seed(seed)
    *batch, steps = shape
    edges = torch.rand(*batch, max(steps - 1, 0), width, width, generator=rng, dtype=torch.float64) + 0.1
    if ties:
        edges = (3 * edges).round()
    mask = torch.rand(*shape, width, generator=rng) < 0.7
    mask &= torch.rand(*shape, 1, generator=rng) < 0.75
    return edges.to(dtype), mask


def visited(mask: Tensor) -> list[int]:
    return torch.nonzero(mask.any(-1))[:, 0].tolist()


def cost_of(edges: Tensor, steps: list[int], places: tuple[int, ...]) -> float:
    """Cost of one path: the edges that enter a step come from the step visited last."""
    return sum(float(edges[step - 1, a, b]) for step, a, b in zip(steps[1:], places[:-1], places[1:], strict=True))


def all_paths(edges: Tensor, mask: Tensor) -> dict[tuple[int, ...], float]:
    steps = visited(mask)
    open_places = [torch.nonzero(mask[step])[:, 0].tolist() for step in steps]
    return {places: cost_of(edges, steps, places) for places in itertools.product(*open_places)}


def by_dijkstra(edges: Tensor, mask: Tensor) -> float:
    """The same minimum from scipy: one node a candidate, a source before all and a sink behind."""
    steps, width = visited(mask), mask.shape[1]
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


def assert_is_a_path(choice: Tensor, mask: Tensor) -> None:
    there = choice >= 0
    assert torch.equal(there, mask.any(-1))
    assert mask[there].gather(1, choice[there, None]).all()


@pytest.mark.parametrize("ties", [False, True], ids=["distinct", "ties"])
@pytest.mark.parametrize("seed", SEEDS)
def test_cost_agrees_with_dijkstra_where_frames_are_empty_and_candidates_masked(seed, ties):
    edges, mask = random_graph((60,), 5, seed, ties=ties)
    path = shortest_path(edges, mask)
    assert math.isclose(float(path.cost), by_dijkstra(edges, mask), abs_tol=1e-10)
    assert_is_a_path(path.choice, mask)


@pytest.mark.parametrize("ties", [False, True], ids=["distinct", "ties"])
@pytest.mark.parametrize("seed", SEEDS)
def test_no_path_of_all_paths_is_cheaper(seed, ties):
    edges, mask = random_graph((8,), 3, seed, ties=ties)
    path = shortest_path(edges, mask)
    every = all_paths(edges, mask)
    assert math.isclose(float(path.cost), min(every.values()), abs_tol=1e-12)
    places = tuple(path.choice[path.choice >= 0].tolist())
    assert math.isclose(every[places], min(every.values()), abs_tol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_of_equally_cheap_paths_the_one_with_the_lowest_indices_from_the_end_is_taken(seed):
    edges, mask = random_graph((7,), 3, seed, ties=True)
    every = all_paths(edges, mask)
    least = min(every.values())
    lowest_from_the_end = min((places for places, cost in every.items() if cost == least), key=lambda p: p[::-1])
    choice = shortest_path(edges, mask).choice
    assert tuple(choice[choice >= 0].tolist()) == lowest_from_the_end


def test_all_costs_equal_gives_the_first_open_candidate_everywhere():
    mask = torch.tensor([[True, True], [False, True], [True, True]])
    path = shortest_path(torch.ones(2, 2, 2), mask)
    assert path.choice.tolist() == [0, 1, 0]
    assert float(path.cost) == 2.0


def test_the_minimum_is_global_and_not_the_cheapest_next_step():
    edges = torch.tensor([[[1.0, 2.0], [9.0, 9.0]], [[9.0, 9.0], [1.0, 9.0]]])
    path = shortest_path(edges, torch.ones(3, 2, dtype=torch.bool))
    assert path.choice.tolist() == [0, 1, 0]  # a greedy walk goes 0, 0, 0 and pays 10
    assert float(path.cost) == 3.0


def test_rows_are_where_an_edge_comes_from_and_columns_where_it_goes():
    edges = torch.full((1, 2, 2), 5.0)
    edges[0, 0, 1] = 1.0
    choice = shortest_path(edges, torch.ones(2, 2, dtype=torch.bool)).choice
    assert choice.tolist() == [0, 1]
    assert choice.tolist() != [1, 0]  # the other reading


def test_an_edge_over_an_empty_step_leads_from_the_step_before_it():
    edges = torch.full((2, 2, 2), 7.0)
    edges[0] = 0.0  # leads into the empty step: does not count
    edges[1, 1, 0] = 2.0
    mask = torch.tensor([[True, True], [False, False], [True, True]])
    path = shortest_path(edges, mask)
    assert path.choice.tolist() == [1, -1, 0]
    assert float(path.cost) == 2.0


def test_a_batch_is_the_stack_of_its_movies(batch, dtype):
    edges, mask = random_graph((*batch, 12), 4, 3, dtype=dtype)
    path = shortest_path(edges, mask)
    assert path.choice.shape == (*batch, 12)
    assert path.cost.shape == batch
    assert path.cost.dtype == dtype
    for at in itertools.product(*map(range, batch)):
        single = shortest_path(edges[at], mask[at])
        assert torch.equal(path.choice[at], single.choice)
        assert_close(path.cost[at], single.cost)


def test_movies_of_different_length_and_different_holes_give_in_a_batch_what_they_give_alone():
    lengths = [20, 13, 1, 17]
    singles = [random_graph((n,), 4, seed) for seed, n in enumerate(lengths)]
    edges = torch.full((len(lengths), 19, 4, 4), 1e-3, dtype=torch.float64)  # padding that would be cheap
    mask = torch.zeros(len(lengths), 20, 4, dtype=torch.bool)
    for row, (n, (edge, here)) in enumerate(zip(lengths, singles, strict=True)):
        edges[row, : n - 1], mask[row, :n] = edge, here
    together = shortest_path(edges, mask)
    for row, (n, (edge, here)) in enumerate(zip(lengths, singles, strict=True)):
        alone = shortest_path(edge, here)
        assert torch.equal(together.choice[row, :n], alone.choice)
        assert (together.choice[row, n:] == -1).all()
        assert_close(together.cost[row], alone.cost)


def test_steps_before_the_first_and_behind_the_last_candidate_do_not_count():
    edges, _ = random_graph((9,), 3, 0)
    mask = torch.ones(9, 3, dtype=torch.bool)
    mask[:2], mask[7:] = False, False
    path, middle = shortest_path(edges, mask), shortest_path(edges[2:6], mask[2:7])
    assert path.choice.tolist() == [-1, -1, *middle.choice.tolist(), -1, -1]
    assert_close(path.cost, middle.cost)


@pytest.mark.parametrize("seed", SEEDS)
def test_single_precision_takes_the_same_path(seed):
    edges, mask = random_graph((60,), 5, seed)
    path, expected = shortest_path(edges.float(), mask), shortest_path(edges, mask)
    assert torch.equal(path.choice, expected.choice)
    assert path.cost.dtype == torch.float32
    assert_close(path.cost, expected.cost.float(), 1e-4)  # a sum of about 40 edges


@pytest.mark.parametrize("ties", [False, True], ids=["distinct", "ties"])
def test_the_same_graph_gives_the_same_path_each_time(ties):
    edges, mask = random_graph((2, 1, 3, 40), 5, 4, ties=ties)
    first = shortest_path(edges, mask)
    for _ in range(5):
        again = shortest_path(edges.clone(), mask.clone())
        assert torch.equal(again.choice, first.choice)
        assert torch.equal(again.cost, first.cost)


@pytest.mark.parametrize("poison", [torch.inf, torch.nan, -100.0], ids=str)
def test_what_stands_on_edges_of_masked_candidates_does_not_matter(poison):
    edges, mask = random_graph((30,), 4, 1)
    clean = shortest_path(edges, mask)
    held = torch.cummax(torch.where(mask.any(1), torch.arange(30), -1), 0).values[:-1]
    usable = mask[held.clamp_min(0)][:, :, None] & (held >= 0)[:, None, None] & mask[1:, None, :]
    dirty = shortest_path(torch.where(usable, edges, poison), mask)
    assert torch.equal(dirty.choice, clean.choice)
    assert_close(dirty.cost, clean.cost)


def test_infinite_edges_are_avoided_and_where_they_cannot_be_there_is_no_path():
    edges = torch.ones(3, 2, 2)
    edges[1, 0] = torch.inf
    mask = torch.ones(4, 2, dtype=torch.bool)
    assert shortest_path(edges, mask).choice[1] == 1
    edges[1] = torch.inf
    path = shortest_path(edges, mask)
    assert torch.isinf(path.cost)
    assert (path.choice == -1).all()


@pytest.mark.parametrize(("steps", "width"), [(0, 3), (1, 3), (4, 0), (5, 1)])
def test_movies_without_steps_links_or_choice_are_data(steps, width):
    path = shortest_path(torch.ones(max(steps - 1, 0), width, width), torch.ones(steps, width, dtype=torch.bool))
    assert path.choice.tolist() == [0 if width else -1] * steps
    assert float(path.cost) == (max(steps - 1, 0) if width else 0)


def test_a_movie_without_candidates_costs_nothing_and_chooses_nothing():
    path = shortest_path(torch.ones(4, 3, 3), torch.zeros(5, 3, dtype=torch.bool))
    assert path.choice.tolist() == [-1] * 5
    assert float(path.cost) == 0.0


def test_costs_that_do_not_fit_the_mask_are_refused():
    with pytest.raises(ShapeError, match="edge_cost: expected"):
        shortest_path(torch.ones(4, 3, 3), torch.ones(4, 3, dtype=torch.bool))


@pytest.mark.parametrize("seed", SEEDS)
def test_gradient_of_the_cost_is_one_on_the_edges_taken_and_zero_elsewhere(seed):
    edges, mask = random_graph((15,), 4, seed)
    edges.requires_grad_()
    path = shortest_path(edges, mask)
    path.cost.backward()
    expected = torch.zeros_like(edges)
    steps = visited(mask)
    for a, b in itertools.pairwise(steps):
        expected[b - 1, path.choice[a], path.choice[b]] = 1.0
    assert torch.equal(edges.grad, expected)


def test_gradient_agrees_with_differences():
    edges, mask = random_graph((3, 9), 3, 5)
    edges.requires_grad_()
    assert torch.autograd.gradcheck(lambda e: shortest_path(e, mask).cost, (edges,))


def test_gradient_is_finite_where_padding_is_infinite():
    edges, mask = random_graph((10,), 3, 2)
    edges = torch.where(mask[1:, None, :], edges, torch.inf).requires_grad_()
    shortest_path(edges, mask).cost.backward()
    assert torch.isfinite(edges.grad).all()


def test_inputs_are_left_as_they_were():
    edges, mask = random_graph((10,), 3, 2)
    before = edges.clone(), mask.clone()
    shortest_path(edges, mask)
    assert torch.equal(edges, before[0])
    assert torch.equal(mask, before[1])


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


def test_edge_costs_do_not_depend_on_how_many_are_computed_at_once(rng, monkeypatch):
    R = so3.random_rotations((2, 6, 3), generator=rng)
    score = torch.rand(2, 6, 3, generator=rng, dtype=torch.float64)
    time = torch.arange(6.0, dtype=torch.float64).expand(2, 6)
    whole = edge_costs(R, score, time)
    monkeypatch.setattr(trellis, "PAIRS_AT_ONCE", 1)
    assert_close(edge_costs(R, score, time), whole)


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


def test_edge_costs_leave_their_inputs_as_they_were(rng):
    inputs = (so3.random_rotations((4, 3), generator=rng), torch.full((4, 3), 0.8), torch.arange(4.0))
    before = [each.clone() for each in inputs]
    edge_costs(*inputs)
    assert all(map(torch.equal, inputs, before))


def test_edge_costs_refuse_scores_of_other_frames():
    with pytest.raises(ShapeError, match="score: expected"):
        edge_costs(torch.eye(3).expand(4, 2, 3, 3), torch.ones(5, 2), torch.arange(4.0))
