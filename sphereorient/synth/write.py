"""Writing of synthetic experiments in the format of `sphereorient track`."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera, TsaiCamera, save_cameras
from sphereorient.errors import SettingsError, refusal
from sphereorient.files.hdf5 import UNNAMED, ball_group, whole_hdf5
from sphereorient.files.picture import write_picture
from sphereorient.files.whole_file import make_folder, write_text
from sphereorient.movies import write_ffv1
from sphereorient.sphere.texture import random_texture
from sphereorient.synth.degrade import OF_ONE_BALL, Disk
from sphereorient.synth.degrade_scene import Filming, degraded_settings, picture_of_ball, worn, wrong_cameras
from sphereorient.synth.motion import Motion6D, RandomMotion, random_motion, without_seam
from sphereorient.synth.scene import Exposure, digitise, exposures, make_scene, seeded
from sphereorient.synth.settings import SynthSettings
from sphereorient.synth.severities import degradation, severity

PIXEL_PITCH_MM = 0.02  # of usual high-speed cameras
DRAWS = 500  # motions tried for each ball
NEXT_SEED = 1_000_003  # from one ball or draw to the next, so that scenes have no seed in common


@dataclass(frozen=True, kw_only=True, eq=False)
class CleanMovie:
    """The cameras' view of balls before degradations of pictures."""

    textures: Sequence[Tensor]  # (H, 2 H) of each paint, without wear
    truth: Mapping[str, Motion6D]  # by ball, at the times of the frames
    disks: Mapping[str, Disk]  # by camera: the first ball in the N frames
    exposures: Mapping[str, Callable[[], Iterable[Exposure]]]  # by camera: the N exposures

    def kept(self) -> Self:
        """Return the movie with all exposures computed, for repeated use."""
        return replace(self, exposures={name: list(each()).__iter__ for name, each in self.exposures.items()})


Clean = Callable[[SynthSettings, float], CleanMovie]


def default_cameras(settings: SynthSettings) -> dict[str, Camera]:
    """Return Tsai cameras, slightly distorted: cam1 looks along lab +y, cam2 along -z, cam3 along -x, cam4 aslant."""
    f64 = partial(torch.tensor, dtype=torch.float64)
    focal_mm = settings.diameter_px * PIXEL_PITCH_MM * settings.distance_mm / settings.diameter_mm
    width, height = settings.image_size
    looks = {
        "cam1": ([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], 2e-4),
        "cam2": ([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]], -1.5e-4),
        "cam3": ([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]], 1e-4),
        "cam4": ([[0.6, -0.8, 0.0], [0.48, 0.36, -0.8], [0.64, 0.48, 0.6]], -1e-4),
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
        for name, (R, kappa1) in islice(looks.items(), settings.cameras)
    }


def write_degraded(folder: Path, base: SynthSettings, applied: Mapping[str, int], clean: Clean | None = None) -> Path:
    """Render as `write_synthetic_experiment` does; `applied` maps degradations to levels 1 .. 5.
    Raises SettingsError: unknown name or level, or impossible scene; OutputError: folder not writable.
    """
    values = {name: severity(name, k) for name, k in applied.items()}
    return write_synthetic_experiment(folder, base, values=values, clean=clean)


def write_synthetic_experiment(
    folder: Path,
    settings: SynthSettings,
    progress: Callable[[int], None] = lambda done: None,
    values: Mapping[str, float] = MappingProxyType({}),
    clean: Clean | None = None,
) -> Path:
    """Render an experiment with exact truth in `folder` and return the path of experiment.yaml. Files: movies,
    backgrounds, texture.png (of several balls texture_0.png, ... of each paint), cameras.yaml and truth.h5; old ones
    are replaced. `progress` gets the number of frames rendered since the last call. `values`: degradations by name,
    physical values; reported cameras, map and diameter may be wrong, truth.h5 never is. `clean` replaces `clean_movie`.
    Raises SettingsError: unknown degradation, one of a single ball for several, or impossible value or scene;
    OutputError: folder not writable.
    """
    for name, value in values.items():
        degradation(name).check(value)
        if settings.balls > 1 and name in OF_ONE_BALL:
            do = "leave it out, or set balls to 1"
            raise SettingsError(refusal(f"degradation {name}", expected="one ball", got=str(settings.balls), do=do))
    settings = degraded_settings(settings, values)
    movie = (clean or clean_movie)(settings, values.get("paint_wear", 0.0))
    make_folder(folder, f"folder {folder}")
    cameras = default_cameras(settings)
    filming = Filming(settings, values, cameras)
    for index, name in enumerate(cameras):
        frames = _frames(movie, filming, name, seeded(settings.seed, index), progress)
        write_ffv1(folder / f"{name}.mkv", frames, settings.frame_rate)
        empty = filming.empty[name].round().clamp(0, 255).byte().numpy()
        write_picture(folder / f"empty_{name}.png", empty)
    for k, texture in enumerate(movie.textures):
        write_picture(folder / _texture_file(settings, k), _as_file(filming.reported_texture(texture, k)))
    reported = wrong_cameras(cameras, values, settings.seed)
    exact = "exact cameras" if reported is cameras else "cameras, wrong on purpose"
    save_cameras(folder / "cameras.yaml", reported, comment=f"{exact}; X_cam = R X_lab + T, mm")
    write_truth(folder / "truth.h5", movie.truth, cameras)
    path = folder / "experiment.yaml"
    too_large = values.get("radius_error", 0.0) / (settings.diameter_px / 2)  # share, at the rim of the picture
    stated = settings.model_copy(update={"diameter_mm": settings.diameter_mm * (1 + too_large)})
    write_text(path, yaml.safe_dump(experiment_document(stated, cameras), sort_keys=False))
    return path


def clean_movie(settings: SynthSettings, paint_wear: float = 0.0) -> CleanMovie:
    """Return the cameras' view before degradations of pictures. Raises SettingsError: no room for a ball."""
    motions = motions_of(settings)
    # Rounded to grey levels, as in the file.
    textures = [
        torch.from_numpy(_as_file(random_texture(settings.texture, settings.seed + k * NEXT_SEED)) / np.float32(255))
        for k in range(min(settings.balls, settings.paints))
    ]
    scenes = [
        make_scene(worn(texture, paint_wear, seeded(settings.seed, "paint_wear", *[k] * (k > 0))), settings)
        for k, texture in enumerate(textures)
    ]
    at = [motion.at(instants_s(settings).reshape(-1)) for motion in motions.values()]
    X = torch.stack([poses.position_lab_mm.reshape(settings.frames, -1, 3) for poses in at])
    R = torch.stack([poses.R_lab_body.reshape(settings.frames, -1, 3, 3) for poses in at])
    wearing = [scenes[k] for k in settings.worn.values()]
    cameras, times_s = default_cameras(settings), frame_times_s(settings)
    return CleanMovie(
        textures=textures,
        truth={name: motion.at(times_s) for name, motion in motions.items()},
        # For several balls, degradations use only the cover.
        disks={name: picture_of_ball(one, X[0].mean(1), settings.diameter_mm / 2) for name, one in cameras.items()},
        exposures={name: partial(exposures, wearing, camera, X, R) for name, camera in cameras.items()},
    )


def frame_times_s(settings: SynthSettings) -> Tensor:
    """Return mid-exposure times, (N,) float64, s."""
    return torch.arange(settings.frames, dtype=torch.float64) / settings.frame_rate


def instants_s(settings: SynthSettings) -> Tensor:
    """Return the instants of each exposure, (N, E) float64, s, with the variance of the open shutter."""
    count = settings.exposure_samples
    within = ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5) * settings.exposure
    if count > 1:
        within = within / math.sqrt(1 - 1 / count**2)
    return frame_times_s(settings)[:, None] + within


def motions_of(settings: SynthSettings) -> dict[str, RandomMotion]:
    """Draw the motion of each ball, by name, without collisions. Raises SettingsError: no room for a ball."""
    times_s, motions, paths = instants_s(settings).reshape(-1), dict[str, RandomMotion](), list[Tensor]()
    for k, name in enumerate(settings.worn):
        for draw in range(DRAWS):
            seed = settings.seed + NEXT_SEED * (k + 8 * draw)
            motion = motion_of(settings.model_copy(update={"seed": seed}))
            path = motion.path(times_s, -1)
            if all(bool(((path - other).norm(dim=-1) >= settings.diameter_mm).all()) for other in paths):
                break
        else:
            expected = f"room for {settings.balls} of {settings.diameter_mm:g} mm in all {settings.frames} frames"
            got, do = f"none for ball {name}", "raise volume_mm, or lower balls, frames or diameter_mm"
            raise SettingsError(refusal("balls", expected=expected, got=got, do=do))
        motions[name] = motion
        paths.append(path)
    return motions


def motion_of(settings: SynthSettings) -> RandomMotion:
    """Draw the motion of the first ball of a synthetic experiment."""
    s = settings
    motion = random_motion(s.velocity_rms, s.velocity_time, s.omega_rms, s.omega_time, s.volume_mm, s.seed)
    return without_seam(motion, s.frames / s.frame_rate) if s.periodic else motion


def _texture_file(settings: SynthSettings, paint: int) -> str:
    return "texture.png" if settings.balls == 1 else f"texture_{paint}.png"


def _as_file(texture: Tensor) -> NDArray[np.uint8]:
    grey: NDArray[np.uint8] = np.rint(texture.numpy() * 255).astype(np.uint8)
    return grey


def _frames(
    movie: CleanMovie, filming: Filming, name: str, rng: torch.Generator, progress: Callable[[int], None]
) -> Iterator[NDArray[np.uint8]]:
    lost, disks = filming.lost(name, filming.settings.frames), movie.disks[name]
    for k, exposure in enumerate(movie.exposures[name]()):
        disk = Disk(centre_px=disks.centre_px[k], radius_px=disks.radius_px[k])
        # Lost frames draw noise too, so that other frames do not depend on losses.
        frame = digitise(filming.picture(exposure, disk, name, k), filming.settings, rng)
        yield np.zeros_like(frame) if k in lost else frame
        progress(1)


def write_truth(path: Path, truths: Mapping[str, Motion6D], cameras: Mapping[str, Camera]) -> None:
    """Write truth.h5 (docs/data-format.md) of balls by name; the name of a single ball is empty."""
    with whole_hdf5(path) as file:
        for name, truth in truths.items():
            group = ball_group(file, name)
            for key, value in _true_values(truth, cameras).items():
                group.create_dataset(key, data=value.numpy())


def _true_values(truth: Motion6D, cameras: Mapping[str, Camera]) -> dict[str, Tensor]:
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
    return data | {f"{name}/centre_px": camera.project(truth.position_lab_mm) for name, camera in cameras.items()}


def experiment_document(settings: SynthSettings, cameras: Iterable[str], suffix: str = ".mkv") -> dict[str, Any]:
    """Return experiment.yaml for movies NAME.mkv (or another suffix) and backgrounds empty_NAME.png."""
    # Leave out exposure 0: the key must be above 0.
    exposure = {"exposure": settings.exposure} if settings.exposure > 0 else {}
    names = list(cameras)
    spheres = {
        name: {"diameter": settings.diameter_mm, "texture": _texture_file(settings, k)}
        for name, k in settings.worn.items()
    }
    return {
        "schema": "sphereorient-experiment/1",
        "name": settings.name,
        "frame_rate": settings.frame_rate,
        **exposure,
        **({"sphere": spheres[UNNAMED]} if UNNAMED in spheres else {"spheres": spheres}),
        "cameras": "cameras.yaml",
        "backgrounds": {name: f"empty_{name}.png" for name in names},
        "movies": {name: f"{name}{suffix}" for name in names},
    }
