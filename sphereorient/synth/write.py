"""A whole synthetic experiment on disk, in the format that `sphereorient track` reads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera, TsaiCamera, save_cameras
from sphereorient.errors import OutputError, refusal
from sphereorient.movies import write_ffv1
from sphereorient.synth.motion import Motion6D, RandomMotion, random_motion
from sphereorient.synth.scene import make_scene, render_frame
from sphereorient.synth.settings import SynthSettings
from sphereorient.synth.textures import random_texture

PIXEL_PITCH_MM = 0.02


def default_cameras(settings: SynthSettings) -> dict[str, Camera]:
    """Two Tsai cameras at right angles: cam1 looks along lab +y, cam2 along lab -z; slight distortion."""
    focal_mm = settings.diameter_px * PIXEL_PITCH_MM * settings.distance_mm / settings.diameter_mm
    width, height = settings.image_size

    def f64(value: Any) -> Tensor:
        return torch.tensor(value, dtype=torch.float64)

    looks = {
        "cam1": [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
        "cam2": [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]],
    }
    return {
        name: TsaiCamera(
            image_size=(width, height),
            f_mm=f64(focal_mm),
            pixel_pitch_mm=f64((PIXEL_PITCH_MM, PIXEL_PITCH_MM)),
            sx=f64(1.0),
            centre_px=f64(((width - 1) / 2, (height - 1) / 2)),
            kappa1=f64(kappa1),
            R_cam_lab=f64(R),
            T_cam_lab_mm=f64((0.0, 0.0, settings.distance_mm)),
        )
        for (name, R), kappa1 in zip(looks.items(), (2e-4, -1.5e-4), strict=True)
    }


def write_experiment(
    folder: Path, settings: SynthSettings, progress: Callable[[int], None] = lambda done: None
) -> Path:
    """Render a two-camera experiment with exact truth.

    Args:
        folder: made where it is missing; files of an older run are replaced.
        settings: the scene.
        progress: called with the number of frames rendered since the last call.

    Returns:
        Path of experiment.yaml. Beside it: cam1.mkv, cam2.mkv, pictures of the scene without the
        sphere, texture.png, cameras.yaml, truth.h5.

    Raises:
        OutputError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            refusal(f"folder {folder}", expected="a folder that can be made", got=str(error), do="choose another --out")
        ) from None
    texture = random_texture(settings.texture, settings.seed)
    grey = np.rint(texture.numpy() * 255).astype(np.uint8)
    cameras = default_cameras(settings)
    time_s = torch.arange(settings.frames, dtype=torch.float64) / settings.frame_rate
    motion = random_motion(
        settings.velocity_rms,
        settings.velocity_time,
        settings.omega_rms,
        settings.omega_time,
        settings.volume_mm,
        settings.seed,
    )
    for index, (name, camera) in enumerate(cameras.items()):
        frames = _frames(settings, torch.from_numpy(grey / np.float32(255)), camera, motion, index, progress)
        write_ffv1(folder / f"{name}.mkv", frames, settings.frame_rate)
        # As a careful lab does: a picture of the scene without the ball, before it is let in.
        empty = np.full(camera.image_size[::-1], round(settings.background), np.uint8)
        _write_picture(folder / f"empty_{name}.png", empty)
    _write_picture(folder / "texture.png", grey)
    save_cameras(folder / "cameras.yaml", cameras, comment="exact cameras; X_cam = R X_lab + T, mm")
    _write_truth(folder / "truth.h5", motion.at(time_s), cameras)
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(_experiment(settings, cameras), sort_keys=False), encoding="utf-8")
    return path


def _write_picture(path: Path, grey: NDArray[np.uint8]) -> None:
    if not cv2.imwrite(str(path), grey):
        raise OutputError(refusal(str(path), expected="a writable file", got="a refusal", do="check the disk"))


def _frames(
    settings: SynthSettings,
    texture: Tensor,
    camera: Camera,
    motion: RandomMotion,
    index: int,
    progress: Callable[[int], None],
) -> Iterator[NDArray[np.uint8]]:
    """Render the movie of one camera, frame by frame."""
    count = settings.exposure_samples
    within = ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5) * settings.exposure
    time_s = torch.arange(settings.frames, dtype=torch.float64) / settings.frame_rate
    now = motion.at((time_s[:, None] + within).reshape(-1))
    scene = make_scene(texture, settings)
    rng = np.random.default_rng([settings.seed, index])
    for k in range(settings.frames):
        these = slice(k * count, (k + 1) * count)
        yield render_frame(scene, camera, now.position_lab_mm[these], now.R_lab_body[these], rng)
        progress(1)


def _write_truth(path: Path, truth: Motion6D, cameras: Mapping[str, Camera]) -> None:
    """Write truth.h5 (docs/data-format.md), aside and then under its name."""
    body = truth.R_lab_body.mT
    data = {
        "time": truth.time_s,
        "position": truth.position_lab_mm,
        "orientation": truth.R_lab_body,
        "velocity": truth.velocity_m_s,
        "acceleration": truth.acceleration_m_s2,
        "omega_lab": truth.omega_lab_rad_s,
        "alpha_lab": truth.alpha_lab_rad_s2,
        "omega_body": (body @ truth.omega_lab_rad_s[..., None])[..., 0],
        "alpha_body": (body @ truth.alpha_lab_rad_s2[..., None])[..., 0],
    }
    data |= {f"{name}/centre_px": camera.project(truth.position_lab_mm) for name, camera in cameras.items()}
    aside = path.with_suffix(".partial")
    with h5py.File(aside, "w") as file:
        for key, value in data.items():
            file.create_dataset(key, data=value.numpy())
    aside.replace(path)


def _experiment(settings: SynthSettings, cameras: Mapping[str, Camera]) -> dict[str, Any]:
    # A momentary exposure is written as none: the experiment's key is a duration above 0.
    exposure = {"exposure": settings.exposure} if settings.exposure > 0 else {}
    return {
        "schema": "sphereorient-experiment/1",
        "name": settings.name,
        "frame_rate": settings.frame_rate,
        **exposure,
        "sphere": {"diameter": settings.diameter_mm, "texture": "texture.png"},
        "cameras": "cameras.yaml",
        "backgrounds": {name: f"empty_{name}.png" for name in cameras},
        "movies": {name: f"{name}.mkv" for name in cameras},
    }
