"""A ball that rotates, sways or sinks in its holder, without a map and without a frame of the empty scene."""

from dataclasses import replace
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch

from sphereorient import so3
from sphereorient.bench.ball import SCENES, measure_scene, write_ball_scene
from sphereorient.errors import ExperimentError, PaintError
from sphereorient.experiment import load_experiment
from sphereorient.experiment.recording import open_recording
from sphereorient.locate import LocateSettings, sightings_of, smoothed
from sphereorient.locate.outline import Outline
from sphereorient.locate.scene import swaying_ball
from sphereorient.mapping.disks import Crop, held_place
from sphereorient.mapping.first_pass import first_adjustment
from sphereorient.methods.method import one_thread
from sphereorient.methods.settings import Settings
from sphereorient.preflight.first_look import look_at

FRAMES = 100
SMALL = replace(SCENES["sways"], size=(220, 200), half_deg=6.0, azimuth_deg=0.0, elevation_deg=0.0, sway_px=2.0)
SCENE = {"sways": SMALL, "sinks": replace(SMALL, sway_px=0.0, sway_share=0.0, elevation_deg=2.0, sink_px=28.0)}
SETTINGS = Settings()


@pytest.fixture(name="scene", scope="module", params=sorted(SCENE))
def swaying_scene(request, tmp_path_factory):
    """A small movie: its experiment, the ball's position from outlines, and the truth."""
    path = write_ball_scene(tmp_path_factory.mktemp("holder") / request.param, SCENE[request.param], FRAMES, 2)
    with h5py.File(path.with_name("truth.h5")) as file:
        R, X = (torch.from_numpy(file[name][()]) for name in ("orientation", "position"))
    with open_recording(path, None, textured=False) as recording, one_thread():
        place = held_place(recording, SETTINGS.paint, SETTINGS.locate)
        pictures = recording.streams[0].spread(FRAMES)

    def number(crop: Crop) -> int:
        """Return the frame that a crop is cut out of; these balls keep away from the border."""
        there = np.s_[crop.top :, crop.left :]
        height, width = crop.grey.shape
        return next(n for n, one in enumerate(pictures) if np.array_equal(one[there][:height, :width], crop.grey))

    return SimpleNamespace(path=path, place=place, R=R, X=X, pictures=pictures, number=number)


def off(scene, position_lab_mm, true) -> np.ndarray:
    """Return errors of positions, (N, 3): to the right and down, px, and of the size, in radii."""
    view, radius_mm = scene.place.views[0], scene.place.radius_mm
    px = view.camera.project(position_lab_mm) - view.camera.project(true)
    sizes = [view.radius_px(X, radius_mm) for X in (position_lab_mm, true)]
    return torch.cat([px, (sizes[0] / sizes[1] - 1)[:, None]], dim=1).numpy()


def test_outlines_give_the_position_in_each_frame(scene):
    assert not scene.place.fixed
    away = off(scene, scene.place.position_lab_mm, scene.X)
    assert np.abs(away.mean(0)).max() < 0.6
    assert (away.std(0) < (0.3, 0.3, 0.01)).all(), away.std(0)
    moved = scene.place.views[0].camera.project(scene.X).numpy()
    assert np.ptp(moved, axis=0).max() > 5.0  # far more than that


def test_the_scene_goes_on_behind_the_ball(scene):
    outline, background = swaying_ball(scene.pictures, LocateSettings())
    assert outline.radius_px == pytest.approx(float(np.median(scene.place.views[0].radius_px(scene.X, 1.0))), rel=0.03)
    assert np.percentile(np.abs(background.mean - 50.0), 99) < 15.0  # paint is 5 to 200


def test_places_and_turns_are_adjusted_in_each_frame(scene):
    with open_recording(scene.path, None, textured=False) as recording, one_thread():
        found = first_adjustment(recording, scene.place, lambda *_: None)
    X, frames = found.crops.position_lab_mm, torch.tensor([scene.number(one) for one in found.crops.crops[0]])
    away = off(scene, X, scene.X[frames])
    assert len(set(frames.tolist())) == len(frames) > 0.8 * FRAMES
    assert np.abs(away[:, :2].mean(0)).max() < 0.1
    assert (np.median(np.abs(away - away.mean(0)), axis=0) < (0.08, 0.08, 0.002)).all()
    body = so3.nearest_rotation((found.R_lab_body.mT @ scene.R[frames]).mean(0))
    error = torch.rad2deg(so3.geodesic_distance(found.R_lab_body @ body, scene.R[frames]))
    assert float(error.median()) < 0.2


@pytest.mark.slow
def test_a_swaying_ball_is_tracked_without_a_map(scene):
    row = measure_scene(scene.path, SETTINGS, True)
    assert row.refined is not None
    assert row.refined.found == FRAMES
    assert np.median(row.refined.step_deg) < 0.03
    assert np.abs(np.asarray(row.refined.behaviour.numbers()["gain"]["value"])[3] - 1) < 0.003


def test_a_ball_that_is_taken_as_fixed_is_refused_with_what_to_write(scene):
    experiment = load_experiment(scene.path).with_sphere(fixed=True, sways=False)
    with (
        open_recording(experiment, None, textured=False) as recording,
        pytest.raises((PaintError, ExperimentError), match=r"sways|rotates in its place"),
    ):
        held_place(recording, SETTINGS.paint, SETTINGS.locate)


def test_init_finds_that_the_ball_sways(scene):
    (look,) = look_at([scene.path.with_name("cam1.mkv")])
    assert look.stays
    assert look.sways


def test_outliers_are_left_out_and_the_path_is_smoothed_by_its_own_noise():
    rng, k = np.random.default_rng(0), np.arange(200)
    true = np.stack([100 + 3 * np.sin(k / 15), 80 + 0.1 * k, 40 + np.cos(k / 25)], axis=1)
    noisy = true + rng.normal(0, 0.3, true.shape)
    noisy[[30, 31, 120]] += (25.0, -10.0, 8.0)
    found = [
        (None if n in (60, 61, 199) else Outline(u_px=u, v_px=v, radius_px=r, rms_px=0.2, coverage=1.0), "ok")
        for n, (u, v, r) in enumerate(noisy.tolist())
    ]
    path = smoothed(sightings_of(found), LocateSettings())
    off = (np.column_stack([path.centre_px, path.radius_px]) - true)[:199]
    assert not bool(path.placed[199])  # no outline follows
    assert (off.std(0) < 0.15).all()
    assert np.abs(off[[30, 31, 60, 61, 120]]).max() < 0.4
