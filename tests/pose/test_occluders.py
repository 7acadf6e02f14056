"""Occluders are found as connected residuals; noise and single outliers are none."""

import torch
from refine_examples import balls, cut, noisy, pictures_of, rig_of

from sphereorient.pose.fit import MOST_HIDDEN, occluded

SIGMA, RIG = 3.0, rig_of(64.0)
X, R = balls(2, 5)
CLEAN = pictures_of(RIG, "patches", X, R)
NOISE = torch.tensor([[SIGMA**2, 0.0, 0.0, 0.0]]).repeat(4, 1)


def found(pictures, most=MOST_HIDDEN):
    pixels = cut(RIG, pictures, X)
    return occluded(pixels, cut(RIG, CLEAN, X).grey, NOISE, pixels.inside, most), pixels


def test_a_speck_is_found_with_its_border_and_nothing_else():
    pictures, (u, v) = noisy(CLEAN, SIGMA, 1), RIG.cameras[0].project(X[0]).round().long().tolist()
    pictures[0, 0, v - 3 : v + 4, u - 3 : u + 4] += 60.0
    hidden, pixels = found(pictures)
    near = (pixels.place.abs() <= 3).all(0)
    assert bool(hidden[0, near].all())
    assert not hidden[0, (pixels.place.abs() > 10).any(0)].any()
    assert not hidden[1:].any()


def test_single_outliers_are_left_to_the_weights():
    pictures = noisy(CLEAN, SIGMA, 1)
    pictures[:, :, ::9, ::9] = 255.0
    assert not found(pictures, most=1.0)[0].any()


def test_half_of_a_disk_may_be_hidden():
    pictures = noisy(CLEAN, SIGMA, 1)
    edge = round(float(RIG.cameras[0].project(X[0])[0])) + 6  # the margin adds 3 px
    pictures[0, 0, :, edge:] += 60.0
    hidden, pixels = found(pictures)
    assert bool(hidden[0, pixels.place[0] > 8].all())
    assert not hidden[0, pixels.place[0] < -2].any()


def test_where_most_of_a_disk_differs_the_model_is_wrong():
    pictures = noisy(CLEAN, SIGMA, 1)
    pictures[:, :, :, ::12] += 60.0
    pictures[:, :, :, 1::12] += 60.0
    pictures[:, :, :, 2::12] += 60.0
    assert not found(pictures)[0].any()
    assert found(pictures, most=1.0)[0].any()


def test_a_batch_is_the_stack_of_its_disks():
    pictures = noisy(CLEAN, SIGMA, 1)
    pictures[:, :, 70:80, 70:80] += 80.0
    whole, pixels = found(pictures)
    expected = cut(RIG, CLEAN, X).grey
    for k in range(len(whole)):
        one = pixels.where(torch.tensor([k]))
        assert occluded(one, expected[k : k + 1], NOISE[:1], one.inside, MOST_HIDDEN)[0].equal(whole[k])
