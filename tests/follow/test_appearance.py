"""What is learnt of the cameras' agreement before frames are followed."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from sphereorient.run.stages import track_movies
from sphereorient.synth import SynthSettings, write_synthetic_experiment
from sphereorient.trajectory import Reason


@pytest.mark.slow
def test_a_small_ball_is_measured_by_both_cameras_though_each_alone_knows_its_rotation_badly(tmp_path):
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
