"""Blobs: the ball before brighter things of another shape, nothing in an empty picture, flicker hidden by the noise."""

import numpy as np
import pytest
from locate_examples import BACK, DIAMETER, NOISE, SETTINGS, blobs, even_background, filmed, plant, white

from sphereorient.locate import LocateSettings
from sphereorient.locate.outline import find_blobs

WIDE = (240, 320)  # H, W
FLAT = np.full(WIDE, NOISE, np.float32)


def difference_of(picture: np.ndarray, seed: int = 0) -> np.ndarray:
    return even_background(picture.shape).difference(filmed(picture, seed))


def glitter(*streaks):
    """Bright streaks of half width 4 px: (row, column, length, slope) each."""

    def add(grey, rows, columns):
        for row, column, length, slope in streaks:
            along = np.abs(columns - column) < length / 2
            streak = along & (np.abs(rows - row - slope * (columns - column)) < 4)
            grey = np.where(streak, np.float32(250), grey)
        return grey

    return add


STREAKS = glitter((40, 240, 110, 0.1), (200, 230, 90, -0.3), (120, 270, 80, 0.8), (215, 60, 100, 0.0))


def test_the_ball_comes_before_brighter_glitter():
    found = find_blobs(difference_of(plant(blobs, 110.0, 95.0, shape=WIDE, also=STREAKS)), FLAT, DIAMETER, SETTINGS)
    assert np.hypot(found[0].u_px - 110.0, found[0].v_px - 95.0) < 8
    assert found[0].merit > 1.2 * found[1].merit
    merits = [blob.merit for blob in found]
    assert merits == sorted(merits, reverse=True)


def test_the_glitter_is_found_where_there_is_no_ball():
    """Else the test above would show nothing."""
    picture = plant(white, 0.0, 0.0, radius=1e-3, shape=WIDE, also=STREAKS)
    assert find_blobs(difference_of(picture), FLAT, DIAMETER, SETTINGS)


@pytest.mark.parametrize("reduction", [1, 2, 3, 4])
def test_the_place_does_not_depend_on_the_reduction(reduction):
    """Pixel centres are whole numbers also after reducing: else the place is off by half a reduced pixel."""
    picture = plant(white, 131.0, 88.0, shape=WIDE)
    found = find_blobs(difference_of(picture), FLAT, DIAMETER, LocateSettings(reduction=reduction))
    assert abs(found[0].u_px - 131.0) < 0.25
    assert abs(found[0].v_px - 88.0) < 0.25


@pytest.mark.parametrize("seed", range(3))
def test_an_empty_picture_has_no_blobs(seed):
    assert find_blobs(difference_of(np.full(WIDE, BACK, np.float32), seed), FLAT, DIAMETER, SETTINGS) == []


def test_a_picture_without_any_difference_has_no_blobs():
    assert find_blobs(np.zeros(WIDE, np.float32), FLAT, DIAMETER, SETTINGS) == []


def test_flicker_is_hidden_by_the_noise_there():
    difference = difference_of(plant(white, 240.0, 120.0, shape=WIDE))
    noise = FLAT.copy()
    noise[:, 160:] = 60.0
    assert find_blobs(difference, FLAT, DIAMETER, SETTINGS)
    assert find_blobs(difference, noise, DIAMETER, SETTINGS) == []


def test_flicker_of_the_balls_shape_does_not_hide_the_ball():
    """Brighter than the ball and as round: only the noise map distinguishes it from the ball."""
    ball = plant(blobs, 90.0, 110.0, shape=WIDE)
    fan = plant(lambda x, y: np.full_like(x, 240), 240.0, 110.0, shape=WIDE)
    difference = difference_of(np.maximum(ball, fan))
    noise = np.where(fan > BACK + 1, np.float32(60.0), np.float32(NOISE))
    best = find_blobs(difference, noise, DIAMETER, SETTINGS)[0]
    assert np.hypot(best.u_px - 90.0, best.v_px - 110.0) < 8


def test_there_are_no_more_blobs_than_the_setting_allows():
    difference = difference_of(plant(white, 110.0, 95.0, shape=WIDE, also=STREAKS))
    assert len(find_blobs(difference, FLAT, DIAMETER, LocateSettings(blob_candidates=1))) == 1
    assert len(find_blobs(difference, FLAT, DIAMETER, LocateSettings(blob_candidates=3))) <= 3


def test_the_difference_is_not_written_into():
    difference = difference_of(plant(white, 110.0, 95.0, shape=WIDE))
    before = difference.copy()
    find_blobs(difference, FLAT, DIAMETER, LocateSettings(reduction=1))
    np.testing.assert_array_equal(difference, before)
