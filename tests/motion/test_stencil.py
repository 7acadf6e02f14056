import torch
from conftest import assert_close

from sphereorient.motion import stencil


def test_a_window_holds_the_neighbours_in_order() -> None:
    x = torch.arange(5.0)
    near = stencil.windows(x, 1)
    assert near.shape == (5, 3)
    assert near[2].tolist() == [1.0, 2.0, 3.0]
    assert near[0].isnan().tolist() == [True, False, False]


def test_windows_of_no_frame_are_no_windows(batch: tuple[int, ...]) -> None:
    assert stencil.windows(torch.zeros(*batch, 0), 2).shape == (*batch, 0, 5)


def test_only_neighbours_of_the_own_segment_are_there() -> None:
    there = torch.tensor([True, True, True, False, True])
    segment = torch.tensor([0, 0, 1, 1, -1])
    near = stencil.neighbours_there(there, segment, 1)
    expected = [[0, 1, 1], [1, 1, 0], [0, 1, 0], [1, 0, 0], [0, 0, 0]]
    assert near.int().tolist() == expected


def test_a_neighbour_counts_only_with_its_mirror_image() -> None:
    there = torch.tensor([True, True, True, True, False])
    assert stencil.paired(there, None, 1).int().tolist() == [[0, 1, 0], [1, 1, 1], [1, 1, 1], [0, 1, 0], [0, 0, 0]]


def test_applying_agrees_with_a_loop(rng: torch.Generator) -> None:
    weights, x = torch.randn(9, 5, generator=rng), torch.randn(9, 3, generator=rng)
    got = stencil.apply(weights, x)
    for k in range(2, 7):
        assert_close(got[k], sum((weights[k, 2 + j] * x[k + j] for j in range(-2, 3)), torch.zeros(3)), atol=1e-6)
    assert got[[0, 1, 7, 8]].isnan().all()


def test_a_missing_value_without_weight_does_no_harm_and_leaves_finite_gradients() -> None:
    x = torch.tensor([[1.0], [torch.nan], [4.0], [5.0]], requires_grad=True)
    weights = torch.tensor([[0.0, 1, 0], [-1, 0, 1], [torch.nan, 0, 0], [0, 1, 0]])
    got = stencil.apply(weights, x)
    assert got[[0, 1, 3], 0].tolist() == [1.0, 3.0, 5.0]
    assert got[2].isnan().all()
    got[[0, 1, 3]].sum().backward()
    assert x.grad is not None
    assert x.grad[:, 0].tolist() == [0.0, 0.0, 1.0, 1.0]


def test_composed_stencils_act_as_one_after_the_other(rng: torch.Generator) -> None:
    inner = torch.randn(2, 20, 5, generator=rng, dtype=torch.float64)
    outer = torch.randn(2, 20, 7, generator=rng, dtype=torch.float64)
    x = torch.randn(2, 20, 3, generator=rng, dtype=torch.float64)
    both = stencil.compose(outer, inner)
    assert both.shape == (2, 20, 11)
    inside = slice(5, 15)
    twice = stencil.apply(outer, stencil.apply(inner, x))
    assert_close(stencil.apply(both, x)[:, inside], twice[:, inside])


def test_the_spread_adds_variances() -> None:
    weights, sigma = torch.tensor([[3.0, 0.0, 4.0]]).expand(3, 3), torch.tensor([[1.0], [torch.nan], [1.0]])
    assert stencil.propagated_sigma(weights, sigma)[1, 0] == 5.0
