"""The share of the limb used for the position, by geometry, for compiled code and torch."""

from dataclasses import replace

import pytest
import torch
from refine_examples import (
    BLUR_PX,
    DISTANCE_MM,
    RADIUS_MM,
    Rig,
    balls,
    cut,
    f64,
    flat_light,
    model_of,
    noisy,
    pictures_of,
    rig_of,
)
from torch import Tensor

from sphereorient.pose.compiled import COMPILED, IN_TORCH, refine_library
from sphereorient.pose.pixels import LinesOfSight, Pixels
from sphereorient.pose.poses import PoseStart
from sphereorient.sphere.renderer import rim_directions

RIG, COUNT = rig_of(48.0), 4
RIGHT_TO = 0.03
BODIES = [
    pytest.param(COMPILED, marks=pytest.mark.skipif(refine_library() is None, reason="needs the compiled fit")),
    IN_TORCH,
]


def disks(X: Tensor, R: Tensor, rig: Rig = RIG) -> Pixels:
    return cut(rig, noisy(pictures_of(rig, "patches", X, R), 2.0, 1), X)


def coverage(body: object, pixels: Pixels, X: Tensor, R: Tensor, rig: Rig = RIG, **changes: object) -> Tensor:
    use = torch.ones(len(X), len(rig.cameras), dtype=torch.bool)
    light = flat_light(len(rig.cameras), 2.0)
    model = replace(model_of(rig.table("patches")), **{"light": light} | changes)
    return body.refine(pixels, PoseStart(X, R, use), model, 2).limb_coverage


@pytest.mark.parametrize("body", BODIES)
def test_all_of_a_whole_disk_counts_of_every_or_some_pixels(body):
    X, R = balls(COUNT, 1)
    for step, to in ((1, RIGHT_TO), (3, 0.08)):  # every third: some 50 pixels of the limb
        assert coverage(body, disks(X, R).thinned(step), X, R).min() > 1 - to


@pytest.mark.parametrize("body", BODIES)
def test_a_mask_over_a_half_and_over_a_quarter_leaves_the_rest(body):
    X, R = balls(COUNT, 1)
    pixels = disks(X, R)
    right, down = pixels.place
    for masked, left in ((right < 0, 0.5), ((right < 0) & (down < 0), 0.75)):
        found = coverage(body, replace(pixels, inside=pixels.inside & ~masked), X, R)
        assert (found - left).abs().max() < RIGHT_TO


@pytest.mark.parametrize("body", BODIES)
def test_pixels_beyond_the_border_do_not_count(body):
    X, R = balls(COUNT, 1)
    X = X + f64([[17.0 + 2 * k, 0.0, 0.0] for k in range(COUNT)])  # to the right in both cameras
    expected = []
    for camera in RIG.cameras:
        rim, _ = rim_directions(camera, X, 720)
        u, v = camera.project(X[:, None] + RADIUS_MM * rim).unbind(-1)
        width, height = camera.image_size
        within = (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        expected.append(within.double().mean(1))
    share = torch.stack(expected, 1)
    assert share.min() < 0.6 < 0.85 < share.max()
    assert (coverage(body, disks(X, R), X, R) - share).abs().max() < RIGHT_TO


@pytest.mark.parametrize("body", BODIES)
def test_a_limb_in_shadow_does_not_count(body):
    X, R = balls(COUNT, 1)
    light = replace(flat_light(2, 2.0), dark=torch.tensor([-torch.inf, 1e6]))
    bright, dark = coverage(body, disks(X, R), X, R, light=light).T
    assert bright.min() > 1 - RIGHT_TO
    assert dark.max() < 0.1  # of pixels that hardly reach the limb


@pytest.mark.parametrize("body", BODIES)
def test_that_of_a_near_ball_on_the_axis_is_whole(body):
    near = 2.9 * RADIUS_MM
    moved = [replace(one, T_cam_lab_mm=f64([0, 0, near])) for one in RIG.cameras[:1]]
    cameras = [replace(one, f_px=one.f_px * near / DISTANCE_MM) for one in moved]
    rig = Rig(tuple(cameras), tuple(LinesOfSight(one) for one in cameras), 54.0)
    X, R = f64([[0.0, 0.0, 0.0]]), balls(1, 1)[1]
    found = coverage(body, disks(X, R, rig), X, R, rig, blur_px=BLUR_PX)
    assert found.min() > 1 - RIGHT_TO
    half = disks(X, R, rig)
    half = replace(half, inside=half.inside & (half.place[1] < 0))
    assert (coverage(body, half, X, R, rig) - 0.5).abs().max() < RIGHT_TO
