"""Lattman's angles and grid; corrected and printed steps side by side: docs/errata.md E5."""

import math

import pytest
import torch
from conftest import assert_close
from so3_covering import nearest_distance

from sphereorient import so3
from sphereorient.errors import SettingsError, ShapeError

F64 = torch.float64
STEP = math.radians(12)


def printed_steps(theta_y, delta):
    return delta / (theta_y / 2 + math.pi / 2).sin(), delta / (math.pi / 2 - theta_y / 2).sin()


def count(steps, delta):
    """Grid size by hand: rows at -90 .. 90 degrees, counts rounded up, at least 1."""
    theta_y = torch.linspace(-math.pi / 2, math.pi / 2, round(math.pi / delta) + 1, dtype=F64)
    plus, minus = steps(theta_y, delta)
    around = [
        (length / step - 1e-9).ceil().clamp_min(1) for length, step in ((4 * math.pi, plus), (2 * math.pi, minus))
    ]
    return int((around[0] * around[1]).sum())


def turned(theta, d_lattman):
    """Angle of the rotation by a small change of Lattman angles."""
    moved = so3.from_lattman(so3.to_lattman(theta) + d_lattman)
    return so3.geodesic_distance(so3.from_tait_bryan(theta), so3.from_tait_bryan(moved))


def test_the_angles_are_sum_and_difference():
    theta = torch.tensor([0.5, 0.2, -0.1], dtype=F64)
    assert_close(so3.to_lattman(theta), torch.tensor([0.4, 0.2, 0.6], dtype=F64))


def test_from_lattman_undoes_to_lattman(rng, dtype, tolerance):
    theta = torch.randn(50, 3, generator=rng, dtype=dtype)
    assert_close(so3.from_lattman(so3.to_lattman(theta)), theta, atol=tolerance)


def test_once_around_is_4_pi_in_plus_or_2_pi_in_plus_and_minus(rng):
    theta = torch.randn(20, 3, generator=rng, dtype=F64)
    for once in ([4 * math.pi, 0, 0], [2 * math.pi, 0, 2 * math.pi]):
        assert turned(theta, torch.tensor(once, dtype=F64)).max() < 1e-14
    for less in ([2 * math.pi, 0, 0], [0, 0, 2 * math.pi]):
        assert turned(theta, torch.tensor(less, dtype=F64)).min() > 1e-3


@pytest.mark.parametrize("degrees", [-80, -30, 0, 45, 80])
def test_E5_each_step_turns_by_delta_and_the_printed_ones_do_not(degrees):
    delta, theta = 1e-5, torch.tensor([0.7, math.radians(degrees), -2.0], dtype=F64)
    for steps, right in ((so3.lattman_steps, True), (printed_steps, False)):
        plus, minus = steps(theta[1], delta)
        zero = torch.zeros((), dtype=F64)
        by_plus = turned(theta, torch.stack([plus, zero, zero])) / delta
        by_minus = turned(theta, torch.stack([zero, zero, minus])) / delta
        exact = abs(by_plus - 1) < 1e-6 and abs(by_minus - 1) < 1e-6
        assert exact == right


def test_E5_near_a_pole_the_printed_steps_are_too_coarse_in_one_angle_and_too_fine_in_the_other():
    near_pole = torch.tensor(math.radians(89.9), dtype=F64)
    right, printed = so3.lattman_steps(near_pole, STEP), printed_steps(near_pole, STEP)
    assert printed[0] / right[0] > 1.41
    assert right[1] / printed[1] > 800
    right, printed = so3.lattman_steps(-near_pole, STEP), printed_steps(-near_pole, STEP)
    assert printed[1] / right[1] > 1.41  # at the other pole it is the other angle


def test_E5_at_the_poles_the_angle_that_turns_nothing_has_an_infinite_step(dtype):
    plus, minus = so3.lattman_steps(torch.tensor([-math.pi / 2, math.pi / 2], dtype=dtype), STEP)
    assert plus.isinf().tolist() == [True, False]
    assert minus.isinf().tolist() == [False, True]


def test_E5_the_grid_has_the_right_size_and_the_printed_steps_give_two_and_a_half_times_it():
    assert len(so3.lattman_grid(STEP)) == count(so3.lattman_steps, STEP) == 9_119
    assert len(so3.lattman_grid(math.radians(3))) == count(so3.lattman_steps, math.radians(3)) == 557_515
    assert count(printed_steps, STEP) == 23_586


@pytest.mark.parametrize("degrees", [12, 20, 25.3])
def test_every_rotation_is_near_one_of_the_grid(rng, degrees):
    step = math.radians(degrees)
    R = so3.random_rotations(10_000, generator=rng)
    distance = nearest_distance(so3.lattman_grid(step), R)
    assert distance.max() <= (0.5 + math.sqrt(0.5)) * step  # proved in the docstring
    assert distance.max() <= math.sqrt(3) / 2 * step  # measured: 0.78 to 0.83
    assert distance.max() >= 0.7 * step  # and no finer than stated


def test_only_the_last_row_holds_its_rotations_twice():
    grid = so3.lattman_grid(math.radians(30))
    assert_close(grid @ grid.mT, torch.eye(3, dtype=F64).expand_as(grid))
    assert_close(torch.linalg.det(grid), torch.ones(len(grid), dtype=F64))
    rows, last = grid[:-24], grid[-24:]  # 720 / 30 degrees of theta_plus
    assert_close(last[:, 0], torch.tensor([[0.0, 0.0, 1.0]], dtype=F64).expand(24, 3))  # theta_y = +90 degrees
    assert_close(last[:12], last[12:])
    once = torch.cat([rows, last[:12]])
    apart = so3.geodesic_distance(once[:, None], once[None]) + math.pi * torch.eye(len(once), dtype=F64)
    assert apart.min() > math.radians(10)


def test_the_grid_has_the_given_dtype_and_is_always_the_same(dtype, tolerance):
    grid = so3.lattman_grid(STEP, dtype=dtype)
    assert grid.dtype == dtype
    assert torch.equal(grid, so3.lattman_grid(STEP, dtype=dtype))
    assert_close(grid.double(), so3.lattman_grid(STEP), atol=tolerance)


@pytest.mark.parametrize("step", [0.0, -0.1, 12.0, math.nan])
def test_impossible_steps_are_refused(step):
    with pytest.raises(SettingsError, match="step_rad"):
        so3.lattman_grid(step)


def test_wrong_shapes_are_refused():
    for function in (so3.to_lattman, so3.from_lattman):
        with pytest.raises(ShapeError):
            function(torch.zeros(2))
