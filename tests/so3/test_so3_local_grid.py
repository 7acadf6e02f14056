import math

import pytest
import torch
from conftest import assert_close
from so3_covering import nearest_distance

from sphereorient import so3
from sphereorient.errors import SettingsError

F64 = torch.float64
STEP, RADIUS = math.radians(3), math.radians(15)
COVER = math.sqrt(5) / 4 * 2 ** (1 / 3)  # of a body-centred cubic lattice with one point per unit volume
BATCH = [(STEP, RADIUS), (math.radians(20), math.pi), (0.01, 0.065)]


def in_ball(rng, radius, n=10_000):
    """Rotations whose vectors fill a ball evenly."""
    axis = torch.randn(n, 3, generator=rng, dtype=F64)
    length = radius * torch.rand(n, 1, generator=rng, dtype=F64) ** (1 / 3)
    return so3.exp(axis / axis.norm(dim=-1, keepdim=True) * length)


@pytest.mark.parametrize(("step", "radius"), BATCH)
def test_every_rotation_of_the_ball_is_within_the_covering_radius(rng, step, radius):
    cover = COVER * step
    grid = so3.local_grid(step, radius)
    inner = nearest_distance(grid, in_ball(rng, radius - cover))
    assert inner.max() <= cover
    assert inner.max() >= 0.8 * cover  # the stated radius is the lattice's, not a generous one
    assert nearest_distance(grid, in_ball(rng, radius)).max() <= 2 * cover


def test_a_plain_cubic_lattice_of_as_many_points_covers_worse(rng):
    line = torch.arange(-6, 7)
    cubic = torch.cartesian_prod(line, line, line).to(F64)
    cubic = so3.exp(cubic[cubic.norm(dim=1) <= RADIUS / STEP] * STEP)
    assert abs(len(cubic) / len(so3.local_grid(STEP, RADIUS)) - 1) < 0.1
    R = in_ball(rng, RADIUS - COVER * STEP)
    assert nearest_distance(cubic, R).max() > 1.1 * nearest_distance(so3.local_grid(STEP, RADIUS), R).max()


@pytest.mark.parametrize(("step", "radius"), BATCH)
def test_the_unit_rotation_is_first_and_the_others_follow_by_angle(step, radius):
    grid = so3.local_grid(step, radius)
    angles = so3.angle(grid)
    assert torch.equal(grid[0], torch.eye(3, dtype=F64))
    assert (angles.diff() > -1e-12).all()
    assert angles.max() <= radius + 1e-9
    assert angles[1] == pytest.approx(2 ** (1 / 3) * math.sqrt(3) / 2 * step)  # the nearest of the lattice


def test_there_is_one_rotation_per_cubed_step():
    volume = 4 / 3 * math.pi * 10**3
    assert len(so3.local_grid(0.01, 0.1)) == pytest.approx(volume, rel=0.03)


def test_with_each_rotation_comes_its_inverse():
    grid = so3.local_grid(STEP, RADIUS)
    assert_close(nearest_distance(grid, grid.mT), torch.zeros(len(grid), dtype=F64), atol=1e-7)


def test_a_shell_on_the_rim_belongs_to_the_grid():
    nearest = 2 ** (1 / 3) * math.sqrt(3) / 2  # of eight neighbours, in steps
    for step in torch.linspace(0.01, 0.5, 50).tolist():
        assert len(so3.local_grid(step, nearest * step)) == 9
        assert len(so3.local_grid(step, 0.999 * nearest * step)) == 1


def test_the_grid_has_the_given_dtype_and_is_always_the_same(dtype, tolerance):
    grid = so3.local_grid(STEP, RADIUS, dtype=dtype)
    assert grid.dtype == dtype
    assert torch.equal(grid, so3.local_grid(STEP, RADIUS, dtype=dtype))
    assert_close(grid.double(), so3.local_grid(STEP, RADIUS), atol=tolerance)


@pytest.mark.parametrize(("step", "radius"), [(0.0, 0.1), (-0.1, 0.1), (math.nan, 0.1), (0.1, -0.1), (0.1, 15.0)])
def test_impossible_sizes_are_refused(step, radius):
    with pytest.raises(SettingsError, match="_rad"):
        so3.local_grid(step, radius)
