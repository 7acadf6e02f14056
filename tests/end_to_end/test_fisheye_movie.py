"""A movie through a fisheye lens: the ball is far off its axis, where a pinhole is another lens."""

from __future__ import annotations

import math
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from precise_examples import angle_deg

from sphereorient import so3
from sphereorient.cameras import Camera, PinholeCamera, load_cameras, save_cameras
from sphereorient.cameras.fisheye import FisheyeCamera
from sphereorient.run.stages import track_movies
from sphereorient.synth import SynthSettings, write, write_synthetic_experiment

OFF_AXIS = math.radians(50.0)
SIZE, DISTANCE_MM = (480, 480), 90.0


def f64(value: object) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


def off_axis(_: SynthSettings) -> dict[str, Camera]:
    """A lens of 137 degrees; the lab's origin lies off its axis."""
    tilt = so3.exp(f64((0.0, OFF_AXIS, 0.0)))
    camera = FisheyeCamera(
        image_size=SIZE,
        R_cam_lab=tilt @ f64([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
        T_cam_lab_mm=tilt @ f64((0.0, 0.0, DISTANCE_MM)),
        centre_px=f64((239.5, 239.5)),
        f_px=f64((200.0, 200.0)),
        k=f64((-0.02, 0.005, -0.004, 0.001)),
    )
    return {"cam1": camera}


@pytest.mark.slow
def test_a_ball_far_off_the_axis_of_a_wide_lens_is_tracked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(write, "default_cameras", off_axis)
    settings = SynthSettings(frames=30, image_size=SIZE, diameter_px=40.0, distance_mm=DISTANCE_MM, volume_mm=8.0)
    path = write_synthetic_experiment(tmp_path, settings.model_copy(update={"cameras": 1}))
    with h5py.File(tmp_path / "truth.h5") as truth:
        X, R = truth["position"][()], truth["orientation"][()]

    track = track_movies(path, method="precise")
    assert track.valid.all()
    assert np.median(angle_deg(track.orientation, R)) < 0.14  # 0.09 measured; disks of 42 px
    assert np.median(np.linalg.norm(track.position - X, axis=1)) < 0.1  # mm, mostly along the line of sight

    (lens,) = load_cameras(tmp_path / "cameras.yaml").values()
    same = {name: getattr(lens, name) for name in ("image_size", "R_cam_lab", "T_cam_lab_mm", "centre_px")}
    save_cameras(tmp_path / "cameras.yaml", {"cam1": PinholeCamera(f_px=lens.f_px[0], **same)})
    wrong = track_movies(path, method="precise")
    assert np.nanmedian(angle_deg(wrong.orientation, R)) > 2
    assert np.nanmedian(np.linalg.norm(wrong.position - X, axis=1)) > 5
