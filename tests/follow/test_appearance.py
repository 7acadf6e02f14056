"""The usual disagreement of the cameras, learnt before tracking."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import torch
import yaml

from sphereorient.cameras import load_cameras
from sphereorient.errors import ExperimentError
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.follow.appearance.presence import explained, proven
from sphereorient.pose.poses import Poses, blank_parts
from sphereorient.run.stages import track_movies
from sphereorient.synth import SynthSettings, write_synthetic_experiment
from sphereorient.trajectory import Reason


def found_by(camera, right, wrong):
    """The best pose and a wrong one of one camera's picture, with their scores."""
    parts = blank_parts(2, 2)
    parts["score"][:, camera] = torch.tensor([right, wrong])
    return Poses(**parts, use=torch.arange(2) == camera, reason=(Reason.OK, Reason.OK))


def test_a_camera_is_explained_by_its_own_proven_frames_where_another_camera_shows_nothing_but_wrong_poses():
    found = [found_by(0, 0.3, 0.95)] * 10 + [found_by(1, 0.9, 0.1)]
    assert proven(found) == []  # by all of them together
    assert explained(found, [10]) == pytest.approx((0.9, 0.1))


@pytest.mark.slow
def test_a_small_ball_is_measured_by_both_cameras_though_each_alone_gives_its_rotation_badly(tmp_path):
    movement = {"volume_mm": 14.0, "velocity_rms": 0.12}
    settings = SynthSettings(frames=30, seed=1, diameter_px=16.0, image_size=(120, 120), **movement)
    experiment = write_synthetic_experiment(tmp_path, settings)
    track = track_movies(experiment)
    with h5py.File(tmp_path / "truth.h5") as truth:
        off_mm = np.linalg.norm(track.position - truth["position"][()], axis=1)
    assert track.valid.all()
    for camera in track.cameras.values():
        assert set(camera.reason) == {Reason.OK}
    assert np.median(off_mm) < 0.1  # 1.5 of one camera


@pytest.mark.slow
def test_a_glare_as_large_as_half_of_the_ball_is_refused_though_light_learnt_at_wrong_poses_explains_it(tmp_path):
    experiment = write_synthetic_experiment(tmp_path, SynthSettings(frames=24, seed=11, texture="blobs"))
    cameras = load_cameras(tmp_path / "cameras.yaml")
    with h5py.File(tmp_path / "truth.h5") as truth:
        position = torch.from_numpy(truth["position"][()])
    document = yaml.safe_load(experiment.read_text())
    for name, movie in open_movies(load_experiment(experiment), list(cameras)).items():
        frames = np.stack(list(movie.frames(0, len(movie)))).astype(float)
        u, v = np.arange(frames.shape[2]), np.arange(frames.shape[1])[:, None]
        for frame, (x, y) in zip(frames, (cameras[name].project(position) + 12.0).tolist(), strict=True):
            frame += 300 * np.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / 10.0**2)
        np.save(tmp_path / f"{name}.npy", frames.clip(0, 255).round().astype(np.uint8))
        document["movies"][name] = f"{name}.npy"
    experiment.write_text(yaml.safe_dump(document))
    with pytest.raises(ExperimentError, match="expected frames that the map explains"):
        track_movies(experiment)
