"""The blurred paint and its slope, against blurring by brute force and harmonics under a Gaussian."""

import math
from functools import cache

import pytest
import torch
from conftest import assert_close, slow
from torch import Tensor

from sphereorient import so3
from sphereorient.files.compiled import WITHOUT, compiled
from sphereorient.sphere import DirectionTable, orthographic_view, sample_texture
from sphereorient.sphere.texture_table import (
    BASE_RAD,
    SOURCE,
    TextureTable,
    Widening,
    octahedral_cells,
    octahedral_directions,
    texture_table,
)
from sphereorient.synth import random_texture

HEIGHT = 256
BLURS = [BASE_RAD, 0.017, 0.03, 0.07]  # rad: the finest, 80 px sharp, the middle and the coarse level of refinement
FAR = 4.3  # / side: no direction is further from the middle of its cell, rad; the faces' middles have the longest cells
# Accuracy of the tables, in steps from black to white and in the slope of a straight border: tangent planes a
# cell wide, and wider blurs made with nine nodes.
VALUE_RMS, VALUE_MOST = 0.008, 0.05
SLOPE_RMS, SLOPE_MOST = 0.08, 0.4


@cache
def map_of(kind: str) -> Tensor:
    return random_texture(kind, 3, HEIGHT)


@cache
def base_of(kind: str) -> TextureTable:
    return texture_table(map_of(kind), BASE_RAD)


@cache
def table_of(kind: str, blur_rad: float) -> TextureTable:
    return base_of(kind).blurred(blur_rad)


@cache
def directions(count: int, seed: int = 1) -> Tensor:
    drawn = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(drawn, dim=-1)


def looked(table: TextureTable, at: Tensor) -> tuple[Tensor, Tensor]:
    """Value (M,) and slope (M, 3) at directions (M, 3)."""
    value, slope = table.sample(at.float().T[None])
    return value[0].double(), slope[0].T.double()


def tangents(at: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors (M, 3) each across directions (M, 3)."""
    helper = torch.where(at[:, 2:].abs() < 0.9, at.new_tensor([0.0, 0, 1]), at.new_tensor([1.0, 0, 0]))
    right = torch.nn.functional.normalize(torch.linalg.cross(helper, at), dim=-1)
    return right, torch.linalg.cross(at, right)


def blurred_by_force(kind: str, at: Tensor, blur_rad: float) -> Tensor:
    """The Gaussian's mean of the map about directions, by 61 x 61 samples, float64."""
    step = torch.linspace(-4.5, 4.5, 61, dtype=torch.float64)
    a, b = torch.meshgrid(step, step, indexing="ij")
    share = torch.exp(-0.5 * (a * a + b * b))
    right, up = tangents(at)
    offset = blur_rad * (a[..., None] * right[:, None, None] + b[..., None] * up[:, None, None])
    angle = offset.norm(dim=-1, keepdim=True)
    # Along great circles: the distance on the sphere is what is normally distributed.
    sample = torch.cos(angle) * at[:, None, None] + torch.sinc(angle / math.pi) * offset
    seen: Tensor = (sample_texture(map_of(kind).double(), sample) * share).sum((1, 2)) / share.sum()
    return seen


# --- value


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["patches", slow("dots"), slow("blobs")])
@pytest.mark.parametrize("blur_rad", BLURS)
def test_the_value_is_the_map_under_a_gaussian(kind, blur_rad):
    at = directions(300)
    value, _ = looked(table_of(kind, blur_rad), at)
    error = value - blurred_by_force(kind, at, blur_rad)
    assert error.square().mean().sqrt() < VALUE_RMS
    assert error.abs().max() < VALUE_MOST
    # Blurs a fifth wider or narrower are worse answers: the width is right.
    for other in (0.8, 1.2):
        assert (value - blurred_by_force(kind, at, other * blur_rad)).square().mean() > 1.5 * error.square().mean()


def harmonic_map() -> Tensor:
    """A map of one harmonic of degree 6, the real part of (x + i y)^6."""
    row, column = torch.meshgrid(
        torch.arange(HEIGHT, dtype=torch.float64), torch.arange(2 * HEIGHT, dtype=torch.float64), indexing="ij"
    )
    longitude = math.pi * ((column + 0.5) / HEIGHT - 1)
    latitude = math.pi * (0.5 - (row + 0.5) / HEIGHT)
    return 0.5 + 0.5 * latitude.cos() ** 6 * torch.cos(6 * longitude)


def harmonic(at: Tensor) -> tuple[Tensor, Tensor]:
    """The harmonic (M,) and its gradient on the sphere (M, 3)."""
    z = torch.complex(at[:, 0], at[:, 1])
    value, change = z.pow(6).real, 6 * z.pow(5)
    gradient = torch.stack([change.real, -change.imag, torch.zeros_like(value)], dim=-1)
    return value, gradient - (gradient * at).sum(-1, keepdim=True) * at


@pytest.mark.slow
@pytest.mark.parametrize("blur_rad", [0.017, 0.03, 0.1])
def test_a_harmonic_fades_by_its_degree_and_its_slope_with_it(blur_rad):
    # The Gaussian on the sphere multiplies degree n by exp(-n (n + 1) blur^2 / 2).
    table = texture_table(harmonic_map(), blur_rad)
    fades = math.exp(-0.5 * 6 * 7 * blur_rad**2)
    middles = octahedral_directions(table.side)[:: 7 * table.side // 64]
    for at, slope_error in ((directions(400, 2), 5.0 * FAR / table.side), (middles, 0.04)):
        value, slope = looked(table, at)
        expected, change = harmonic(at)
        assert_close(value, 0.5 + 0.5 * fades * expected, atol=4e-3)
        # The steepest slope is 3; within a cell it is that of the middle.
        assert_close(slope, 0.5 * fades * change, atol=3 * slope_error)


def test_even_paint_stays_even_and_has_no_slope():
    table = texture_table(torch.full((64, 128), 0.7), 0.05, 128)
    value, slope = looked(table, directions(500))
    assert_close(value, torch.full_like(value, 0.7), atol=1e-4)
    assert_close(slope, torch.zeros_like(slope), atol=1e-3)


# --- slope


@pytest.mark.parametrize("kind", ["patches", slow("blobs")])
@pytest.mark.parametrize("blur_rad", BLURS)
def test_the_slope_is_how_the_blurred_map_changes(kind, blur_rad):
    at, h = directions(200), 0.05 * blur_rad
    _, slope = looked(table_of(kind, blur_rad), at)
    steepest = 1 / (math.sqrt(2 * math.pi) * blur_rad)  # across a straight border
    for tangent in tangents(at):
        ahead, behind = (
            blurred_by_force(kind, torch.nn.functional.normalize(at + s * h * tangent, dim=-1), blur_rad)
            for s in (1, -1)
        )
        change = (ahead - behind) / (2 * h)
        error = ((slope * tangent).sum(-1) - change) / steepest
        assert change.abs().max() > 0.3 * steepest
        assert error.square().mean().sqrt() < SLOPE_RMS
        assert error.abs().max() < SLOPE_MOST


@pytest.mark.parametrize("blur_rad", BLURS)
def test_the_slope_is_the_gradient_of_the_value_that_is_returned(blur_rad):
    at = directions(300).float().T[None].requires_grad_()
    value, slope = table_of("patches", blur_rad).sample(at)
    (gradient,) = torch.autograd.grad(value.sum(), at)
    assert_close(gradient, slope.detach(), atol=0.0)


@pytest.mark.parametrize("blur_rad", BLURS)
def test_the_slope_lies_in_the_sphere(blur_rad):
    table, at = table_of("patches", blur_rad), directions(500)
    _, slope = looked(table, at)
    # It is tangent at the cell's middle.
    assert ((slope * at).sum(-1).abs() < FAR / table.side * slope.norm(dim=-1) + 1e-5).all()
    assert slope.norm(dim=-1).max() > 1


# --- blurring again


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["patches", slow("dots")])
def test_blurring_twice_is_blurring_once_by_the_root_of_the_sum_of_squares(kind):
    at = directions(2000)
    once = base_of(kind).blurred(0.06)
    twice = base_of(kind).blurred(0.025).blurred(0.06)
    assert once.blur_rad == twice.blur_rad == 0.06
    steepest = 1 / (math.sqrt(2 * math.pi) * 0.06)
    (value, slope), (value_2, slope_2) = looked(once, at), looked(twice, at)
    assert (value - value_2).square().mean().sqrt() < 0.006
    assert (slope - slope_2).square().mean().sqrt() < 0.03 * steepest
    # The wrong sum, 0.025 + 0.06, is another picture.
    assert (value - looked(base_of(kind).blurred(0.085), at)[0]).square().mean().sqrt() > 0.02


@pytest.mark.parametrize("blur_rad", [slow(1.01 * BASE_RAD), 0.012, 0.05])
def test_compiled_code_and_torch_blur_alike(blur_rad: float, monkeypatch: pytest.MonkeyPatch):
    if compiled(SOURCE, Widening) is None:
        pytest.skip("needs the compiled tables: `make setup` with a compiler")
    unseen = torch.rand(HEIGHT, 2 * HEIGHT, generator=torch.Generator().manual_seed(1)) < 0.01
    base = texture_table(map_of("blobs"), BASE_RAD, unseen=unseen)
    found = base.blurred(blur_rad)
    monkeypatch.setenv(WITHOUT, "1")
    compiled.cache_clear()
    expected = TextureTable.of(base.arrays()).blurred(blur_rad)
    compiled.cache_clear()
    for one, other in ((found, expected), (found.unseen, expected.unseen)):
        assert one.side == other.side
        assert torch.equal(one.rows, other.rows)


def test_a_table_is_not_made_sharper():
    table = table_of("patches", 0.03)
    assert table.blurred(0.03) is table
    assert table.blurred(0.01) is table
    assert table.blurred(math.nextafter(0.03, 1.0)) is table  # the same but for rounding


def test_a_wider_blur_needs_no_more_cells():
    sides = [table_of("patches", blur).side for blur in BLURS]
    assert sides == sorted(sides, reverse=True)
    assert sides[-1] < sides[0]
    for blur, side in zip(BLURS[2:], sides[2:], strict=True):
        assert math.sqrt(4 * math.pi) / side < 0.6 * blur  # a cell's width, were all of one size


# --- seams


def seams() -> Tensor:
    """Directions on the octahedron's corners and edges, and beside them: the poles, the equator, the meridians."""
    axis = torch.eye(3, dtype=torch.float64)
    corners = torch.cat([axis, -axis])
    angle = torch.linspace(0, 2 * math.pi, 181, dtype=torch.float64)[:-1]
    circle = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1)
    edges = torch.cat([circle, circle.roll(1, -1), circle.roll(2, -1)])
    edges = torch.where(edges.abs() < 1e-12, 0.0, edges)
    beside = torch.cat([edges + sign * 1e-7 * part for sign in (1, -1) for part in axis])
    return torch.nn.functional.normalize(torch.cat([corners, edges, beside]), dim=-1)


@pytest.mark.parametrize("blur_rad", [0.017, 0.07])
def test_corners_and_edges_of_the_octahedron_are_as_good_as_any_place(blur_rad):
    at = seams()
    some = torch.arange(0, len(at), 11)
    at = torch.cat([at[:6], at[some]])
    value, _ = looked(table_of("patches", blur_rad), at)
    error = value - blurred_by_force("patches", at, blur_rad)
    assert error.square().mean().sqrt() < VALUE_RMS
    assert error.abs().max() < VALUE_MOST


@pytest.mark.parametrize("blur_rad", [0.017, 0.07])
def test_nothing_jumps_across_a_seam(blur_rad):
    table, at = table_of("patches", blur_rad), seams()[6 : 6 + 540]
    within = directions(540)
    jumps = []
    for places in (at, within):
        for part in torch.eye(3, dtype=torch.float64):
            near = [torch.nn.functional.normalize(places + s * 2.5 / table.side * part, dim=-1) for s in (1, -1)]
            (one, slope), (other, slope_2) = (looked(table, place) for place in near)
            along = (0.5 * (slope + slope_2) * (near[0] - near[1])).sum(-1)
            jumps.append((one - other - along).square().mean())
    at_seams, elsewhere = torch.stack(jumps).reshape(2, 3).mean(1).sqrt()
    assert at_seams < 1.2 * elsewhere + 1e-3


@pytest.mark.parametrize("side", [2, 64, 512])
def test_the_middle_of_each_cell_lies_in_that_cell(side):
    middles = octahedral_directions(side)
    assert_close(middles.norm(dim=-1), torch.ones(side * side, dtype=torch.float64))
    assert octahedral_cells(*middles.unbind(-1), side).tolist() == list(range(side * side))


def test_every_direction_has_a_cell_whose_middle_is_near():
    at, side = torch.cat([directions(20000), seams()]), 128
    cell = octahedral_cells(*at.unbind(-1), side)
    assert ((cell >= 0) & (cell < side * side)).all()
    middle = octahedral_directions(side)[cell]
    assert (middle - at).norm(dim=-1).max() < FAR / side


def test_the_length_of_a_direction_does_not_matter_for_its_cell():
    x, y, z = directions(1000).unbind(-1)
    assert octahedral_cells(x, y, z, 256).equal(octahedral_cells(4 * x, 4 * y, 4 * z, 256))


@pytest.mark.slow
def test_a_map_that_is_turned_gives_a_table_that_is_turned():
    # A quarter turn about the pole is a shift of columns: the octahedron's faces change places.
    texture, at = map_of("patches"), directions(2000)
    quarter = so3.exp(torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64))
    turned = texture_table(texture.roll(HEIGHT // 2, 1), 0.03)
    value, slope = looked(table_of("patches", 0.03), at)
    value_t, slope_t = looked(turned, at @ quarter.mT)
    assert (value_t - value).square().mean().sqrt() < VALUE_RMS
    assert (slope_t - slope @ quarter.mT).square().mean().sqrt() < SLOPE_RMS / (math.sqrt(2 * math.pi) * 0.03)
    # Rotated the other way it is another ball.
    assert (looked(turned, at @ quarter)[0] - value).square().mean().sqrt() > 0.3


# --- batches


@pytest.mark.parametrize("shape", [(0, 7), (1, 1), (3, 0), (3, 50)])
def test_each_direction_is_looked_up_as_if_it_were_alone(shape):
    disks, places = shape
    at = directions(max(disks * places, 1))[: disks * places].float().reshape(disks, places, 3).movedim(-1, 1)
    table = table_of("patches", 0.03)
    value, slope = table.sample(at)
    assert value.shape == (disks, places)
    assert slope.shape == (disks, 3, places)
    for k in range(disks):
        for p in range(places):
            one_value, one_slope = table.sample(at[k : k + 1, :, p : p + 1])
            assert one_value.item() == value[k, p].item()
            assert one_slope[0, :, 0].equal(slope[k, :, p])


# --- black and white, for banks


@pytest.mark.parametrize(("kind", "seed"), [("blobs", 1), ("patches", 2), ("dots", 3)])
def test_the_table_differs_from_the_renderer_only_at_borders_of_paint(rng, kind, seed):
    texture, view = random_texture(kind, seed, 128), orthographic_view(60)
    R_view_body = so3.random_rotations(8, generator=rng, dtype=torch.float32)
    table = DirectionTable(texture).render(R_view_body, view.normal_view)
    assert table.dtype == torch.int8
    assert (table.min(), table.max()) == (-127, 127)
    exact = view.paint(texture, R_view_body) >= 0.5
    differs = (table > 0) != exact
    assert 0 < differs.float().mean() < 0.03
    # The middle of a cell of 1/64 lies within sqrt(3)/128 rad = 0.78 degrees: both paints must be that near.
    direction = (view.normal_view @ R_view_body)[differs]
    near = direction[:, None] + 0.01 * torch.randn(len(direction), 60, 3, generator=rng)
    white = sample_texture(texture, near) >= 0.5
    assert (white.any(1) & ~white.all(1)).all()


def test_a_finer_table_differs_less(rng):
    texture, view = random_texture("blobs", 1, 128), orthographic_view(60)
    R_view_body = so3.random_rotations(10, generator=rng, dtype=torch.float32)
    exact = view.paint(texture, R_view_body) >= 0.5
    share = [
        float(((DirectionTable(texture, cells).render(R_view_body, view.normal_view) > 0) != exact).float().mean())
        for cells in (32, 64, 128)
    ]
    assert share[0] > 1.5 * share[1] > 2.25 * share[2]


def test_the_direction_tables_answer_does_not_depend_on_the_others(rng):
    table, view = DirectionTable(random_texture("blobs", 1, 32), 32), orthographic_view(20)
    R_view_body = so3.random_rotations(70, generator=rng, dtype=torch.float32)  # more than two chunks
    together = table.render(R_view_body, view.normal_view)
    for k in (0, 31, 32, 69):
        assert torch.equal(table.render(R_view_body[k : k + 1], view.normal_view)[0], together[k])
    assert table.render(R_view_body[:0], view.normal_view).shape == (0, len(view.normal_view))


def test_axes_of_the_cube_stay_within_the_table():
    # Components of exactly 1, and a little above it, must not fall out of the last cell.
    table = DirectionTable(random_texture("blobs", 1, 32), 16)
    axes = torch.eye(3)
    assert table.render(axes[None] * (1 + 5e-7), torch.cat([axes, -axes])).abs().gt(0).all()


def test_a_cell_of_the_direction_table_holds_the_paint_at_its_middle():
    # The equator is a border between cells: with the middles' paint the table of a half-white sphere is exact, and
    # that of its negative is its negative. With the corners' paint one of the two is off by a cell.
    north = torch.zeros(32, 64)
    north[:16] = 1.0
    view = orthographic_view(60)
    upright = torch.tensor([[[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]])
    up = view.normal_view[:, 1] < 0
    white = DirectionTable(north, 64).render(upright, view.normal_view)[0]
    assert torch.equal(white > 0, up)
    assert torch.equal(DirectionTable(1 - north, 64).render(upright, view.normal_view)[0], -white)
