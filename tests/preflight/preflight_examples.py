"""One small synthetic experiment, spoilt in memory, for the check before a run."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from sphereorient.movies import open_movie
from sphereorient.preflight import Finding, Preflight, Severity, preflight
from sphereorient.synth import SynthSettings, write_synthetic_experiment

PLAIN = {"diameter": 18.0}  # the map costs a second: only where the test is of it
PAINTED = {"diameter": 18.0, "texture": "texture.png"}
CAMERAS = ("cam1", "cam2")
SMALL: dict[str, Any] = {
    "frames": 64,
    "image_size": (240, 240),
    "diameter_px": 56.0,
    "volume_mm": 30.0,
    "velocity_rms": 0.4,
    "velocity_time": 0.03,
    "seed": 3,
    "exposure": 0.0001,
    "exposure_samples": 1,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Example:
    """An experiment in memory; spoilt by tests, written by `write`."""

    folder: Path  # of the clean one
    pictures: Mapping[str, NDArray[np.uint8]]  # (N, H, W) each
    texture: NDArray[np.uint8]  # (H, 2 H)

    def spoilt(self, how: Callable[[NDArray[np.uint8]], NDArray[Any]], cameras: tuple[str, ...] = CAMERAS) -> Example:
        """Return the example with the movies of some cameras changed."""
        changed = {name: how(self.pictures[name]).astype(np.uint8) for name in cameras}
        return replace(self, pictures={**self.pictures, **changed})


def render(folder: Path) -> Example:
    write_synthetic_experiment(folder, SynthSettings(**SMALL))
    pictures = {}
    for name in CAMERAS:
        with open_movie(folder / f"{name}.mkv") as movie:
            pictures[name] = np.stack(list(movie.frames()))
    texture = cv2.imread(str(folder / "texture.png"), cv2.IMREAD_GRAYSCALE)
    return Example(folder=folder, pictures=pictures, texture=np.asarray(texture, np.uint8))


_RENDERED: list[Example] = []


@pytest.fixture(name="clean", scope="module")
def clean_example(tmp_path_factory: pytest.TempPathFactory) -> Example:
    """Return the clean experiment, rendered once for all files of tests."""
    if not _RENDERED:
        _RENDERED.append(render(tmp_path_factory.mktemp("clean")))
    return _RENDERED[0]


def write(example: Example, folder: Path, **keys: Any) -> Path:
    """Write movies as .npy beside what belongs to them, without the map unless `sphere` names it.

    keys: of experiment.yaml, None takes one away.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for path in example.folder.iterdir():
        if path.suffix in (".png", ".yaml"):
            shutil.copy(path, folder)
    for name, movie in example.pictures.items():
        np.save(folder / f"{name}.npy", movie)
    cv2.imwrite(str(folder / "texture.png"), example.texture)
    document = yaml.safe_load((example.folder / "experiment.yaml").read_text())
    document |= {"movies": {name: f"{name}.npy" for name in example.pictures}, "sphere": PLAIN, **keys}
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in document.items() if value is not None}))
    return path


def checked(example: Example, folder: Path, **keys: Any) -> Preflight:
    return preflight(write(example, folder, **keys))


def of(result: Preflight, title: str) -> Finding:
    """Return the finding of a title."""
    (found,) = [finding for finding in result.findings if finding.title == title]
    return found


def complaints(result: Preflight) -> list[str]:
    return [f"{one.title}: {one.measured}" for one in result.findings if one.severity is not Severity.OK]
