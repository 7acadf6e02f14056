"""The background: pictures without the ball, their scatter, and backgrounds from a file."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from locate_examples import BACK, SETTINGS, Paint, blobs, filmed, plant, white

from sphereorient.errors import ExperimentError
from sphereorient.experiment.recording import load_background, spread_frames
from sphereorient.locate import learn_background
from sphereorient.locate.background import measure_background, saturated, without_ball
from sphereorient.locate.outline import find_blobs

SHAPE = (150, 190)
SIGMA = 3.0


class Pictures:
    """The part of a movie that learning a background needs."""

    def __init__(self, frames: np.ndarray) -> None:
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def sample(self, indices: Sequence[int]) -> np.ndarray:
        return self._frames[list(indices)]


def noisy(count: int, sigma: float = SIGMA, level: float = 500.0, shape: tuple[int, int] = (24, 30)) -> np.ndarray:
    """Gaussian noise in 16 bits, so that rounding does not count; row 0, column 0 is the brightest of 12 bits."""
    rng = np.random.default_rng(3)
    frames = np.rint(16 * (level + sigma * rng.standard_normal((count, *shape)))).astype(np.uint16)
    frames[:, 0, 0] = 65535
    return frames


def dwelling_ball(count: int = 24) -> np.ndarray:
    """A ball that wanders about the middle by less than its radius, and moves to the corner in the last third."""
    gradient = np.linspace(-4, 4, SHAPE[1], dtype=np.float32)
    frames = []
    for k in range(count):
        u, v = 70 + 14 * np.sin(0.7 * k), 75 + 12 * np.cos(0.9 * k)
        if k >= 2 * count // 3:
            u, v = 140.0 + 3 * (k % 4), 75.0
        frames.append(filmed(plant(blobs, u, v, 30.0, SHAPE) + gradient, seed=k))
    return np.stack(frames)


@pytest.fixture(scope="module")
def dwelling() -> np.ndarray:
    return dwelling_ball()


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return BACK + np.broadcast_to(np.linspace(-4, 4, SHAPE[1], dtype=np.float32), SHAPE)


def test_the_mean_is_learnt_without_the_ball_where_it_dwells(dwelling, scene):
    learnt = learn_background(dwelling, 60.0, SETTINGS)
    error = np.abs(learnt.mean - scene)
    assert error.max() < 4
    assert np.percentile(error, 99) < 1.5
    # For comparison: the first measurement takes the ball for a part of the scene.
    first = np.abs(measure_background(dwelling).mean - scene)
    assert first.max() > 30


def test_the_noise_is_learnt_without_the_ball_where_it_dwells(dwelling):
    learnt = learn_background(dwelling, 60.0, SETTINGS)
    assert learnt.typical_noise == pytest.approx(1.5, rel=0.15)
    assert np.percentile(learnt.noise, 99) < 4
    assert np.percentile(measure_background(dwelling).noise, 99) > 20


def test_a_passing_ball_leaves_no_trace_in_the_mean(scene):
    frames = np.stack([filmed(plant(white, 10.0 + 9 * k, 75.0, 12.0, SHAPE), seed=k) for k in range(20)])
    mean = measure_background(frames).mean
    assert np.abs(mean - BACK).max() < 3
    assert np.abs(frames.mean(0) - BACK).max() > 20  # the paper's plain mean


def test_a_given_empty_picture_is_the_mean_and_only_noise_is_measured(dwelling, scene):
    empty = scene.astype(np.float32)
    given = learn_background(dwelling, 60.0, SETTINGS, empty)
    np.testing.assert_array_equal(given.mean, empty)
    assert 1.2 < given.typical_noise < 2.5  # 1.5; the ball is in a third of this small picture
    assert np.percentile(given.noise, 99) < 8  # also below the ball, which covers some pixels in most frames


def test_a_ball_at_rest_is_seen_before_a_given_empty_picture():
    """In its own movie it is part of the scene."""
    frames = np.stack([filmed(plant(white, 80.0, 75.0, 30.0, SHAPE), seed=k) for k in range(10)])
    empty = np.full(SHAPE, BACK, np.float32)
    given = measure_background(frames, empty)
    alone = measure_background(frames)
    assert given.difference(frames[0])[75, 80] > 100
    assert alone.difference(frames[0])[75, 80] < 10


@pytest.mark.parametrize("sigma", [6.0, 12.0, 30.0])
def test_the_noise_of_gaussian_noise_is_its_sigma(sigma):
    measured = measure_background(noisy(200, sigma)).noise / 16
    assert np.median(measured) == pytest.approx(sigma, rel=0.1)


@pytest.mark.parametrize("sigma", [20.0, 40.0])
def test_the_noise_about_a_given_picture_is_its_sigma(sigma):
    """Other shares of the frames, other quantiles. Above a floor: 1/255 of full scale over the root of twelve."""
    frames = noisy(1001, sigma, level=2000.0)
    measured = measure_background(frames, np.full(frames.shape[1:], 16 * 2000.0, np.float32)).noise / 16
    assert np.median(measured) == pytest.approx(sigma, rel=0.1)


def test_a_pixel_noisier_than_most_keeps_its_own_noise_about_a_given_picture():
    """Most pixels lie at the floor; a flickering third lies above it."""
    frames = noisy(1001, 20.0, level=2000.0)
    away = frames.astype(np.float32) - 16 * 2000.0
    away[:, :, 20:] *= 4
    flickering = np.clip(np.rint(16 * 2000.0 + away), 0, 65535).astype(np.uint16)
    measured = measure_background(flickering, np.full(frames.shape[1:], 16 * 2000.0, np.float32)).noise / 16
    assert np.median(measured[:, 20:]) == pytest.approx(80.0, rel=0.1)
    assert np.median(measured[:, :20]) == pytest.approx(20.0, rel=0.15)


def test_frames_that_are_all_equal_scatter_by_their_rounding():
    frames = np.full((5, 20, 20), 40, np.uint8)
    measured = measure_background(frames)
    np.testing.assert_allclose(measured.noise, 12**-0.5, rtol=1e-5)
    np.testing.assert_array_equal(measured.mean, 40.0)


def test_one_frame_is_enough_for_a_mean():
    frames = filmed(np.full(SHAPE, BACK, np.float32))[None]
    np.testing.assert_array_equal(measure_background(frames).mean, frames[0])


@pytest.mark.parametrize(
    ("dtype", "brightest", "full_scale"),
    [
        (np.uint8, 90, 255),
        (np.uint16, 1000, 1023),
        (np.uint16, 1023, 1023),
        (np.uint16, 1024, 4095),
        (np.uint16, 16000, 16383),
        (np.uint16, 65535, 65535),
    ],
)
def test_full_scale_is_that_of_the_camera_and_not_of_the_number(dtype, brightest, full_scale):
    """A camera of 10 bits never reaches 65535: against that, all its balls would be dark."""
    frames = np.full((3, 20, 20), 30, dtype)
    frames[1, 4, 5] = brightest
    assert measure_background(frames).full_scale == full_scale


def test_covered_pixels_are_measured_from_the_other_frames():
    rng = np.random.default_rng(1)
    frames = np.rint(100 + 2 * rng.standard_normal((20, 16, 16))).astype(np.uint8)
    covered = np.zeros(frames.shape, bool)
    covered[:12, 4:8, 4:8] = True  # 8 frames are free
    covered[:17, 10:14, 10:14] = True  # 3 are
    frames[covered] = 250
    first = measure_background(frames)
    again = without_ball(first, frames, covered)
    assert np.abs(first.mean[4:8, 4:8] - 100).min() > 50
    assert np.abs(again.mean[4:8, 4:8] - 100).max() < 4
    assert np.abs(again.noise[4:8, 4:8]).max() < 8
    np.testing.assert_array_equal(again.mean[10:14, 10:14], first.mean[10:14, 10:14])
    elsewhere = ~covered.any(axis=0)
    np.testing.assert_array_equal(again.mean[elsewhere], first.mean[elsewhere])
    np.testing.assert_array_equal(again.noise[elsewhere], first.noise[elsewhere])


@pytest.mark.parametrize(
    ("frames", "count", "expected"),
    [
        (range(10, 14), 9, [10, 11, 12, 13]),
        (range(101), 5, [0, 25, 50, 75, 100]),
        (range(20, 31), 3, [20, 25, 30]),
        (range(7), 1, [0]),
        (range(0), 4, []),
    ],
)
def test_frames_are_spread_evenly_and_hold_both_ends(frames, count, expected):
    assert spread_frames(frames, count) == expected


def picture_file(path: Path, picture: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), picture)
    return path


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_background_is_read_in_its_own_grey_levels(tmp_path, dtype):
    picture = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (12, 17)).astype(dtype)
    read = load_background(picture_file(tmp_path / "empty.png", picture), (12, 17))
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, picture.astype(np.float32))


def test_a_coloured_background_is_read_as_grey(tmp_path):
    picture = np.full((12, 17, 3), 90, np.uint8)
    np.testing.assert_array_equal(load_background(picture_file(tmp_path / "empty.png", picture), (12, 17)), 90.0)


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda path: None, ["no such file"]),
        (Path.mkdir, ["a folder"]),
        (lambda path: path.write_bytes(b""), ["a file that cannot be decoded"]),
        (lambda path: path.write_text("no picture"), ["a file that cannot be decoded"]),
        (lambda path: picture_file(path, np.zeros((10, 20), np.uint8)), ["17 x 12 px as the movie", "20 x 10 px"]),
    ],
    ids=["missing", "folder", "empty", "text", "size"],
)
def test_a_bad_background_is_refused_in_one_line(tmp_path, write, words):
    path = tmp_path / "empty.png"
    write(path)
    with pytest.raises(ExperimentError) as caught:
        load_background(path, (12, 17))
    text = str(caught.value)
    assert "\n" not in text
    for word in ["empty.png", *words]:
        assert word in text


def staying(paint: Paint, blur_px: float, count: int = 24) -> np.ndarray:
    """A fixed ball that rotates by little: its pixels never show the scene."""
    sights = [
        plant(lambda x, y, turn=0.02 * k: paint(x * np.cos(turn) - y * np.sin(turn), y), 80.0, 75.0, 30.0, SHAPE)
        for k in range(count)
    ]
    return np.stack([filmed(sight, seed=k, blur_px=blur_px) for k, sight in enumerate(sights)])


@pytest.mark.slow
def test_a_blurred_ball_that_never_leaves_its_place_is_not_taken_for_noise_of_the_scene():
    frames = staying(blobs, blur_px=5.0)
    empty = np.full(SHAPE, BACK, np.float32)
    background = learn_background(frames, 60.0, SETTINGS, empty)
    assert measure_background(frames, empty).noise[75, 80] > 50
    assert background.noise[75, 80] < 10
    found = find_blobs(background.difference(frames[0]), background.noise, 60.0, SETTINGS)
    assert np.hypot(found[0].u_px - 80.0, found[0].v_px - 75.0) < 6


def test_glitter_stays_hidden_also_where_no_ball_is_found():
    rng = np.random.default_rng(5)
    frames = np.stack([filmed(np.full(SHAPE, BACK, np.float32), seed=k) for k in range(24)])
    frames[:, 40:100, 60:120] = rng.integers(60, 250, (24, 60, 60))
    background = learn_background(frames, 60.0, SETTINGS, np.full(SHAPE, BACK, np.float32))
    assert np.median(background.noise[45:95, 65:115]) > 40


def test_a_brighter_level_than_the_full_scale_shows_that_it_is_larger():
    """12 bit: the frames from which the background was learnt did not show the bright ball."""
    background = measure_background(np.full((3, 20, 20), 120, np.uint16))
    assert background.full_scale == 1023
    assert saturated(np.array([120, 1100, 2600, 2600], np.uint16), background) == 0
    assert saturated(np.array([120, 1100, 4095, 4095], np.uint16), background) == 0.5
    assert saturated(np.array([120, 900, 1023, 1023], np.uint16), background) == 0.5
