import numpy as np
import pytest
from locate_examples import BACK, NOISE, SETTINGS, blobs, checker, even_background, filmed, plant, white

from sphereorient.locate import find_disks, learn_background

SHAPE = (240, 320)


def scene(*disks, shape=SHAPE, seed=0, back=BACK):
    """Film disks (paint, u, v, radius), px, the last one in front."""

    def also(grey, rows, columns):
        for paint, u, v, radius in disks:
            x, y = (columns - np.float32(u)) / np.float32(radius), (rows - np.float32(v)) / np.float32(radius)
            grey = np.where(x**2 + y**2 <= 1, paint(*np.broadcast_arrays(x, y)), grey).astype(np.float32)
        return grey

    return filmed(plant(white, -1000.0, -1000.0, shape=shape, back=back, also=also), seed)


def found(picture, *diameters_px, background=None):
    return find_disks(picture, background or even_background(picture.shape), diameters_px, SETTINGS)


def nearest(disks, u, v):
    return min(disks, key=lambda one: np.hypot(one.u_px - u, one.v_px - v))


def astray(disks, u, v):
    one = nearest(disks, u, v)
    return np.hypot(one.u_px - u, one.v_px - v)


@pytest.mark.parametrize("seed", range(3))
def test_three_balls_are_found_where_they_are_and_nothing_else(seed):
    rng = np.random.default_rng(seed)
    places = np.array([[60, 70], [170, 150], [250, 60]]) + rng.uniform(-10, 10, (3, 2))
    paints = [blobs, checker, blobs]
    disks = found(scene(*((paint, *place, 30.0) for paint, place in zip(paints, places, strict=True))), 60, 60, 60)
    assert len(disks) == 3
    assert all(astray(disks, *place) < 1.5 for place in places)


def test_an_empty_picture_has_no_disks():
    assert found(scene(), 60, 60) == []


@pytest.mark.parametrize("visible", [0.8, 0.5, 0.3])
def test_a_ball_behind_another_one_is_found(visible):
    apart = 60 * (1 - visible) ** -0.5 * visible  # more apart, more visible; about the share for equal disks
    disks = found(scene((checker, 150, 120, 30.0), (blobs, 150 + apart, 120, 30.0)), 60, 60)
    assert astray(disks, 150, 120) < 4
    assert astray(disks, 150 + apart, 120) < 2


@pytest.mark.parametrize("place", [(12, 100), (300, 100), (150, -6), (312, 230)])
def test_a_ball_cut_by_the_border_is_found(place):
    disks = found(scene((checker, *place, 30.0), (blobs, 150, 130, 30.0)), 60, 60)
    assert astray(disks, *place) < 2
    assert astray(disks, 150, 130) < 1.5


def test_a_ball_whose_black_paint_does_not_show_is_found():
    def half_black(x, y):  # two thirds of the disk look like what is behind it
        return np.where((np.abs(y) < 0.3) | (x > 0.75), 170.0, BACK).astype(np.float32)

    disks = found(scene((half_black, 100, 100, 30.0), (blobs, 220, 120, 30.0)), 60, 60)
    assert astray(disks, 100, 100) < 4


def test_balls_of_other_diameters_are_found_with_their_own():
    disks = found(scene((checker, 80, 100, 20.0), (blobs, 200, 120, 40.0)), 40, 80)
    assert nearest(disks, 80, 100).radius_px == pytest.approx(20, abs=1)
    assert nearest(disks, 200, 120).radius_px == pytest.approx(40, abs=1.5)


def test_a_smaller_disk_than_expected_is_not_found():
    assert found(scene((checker, 80, 100, 20.0), (white, 200, 100, 9.0)), 40, 40)[1:] == []


def test_an_arc_is_less_sure_than_a_whole_rim():
    disks = found(scene((white, 100, 100, 30.0), (white, 318, 100, 30.0)), 60, 60)
    assert nearest(disks, 318, 100).rms_px > nearest(disks, 100, 100).rms_px > 0
    assert nearest(disks, 318, 100).coverage < nearest(disks, 100, 100).coverage


def test_pixels_that_something_static_hides_do_not_count():
    mask = np.ones(SHAPE, bool)
    mask[:, 150:] = False
    background = even_background(SHAPE)
    background = type(background)(mean=background.mean, noise=background.noise, full_scale=255.0, shown=mask)
    disks = found(scene((checker, 100, 100, 30.0), (blobs, 220, 100, 30.0)), 60, 60, background=background)
    assert len(disks) == 1
    assert astray(disks, 100, 100) < 1.5


SMALL = (90, 180)


def test_the_background_behind_two_balls_is_learnt_where_one_of_them_dwells():
    frames = []
    for k in range(15):
        dwelling = (checker, (40.0, 90.0, 140.0)[k // 5], 50.0, 16.0)
        frames.append(scene(dwelling, (blobs, 20.0 + 10 * k, 40.0, 16.0), shape=SMALL, seed=k))
    learnt = learn_background(np.stack(frames), (32.0, 32.0), SETTINGS)
    assert np.abs(learnt.mean - BACK).max() < 2.5
    assert learnt.noise.max() < 3 * NOISE
    one = learn_background(np.stack(frames), 32.0, SETTINGS)  # that of one ball keeps the other one
    assert np.abs(one.mean - BACK).max() > 10 or one.noise.max() > 10 * NOISE


def turning(k):
    return lambda x, y: checker(x + 0.31 * k, y)


def test_the_background_behind_a_ball_that_never_leaves_its_place_is_that_around_it():
    frames = [
        scene((turning(k), 120.0, 50.0, 16.0), (blobs, 20.0 + 4 * k, 40.0, 16.0), shape=SMALL, seed=k)
        for k in range(15)
    ]
    learnt = learn_background(np.stack(frames), (32.0, 32.0), SETTINGS)
    assert np.abs(learnt.mean - BACK).max() < 2.5
    assert learnt.noise.max() < 3 * NOISE


def test_a_disk_that_stands_still_stays_in_the_background():
    still = scene((white, 120.0, 50.0, 16.0), shape=SMALL)
    frames = [
        scene((white, 120.0, 50.0, 16.0), (checker, 20.0 + 5 * k, 40.0, 16.0), shape=SMALL, seed=k) for k in range(15)
    ]
    learnt = learn_background(np.stack(frames), (32.0, 32.0), SETTINGS)
    row, column = np.ogrid[: SMALL[0], : SMALL[1]]
    inside = np.hypot(row - 50.0, column - 120.0) < 14
    assert np.abs(learnt.mean - still.astype(float))[inside].mean() < 3 * NOISE


def test_a_list_of_one_diameter_gives_the_background_of_one_ball():
    frames = np.stack([scene((checker, 30.0 + 15 * k, 45.0, 16.0), shape=SMALL, seed=k) for k in range(9)])
    one, listed = (learn_background(frames, size, SETTINGS) for size in (32.0, (32.0,)))
    assert (one.mean == listed.mean).all()
    assert (one.noise == listed.noise).all()
