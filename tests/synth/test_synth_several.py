"""Several balls in one movie: names in the files, no two overlap, nearer ones hide farther ones, one ball as before."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from synth_examples import NOISELESS, WHITE_MAP, camera, scene, seen_at

from sphereorient.errors import SettingsError
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.sphere import load_texture
from sphereorient.synth import SynthSettings, make_scene, write_synthetic_experiment
from sphereorient.synth.scene import expose
from sphereorient.synth.write import default_cameras, frame_times_s, motion_of, motions_of

SCENE = {"name": "tiny", "frames": 2, "image_size": (220, 200), "diameter_mm": 12.0, "diameter_px": 24.0}
SCENE |= {"volume_mm": 40.0, "background": 0.0, "exposure_samples": 1, "seed": 2}
SMALL = SynthSettings(balls=4, paints=3, **SCENE)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic_experiment(tmp_path_factory.mktemp("several"), SMALL)


def test_each_ball_has_its_name_its_paint_and_its_truth(written):
    experiment = load_experiment(written)
    assert experiment.names == ("a", "b", "c", "d")
    worn = [sphere.texture_path.name for sphere in experiment.spheres if sphere.texture_path]
    assert worn == ["texture_0.png", "texture_1.png", "texture_2.png", "texture_0.png"]  # a and d look alike
    maps = [load_texture(written.parent / name) for name in worn[:3]]
    assert all((maps[k] - maps[j]).abs().mean() > 0.2 for k in range(3) for j in range(k))
    with h5py.File(written.parent / "truth.h5") as file:
        assert list(file) == ["spheres"]
        assert list(file["spheres"]) == list("abcd")
        for name, motion in motions_of(SMALL).items():
            truth = motion.at(frame_times_s(SMALL))
            group = file[f"spheres/{name}"]
            assert np.array_equal(group["position"][()], truth.position_lab_mm.numpy())
            assert np.array_equal(group["orientation"][()], truth.R_lab_body.numpy())
            assert set(group) == {
                *("time", "position", "orientation", "velocity", "acceleration"),
                *("omega_lab", "omega_body", "alpha_lab", "alpha_body", "cam1", "cam2"),
            }


def test_each_picture_is_that_of_the_balls_at_their_true_places(written):
    """The oracle draws each ball alone: where its disk is free of the others, the movie shows it."""
    noise = 6 * np.hypot(SMALL.read_noise, SMALL.shot_noise * np.sqrt(SMALL.white))
    movies = open_movies(load_experiment(written))
    textures = [load_texture(written.parent / f"texture_{k}.png") for k in range(3)]
    for name, one in default_cameras(SMALL).items():
        frame = next(iter(movies[name].frames())).astype(float)
        alone = {}
        for ball, motion in motions_of(SMALL).items():
            at = motion.at(frame_times_s(SMALL)[:1])
            ball_alone = make_scene(textures[SMALL.worn[ball]], SMALL)
            alone[ball] = expose([ball_alone], one, at.position_lab_mm[None], at.R_lab_body[None])
        covers = np.stack([exposure.covered for exposure in alone.values()])
        for k, exposure in enumerate(alone.values()):
            picture, cover = exposure.before(0.0), exposure.covered
            free = (cover > 0.99) & (np.delete(covers, k, axis=0).max(0) < 1e-3)
            assert free.sum() > 100
            assert np.abs(frame - picture)[free].max() < noise
        assert frame[covers.max(0) < 1e-3].max() < noise


@pytest.mark.parametrize("seed", range(3))
def test_no_two_balls_overlap_while_a_shutter_is_open(seed):
    settings = SynthSettings(balls=8, frames=60, volume_mm=50.0, exposure=0.001, exposure_samples=3, seed=seed)
    within = torch.tensor([-1, 0, 1], dtype=torch.float64) * 0.001 / 3
    times_s = (frame_times_s(settings)[:, None] + within).reshape(-1)
    paths = torch.stack([motion.path(times_s, -1) for motion in motions_of(settings).values()])
    apart = (paths[:, None] - paths[None]).norm(dim=-1) + 1e3 * torch.eye(8)[..., None]
    assert apart.min() >= settings.diameter_mm
    free = torch.stack([motion_of(settings.model_copy(update={"seed": s})).path(times_s, -1) for s in range(8)])
    assert ((free[:, None] - free[None]).norm(dim=-1) + 1e3 * torch.eye(8)[..., None]).min() < 18  # by chance they do


def test_the_first_ball_moves_as_an_only_one():
    alone, (first, *_) = motions_of(SMALL.model_copy(update={"balls": 1})), motions_of(SMALL).values()
    assert list(alone) == [""]
    assert torch.equal(alone[""].path.amplitude, first.path.amplitude)
    assert torch.equal(motion_of(SMALL).R_start, first.R_start)


def test_balls_without_room_are_refused_in_one_line():
    with pytest.raises(SettingsError, match="room for 8 of 18 mm") as caught:
        motions_of(SynthSettings(balls=8, frames=3, volume_mm=8.0))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["uneven_light", "highlights", "occlusion", "bubbles"])
def test_degradations_on_the_disk_of_one_ball_are_refused_of_several(name, tmp_path):
    with pytest.raises(SettingsError, match=f"{name}: .* one ball, got 4"):
        write_synthetic_experiment(tmp_path / "new", SMALL, values={name: 2.0 if name == "uneven_light" else 0.5})
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_degradations_of_the_picture_and_of_input_files_take_several_balls(written, tmp_path):
    values = {"background_clutter": 20.0, "defocus": 1.0, "radius_error": 1.2, "texture_error": 0.1, "paint_wear": 0.2}
    path = write_synthetic_experiment(tmp_path, SMALL, values=values)
    given = load_experiment(path)
    assert [sphere.diameter_mm for sphere in given.spheres] == pytest.approx([12.0 * 1.1] * 4)
    wrong = [
        (load_texture(tmp_path / f"texture_{k}.png") - load_texture(written.parent / f"texture_{k}.png")).abs() > 0.5
        for k in range(3)
    ]
    assert all(0.03 < part.float().mean() < 0.3 for part in wrong)
    assert not torch.equal(wrong[0], wrong[1])  # patches of each paint's own


def white(diameter_mm: float = 18.0) -> object:
    return scene(WHITE_MAP, diameter_mm=diameter_mm, white=200.0, black=0.0)


def test_a_nearer_ball_covers_those_behind_it_in_any_order():
    lens = camera()
    dark, bright = scene(torch.zeros(8, 16), black=50.0), white()
    near, far = seen_at(lens, 0.0, 0.0, 380.0), seen_at(lens, 0.5, 0.0, 420.0)
    eye = torch.eye(3, dtype=torch.float64)[None, None].expand(2, 1, -1, -1)
    u, v = lens.project(near).round().int().tolist()
    for scenes, places in (([dark, bright], [near, far]), ([bright, dark], [far, near])):
        exposure = expose(scenes, lens, torch.stack(places)[:, None], eye)
        picture = exposure.before(0.0)
        assert picture[v, u] == pytest.approx(50.0)
        assert exposure.cover.max() == pytest.approx(1.0)
        assert picture.max() == pytest.approx(200.0)


def test_balls_apart_add_and_the_cover_is_that_of_all():
    lens = camera()
    places = torch.stack([seen_at(lens, -3.0, 0.0), seen_at(lens, 3.0, 1.0)])[:, None]
    eye = torch.eye(3, dtype=torch.float64)[None]
    both = expose([white(), white()], lens, places, eye.expand(2, 1, -1, -1))
    parts = [expose([white()], lens, X[None], eye[None]) for X in places]
    np.testing.assert_array_equal(both.before(0.0), parts[0].before(0.0) + parts[1].before(0.0))
    np.testing.assert_array_equal(both.covered, parts[0].covered + parts[1].covered)


def test_the_names_of_balls_that_look_alike_follow_the_number_of_paints():
    assert SynthSettings().worn == {"": 0}
    assert SynthSettings(balls=3).worn == {"a": 0, "b": 1, "c": 2}
    assert SynthSettings(balls=5, paints=2, **NOISELESS).worn == {"a": 0, "b": 1, "c": 0, "d": 1, "e": 0}
