"""Random maps: seamless on the sphere, in the layout of docs/conventions.md."""

import pytest
import torch
from conftest import assert_close

from sphereorient.sphere import sample_texture
from sphereorient.sphere.texture import KINDS, map_directions, texture_coordinates
from sphereorient.synth import random_texture

CASES = [(kind, seed) for kind in KINDS for seed in range(3)]


@pytest.mark.parametrize(("kind", "seed"), CASES)
def test_across_the_date_line_a_map_changes_as_little_as_anywhere(kind, seed):
    texture = random_texture(kind, seed, 128)
    step = (texture[:, 1:] - texture[:, :-1]).abs().mean()
    seam = (texture[:, 0] - texture[:, -1]).abs().mean()
    assert seam < 4 * step
    assert (texture[:, 0] - texture[:, 128]).abs().mean() > 5 * step  # as it would be, were the map cut elsewhere


@pytest.mark.parametrize(("kind", "seed"), CASES)
def test_at_the_poles_a_map_has_one_grey_but_for_an_edge_that_may_cross(kind, seed):
    texture = random_texture(kind, seed, 512)
    for ring in (texture[0], texture[-1]):
        assert (ring - ring.roll(1)).abs().mean() < 0.01  # at most an edge or two, soft or hard, in 1024 columns


@pytest.mark.parametrize("kind", KINDS)
def test_a_map_is_black_and_white_paint_in_two_shares(kind):
    for seed in range(6):
        texture = random_texture(kind, seed, 64)
        assert texture.shape == (64, 128)
        assert texture.dtype == torch.float32
        assert texture.min() == 0
        assert texture.max() == 1
        low, high = (0.35, 0.65) if kind != "dots" else (0.6, 0.85)
        assert low < texture.mean() < high
        assert ((texture == 0) | (texture == 1)).float().mean() > 0.8


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_is_the_same_map_and_another_another(kind):
    assert torch.equal(random_texture(kind, 4, 32), random_texture(kind, 4, 32))
    assert not torch.equal(random_texture(kind, 4, 32), random_texture(kind, 5, 32))


@pytest.mark.parametrize("kind", KINDS)
def test_a_map_of_twice_the_size_shows_the_same_paint(kind):
    small, large = random_texture(kind, 1, 64), random_texture(kind, 1, 128)
    reduced = torch.nn.functional.avg_pool2d(large[None, None], 2)[0, 0]
    assert (reduced - small).abs().mean() < 0.03


def test_directions_of_texels_are_where_the_lookup_finds_them(rng):
    direction = map_directions(6)
    assert direction.shape == (6, 12, 3)
    assert_close(direction.norm(dim=-1), torch.ones(6, 12, dtype=torch.float64))
    noise = torch.rand(6, 12, generator=rng, dtype=torch.float64)
    assert_close(sample_texture(noise, direction), noise, atol=1e-13)
    # By hand (docs/conventions.md): row 0 is at latitude 75, column 0 at longitude -165 degrees.
    longitude, latitude = texture_coordinates(direction[0, 0])
    assert_close(longitude.rad2deg(), torch.tensor(-165.0, dtype=torch.float64), atol=1e-11)
    assert_close(latitude.rad2deg(), torch.tensor(75.0, dtype=torch.float64), atol=1e-11)
