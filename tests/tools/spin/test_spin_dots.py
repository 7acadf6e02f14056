import math

import cv2
import numpy as np
import pytest
import torch
from spin_examples import dot_directions, photograph

from sphereorient import so3
from sphereorient.errors import PaintError, ShapeError
from sphereorient.tools.spin.disks import BallOutline, Photographs, find_disk, load_photographs
from sphereorient.tools.spin.dots import DotTable


def test_a_dot_lies_where_the_maps_of_the_world_have_it():  # convention
    # +y is 90 degrees east: three quarters of the width; 30 degrees north: a third of the way from pole to pole.
    north_east = torch.tensor([[0.0, math.cos(math.pi / 6), math.sin(math.pi / 6)]])
    texture = DotTable(direction_body=north_east, radius_deg=5.0).texture(60)
    row, column = np.unravel_index(int(texture.argmin()), texture.shape)
    assert (int(row), int(column)) in {(r, c) for r in (19, 20) for c in (89, 90)}
    assert texture[-20 - 1, 89] == 1  # not in the south
    assert texture[20, 29] == 1  # nor in the west


def test_dots_cover_the_share_of_the_sphere_that_caps_have():  # oracle
    directions = dot_directions(6)
    texture = DotTable(direction_body=directions, radius_deg=7.0).texture(400)
    latitude = (0.5 - (torch.arange(400) + 0.5) / 400) * math.pi
    area = torch.cos(latitude)[:, None].expand(-1, 800)
    dark = float(((1 - texture) * area).sum() / area.sum())
    assert dark == pytest.approx(6 * (1 - math.cos(math.radians(7.0))) / 2, rel=0.01)


def test_the_mirrored_table_is_the_mirrored_map():
    table = DotTable(direction_body=dot_directions(5), radius_deg=9.0)
    torch.testing.assert_close(table.mirrored().texture(64), table.texture(64).flip(-1))


@pytest.mark.parametrize("radius_deg", [6.0, 9.0])
def test_the_size_of_dots_is_read_off_photographs(radius_deg):
    directions = dot_directions()
    R = so3.random_rotations(8, generator=torch.Generator().manual_seed(1))
    pictures = [photograph(one, directions, radius_deg, seed=k) for k, one in enumerate(R)]
    disks, _ = Photographs(pictures=pictures, time_s=torch.arange(8)).disks(48)
    tables = [DotTable(direction_body=directions, radius_deg=factor * radius_deg) for factor in (0.8, 1.4)]
    found = [table.measured(disks, R).radius_deg for table in tables]
    assert found == pytest.approx([radius_deg] * 2, abs=0.7)


def test_dots_that_are_not_there_are_refused():
    directions = dot_directions()
    R = so3.random_rotations(4, generator=torch.Generator().manual_seed(1))
    white = torch.full((4, 40, 40), 100.0)
    with pytest.raises(PaintError, match="dark dots"):
        DotTable(direction_body=directions).measured(white, R)


@pytest.mark.parametrize(
    ("table", "radius", "got"),
    [
        (torch.zeros(0, 3), 6.0, "no rows"),
        (20.0 * torch.eye(3), 6.0, "one of 20"),
        (torch.full((2, 3), math.nan), 6.0, "nan"),
        (torch.eye(3), 0.0, "0.5 .. 45 degrees, got 0"),
        (torch.eye(3), math.nan, "nan"),
    ],
)
def test_a_file_that_is_no_table_of_dots_is_refused_in_one_line(table, radius, got):
    with pytest.raises(PaintError, match=got) as caught:
        DotTable(direction_body=table, radius_deg=radius)
    assert "\n" not in str(caught.value)


def test_directions_of_another_shape_are_refused():
    with pytest.raises(ShapeError):
        DotTable(direction_body=torch.eye(4))


@pytest.mark.parametrize("ball", [(33.0, 32.0, 29.0), (30.3, 35.6, 21.4), (24.0, 30.0, 29.0)])  # the last one is cut
def test_a_ball_is_found_to_a_fraction_of_a_pixel(ball):
    R = so3.random_rotations(3, generator=torch.Generator().manual_seed(2))
    for k, one in enumerate(R):
        found = find_disk(photograph(one, dot_directions(), ball=ball, seed=k))
        assert (found.u_px, found.v_px) == pytest.approx(ball[:2], abs=0.4)
        assert found.radius_px == pytest.approx(ball[2], abs=0.5)


def test_a_dark_ball_on_a_bright_scene_is_found_too():
    picture = 255 - photograph(torch.eye(3), dot_directions())[..., 0]
    found = find_disk(picture)
    assert (found.u_px, found.v_px, found.radius_px) == pytest.approx((33.0, 32.0, 29.0), abs=0.6)


@pytest.mark.parametrize("what", ["flat", "noise", "bar", "small", "shape"])
def test_a_photograph_without_a_ball_is_refused_in_one_line(what):
    noise = np.random.default_rng(0).normal(100, 4, (60, 60, 3)).astype(np.uint8)
    bar = noise.copy()
    bar[25:32, 5:55] = 220
    picture = {
        "flat": np.full((60, 60), 7, np.uint8),
        "noise": noise,
        "bar": bar,
        "small": noise[:8],
        "shape": noise[..., :2],
    }[what]
    with pytest.raises(PaintError, match="photograph") as caught:
        find_disk(picture)
    assert "\n" not in str(caught.value)


def test_outlines_that_are_given_are_not_searched():
    pictures = [photograph(torch.eye(3), dot_directions())] * 3
    balls = [BallOutline(u_px=30.0, v_px=31.0, radius_px=20.0)] * 3
    disks, found = Photographs(pictures=pictures, time_s=torch.arange(3), balls=balls).disks(32)
    assert disks.shape == (3, 32, 32)
    assert found == tuple(balls)


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_photographs_of_16_bits_keep_their_levels(tmp_path, ending):
    """Before: all levels above 255 were white, and no ball was found."""
    grey = photograph(torch.eye(3), dot_directions())[..., 0].astype(np.uint16) * 200
    paths = [tmp_path / f"{k}.{ending}" for k in range(3)]
    for path in paths:
        cv2.imwrite(str(path), grey)
    loaded = load_photographs(paths, "100")
    np.testing.assert_array_equal(loaded.pictures[0], grey)
    disks, (found, *_) = loaded.disks(32)
    assert (found.u_px, found.v_px, found.radius_px) == pytest.approx((33.0, 32.0, 29.0), abs=0.6)
    plain = Photographs(pictures=[grey / 200] * 3, time_s=torch.arange(3), balls=[found] * 3).disks(32)[0]
    torch.testing.assert_close(disks, 200 * plain, rtol=1e-4, atol=0.1)
