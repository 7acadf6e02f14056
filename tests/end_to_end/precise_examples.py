"""Small synthetic experiments for the precise method: rendered once, spoilt in memory, tracked from .npy movies."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.methods.settings import Settings, load_settings
from sphereorient.movies import open_movie
from sphereorient.run.stages import track_movies
from sphereorient.synth import SynthSettings, write_synthetic_experiment
from sphereorient.trajectory import Trajectory

CAMERAS = ("cam1", "cam2")
Floats = NDArray[np.float64]
Pictures = NDArray[np.uint8]

# Half the size of a usual movie, so that a hundred frames are tracked in seconds.
SMALL: dict[str, Any] = {"frames": 120, "image_size": (240, 240), "diameter_px": 50.0, "distance_mm": 520.0}
SMALL |= {"volume_mm": 30.0, "exposure": 0.0001, "exposure_samples": 1}


def mean_turn(deg: float, frame_rate: float = 600.0) -> float:
    """Return the omega_rms, rad/s, of a mean rotation by this angle from frame to frame."""
    return float(np.deg2rad(deg) * frame_rate / np.sqrt(8 / np.pi))


@dataclass(frozen=True, kw_only=True, eq=False)
class Movies:
    """An experiment in memory with its truth, N frames; spoilt by tests, written by `write`."""

    folder: Path  # of unchanged files: cameras, texture, pictures without the ball
    pictures: Mapping[str, Pictures]  # (N, H, W) each
    position_mm: Floats  # (N, 3), NaN where there is no ball
    R_lab_body: Floats  # (N, 3, 3)
    empty: float  # grey level behind the ball

    def __len__(self) -> int:
        return len(self.position_mm)

    def frames(self, rows: slice | NDArray[np.int64]) -> Movies:
        """Return other frames, in any order."""
        pictures = {name: movie[rows] for name, movie in self.pictures.items()}
        return replace(self, pictures=pictures, position_mm=self.position_mm[rows], R_lab_body=self.R_lab_body[rows])

    def without_ball(self, rows: Any, cameras: tuple[str, ...] = CAMERAS) -> Movies:
        """Return the movies with some frames replaced by the empty scene, its noise included."""
        pictures = {name: movie.copy() for name, movie in self.pictures.items()}
        for k, name in enumerate(cameras):
            noise = np.random.default_rng(k).normal(self.empty, 1.9, pictures[name][rows].shape)
            pictures[name][rows] = np.clip(np.rint(noise), 0, 255)
        return replace(self, pictures=pictures)

    def spoilt(self, how: Callable[[Pictures], Pictures]) -> Movies:
        """Return the movies with every picture changed."""
        return replace(self, pictures={name: how(movie) for name, movie in self.pictures.items()})


def render(folder: Path, **changed: Any) -> Movies:
    """Render an experiment and read it into memory; changed: settings of synth."""
    settings = SynthSettings(**{**SMALL, **changed})
    write_synthetic_experiment(folder, settings)
    pictures = {}
    for name in CAMERAS:
        with open_movie(folder / f"{name}.mkv") as movie:
            pictures[name] = np.stack(list(movie.frames()))
    with h5py.File(folder / "truth.h5") as truth:
        place, R = truth["position"][()], truth["orientation"][()]
    return Movies(folder=folder, pictures=pictures, position_mm=place, R_lab_body=R, empty=settings.background)


def write(movies: Movies, folder: Path, **keys: Any) -> Path:
    """Write movies as .npy beside a copy of their other files; keys: of experiment.yaml, None takes one away."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in movies.folder.iterdir():
        if path.suffix in (".png", ".yaml"):
            shutil.copy(path, folder)
    for name, movie in movies.pictures.items():
        np.save(folder / f"{name}.npy", movie)
    document = yaml.safe_load((movies.folder / "experiment.yaml").read_text())
    document |= {"movies": {name: f"{name}.npy" for name in movies.pictures}, **keys}
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in document.items() if value is not None}))
    return path


def tracked(movies: Movies, folder: Path, *changed: str, cameras: tuple[str, ...] | None = None) -> Trajectory:
    """Write and track; changed: settings as room.key=value."""
    return track_movies(write(movies, folder), method="precise", settings=settings(*changed), cameras=cameras)


def settings(*changed: str) -> Settings:
    return load_settings(None, changed)


def turned_off(track: Trajectory, movies: Movies) -> Floats:
    """Return the errors of orientation, (N,), degrees; NaN where there is none."""
    return angle_deg(track.orientation, movies.R_lab_body)


def angle_deg(A: Floats, B: Floats) -> Floats:
    return np.asarray(np.rad2deg(so3.geodesic_distance(torch.from_numpy(A), torch.from_numpy(B)).numpy()))


def in_sigmas(error: Floats, covariance: Floats) -> Floats:
    """Whiten errors (N, 3) by their covariances (N, 3, 3)."""
    return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), error[..., None])[..., 0])


def rotation_error(track: Trajectory, movies: Movies) -> Floats:
    """Return delta of R_true = exp(delta) R, (N, 3), rad."""
    turn = torch.from_numpy(movies.R_lab_body) @ torch.from_numpy(track.orientation).mT
    return np.asarray(so3.log(torch.nan_to_num(turn)).numpy())
