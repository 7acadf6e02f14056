"""Maps compared: planted rotations, shifts and wear are found with their signs; unseen paint stays unknown."""

import math

import pytest
import torch
from conftest import assert_close
from map_examples import shift_field, warped

from sphereorient import so3
from sphereorient.errors import PaintError, ShapeError
from sphereorient.sphere.compare import compare_maps, compass, fit_levels, texture_change, turned_map, without_changed
from sphereorient.sphere.texture import fibonacci_directions, map_directions, random_texture

HEIGHT = 128
TURN = so3.exp(torch.tensor([1.2, -2.0, 0.4], dtype=torch.float64))


@pytest.fixture(scope="module")
def paint():
    return random_texture("dots", 3, HEIGHT)


def test_a_map_in_another_body_frame_is_looked_up_there(paint):
    """R_map_new takes the new frame's components to the map's: by hand, a quarter turn about z."""
    quarter = so3.exp(torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64))
    # The new frame's x is the map's y: longitude 0 of the new map is longitude 90 of the old one.
    new = turned_map(paint, quarter)
    assert_close(new, paint.roll(-HEIGHT // 2, 1), atol=1e-5)
    assert float((new - paint.roll(HEIGHT // 2, 1)).abs().mean()) > 0.05


def test_turning_a_map_to_and_fro_changes_nothing_but_a_little_sharpness(paint):
    there = turned_map(turned_map(paint, TURN), TURN.mT)
    assert float((there - paint).abs().mean()) < 0.02


@pytest.mark.slow
def test_a_planted_rotation_is_found(paint):
    # Paint at d of the reference is at R d of the rotated map.
    found = compare_maps(turned_map(paint, TURN.mT), paint)
    assert math.degrees(float(so3.geodesic_distance(found.R_other_reference, TURN))) < 0.05
    assert found.correlation > 0.99
    assert len(found.length_rad) > 50
    assert math.degrees(found.rms_rad) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("brightness", [(1.0, 0.0), (0.6, 0.3)])
def test_a_planted_shift_is_found_where_it_is_with_its_direction(paint, brightness):
    gain, offset = brightness
    found = compare_maps(gain * warped(paint, 1.0) + offset, paint, turned=False)
    # The warped map shows at d the paint of d + w x d, so paint of d is at d - w x d in it.
    d = found.direction_body
    moved = -torch.linalg.cross(shift_field(d, 1.0), d)
    planted = torch.stack([(moved * axis).sum(-1) for axis in compass(d)], dim=-1)
    off = torch.rad2deg((found.moved_rad - planted).norm(dim=-1))
    off = off[torch.isfinite(off)]
    assert len(off) > 50
    # Within a patch of 15 degrees the shift itself changes; its mean is what is found.
    assert float(off.median()) < 0.15
    assert float(torch.rad2deg((found.moved_rad + planted).norm(dim=-1)).nanmedian()) > 1.0
    assert math.degrees(found.rms_rad) == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
def test_a_worn_place_does_not_turn_the_map(paint):
    worn = turned_map(paint, TURN.mT)
    worn = torch.where(map_directions(HEIGHT)[..., 0] > 0.9, 1.0, worn)
    found = compare_maps(worn, paint)
    assert math.degrees(float(so3.geodesic_distance(found.R_other_reference, TURN))) < 0.02
    assert math.degrees(float(found.length_rad.median())) < 0.05


@pytest.mark.slow
def test_the_shift_of_east_and_north_has_the_sign_of_the_map(paint):
    """Rolled by two columns to the right, all paint lies 360 / 128 degrees further east (at the equator)."""
    found = compare_maps(paint.roll(1, 1), paint, turned=False)
    d, moved = found.direction_body, found.moved_rad
    near = (d[:, 2].abs() < 0.3) & torch.isfinite(moved).all(1)
    assert near.sum() > 5
    expected = math.radians(180 / HEIGHT) * (1 - d[near, 2] ** 2).sqrt()
    assert_close(moved[near, 0], expected, atol=math.radians(0.15))
    assert float(moved[near, 1].abs().max()) < math.radians(0.15)


@pytest.mark.slow
def test_unseen_paint_of_either_map_is_not_compared(paint):
    half = paint.clone()
    half[:, :HEIGHT] = torch.nan  # the western half
    found = compare_maps(turned_map(half, TURN.mT), paint)
    assert math.degrees(float(so3.geodesic_distance(found.R_other_reference, TURN))) < 0.1
    known = torch.isfinite(found.moved_rad).all(1)
    longitude = torch.atan2(found.direction_body[:, 1], found.direction_body[:, 0])
    assert known.sum() > 20
    # Only patches that lie within the eastern half as a whole: 7.5 degrees from its edge, by angle on the sphere.
    assert float((found.direction_body[known, 1]).min()) > math.sin(math.radians(6.0))
    assert not known[longitude < 0].any()


@pytest.mark.slow
def test_maps_of_two_balls_and_mirrored_ones_are_refused(paint):
    other = random_texture("dots", 4, HEIGHT)
    for wrong in (other, paint.flip(1)):
        with pytest.raises(PaintError, match="one ball") as caught:
            compare_maps(wrong, paint)
        assert "\n" not in str(caught.value)
    with pytest.raises(ShapeError, match="2 H"):
        compare_maps(paint[:, :100], paint)


def test_levels_are_fitted_past_a_new_spot(paint):
    spotted = paint.clone()
    spotted[20:40, 30:60] = 1.0
    gain, offset = fit_levels(0.5 * paint + 0.2, spotted)
    assert gain == pytest.approx(2.0, abs=0.05)
    assert offset == pytest.approx(-0.4, abs=0.05)


@pytest.mark.slow
def test_worn_paint_is_shown_and_moved_paint_is_not(paint):
    assert float(texture_change(paint, paint).abs().max()) < 1e-6
    moved = warped(paint, 0.4)
    assert float(texture_change(moved, paint).abs().mean()) < 0.005
    direction = map_directions(HEIGHT)
    dot = direction[(paint < 0.05) & (direction[..., 2].abs() < 0.5)][0]
    spot = direction @ dot > math.cos(math.radians(12))
    worn = torch.where(spot, 1.0, moved)  # black dots rubbed off, in white paint
    change = texture_change(worn, paint)
    lost = spot & (paint < 0.1)
    assert lost.sum() > 10
    assert float(change[lost].median()) > 0.5, "brighter than before: positive"
    assert float(change[~spot].abs().mean()) < 0.005
    found = compare_maps(worn, paint, turned=False)
    kept = without_changed(found, change, 0.15)
    gone = torch.isfinite(found.moved_rad[:, 0]) & torch.isnan(kept.moved_rad[:, 0])
    near = found.direction_body @ dot > math.cos(math.radians(20))
    assert not (gone & ~near).any(), "patches away from the worn place keep their shifts"
    assert torch.isnan(kept.moved_rad[found.direction_body @ dot > math.cos(math.radians(5))]).all()
    unknown = torch.where(spot, torch.nan, paint)
    assert torch.isnan(texture_change(unknown, paint)[spot]).all()
    assert torch.isnan(texture_change(paint, unknown)[spot]).all()


def test_compass_axes_point_east_and_north():
    east, north = compass(torch.tensor([1.0, 0.0, 0.0]))
    assert_close(east, torch.tensor([0.0, 1.0, 0.0]))
    assert_close(north, torch.tensor([0.0, 0.0, 1.0]))
    d = fibonacci_directions(100)
    for axis in compass(d):
        assert_close((axis * d).sum(-1), torch.zeros(100, dtype=torch.float64))
