"""The outline: planted disks come back to a fraction of a pixel, for any paint and any object beside them."""

import cv2
import numpy as np
import pytest
from locate_examples import (
    BACK,
    DIAMETER,
    NOISE,
    PLACES,
    SHAPE,
    WHITE,
    blobs,
    checker,
    distance_px,
    even_background,
    filmed,
    lit_from_the_left,
    outline_of,
    plant,
    white,
)

from sphereorient.locate import LocateSettings
from sphereorient.locate.outline import Blob, fit_outline

RADII = [39.0, 36.4]


def sectors(count: int, turn: float = 0.0):
    """White sectors; the others are as dark as the background, so that they and their rim vanish."""

    def paint(x, y):
        number = np.floor((np.arctan2(y, x) + turn) * count / (2 * np.pi))
        return np.where(number % 2 == 0, WHITE, BACK).astype(np.float32)

    return paint


def half_gone(x, y):
    return np.where(x > 0, WHITE, BACK).astype(np.float32)


def patches_gone(x, y):
    wave = np.sin(4.1 * x + 1.3 * y) + np.sin(3.7 * y - 2.2 * x + 1) + np.sin(5.3 * x + 4.4 * y - 0.7)
    return np.where(wave > 0, WHITE, BACK).astype(np.float32)


def dimmer_at_the_rim(ambient: float):
    """A ball lit from the camera: brightness falls with the slope of its surface."""

    def paint(x, y):
        return (WHITE * (ambient + (1 - ambient) * np.sqrt(np.clip(1 - x**2 - y**2, 0, None)))).astype(np.float32)

    return paint


def bubble(place, radius, angle, size, inside=0.0):
    """A glaring disk that touches the rim, or lies over it by `inside` px."""

    def add(grey, rows, columns):
        u = place[0] + np.cos(angle) * (radius + size - inside)
        v = place[1] + np.sin(angle) * (radius + size - inside)
        return np.where((rows - v) ** 2 + (columns - u) ** 2 <= size**2, np.float32(250), grey)

    return add


@pytest.mark.parametrize("radius", RADII)
@pytest.mark.parametrize("place", PLACES)
def test_a_plain_disk_is_centred_to_a_twentieth_of_a_pixel(place, radius):
    outline = outline_of(filmed(plant(white, *place, radius)), *place)
    assert distance_px(outline, place) < 0.05
    assert outline.coverage == 1.0
    assert 0 < outline.rms_px < 0.1


@pytest.mark.parametrize("radius", RADII)
@pytest.mark.parametrize("place", PLACES)
def test_the_radius_of_a_ball_dimmer_at_its_rim_is_right(place, radius):
    outline = outline_of(filmed(plant(dimmer_at_the_rim(0.3), *place, radius)), *place)
    assert abs(outline.radius_px - radius) < 0.15
    assert distance_px(outline, place) < 0.05


@pytest.mark.parametrize("radius", RADII)
def test_the_root_of_the_picture_makes_an_evenly_lit_disk_too_large_by_a_known_amount(radius):
    """The known limit of edges in the root of the picture, accepted for the dim rim of a real ball, above."""
    outline = outline_of(filmed(plant(white, *PLACES[0], radius)), *PLACES[0])
    assert 0.30 < outline.radius_px - radius < 0.45


def test_two_disks_that_differ_by_a_fraction_of_a_pixel_are_distinguished():
    radii = np.array([outline_of(filmed(plant(white, *PLACES[0], r)), *PLACES[0]).radius_px for r in (38.0, 38.25)])
    assert abs(np.diff(radii)[0] - 0.25) < 0.03


@pytest.mark.parametrize(
    "paint", [half_gone, sectors(8), sectors(6, 0.3), patches_gone], ids=["half", "8", "6", "paint"]
)
@pytest.mark.parametrize("place", PLACES)
def test_half_of_the_rim_may_vanish_into_the_dark(place, paint):
    whole = outline_of(filmed(plant(white, *place)), *place)
    outline = outline_of(filmed(plant(paint, *place), seed=1), *place)
    assert distance_px(outline, place) < 0.3
    assert abs(outline.radius_px - whole.radius_px) < 0.15
    assert 0.35 < outline.coverage < 0.65


@pytest.mark.parametrize(
    ("paint", "share"),
    [(checker, 0.9), (blobs, 0.9), (lit_from_the_left(white), 0.0), (lit_from_the_left(blobs), 0.0)],
    ids=["checker", "blobs", "lit", "lit blobs"],
)
@pytest.mark.parametrize("place", PLACES)
def test_neither_edges_of_the_paint_nor_light_from_one_side_count_as_rim(place, paint, share):
    outline = outline_of(filmed(plant(paint, *place)), *place)
    assert distance_px(outline, place) < 0.1
    assert abs(outline.radius_px - DIAMETER / 2) < 0.45
    assert outline.coverage > share


@pytest.mark.parametrize("paint", [white, blobs])
@pytest.mark.parametrize(("angle", "size", "inside"), [(0.3, 4, 0), (2.0, 6, 2), (3.7, 8, 0), (5.4, 10, 3)])
def test_a_bright_bubble_at_the_rim_is_left_out(angle, size, inside, paint):
    place = PLACES[1]
    clean = outline_of(filmed(plant(paint, *place)), *place)
    outline = outline_of(filmed(plant(paint, *place, also=bubble(place, 39.0, angle, size, inside))), *place)
    assert distance_px(outline, place) < 0.1
    assert abs(outline.radius_px - clean.radius_px) < 0.05
    assert outline.coverage < 1.0


@pytest.mark.parametrize("paint", [white, blobs])
@pytest.mark.parametrize("place", [(20.3, 80.2), (5.2, 80.0), (-2.0, 80.0), (100.0, 10.4)])
def test_a_disk_that_the_border_cuts_is_measured_by_what_is_left(place, paint):
    outline = outline_of(filmed(plant(paint, *place)), *place)
    assert distance_px(outline, place) < 0.15
    assert abs(outline.radius_px - DIAMETER / 2) < 0.45
    assert 0.45 < outline.coverage < 0.7


def test_the_spread_of_half_a_rim_is_that_of_its_geometry():
    """By hand: over half a rim the mean of cos^2 is 1/2, that of cos 2/pi; so the errors of u and radius correlate.
    The tolerance holds half a direction that is missing at either end.
    """
    det = 0.5 - (2 / np.pi) ** 2
    expected = [[1 / det, 0, -2 / np.pi / det], [0, 2, 0], [-2 / np.pi / det, 0, 0.5 / det]]
    half = outline_of(filmed(plant(half_gone, *PLACES[0])), *PLACES[0])
    np.testing.assert_allclose(half.spread, expected, rtol=0.1, atol=1e-6)
    whole = outline_of(filmed(plant(white, *PLACES[0])), *PLACES[0])
    np.testing.assert_allclose(whole.spread, np.diag([1, 1, 0.5]), atol=1e-6)


@pytest.mark.parametrize("paint", [white, blobs])
@pytest.mark.parametrize("u", [-14.0, -7.0, 0.0, 12.0])
def test_a_disk_that_the_border_cuts_is_as_wrong_as_its_spread_states(u, paint):
    outline = outline_of(filmed(plant(paint, u, 80.0)), u, 80.0, LocateSettings(coverage_min=0.2))
    error = np.array([outline.u_px - u, outline.v_px - 80.0, outline.radius_px - DIAMETER / 2])
    scale = max(outline.rms_px, 0.2)  # the known error of the radius is no scatter
    assert error @ np.linalg.inv(outline.spread) @ error < 3 * (3 * scale) ** 2
    sigma = np.sqrt(np.diag(outline.spread))
    assert sigma[0] > 1.5 * sigma[1]  # along the border the error is small


def wrinkled(depth, share):
    """A rim with nine waves, which shows in a share of its directions."""

    def paint(x, y):
        angle = np.arctan2(y, x)
        inside = np.hypot(x, y) < 1 - depth * (1 + np.sin(9 * angle))
        return np.where(inside & (np.abs(angle) < share * np.pi), WHITE, BACK).astype(np.float32)

    return paint


@pytest.mark.parametrize(
    ("depth", "share", "counts"), [(0.025, 1, True), (0.03, 0.7, True), (0.025, 0.5, False), (0.005, 0.5, True)]
)
def test_edges_that_scatter_are_a_rim_only_if_they_are_nearly_all_around(depth, share, counts):
    outline = outline_of(filmed(plant(wrinkled(depth, share), *PLACES[1])), *PLACES[1])
    assert (outline is not None) == counts


def test_the_borders_of_the_picture_are_no_rim():
    """A picture that is bright all over has edges nowhere."""
    frame = filmed(np.full(SHAPE, WHITE, np.float32))
    assert outline_of(frame, 100.0, 80.0) is None


@pytest.mark.parametrize("seed", range(4))
def test_noise_alone_has_no_outline(seed):
    assert outline_of(filmed(np.full(SHAPE, BACK, np.float32), seed), 100.0, 80.0) is None


def bar(grey, rows, columns):
    return np.where(np.abs(rows - 80 + 0.2 * (columns - 100)) < 12, np.float32(200), np.float32(BACK))


def triangle(grey, rows, columns):
    inside = (rows > 50) & (rows - 80 < 40 - 1.6 * np.abs(columns - 100))
    return np.where(inside, np.float32(200), np.float32(BACK))


def square(grey, rows, columns):
    inside = (np.abs(rows - 80) < 34) & (np.abs(columns - 100) < 34)
    return np.where(inside, np.float32(200), np.float32(BACK))


@pytest.mark.parametrize("shape", [bar, triangle, square])
def test_shapes_that_are_no_disks_are_not_taken_for_one(shape):
    outline = outline_of(filmed(plant(white, 100.0, 80.0, also=shape)), 100.0, 80.0)
    assert outline is None or outline.coverage < LocateSettings().coverage_min


@pytest.mark.parametrize(("radius", "seen"), [(10, False), (20, False), (25, True), (53, True), (58, False)])
def test_only_radii_within_the_tolerance_are_accepted(radius, seen):
    """0.6 to 1.4 times 39 px: 23.4 to 54.6."""
    outline = outline_of(filmed(plant(white, 100.0, 80.0, radius)), 100.0, 80.0)
    assert (outline is not None) == seen
    if seen:
        assert abs(outline.radius_px - radius) < 0.45


def test_whole_numbers_are_pixel_centres():
    """A disk drawn over the pixels 60 .. 139 and 40 .. 119 has its middle between the two middle ones."""
    outline = outline_of(filmed(plant(white, 99.5, 79.5, 40.0), blur_px=0.3), 99.5, 79.5)
    assert distance_px(outline, (99.5, 79.5)) < 0.03


def test_a_window_of_a_few_pixels_has_no_outline():
    difference = np.full((6, 6), 100, np.float32)
    assert fit_outline(difference, NOISE, Blob(u_px=3, v_px=3, merit=1.0), DIAMETER, LocateSettings()) is None


def test_the_same_picture_gives_the_same_outline():
    difference = even_background().difference(filmed(plant(blobs, *PLACES[0])))
    before = difference.copy()
    blob = Blob(u_px=98.0, v_px=85.0, merit=1.0)
    first, again = (fit_outline(difference, NOISE, blob, DIAMETER, LocateSettings()) for _ in range(2))
    assert first == again
    np.testing.assert_array_equal(difference, before)


@pytest.mark.parametrize("colour", [4.0, 40.0, 110.0], ids=["darker", "brighter", "bright"])
@pytest.mark.parametrize("angle", [0.4, 2.2, 4.0])
def test_a_round_thing_of_the_same_size_that_passes_before_the_ball_is_not_taken_for_it(angle, colour):
    """Its rim is whole, the ball's is not; but nothing is painted on it."""
    place, radius = (99.37, 84.81), DIAMETER / 2
    before = np.array(place) + radius * np.array([np.cos(angle), np.sin(angle)])

    def hidden(grey, rows, columns):
        return np.where((columns - before[0]) ** 2 + (rows - before[1]) ** 2 < radius**2, np.float32(colour), grey)

    outline = outline_of(filmed(plant(blobs, *place, also=hidden)), *place)
    assert distance_px(outline, place) < 1.0
    assert abs(outline.radius_px - radius) < 1.0
    assert outline.coverage < 0.75


@pytest.mark.parametrize("wider", [-0.03, 0.0, 0.03])
def test_the_ratio_of_a_disk_that_is_wider_than_high_is_measured(wider):
    u, v = 40.3, 38.7
    picture = plant(white, u, v)
    turn = np.float32([[1 + wider / 2, 0, -u * wider / 2], [0, 1 - wider / 2, v * wider / 2]])
    stretched = cv2.warpAffine(picture, turn, picture.shape[::-1], borderValue=BACK)
    found = outline_of(filmed(stretched), u, v)
    assert found.stretch == pytest.approx(wider, abs=0.006)
