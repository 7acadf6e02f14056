"""Masks: pixels of static occluders are not used."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from locate_examples import BACK, DIAMETER, SETTINGS, SHAPE, blobs, even_background, filmed, looking_down, plant

from sphereorient.errors import ExperimentError
from sphereorient.experiment.recording import load_mask
from sphereorient.locate import Background, find_ball
from sphereorient.locate.scene import fixed_ball, learn_background
from sphereorient.pose.pixels import LinesOfSight, cut_pixels, disk_stencil

MIDDLE = (99.37, 84.81)
LOW = int(MIDDLE[1] - 2)  # a cup that fits the ball hides it from this row on
CUP = 1.25  # its radius over the ball's


def in_the_cup() -> np.ndarray:
    rows, columns = np.ogrid[: SHAPE[0], : SHAPE[1]]
    return (np.hypot(rows - MIDDLE[1], columns - MIDDLE[0]) < CUP * DIAMETER / 2) & (rows >= LOW)


def held(frame: np.ndarray) -> np.ndarray:
    """A bright cup before the lower half of a frame's ball."""
    return np.where(in_the_cup(), 190, frame).astype(np.uint8)


def shown() -> np.ndarray:
    return ~in_the_cup()


def test_a_half_hidden_ball_is_found_with_a_mask():
    frame = held(filmed(plant(blobs, *MIDDLE)))
    masked = replace(even_background(), shown=shown())
    outline, _ = find_ball(frame, masked, DIAMETER, SETTINGS)
    assert outline is not None
    assert np.hypot(outline.u_px - MIDDLE[0], outline.v_px - MIDDLE[1]) < 0.4
    assert outline.radius_px == pytest.approx(DIAMETER / 2, abs=0.4)
    assert outline.coverage > 0.8, "of the rim that can be seen"
    # Without, the cup's rim is taken for the ball's.
    free, _ = find_ball(frame, even_background(), DIAMETER, SETTINGS)
    assert free is None or abs(free.radius_px - DIAMETER / 2) > 1.0


def test_a_mask_that_hides_nothing_changes_nothing():
    frame = filmed(plant(blobs, *MIDDLE))
    everything = replace(even_background(), shown=np.ones(SHAPE, bool))
    assert find_ball(frame, everything, DIAMETER, SETTINGS) == find_ball(frame, even_background(), DIAMETER, SETTINGS)


def test_hidden_pixels_do_not_differ_from_the_scene():
    background = replace(even_background(), shown=shown())
    difference = background.difference(np.full(SHAPE, 200, np.uint8))
    assert (difference[~shown()] == 0).all()
    assert (difference[shown()] == 200 - BACK).all()


def test_a_learnt_background_keeps_the_mask():
    frames = np.stack([filmed(np.full(SHAPE, BACK, np.float32), seed) for seed in range(12)])
    learnt = learn_background(frames, DIAMETER, SETTINGS, None, shown())
    np.testing.assert_array_equal(learnt.shown, shown())


def test_hidden_pixels_are_not_inside_a_disk():
    rows = np.repeat(np.arange(SHAPE[0], dtype=np.float32)[:, None], SHAPE[1], 1)
    pixels = cut_pixels(
        rows,
        Background(mean=rows, noise=rows, full_scale=255.0, shown=shown()),
        LinesOfSight(looking_down(image_size=SHAPE[::-1])),
        MIDDLE,
        disk_stencil(35.0),
    )
    assert torch.equal(pixels.inside, pixels.grey < LOW)  # the whole stencil lies within the cup's radius
    assert 0.2 < float(pixels.inside.float().mean()) < 0.95


@pytest.mark.slow
def test_a_ball_that_turns_in_its_place_is_found_past_a_mask():
    def turned(k: int) -> np.ndarray:
        return held(filmed(plant(lambda x, y: blobs(x + 0.3 * k, y - 0.2 * k), *MIDDLE), k))

    frames = np.stack([turned(k) for k in range(12)])
    flicker = frames.copy()  # the moving occluder lies under the mask too
    flicker[::2, in_the_cup()] = 30
    outline, scene = fixed_ball(flicker, SETTINGS, None, shown())
    assert np.hypot(outline.u_px - MIDDLE[0], outline.v_px - MIDDLE[1]) < 1.0
    assert outline.radius_px == pytest.approx(DIAMETER / 2, abs=1.0)
    np.testing.assert_array_equal(scene.shown, shown())


def test_masks_are_read_white_where_the_ball_is_seen(tmp_path):
    grey = np.where(shown(), 255, 0).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "mask.png"), grey)
    np.testing.assert_array_equal(load_mask(tmp_path / "mask.png", SHAPE), shown())
    cv2.imwrite(str(tmp_path / "deep.png"), grey.astype(np.uint16) * 257)
    np.testing.assert_array_equal(load_mask(tmp_path / "deep.png", SHAPE), shown())
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros(SHAPE, np.uint8))
    for name, shape, words in (
        ("black.png", SHAPE, "black only"),
        ("mask.png", (SHAPE[0], 100), "100 x 170"),
        ("none.png", SHAPE, "no such file"),
    ):
        with pytest.raises(ExperimentError, match=words) as caught:
            load_mask(tmp_path / name, shape)
        assert "\n" not in str(caught.value)
