"""Write changed experiments as another experiment.yaml, for scripts and tests."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sphereorient.experiment import Experiment, Sphere
from sphereorient.experiment.experiment import MOVIES_OWN, SCHEMA
from sphereorient.files.hdf5 import UNNAMED
from sphereorient.files.whole_file import relative_path
from sphereorient.files.yaml_file import write_document


def write_experiment(experiment: Experiment) -> Path:
    """Write an experiment, without its cameras, to its `path`; return the path. OutputError if that fails."""

    def relative(path: Path | str) -> str:
        return relative_path(path, experiment.folder)

    def all_relative(paths: Mapping[str, Path]) -> dict[str, str]:
        return {name: relative(path) for name, path in paths.items()}

    def keys_of(sphere: Sphere) -> dict[str, Any]:
        keys: dict[str, Any] = {"diameter": sphere.diameter_mm}
        keys |= {} if sphere.texture_path is None else {"texture": relative(sphere.texture_path)}
        return keys | ({"fixed": True} if sphere.fixed else {})

    times, spheres = experiment.times, {sphere.name: keys_of(sphere) for sphere in experiment.spheres}
    document: dict[str, Any] = {
        "name": experiment.name,
        "frame_rate": float(experiment.frame_rate_hz) if times is None else None,
        "times": times if times in (None, MOVIES_OWN) else relative(str(times)),
        "exposure": None if experiment.exposure_s is None else float(experiment.exposure_s),
        **({"sphere": spheres[UNNAMED]} if UNNAMED in spheres else {"spheres": spheres}),
        "cameras": relative(experiment.cameras_path),
        "movies": all_relative(experiment.movie_paths),
        "masks": all_relative(experiment.mask_paths),
        "backgrounds": all_relative(experiment.background_paths),
        "start": {name: number for name, number in experiment.start.items() if number},
        "frames": None if experiment.frames is None else list(experiment.frames),
        "flip": dict(experiment.flip),
        "flow": dict(experiment.flow),
    }
    document = {key: value for key, value in document.items() if value not in (None, {})}
    write_document(experiment.path, SCHEMA, document)
    return experiment.path
