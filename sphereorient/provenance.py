"""Where a result comes from: versions, command, fingerprints of the inputs."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from sphereorient.experiment import MOVIES_OWN, Experiment
from sphereorient.movies import movie_files

PACKAGES = ("sphereorient", "torch", "kornia", "numpy", "scipy", "opencv-python-headless", "h5py", "av")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages whose numbers enter a result."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits, read in pieces."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def provenance(experiment: Experiment, cameras: Sequence[str], command: str) -> dict[str, Any]:
    """Return what the track's attribute `provenance` holds, all of it fit for JSON."""
    inputs = [experiment.path, experiment.cameras_path]
    inputs += [experiment.background_paths[name] for name in cameras if name in experiment.background_paths]
    if experiment.texture_path is not None:
        inputs.append(experiment.texture_path)
    if experiment.times not in (None, MOVIES_OWN):
        inputs.append(Path(str(experiment.times)))
    hashes = {path: sha256(path) for path in inputs}
    hashes |= {(movie := experiment.movie_paths[name]): _movie_sha256(movie) for name in cameras}
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "platform": f"{platform.system()} {platform.machine()}, {sys.implementation.name}",
        "versions": versions(),
        # By their place beside experiment.yaml: two cameras' movies in two folders often share a name.
        "sha256": {
            Path(os.path.relpath(path, experiment.folder)).as_posix(): digest for path, digest in hashes.items()
        },
    }


def _movie_sha256(path: Path) -> str:
    """Return the hash of a movie's file, or of the hashes of its pictures in their order."""
    files = movie_files(path)
    if len(files) == 1:
        return sha256(files[0])
    return hashlib.sha256("".join(sha256(file) for file in files).encode()).hexdigest()
