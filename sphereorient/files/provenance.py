import hashlib
import math
import platform
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from sphereorient.errors import OutputError, SphereOrientError, refusal
from sphereorient.files.whole_file import relative_path

PACKAGES = ("sphereorient", "torch", "kornia", "numpy", "scipy", "opencv-python-headless", "h5py", "av")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def without_nan(value: Any) -> Any:
    """Return a value, or nested lists and mappings of such, with None, JSON's null, for NaN and infinity."""
    if isinstance(value, dict):
        return {name: without_nan(part) for name, part in value.items()}
    if isinstance(value, list):
        return [without_nan(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def package(name: str, extra: str, error: type[SphereOrientError] = OutputError) -> Any:
    """Import a package of an extra; the error names the command that installs it."""
    try:
        return import_module(name)
    except ImportError as fault:
        label, do = f"sphereorient[{extra}]", f"install it with `pip install 'sphereorient[{extra}]'`"
        got = f"the package {name.partition('.')[0]}"
        raise error(refusal(label, expected=got, got="none", do=do)) from fault


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _digest(files: Sequence[Path]) -> str:
    hashes = [sha256(file) for file in files]
    return hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()


def provenance(inputs: Mapping[Path, Sequence[Path]], folder: Path, command: str) -> dict[str, Any]:
    """Return the track's attribute `provenance`, ready for JSON.
    `inputs`: each path with its file or the pictures of its sequence in order; named relative to `folder`.
    """
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "platform": f"{platform.system()} {platform.machine()}, {sys.implementation.name}",
        "versions": versions(),
        # By path relative to experiment.yaml: two cameras' movies in two folders often share a name.
        "sha256": {relative_path(path, folder): _digest(files) for path, files in inputs.items()},
    }
