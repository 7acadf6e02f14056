"""A whole experiment on disk is read back and agrees with its truth."""

import math
from pathlib import Path

import cv2
import h5py
import numpy as np
import pydantic
import pytest
import torch
from conftest import assert_close
from synth_examples import frames_of

from sphereorient.errors import OutputError
from sphereorient.experiment import load_experiment
from sphereorient.sphere import load_texture
from sphereorient.synth import SynthSettings, make_scene, render_frame, write_synthetic_experiment
from sphereorient.synth.scene import seeded
from sphereorient.synth.write import default_cameras, frame_times_s, instants_s, motion_of

FRAMES = 6
# Light paint on dark ground, so that the whole disk stands out.
SCENE = {"frames": FRAMES, "frame_rate": 200.0, "image_size": (160, 140), "diameter_px": 40.0, "volume_mm": 12.0}
SCENE |= {"black": 110.0, "white": 180.0, "ambient": 0.9, "background": 10.0, "velocity_time": 0.03}
SETTINGS = SynthSettings(name="tiny", velocity_rms=1.5, seed=2, **SCENE)
RATES = ("velocity", "acceleration", "omega_lab", "omega_body", "alpha_lab", "alpha_body")
TRUTH = {"time": (FRAMES,), "orientation": (FRAMES, 3, 3)} | dict.fromkeys(("position", *RATES), (FRAMES, 3))
TRUTH |= dict.fromkeys(("cam1/centre_px", "cam2/centre_px"), (FRAMES, 2))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic_experiment(tmp_path_factory.mktemp("synth") / "new" / "folder", SETTINGS)


def truth_of(path: Path) -> dict[str, torch.Tensor]:
    with h5py.File(path.parent / "truth.h5") as file:
        return {name: torch.from_numpy(file[name][()]) for name in TRUTH}


def test_it_is_an_experiment_that_loads(written):
    experiment = load_experiment(written)
    assert experiment.name == "tiny"
    assert experiment.frame_rate_hz == 200.0
    assert experiment.exposure_s == 0.0004
    assert experiment.diameter_mm == 18.0
    assert list(experiment.cameras) == ["cam1", "cam2"]
    assert {path.name for path in written.parent.iterdir()} == {
        "experiment.yaml",
        "cameras.yaml",
        "texture.png",
        "truth.h5",
        *("cam1.mkv", "cam2.mkv", "empty_cam1.png", "empty_cam2.png"),
    }
    assert experiment.texture_path is not None
    assert load_texture(experiment.texture_path).shape == (512, 1024)


def test_the_truth_has_every_dataset_in_its_shape(written):
    with h5py.File(written.parent / "truth.h5") as file:
        names: list[str] = []
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        assert {name: file[name].shape for name in names} == TRUTH
        assert all(file[name].dtype == np.float64 for name in names)
    truth = truth_of(written)
    assert_close(truth["time"], torch.arange(FRAMES, dtype=torch.float64) / 200)
    assert all(torch.isfinite(value).all() for value in truth.values())


def test_body_components_are_R_transposed_times_lab_components(written):
    truth = truth_of(written)
    for quantity in ("omega", "alpha"):
        assert_close(
            torch.einsum("nij,nj->ni", truth["orientation"], truth[f"{quantity}_body"]), truth[f"{quantity}_lab"]
        )
        assert (truth[f"{quantity}_body"] - truth[f"{quantity}_lab"]).norm(dim=-1).min() > 0.1


def test_centres_are_the_projections_of_the_positions(written):
    truth = truth_of(written)
    for name, camera in load_experiment(written).cameras.items():
        assert_close(truth[f"{name}/centre_px"], camera.project(truth["position"]), atol=1e-9)


def test_in_each_picture_the_disk_lies_at_its_true_centre(written):
    truth = truth_of(written)
    v, u = np.mgrid[:140, :160]
    for name, frames in frames_of(written).items():
        disks = frames > 60
        assert disks.sum((1, 2)) == pytest.approx(np.pi * 20**2, rel=0.15)
        seen = torch.tensor([[u[disk].mean(), v[disk].mean()] for disk in disks])
        centre = truth[f"{name}/centre_px"]
        assert (seen - centre).norm(dim=-1).max() < 0.3
        assert (seen[1:] - centre[:-1]).norm(dim=-1).mean() > 0.45  # a frame too early or too late is seen


def test_the_pictures_of_the_empty_scene_are_its_background(written):
    experiment = load_experiment(written)
    for name in experiment.cameras:
        empty = cv2.imread(str(experiment.background_paths[name]), cv2.IMREAD_UNCHANGED)
        assert empty.shape == (140, 160)
        assert (empty == 10).all()


@pytest.mark.slow
def test_the_same_seed_gives_the_same_movies_and_truth_and_another_others(written, tmp_path):
    again = write_synthetic_experiment(tmp_path / "again", SETTINGS)
    other = write_synthetic_experiment(tmp_path / "other", SETTINGS.model_copy(update={"seed": 3}))
    for name, frames in frames_of(written).items():
        assert np.array_equal(frames_of(again)[name], frames)
        assert not np.array_equal(frames_of(other)[name], frames)
    for name, value in truth_of(written).items():
        assert torch.equal(truth_of(again)[name], value)
    assert not torch.equal(truth_of(other)["orientation"], truth_of(written)["orientation"])


@pytest.mark.slow
def test_progress_counts_the_frames_of_both_cameras_and_old_files_are_replaced(tmp_path):
    steps: list[int] = []
    few = SETTINGS.model_copy(update={"frames": 2, "image_size": (64, 60)})
    for _ in range(2):
        steps.clear()
        path = write_synthetic_experiment(tmp_path, few, steps.append)
        assert sum(steps) == 4
    assert {len(frames) for frames in frames_of(path).values()} == {2}


@pytest.mark.slow
def test_a_momentary_exposure_gives_an_experiment_that_loads(tmp_path):
    few = SETTINGS.model_copy(update={"frames": 2, "image_size": (64, 60), "exposure": 0.0})
    assert load_experiment(write_synthetic_experiment(tmp_path, few)).exposure_s is None


@pytest.mark.slow
def test_the_exposure_lies_about_the_frames_time_also_in_frame_0(tmp_path):
    noiseless = {"frames": 2, "exposure": 0.004, "exposure_samples": 2, "read_noise": 0.0, "shot_noise": 0.0}
    settings = SETTINGS.model_copy(update=noiseless)
    path = write_synthetic_experiment(tmp_path, settings)
    scene = make_scene(load_texture(path.parent / "texture.png"), settings)
    motion = motion_of(settings)
    for name, camera in default_cameras(settings).items():
        for k, frame in enumerate(frames_of(path)[name]):
            # Two instants with the variance of 4 ms: 4 / sqrt(12) ms before and after the frame's time.
            now = motion.at(k / 200 + 0.004 / math.sqrt(12) * torch.tensor([-1.0, 1.0], dtype=torch.float64))
            rng = seeded(0)
            expected = render_frame(scene, camera, now.position_lab_mm, now.R_lab_body, rng)
            assert np.abs(frame.astype(int) - expected).max() <= 1


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="can be made"):
        write_synthetic_experiment(tmp_path / "file" / "folder", SETTINGS)


@pytest.mark.parametrize(
    "wrong", [{"frames": 1}, {"white": 300.0}, {"texture": "stripes"}, {"whit": 3}, {"exposure": 0.01}], ids=str
)
def test_impossible_and_unknown_settings_are_refused(wrong):
    with pytest.raises(pydantic.ValidationError):
        SynthSettings(**wrong)


def test_an_exposure_longer_than_a_frame_is_refused_as_the_experiment_would_be():
    with pytest.raises(pydantic.ValidationError, match=r"exposure: .*frame_rate"):
        SynthSettings(exposure=0.01, frame_rate=200.0)
    assert SynthSettings(exposure=0.005, frame_rate=200.0).exposure == 0.005


@pytest.mark.parametrize("samples", [2, 3, 8])
def test_instants_spread_like_the_open_shutter(samples: int):
    settings = SynthSettings(frames=2, frame_rate=100.0, exposure=0.002, exposure_samples=samples)
    instants = instants_s(settings)[0] - frame_times_s(settings)[0]
    assert float(instants.mean()) == pytest.approx(0.0, abs=1e-12)
    assert float(instants.var(correction=0)) == pytest.approx(0.002**2 / 12)
    assert float(instants.abs().max()) <= 0.001
