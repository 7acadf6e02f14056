import numpy as np
import pytest

from sphereorient.search import crop_disk

# Bilinear look-up is exact on a plane; OpenCV 4 rounds places to 1/32 px: up to 7/64 of slopes 3 and 4.
EXACT = 0.12
U, V = np.meshgrid(np.arange(90.0), np.arange(70.0))
PLANE = 3 * U - 4 * V + 300


def plane(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return 3 * u - 4 * v + 300


def expected(u_px: float, v_px: float, radius_px: float, size_px: int) -> np.ndarray:
    """Pixel k of S shows the place (2 k + 1)/S - 1 radii from the centre; whole numbers are pixel centres."""
    at = ((2 * np.arange(size_px) + 1) / size_px - 1) * radius_px
    return plane(u_px + at[None, :], v_px + at[:, None])


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32, np.float64])
def test_it_takes_every_type_of_frame(kind):
    frame = (U + V).astype(kind)
    crop = crop_disk(frame, 40.0, 30.0, 10.0, 20)
    assert crop.dtype == np.float32
    assert crop[0, 0] == pytest.approx(40 - 9.5 + 30 - 9.5, abs=EXACT)


@pytest.mark.parametrize("place", [(41.0, 33.0), (41.37, 32.81), (40.5, 30.5), (22.25, 21.9)], ids=str)
@pytest.mark.parametrize(("radius_px", "size_px"), [(20.3, 40), (12.0, 40), (19.6, 17)])
def test_a_plane_of_grey_is_found_again_below_a_pixel(place, radius_px, size_px):
    crop = crop_disk(PLANE, *place, radius_px, size_px)
    assert np.abs(crop - expected(*place, radius_px, size_px)).max() < EXACT
    # Half a pixel, and rows for columns, are seen.
    assert np.abs(crop - expected(place[0] + 0.5, place[1], radius_px, size_px)).min() > 10 * EXACT
    assert np.abs(crop - expected(place[1], place[0], radius_px, size_px)).max() > 10 * EXACT


def test_at_its_own_size_a_crop_is_the_frames_pixels():
    frame = np.random.default_rng(0).integers(0, 255, (40, 50)).astype(np.uint8)
    # Centre between pixels 19 and 20, radius 8: pixels 12 .. 27.
    assert np.array_equal(crop_disk(frame, 19.5, 15.5, 8.0, 16), frame[8:24, 12:28].astype(np.float32))


@pytest.mark.parametrize("place", [(-3.3, 20.0), (88.2, 69.4), (40.0, -6.7), (5.0, 75.2)], ids=str)
def test_beyond_the_border_the_nearest_pixel_is_repeated(place):
    u, v = place
    at = ((2 * np.arange(24) + 1) / 24 - 1) * 12.0
    clamped = plane(np.clip(u + at[None, :], 0, 89), np.clip(v + at[:, None], 0, 69))
    assert np.abs(crop_disk(PLANE, u, v, 12.0, 24) - clamped).max() < EXACT


@pytest.mark.parametrize(
    ("place", "corner"),
    [((-30, 35), PLANE[35, 0]), ((300, 35), PLANE[35, 89]), ((45, -14), PLANE[0, 45]), ((45, 400), PLANE[69, 45])],
    ids=str,
)
def test_a_disk_beside_the_frame_shows_the_nearest_pixels(place, corner):
    crop = crop_disk(PLANE, *place, 10.0, 21)
    assert crop[10, 10] == pytest.approx(corner, abs=EXACT)


def test_the_frame_stays_as_it_is():
    frame = PLANE.copy()
    crop_disk(frame, 40.2, 30.7, 12.0, 24)
    assert np.array_equal(frame, PLANE)
