import cv2
import numpy as np
import pytest
import torch
import yaml
from locate_examples import BACK, DIAMETER, SETTINGS, blobs, distance_px, even_background, filmed, plant, white

from sphereorient import track_movies
from sphereorient.errors import ExperimentError, SettingsError, ShapeError
from sphereorient.experiment.recording import open_recording
from sphereorient.locate import Background, LocateSettings, Sightings, find_ball, find_scenes, sightings_of
from sphereorient.locate.outline import Outline, find_blobs
from sphereorient.trajectory import Reason

WIDE = (240, 320)


def even(level: float):
    return lambda x, y: np.full_like(x, level)


def burnt_out(share: float):
    """Saturated in the middle, on this share of the radius."""
    return lambda x, y: np.where(x**2 + y**2 < share**2, np.float32(400), np.float32(150))


def find(picture, seed=0, settings=SETTINGS, **background):
    frame = filmed(picture, seed)
    return find_ball(frame, even_background(frame.shape, **background), DIAMETER, settings)


def streaks(grey, rows, columns):
    for row, column, slope in ((40, 240, 0.1), (200, 230, -0.3), (215, 60, 0.0)):
        streak = (np.abs(columns - column) < 50) & (np.abs(rows - row - slope * (columns - column)) < 4)
        grey = np.where(streak, np.float32(250), grey)
    return grey


@pytest.mark.parametrize("place", [(110.3, 95.6), (200.8, 140.1), (60.0, 180.4)])
def test_a_ball_among_glitter_is_found(place):
    outline, reason = find(plant(blobs, *place, shape=WIDE, also=streaks))
    assert reason is Reason.OK
    assert distance_px(outline, place) < 0.15


def test_a_dark_ball_before_a_bright_wall_is_found():
    outline, reason = find(plant(even(20), 110.0, 95.0, shape=WIDE, back=120.0), back=120.0)
    assert reason is Reason.OK
    assert distance_px(outline, (110.0, 95.0)) < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_an_empty_picture_has_the_reason_not_found(seed):
    assert find(np.full(WIDE, BACK, np.float32), seed) == (None, Reason.NOT_FOUND)


@pytest.mark.parametrize("radius", [12, 15, 20, 58, 70])
@pytest.mark.parametrize("seed", range(2))
def test_a_disk_of_another_size_is_refused(radius, seed):
    """A lone bubble too: noise around it must not make up a ball."""
    outline, reason = find(plant(white, 150.0, 120.0, radius, shape=WIDE), seed)
    assert outline is None
    assert reason in (Reason.OUTLINE, Reason.DARK)


def test_a_bright_thing_of_another_shape_has_the_reason_outline():
    def triangle(grey, rows, columns):
        inside = (rows > 90) & (rows - 120 < 40 - 1.6 * np.abs(columns - 150))
        return np.where(inside, np.float32(200), np.float32(BACK))

    assert find(plant(white, 150.0, 120.0, shape=WIDE, also=triangle)) == (None, Reason.OUTLINE)


@pytest.mark.parametrize("above", [4, 5])
def test_a_ball_hardly_brighter_than_the_scene_has_the_reason_dark(above):
    assert find(plant(even(BACK + above), 150.0, 120.0, shape=WIDE), noise=0.7) == (None, Reason.DARK)


def test_a_ball_just_bright_enough_is_found():
    outline, reason = find(plant(even(BACK + 10), 150.0, 120.0, shape=WIDE), noise=0.7)
    assert reason is Reason.OK
    assert distance_px(outline, (150.0, 120.0)) < 0.3


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_a_ball_mostly_saturated_has_the_reason_saturated(share):
    assert find(plant(burnt_out(share), 150.0, 120.0, shape=WIDE)) == (None, Reason.SATURATED)


def test_a_reflection_on_the_ball_is_not_too_much_light():
    outline, reason = find(plant(burnt_out(0.3), 150.0, 120.0, shape=WIDE))
    assert reason is Reason.OK
    assert distance_px(outline, (150.0, 120.0)) < 0.1


@pytest.mark.parametrize("scale", [4, 16, 257])
def test_pictures_of_more_bits_are_found_alike(scale):
    """Contrast and saturation count in shares of full scale."""
    frame = filmed(plant(blobs, 150.0, 120.0, shape=WIDE)).astype(np.uint16) * scale
    eight = even_background(WIDE)
    background = type(eight)(mean=eight.mean * scale, noise=eight.noise * scale, full_scale=255.0 * scale)
    outline, reason = find_ball(frame, background, DIAMETER, SETTINGS)
    again, _ = find_ball((frame // scale).astype(np.uint8), eight, DIAMETER, SETTINGS)
    assert reason is Reason.OK
    assert distance_px(outline, (again.u_px, again.v_px)) < 0.02


@pytest.mark.parametrize("u", [-32.0, -28.0, -12.0])
def test_a_ball_that_is_nearly_out_of_the_picture_is_judged_by_what_is_left(u):
    """Its centre is outside, and the square about it that lies inside the disk may be, too."""
    outline, reason = find(plant(white, u, 120.0, shape=WIDE), settings=LocateSettings(coverage_min=0.05))
    assert reason is Reason.OK
    assert distance_px(outline, (u, 120.0)) < 0.6


def test_the_share_of_directions_of_the_setting_counts():
    def quarter(x, y):
        return np.where((x > 0) & (y > 0), np.float32(170), np.float32(BACK))

    picture = plant(quarter, 150.0, 120.0, shape=WIDE)
    assert find(picture, settings=LocateSettings(coverage_min=0.35))[1] is Reason.OUTLINE
    outline, reason = find(picture, settings=LocateSettings(coverage_min=0.2))
    assert reason is Reason.OK
    assert distance_px(outline, (150.0, 120.0)) < 0.5


def test_sightings_have_one_row_a_frame():
    outline = Outline(u_px=10.5, v_px=20.25, radius_px=39.0, rms_px=0.2, coverage=0.9)
    seen = sightings_of(iter([(outline, Reason.OK), (None, Reason.DARK)]))
    assert len(seen) == 2
    assert seen.centre_px.tolist()[0] == [10.5, 20.25]
    assert (seen.radius_px[0], seen.outline_rms_px[0], seen.coverage[0]) == (39.0, 0.2, 0.9)
    assert seen.placed.tolist() == [True, False]
    assert seen.centre_px[1].isnan().all()
    assert seen.reason == (Reason.OK, Reason.DARK)
    assert seen.flags.tolist() == [0, 0]


def test_no_frames_are_no_rows():
    seen = sightings_of([])
    assert len(seen) == 0
    assert seen.centre_px.shape == (0, 2)
    assert seen.placed.shape == (0,)


@pytest.mark.parametrize(
    "part", ["centre_px", "radius_px", "outline_rms_px", "coverage", "covariance_px2", "flags", "reason"]
)
def test_sightings_of_unequal_lengths_are_refused(part):
    parts = {
        "centre_px": torch.zeros(3, 2, dtype=torch.float64),
        "radius_px": torch.zeros(3, dtype=torch.float64),
        "outline_rms_px": torch.zeros(3, dtype=torch.float64),
        "coverage": torch.zeros(3, dtype=torch.float64),
        "covariance_px2": torch.zeros(3, 3, 3, dtype=torch.float64),
        "flags": torch.zeros(3, dtype=torch.int64),
        "reason": (Reason.OK,) * 3,
    }
    assert len(Sightings(**parts)) == 3
    with pytest.raises(ShapeError, match="one row a frame"):
        Sightings(**(parts | {part: parts[part][:2]}))


@pytest.mark.parametrize(("diameter", "reduction"), [(18.0, 8), (9.0, 4), (20.0, 8)])
def test_a_small_ball_is_found_in_a_much_reduced_picture(diameter, reduction):
    row, column = np.mgrid[:480, :640]
    shown = np.hypot(column - 300.3, row - 200.6) < diameter / 2
    frame = np.where(shown, 180, 30).astype(np.uint8)
    background = Background(
        mean=np.full(frame.shape, 30, np.float32), noise=np.ones(frame.shape, np.float32), full_scale=255.0
    )
    (first, *_) = find_blobs(
        background.difference(frame), background.noise, diameter, LocateSettings(reduction=reduction)
    )
    assert np.hypot(first.u_px - 300.3, first.v_px - 200.6) < diameter / 2


def experiment_of_two(folder, frames, keys=""):
    """Write an experiment of one camera and two balls of 80 px."""
    np.save(folder / "cam1.npy", frames)
    cv2.imwrite(str(folder / "texture.png"), np.random.default_rng(0).integers(0, 255, (64, 128)).astype(np.uint8))
    camera = {"model": "pinhole", "image_size": [320, 240], "f_px": 1500.0, "centre": [159.5, 119.5]}
    camera |= {"R": np.eye(3).tolist(), "T": [0, 0, 340]}
    cameras = {"schema": "sphereorient-cameras/1", "cameras": {"cam1": camera}}
    ball = {"diameter": 18.0, "texture": "texture.png"} | ({"fixed": keys} if keys else {})
    document = {"schema": "sphereorient-experiment/1", "cameras": "cameras.yaml", "movies": {"cam1": "cam1.npy"}}
    document |= {"frame_rate": 100.0, "spheres": {"a": ball, "b": ball}}
    (folder / "cameras.yaml").write_text(yaml.safe_dump(cameras))
    (folder / "experiment.yaml").write_text(yaml.safe_dump(document))
    return folder / "experiment.yaml"


def two_balls(count):
    """Frames of two painted balls that sway by 2 px before a scene of 30."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[: WIDE[0], : WIDE[1]]
    paint = [cv2.GaussianBlur(rng.standard_normal((600, 600)), (0, 0), 8) > 0 for _ in range(2)]
    for k in range(count):
        grey = np.full(WIDE, 30.0)
        for n, (u, v) in enumerate(((85, 120), (235, 118))):
            far = np.hypot(column - u - 2 * np.sin(0.3 * k + n), row - v - 2 * np.cos(0.21 * k))
            turned = paint[n][100 + 4 * k :][: WIDE[0], 100 : 100 + WIDE[1]]
            grey = np.where(far < 40, np.where(turned, 190, 50), grey)
        yield np.clip(grey + rng.standard_normal(WIDE), 0, 255).astype(np.uint8)


def test_several_balls_in_place_are_all_missing_in_the_background(tmp_path):
    with open_recording(experiment_of_two(tmp_path, np.stack(list(two_balls(60))), "sways")) as recording:
        scene = next(iter(find_scenes(recording, recording.streams[0], 32, LocateSettings()).values()))
    row, column = np.mgrid[: WIDE[0], : WIDE[1]]
    for u, v in ((85, 120), (235, 118)):
        inside = np.hypot(column - u, row - v) < 34
        assert scene.background.mean[inside].mean() == pytest.approx(30, abs=3)


def test_one_picture_of_several_balls_is_refused(tmp_path):
    path = experiment_of_two(tmp_path, np.stack(list(two_balls(1))))
    with open_recording(path) as recording, pytest.raises(SettingsError, match="got one picture"):
        find_scenes(recording, recording.streams[0], 32, LocateSettings())
    with pytest.raises(ExperimentError, match="expected one ball, got a, b"):
        track_movies(path, method="paper")
