"""Degraded experiments: the truth stays, and the files are wrong by as much as the unit states."""

import math
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch
from conftest import assert_close

from sphereorient import so3
from sphereorient.cameras import TsaiCamera
from sphereorient.errors import SettingsError
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.sphere import load_texture
from sphereorient.sphere.texture import map_directions
from sphereorient.synth import DEGRADATIONS, SynthSettings, severity, write_degraded, write_synthetic_experiment
from sphereorient.synth.degrade import ON_THE_BALL
from sphereorient.synth.degrade_scene import (
    degraded_settings,
    misdrawn,
    picture_of_ball,
    random_patches,
    with_ball_size,
    with_motion_blur,
    with_spin,
    worn,
    wrong_cameras,
)
from sphereorient.synth.write import clean_movie, default_cameras, motion_of

SETTINGS = SynthSettings(frames=10, image_size=(96, 90), diameter_px=40.0, volume_mm=6.0, velocity_rms=0.3, seed=6)


def frames_of(path: Path) -> dict[str, np.ndarray]:
    movies = open_movies(load_experiment(path))
    return {name: np.stack(list(movie.frames())).astype(np.float64) for name, movie in movies.items()}


def empty_of(path: Path) -> np.ndarray:
    return cv2.imread(str(path.parent / "empty_cam1.png"), cv2.IMREAD_UNCHANGED).astype(np.float64)


def truth_of(path: Path) -> dict[str, np.ndarray]:
    truth = {}
    with h5py.File(path.parent / "truth.h5") as file:
        file.visititems(lambda name, item: truth.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return truth


def same_truth(one: Path, other: Path) -> bool:
    a, b = truth_of(one), truth_of(other)
    return a.keys() == b.keys() and len(a) == 11 and all(np.array_equal(a[name], b[name]) for name in a)


def tsai(path: Path, name: str) -> TsaiCamera:
    camera = load_experiment(path).cameras[name]
    assert isinstance(camera, TsaiCamera)
    return camera


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic_experiment(tmp_path_factory.mktemp("plain"), SETTINGS)


def test_without_degradations_the_files_are_those_of_synth(plain, tmp_path):
    path = write_degraded(tmp_path, SETTINGS, {})
    assert same_truth(path, plain)
    for name in ("experiment.yaml", "cameras.yaml", "texture.png", "empty_cam1.png", "empty_cam2.png"):
        assert (tmp_path / name).read_bytes() == (plain.parent / name).read_bytes()
    for name, frames in frames_of(plain).items():
        assert np.array_equal(frames_of(path)[name], frames)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name, row in DEGRADATIONS.items() if row.where in ("picture", "frame", "map", "movie")]
)
def test_degradations_of_pictures_change_the_movies_and_no_input_file(name, plain, tmp_path):
    path = write_degraded(tmp_path, SETTINGS, {name: 5})
    assert same_truth(path, plain)
    for same in ("experiment.yaml", "cameras.yaml", "texture.png"):
        assert (tmp_path / same).read_bytes() == (plain.parent / same).read_bytes()
    for camera, frames in frames_of(plain).items():
        assert np.abs(frames_of(path)[camera] - frames).mean() > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, row in DEGRADATIONS.items() if row.where == "reported"])
def test_wrong_input_files_change_neither_truth_nor_movies(name, plain, tmp_path):
    path = write_degraded(tmp_path, SETTINGS, {name: 4})
    assert same_truth(path, plain)
    for camera, frames in frames_of(plain).items():
        assert np.array_equal(frames_of(path)[camera], frames)
    given = ("experiment.yaml", "cameras.yaml", "texture.png")
    changed = [file for file in given if (tmp_path / file).read_bytes() != (plain.parent / file).read_bytes()]
    assert changed == [{"radius_error": "experiment.yaml", "texture_error": "texture.png"}.get(name, "cameras.yaml")]


@pytest.mark.slow
def test_several_at_once_are_the_same_for_the_same_seed_and_others_for_another(tmp_path):
    applied = {"dropped_frames": 4, "bubbles": 2, "spin": 3, "texture_error": 2, "dirt": 3, "camera_rotation": 2}
    few = SETTINGS.model_copy(update={"frames": 3})
    first = write_degraded(tmp_path / "a", few, applied)
    again = write_degraded(tmp_path / "b", few, dict(reversed(applied.items())))
    other = write_degraded(tmp_path / "c", few.model_copy(update={"seed": 7}), applied)
    assert same_truth(first, again)
    for name, frames in frames_of(first).items():
        assert np.array_equal(frames_of(again)[name], frames)
        assert not np.array_equal(frames_of(other)[name], frames)
    for name in ("cameras.yaml", "texture.png", "empty_cam1.png"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert not same_truth(first, other)


def test_unknown_names_and_levels_are_refused_before_anything_is_written(tmp_path):
    for applied, message in (({"defocs": 2}, "write 'defocus' instead"), ({"defocus": 6}, "got 6; choose one of them")):
        with pytest.raises(SettingsError, match=message):
            write_degraded(tmp_path / "new", SETTINGS, applied)
    with pytest.raises(SettingsError, match=r"degradation occlusion: .* below 1"):
        write_synthetic_experiment(tmp_path / "new", SETTINGS, values={"occlusion": 2.0})
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_noise_comes_on_top_of_the_cameras_own(tmp_path):
    few = SETTINGS.model_copy(update={"frames": 4, "background": 80.0, "read_noise": 3.0, "shot_noise": 0.0})
    frames = frames_of(write_synthetic_experiment(tmp_path, few, values={"read_noise": 4.0}))
    for movie in frames.values():
        assert movie[:, :15].std() == pytest.approx(math.sqrt(3**2 + 4**2 + 1 / 12), rel=0.03)
        assert abs(np.corrcoef(movie[0, :15].ravel(), movie[1, :15].ravel())[0, 1]) < 0.1  # new in every frame


@pytest.mark.slow
def test_structure_and_dirt_stand_still_and_are_in_the_picture_without_the_ball(tmp_path):
    quiet = SETTINGS.model_copy(update={"frames": 3, "read_noise": 0.0, "shot_noise": 0.0, "background": 60.0})
    for name in ("background_clutter", "dirt"):
        path = write_degraded(tmp_path / name, quiet, {name: 4})
        frames, empty = frames_of(path)["cam1"], empty_of(path)
        corner = np.s_[..., :15, :15]
        for frame in frames:
            assert np.array_equal(frame[corner], empty[corner])
        assert empty.std() > 5


@pytest.mark.parametrize("name", ON_THE_BALL)
def test_the_optics_blur_the_light_of_the_ball(name, tmp_path):  # the other order: 1.7 and 49 grey levels off
    quiet = SETTINGS.model_copy(update={"frames": 2, "read_noise": 0.0, "shot_noise": 0.0, "white": 120.0})
    values = {name: severity(name, 3)}
    at = {blur: quiet.model_copy(update={"blur_px": blur}) for blur in (0.0, 2.0)}
    paths = (write_synthetic_experiment(tmp_path / str(blur), one, values=values) for blur, one in at.items())
    sharp, seen = (frames_of(path)["cam1"] for path in paths)
    for before, after in zip(sharp, seen, strict=True):
        expected = cv2.GaussianBlur(before.astype(np.float32), (0, 0), 2.0)
        assert np.abs(after - expected).max() <= 1.0  # both are rounded to whole levels


@pytest.mark.slow
def test_bubbles_move_and_are_not_in_the_picture_without_the_ball(plain, tmp_path):
    for name in ("occlusion", "bubbles"):
        path = write_degraded(tmp_path / name, SETTINGS, {name: 5})
        assert (empty_of(path) == 15).all()
        change = np.abs(frames_of(path)["cam1"] - frames_of(plain)["cam1"])
        v, u = np.mgrid[:90, :96]
        middles = [((u * c).sum() / c.sum(), (v * c).sum() / c.sum()) for c in np.where(change > 40, change, 0)]
        assert np.ptp(np.array(middles), axis=0).max() > 5  # px


@pytest.mark.slow
def test_occlusion_follows_the_ball_and_hides_its_share(tmp_path):
    white = SETTINGS.model_copy(
        update={"frames": 4, "black": 160.0, "white": 160.0, "ambient": 1.0, "background": 30.0}
    )
    quiet = white.model_copy(update={"read_noise": 0.0, "shot_noise": 0.0})
    for movie in frames_of(write_synthetic_experiment(tmp_path, quiet, values={"occlusion": 0.4})).values():
        assert (movie - 30).sum((1, 2)) / (130 * math.pi * 20**2) == pytest.approx(0.6, abs=0.02)


@pytest.mark.slow
def test_saturation_clips_its_share_of_a_white_ball_with_one_gain_for_the_movie(tmp_path):
    white = {"black": 150.0, "white": 150.0, "read_noise": 0.0, "shot_noise": 0.0, "frames": 3, "ambient": 0.3}
    settings = SETTINGS.model_copy(update=white)
    path = write_synthetic_experiment(tmp_path, settings, values={"saturation": 0.3})
    for movie in frames_of(path).values():
        for frame in movie:
            assert (frame == 255).sum() / (math.pi * 19.5**2) == pytest.approx(0.3, abs=0.04)
    grounds = [movie[:, :10, :10] for movie in frames_of(path).values()]
    assert all(np.ptp(ground) == 0 and ground[0, 0, 0] > 15 for ground in grounds)


@pytest.mark.slow
def test_dropped_frames_are_black_in_their_camera_and_all_others_stay(plain, tmp_path):
    path = write_synthetic_experiment(tmp_path, SETTINGS, values={"dropped_frames": 0.3})
    lost = {}
    for name, frames in frames_of(plain).items():
        got = frames_of(path)[name]
        assert len(got) == SETTINGS.frames  # numbers stay
        lost[name] = {k for k in range(len(got)) if not got[k].any()}
        assert len(lost[name]) == 3
        assert all(np.array_equal(got[k], frames[k]) for k in range(len(got)) if k not in lost[name])
    assert lost["cam1"] != lost["cam2"]


def test_the_ball_in_a_picture_is_where_and_as_large_as_it_is_seen(plain):
    # Over the limb's threshold: the disk's area and middle, 40 px at the origin.
    camera = default_cameras(SETTINGS)["cam1"]
    near = torch.tensor([[0.0, -60.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)  # mm; cam1 looks along +y
    disk = picture_of_ball(camera, near, 9.0)
    assert_close(disk.centre_px, camera.project(near))
    assert disk.radius_px.tolist() == pytest.approx([20 * 520 / 460, 20.0], rel=1e-3)


@pytest.mark.slow
def test_the_ball_has_its_size_and_the_scene_stays_the_same(tmp_path):
    for diameter in (20.0, 32.0):
        settings = with_ball_size(SETTINGS.model_copy(update={"frames": 2, "black": 150.0, "white": 150.0}), diameter)
        path = write_synthetic_experiment(tmp_path / str(diameter), settings)
        ball = np.sqrt((frames_of(path)["cam1"] > 60).sum((1, 2)) * 4 / np.pi)
        assert ball == pytest.approx(diameter, rel=0.06)
        scale = diameter / 40
        assert settings.image_size == pytest.approx((96 * scale, 90 * scale), abs=0.5)
        truth, base = motion_of(settings), motion_of(SETTINGS)
        now = torch.tensor([0.01], dtype=torch.float64)
        assert torch.equal(truth.at(now).position_lab_mm, base.at(now).position_lab_mm)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [5.0, 60.0])
def test_spin_is_the_rms_turn_from_frame_to_frame_and_smears_no_more(degrees):
    settings = with_spin(SETTINGS, degrees)
    time_s = torch.arange(3000, dtype=torch.float64) / settings.frame_rate
    R = motion_of(settings).at(time_s).R_lab_body
    turn = torch.rad2deg(so3.log(R[1:] @ R[:-1].mT).norm(dim=-1))
    # Between frames omega changes too, and the chord is shorter: a few per cent at 60 degrees.
    assert float(turn.square().mean().sqrt()) == pytest.approx(degrees, rel=0.04)
    assert settings.exposure * settings.omega_rms == pytest.approx(SETTINGS.exposure * SETTINGS.omega_rms)


@pytest.mark.parametrize("degrees", [1.0, 3.0, 16.0])
def test_motion_blur_is_the_rms_turn_while_the_shutter_is_open(degrees):
    settings = with_motion_blur(SETTINGS, degrees)
    assert settings.exposure <= 1 / settings.frame_rate
    assert math.degrees(settings.omega_rms * math.sqrt(3) * settings.exposure) == pytest.approx(degrees)
    # 1 degree is done by the shutter alone, the others by more spin.
    assert (settings.omega_rms == SETTINGS.omega_rms) == (degrees == 1.0)
    step_px = math.radians(degrees) * 20 / settings.exposure_samples
    assert step_px < 1


@pytest.mark.slow
def test_motion_blur_smears_the_picture_of_the_ball(tmp_path):
    quiet = SETTINGS.model_copy(update={"frames": 3, "read_noise": 0.0, "shot_noise": 0.0})
    left = []
    for degrees in (1.0, 8.0, 32.0):
        open_long = with_motion_blur(quiet, degrees)
        # The same poses in a flash.
        flash = open_long.model_copy(update={"exposure": 0.0, "exposure_samples": 1})
        movies = [frames_of(write_synthetic_experiment(tmp_path / "a", one)).values() for one in (open_long, flash)]
        steps = [sum(np.square(np.diff(one[:, 5:85, 5:91])).sum() for one in each) for each in movies]
        left.append(steps[0] / steps[1])
    assert 1.0 > left[0] > 1.02 * left[1]
    assert left[2] < 0.8 * left[1]


def test_blur_at_high_spin_needs_no_more_spin():
    settings = degraded_settings(SETTINGS, {"motion_blur": 16.0, "spin": 60.0})
    assert settings.omega_rms == with_spin(SETTINGS, 60.0).omega_rms
    assert settings.exposure * settings.frame_rate == pytest.approx(16 / 60)


@pytest.mark.parametrize(("share", "height"), [(0.05, 128), (0.35, 96), (0.2, 64)])
def test_worn_and_misdrawn_maps_differ_in_their_share_of_the_area(share, height):
    texture = torch.rand(height, 2 * height, generator=torch.Generator().manual_seed(1)) * 0.4
    area = map_directions(height)[..., :2].norm(dim=-1)  # cosine of the latitude
    for change in (worn, misdrawn):
        got = change(texture, share, torch.Generator().manual_seed(2))
        differs = got != texture
        assert float((area * differs).sum() / area.sum()) == pytest.approx(share, abs=1e-3)
        expected = torch.full_like(texture, 0.5) if change is worn else 1 - texture
        assert torch.equal(got[differs], expected[differs])
        assert torch.equal(change(texture, 0.0, torch.Generator()), texture)


def test_patches_are_patches_seamless_and_anywhere():
    rng = torch.Generator().manual_seed(3)
    many = random_patches(torch.empty(30, 64, 128), 0.2, rng)
    beside = (many != many.roll(1, -1)).double().mean((0, 1))
    assert beside[0] < 2 * beside.mean()  # the date line is no border
    assert beside.mean() < 0.08  # single texels would differ in 32 %
    assert many.double().mean((0, 2)) == pytest.approx(0.2, abs=0.12)  # at all latitudes alike
    again = torch.Generator().manual_seed(3)
    assert torch.equal(torch.stack([random_patches(torch.empty(64, 128), 0.2, again) for _ in range(3)]), many[:3])


@pytest.mark.slow
def test_the_given_map_differs_from_the_filmed_one_by_its_share(plain, tmp_path):
    path = write_degraded(tmp_path, SETTINGS, {"texture_error": 4})
    given, true = (load_texture(p.parent / "texture.png") for p in (path, plain))
    area = map_directions(512)[..., :2].norm(dim=-1)
    differs = (given - true).abs() > 0.02
    assert_close(given[differs], (1 - true)[differs], atol=1e-6)
    # Where the map is grey, exchanging black and white changes little: 2 % of its area.
    assert float((area * differs).sum() / area.sum()) == pytest.approx(severity("texture_error", 4), abs=0.01)


def test_worn_paint_is_on_the_filmed_ball_only():
    plain, spoilt = (clean_movie(SETTINGS, share) for share in (0.0, 0.25))
    assert torch.equal(plain.textures[0], spoilt.textures[0])
    before, after = (next(iter(movie.exposures["cam1"]())) for movie in (plain, spoilt))
    assert np.array_equal(before.cover, after.cover)
    assert np.abs(before.light - after.light).mean() > 3.0
    area = map_directions(512)[..., :2].norm(dim=-1)
    bare = worn(plain.textures[0], 0.25, torch.Generator().manual_seed(6)) == 0.5
    assert float((area * bare).sum() / area.sum()) == pytest.approx(0.25, abs=5e-3)


@pytest.mark.slow
def test_the_reported_diameter_is_too_large_by_px_at_the_rim(tmp_path):
    path = write_synthetic_experiment(tmp_path, SETTINGS, values={"radius_error": 2.0})
    given = load_experiment(path)
    assert given.diameter_mm == pytest.approx(18.0 * (20 + 2) / 20)
    disk = picture_of_ball(given.cameras["cam1"], torch.zeros(3, dtype=torch.float64), given.diameter_mm / 2)
    assert float(disk.radius_px) == pytest.approx(22.0, rel=1e-3)


@pytest.mark.slow
def test_given_principal_points_are_off_in_opposite_directions_and_lines_of_sight_miss(plain, tmp_path):
    path = write_synthetic_experiment(tmp_path, SETTINGS, values={"centre_error": 2.0})
    off = {name: tsai(path, name).centre_px - tsai(plain, name).centre_px for name in ("cam1", "cam2")}
    for shift in off.values():
        assert float(shift.norm()) == pytest.approx(2.0)
    assert_close(off["cam1"], -off["cam2"])
    # Both pictures' columns lie along lab x: there the given lines of sight miss each other.
    given, truth = load_experiment(path).cameras, truth_of(path)
    lines = [given[name].rays(torch.from_numpy(truth[f"{name}/centre_px"])) for name in given]
    across = torch.linalg.cross(lines[0].direction_lab, lines[1].direction_lab)
    across = across / across.norm(dim=-1, keepdim=True)
    miss_mm = ((lines[0].origin_lab_mm - lines[1].origin_lab_mm) * across).sum(-1).abs()
    assert (miss_mm * 40 / 18).tolist() == pytest.approx([2 * math.sqrt(2)] * 10, rel=0.05)


def test_an_odd_seed_turns_the_first_camera():
    """Before: only the second, and `track` prefers the first where they contradict each other."""
    true = default_cameras(SETTINGS)
    for seed, turned, kept in ((1, "cam1", "cam2"), (2, "cam2", "cam1")):
        given = wrong_cameras(true, {"camera_rotation": 5.0}, seed)
        turn = so3.log(given[turned].R_cam_lab @ true[turned].R_cam_lab.mT)
        assert math.degrees(float(turn.norm())) == pytest.approx(5)
        assert torch.equal(given[kept].R_cam_lab, true[kept].R_cam_lab)


@pytest.mark.slow
def test_the_given_second_camera_is_rotated_by_degrees_about_the_origin_and_moved_by_mm(plain, tmp_path):
    path = write_synthetic_experiment(tmp_path, SETTINGS, values={"camera_rotation": 1.5, "camera_shift": 0.3})
    true, given = tsai(plain, "cam2"), tsai(path, "cam2")
    turn = so3.log(given.R_cam_lab @ true.R_cam_lab.mT)
    assert math.degrees(float(turn.norm())) == pytest.approx(1.5)
    assert_close(turn, turn[:1].expand(3), atol=1e-9)
    assert_close(given.T_cam_lab_mm - true.T_cam_lab_mm, torch.tensor([0.3, 0.0, 0.0]).double(), atol=1e-6)
    for part in ("R_cam_lab", "T_cam_lab_mm", "centre_px"):
        assert torch.equal(getattr(tsai(path, "cam1"), part), getattr(tsai(plain, "cam1"), part))
    only_turned = wrong_cameras(default_cameras(SETTINGS), {"camera_rotation": 5.0})["cam2"]
    origin = torch.zeros(3, dtype=torch.float64)
    assert_close(only_turned.project(origin), true.project(origin), atol=1e-9)
