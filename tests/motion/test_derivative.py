"""Gaussian derivatives: exact on polynomials, of known response to sines and noise, NaN where not measured."""

import math

import pytest
import torch
from conftest import assert_close
from hypothesis import given, settings
from hypothesis import strategies as st

from sphereorient.errors import SettingsError
from sphereorient.motion.stencil import apply, gap_aware_stencil, gaussian_derivative, gaussian_kernel

DT = 1 / 600


def polynomial(coefficients: list[float], order: int, frames: int = 41) -> tuple[torch.Tensor, torch.Tensor]:
    """Return x and its derivative at every frame, time in frames, (N, 1)."""
    t = torch.arange(frames, dtype=torch.float64) - frames // 2
    x = sum(c * t**p for p, c in enumerate(coefficients))
    kept = list(enumerate(coefficients))[order:]
    slope = sum((c * math.perm(p, order) * t ** (p - order) for p, c in kept), torch.zeros_like(t))
    return torch.as_tensor(x)[:, None], slope[:, None]


@pytest.mark.parametrize("sigma", [0.4, 1.0, 2.7, 5.0])
@pytest.mark.parametrize("order", [0, 1, 2])
def test_polynomials_one_degree_above_the_order_are_differentiated_exactly(sigma: float, order: int) -> None:
    x, slope = polynomial([3.0, -1.0, 0.5, 0.25][: order + 2], order)
    got = gaussian_derivative(x, 1.0, sigma, order)
    seen = got.isfinite()
    assert seen.sum() == 41 - 2 * max(1, math.ceil(3 * sigma))
    assert_close(got[seen], slope[seen], atol=1e-9)


def test_the_time_step_divides_once_for_each_order() -> None:
    t = torch.arange(30, dtype=torch.float64)[:, None] * DT
    assert_close(gaussian_derivative(7 * t, DT, 2.0, 1)[15], torch.tensor([7.0], dtype=torch.float64), atol=1e-9)
    assert_close(gaussian_derivative(7 * t**2, DT, 2.0, 2)[15], torch.tensor([14.0], dtype=torch.float64), atol=1e-8)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_a_sine_is_damped_by_the_gaussian_transfer_function(order: int) -> None:
    sigma, f = 3.0, 0.03  # cycles per frame
    t = torch.arange(200, dtype=torch.float64)[:, None]
    w = 2 * math.pi * f
    slope = (torch.sin(w * t), w * torch.cos(w * t), -(w**2) * torch.sin(w * t))[order]
    got = gaussian_derivative(torch.sin(w * t), 1.0, sigma, order, truncate=6.0)
    seen = got.isfinite()
    assert_close(got[seen], slope[seen] * math.exp(-0.5 * (w * sigma) ** 2), atol=1e-7)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_truncation_at_three_sigma_changes_the_response_by_less_than_a_percent(order: int) -> None:
    w, sigma = 2 * math.pi * 0.03, 3.0
    t = torch.arange(60, dtype=torch.float64)[:, None]
    short = gaussian_derivative(torch.sin(w * t), 1.0, sigma, order)[20:40]
    long = gaussian_derivative(torch.sin(w * t), 1.0, sigma, order, truncate=6.0)[20:40]
    assert (short - long).abs().max() < 0.02 * long.abs().max()


def test_nothing_is_invented_at_ends_and_around_a_missing_value() -> None:
    x = torch.zeros(40, 2)
    x[20, 0] = torch.nan
    got = gaussian_derivative(x, DT, 1.0, 1)
    assert got[:, 0].isnan().nonzero().flatten().tolist() == [0, 1, 2, *range(17, 24), 37, 38, 39]
    assert got[:, 1].isnan().nonzero().flatten().tolist() == [0, 1, 2, 37, 38, 39]


@pytest.mark.parametrize("order", [0, 1, 2])
def test_noise_gain_agrees_with_seeded_noise(order: int, rng: torch.Generator) -> None:
    x = torch.randn(200_000, 1, generator=rng, dtype=torch.float64)
    got = gaussian_derivative(x, 1.0, 2.0, order)
    assert float(got[got.isfinite()].std()) == pytest.approx(float(gaussian_kernel(2.0, order).norm()), rel=0.01)


def test_noise_gain_is_the_known_one_of_a_wide_gaussian() -> None:
    for order, constant, power in ((0, 0.531, -0.5), (1, 0.376, -1.5), (2, 0.460, -2.5)):
        gain = float(gaussian_kernel(4.0, order, truncate=6.0).norm())
        assert gain == pytest.approx(constant * 4.0**power, rel=2e-3)


def test_a_batch_is_the_stack_of_its_singles(
    batch: tuple[int, ...], dtype: torch.dtype, tolerance: float, rng: torch.Generator
) -> None:
    x = torch.randn(*batch, 12, 3, generator=rng, dtype=dtype)
    got = gaussian_derivative(x, 1.0, 1.0, 1)
    assert got.shape == x.shape
    assert got.dtype == dtype
    for one, x_one in zip(got.reshape(-1, 12, 3), x.reshape(-1, 12, 3), strict=True):
        assert_close(one, gaussian_derivative(x_one, 1.0, 1.0, 1), atol=tolerance)


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_too_few_frames_give_nan(frames: int) -> None:
    got = gaussian_derivative(torch.zeros(frames, 3), 1.0, 2.0, 1)
    assert got.shape == (frames, 3)
    assert got.isnan().all()


def test_the_derivative_has_the_gradient_that_finite_differences_have(rng: torch.Generator) -> None:
    x = torch.randn(9, 2, generator=rng, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: gaussian_derivative(v, 0.5, 1.0, 2)[3:-3], x)


@pytest.mark.parametrize(("sigma", "order"), [(0.0, 1), (-1.0, 1), (1.0, 3)])
def test_impossible_widths_and_orders_are_refused(sigma: float, order: int) -> None:
    with pytest.raises(SettingsError, match="expected"):
        gaussian_derivative(torch.zeros(9, 1), 1.0, sigma, order)  # type: ignore[arg-type]


# the same with frames missing


@pytest.mark.parametrize("order", [0, 1, 2])
def test_where_nothing_is_missing_the_gap_aware_stencil_is_the_kernel(order: int, rng: torch.Generator) -> None:
    x = torch.randn(30, 3, generator=rng, dtype=torch.float64)
    stencil = gap_aware_stencil(torch.ones(30, dtype=torch.bool), None, 1.7, order)
    assert_close(apply(stencil, x), gaussian_derivative(x, 1.0, 1.7, order))


@settings(deadline=None, max_examples=30)
@given(lost=st.sets(st.integers(0, 40), max_size=14), order=st.sampled_from([0, 1, 2]))
def test_polynomials_stay_exact_with_any_frames_missing(lost: set[int], order: int) -> None:
    x, slope = polynomial([3.0, -1.0, 0.5, 0.25][: order + 2], order)
    there = torch.ones(41, dtype=torch.bool)
    there[list(lost)] = False
    x[~there] = torch.nan
    got = apply(gap_aware_stencil(there, None, 2.0, order, min_share=0.3), x)
    seen = got.isfinite()
    assert seen.any()
    assert_close(got[seen], slope[seen], atol=1e-8)


def test_a_line_made_of_two_segments_is_not_differentiated_across_the_cut() -> None:
    x = torch.cat([torch.arange(12.0), 100 - torch.arange(12.0)])[:, None]
    segment = torch.tensor([0] * 12 + [1] * 12)
    got = apply(gap_aware_stencil(torch.ones(24, dtype=torch.bool), segment, 1.0, 1, min_share=0.6).float(), x)[:, 0]
    seen = got.isfinite()
    assert seen[[2, 9, 14, 21]].all()
    assert not seen[[0, 11, 12, 23]].any()
    assert_close(got[:12][seen[:12]], torch.ones(int(seen[:12].sum())), atol=1e-5)
    assert_close(got[12:][seen[12:]], -torch.ones(int(seen[12:].sum())), atol=1e-5)


def test_frames_outside_any_segment_have_no_derivative_and_lend_none() -> None:
    there, segment = torch.ones(21, dtype=torch.bool), torch.zeros(21, dtype=torch.long)
    segment[10] = -1
    stencil = gap_aware_stencil(there, segment, 1.0, 1, min_share=0.5)
    assert stencil[10].isnan().all()
    assert stencil[9, 3 + 1] == 0.0


def test_a_long_gap_is_not_bridged() -> None:
    there = torch.ones(60, dtype=torch.bool)
    there[25:35] = False
    lost = gap_aware_stencil(there, None, 3.5, 1, min_share=0.55).isnan().all(-1)
    assert lost[24:36].all()
    there = torch.ones(60, dtype=torch.bool)
    there[25:27] = False
    assert not gap_aware_stencil(there, None, 3.5, 1, min_share=0.55).isnan().all(-1)[10:50].any()
