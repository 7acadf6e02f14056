"""Write synthetic experiments in the format that `sphereorient track` reads."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
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
from sphereorient.synth.scene import RenderedScene, digitise, expose, make_scene
from sphereorient.synth.settings import SynthSettings
from sphereorient.synth.textures import random_texture

PIXEL_PITCH_MM = 0.02


@dataclass(frozen=True, kw_only=True, eq=False)
class FilmedView:
    """The sphere in one picture, for `Filming.picture`."""

    name: str
    camera: Camera
    frame: int | None  # frame number; None: background picture
    cover: NDArray[np.float32]  # (H, W), coverage of each pixel
    position_lab_mm: Tensor  # (3,) float64, centre at mid-exposure


class Filming:
    """Hooks that change pictures and reported files; the base class changes nothing."""

    def paint(self, texture: Tensor) -> Tensor:
        """Return the texture map of the filmed sphere, (H, 2 H)."""
        return texture

    def picture(self, picture: NDArray[np.float32], view: FilmedView) -> NDArray[np.float32]:
        """Return grey levels (H, W) before noise."""
        return picture

    def lost(self, name: str, frames: int) -> frozenset[int]:
        """Return the numbers of a camera's black frames."""
        return frozenset()

    def reported_texture(self, texture: Tensor) -> Tensor:
        """Return the texture map (H, 2 H) to write."""
        return texture

    def reported_cameras(self, cameras: Mapping[str, Camera]) -> Mapping[str, Camera]:
        """Return the cameras to write."""
        return cameras

    def reported_diameter_mm(self, diameter_mm: float) -> float:
        """Return the diameter to write, mm."""
        return diameter_mm


def default_cameras(settings: SynthSettings) -> dict[str, Camera]:
    """Return two Tsai cameras with slight distortion: cam1 looks along lab +y, cam2 along lab -z."""
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


def write_synthetic_experiment(
    folder: Path,
    settings: SynthSettings,
    progress: Callable[[int], None] = lambda done: None,
    filming: Filming | None = None,
) -> Path:
    """Render a two-camera experiment with exact truth in `folder` and return the path of experiment.yaml.

    The folder also receives movies, backgrounds, texture.png, cameras.yaml and truth.h5; old files are replaced.
    `progress` receives the number of frames rendered since the last call; `filming` changes pictures and reported
    files.

    Raises:
        OutputError: folder not writable.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            refusal(f"folder {folder}", expected="a folder that can be made", got=str(error), do="choose another --out")
        ) from None
    filming = filming or Filming()
    # Rounded to grey levels, as in the file.
    texture = _as_file(random_texture(settings.texture, settings.seed)) / np.float32(255)
    cameras = default_cameras(settings)
    scene = make_scene(filming.paint(torch.from_numpy(texture)), settings)
    for index, (name, camera) in enumerate(cameras.items()):
        frames = _frames(scene, (name, camera), filming, np.random.default_rng([settings.seed, index]), progress)
        write_ffv1(folder / f"{name}.mkv", frames, settings.frame_rate)
        _write_picture(folder / f"empty_{name}.png", _without_the_ball(settings, name, camera, filming))
    _write_picture(folder / "texture.png", _as_file(filming.reported_texture(torch.from_numpy(texture))))
    reported = filming.reported_cameras(cameras)
    exact = "exact cameras" if reported is cameras else "cameras, wrong on purpose"
    save_cameras(folder / "cameras.yaml", reported, comment=f"{exact}; X_cam = R X_lab + T, mm")
    _write_truth(folder / "truth.h5", motion_of(settings).at(frame_times_s(settings)), cameras)
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(_experiment(settings, cameras, filming), sort_keys=False), encoding="utf-8")
    return path


def frame_times_s(settings: SynthSettings) -> Tensor:
    """Return mid-exposure times, (N,) float64, s."""
    return torch.arange(settings.frames, dtype=torch.float64) / settings.frame_rate


def motion_of(settings: SynthSettings) -> RandomMotion:
    """Draw the motion of a synthetic experiment."""
    return random_motion(
        settings.velocity_rms,
        settings.velocity_time,
        settings.omega_rms,
        settings.omega_time,
        settings.volume_mm,
        settings.seed,
    )


def _as_file(texture: Tensor) -> NDArray[np.uint8]:
    grey: NDArray[np.uint8] = np.rint(texture.numpy() * 255).astype(np.uint8)
    return grey


def _write_picture(path: Path, grey: NDArray[np.uint8]) -> None:
    if not cv2.imwrite(str(path), grey):
        raise OutputError(refusal(str(path), expected="a writable file", got="a refusal", do="check the disk"))


def _frames(
    scene: RenderedScene,
    named: tuple[str, Camera],
    filming: Filming,
    rng: np.random.Generator,
    progress: Callable[[int], None],
) -> Iterator[NDArray[np.uint8]]:
    settings, (name, camera) = scene.settings, named
    count = settings.exposure_samples
    within = ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5) * settings.exposure
    now = motion_of(settings).at((frame_times_s(settings)[:, None] + within).reshape(-1))
    lost = filming.lost(name, settings.frames)
    for k in range(settings.frames):
        position, R_lab_body = (x[k * count : (k + 1) * count] for x in (now.position_lab_mm, now.R_lab_body))
        picture, cover = expose(scene, camera, position, R_lab_body)
        view = FilmedView(name=name, camera=camera, frame=k, cover=cover, position_lab_mm=position.mean(0))
        # Lost frames draw noise too: the other frames do not depend on losses.
        frame = digitise(filming.picture(picture, view), settings, rng)
        yield np.zeros_like(frame) if k in lost else frame
        progress(1)


def _without_the_ball(settings: SynthSettings, name: str, camera: Camera, filming: Filming) -> NDArray[np.uint8]:
    size = camera.image_size[::-1]
    cover, origin = np.zeros(size, np.float32), torch.zeros(3, dtype=torch.float64)
    view = FilmedView(name=name, camera=camera, frame=None, cover=cover, position_lab_mm=origin)
    empty = filming.picture(np.full(size, settings.background, np.float32), view)
    rounded: NDArray[np.uint8] = np.clip(np.rint(empty), 0, 255).astype(np.uint8)
    return rounded


def _write_truth(path: Path, truth: Motion6D, cameras: Mapping[str, Camera]) -> None:
    """Write truth.h5 (docs/data-format.md) under a temporary name, then rename it."""
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


def _experiment(settings: SynthSettings, cameras: Mapping[str, Camera], filming: Filming) -> dict[str, Any]:
    # exposure 0 is left out: the key must be above 0.
    exposure = {"exposure": settings.exposure} if settings.exposure > 0 else {}
    return {
        "schema": "sphereorient-experiment/1",
        "name": settings.name,
        "frame_rate": settings.frame_rate,
        **exposure,
        "sphere": {"diameter": filming.reported_diameter_mm(settings.diameter_mm), "texture": "texture.png"},
        "cameras": "cameras.yaml",
        "backgrounds": {name: f"empty_{name}.png" for name in cameras},
        "movies": {name: f"{name}.mkv" for name in cameras},
    }
