import hashlib
import math
import platform
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import import_module
from importlib.metadata import PackageNotFoundError, metadata, version
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from sphereorient.errors import OutputError, SphereOrientError, error_words, refusal
from sphereorient.files.whole_file import relative_path

PACKAGES = ("sphereorient", "torch", "kornia", "numpy", "scipy", "opencv-python-headless", "h5py", "av")
IMPORTED_AS = {"opencv-python-headless": "cv2"}
OF_EXTRA = {  # purpose, unless clear from the name
    "table": "export to parquet and netcdf",
    "nwb": "export to nwb",
    "live": "live --to zmq, serial, lsl or osc",
    "pylon": "live --source pylon:SERIAL",
    "vimba": "live --source vimba:ID",
    "genicam": "live --source genicam:PRODUCER.cti",
    "cluster": "track --cluster",
    "moon": "scripts/moon.py",
}


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that affect results."""
    return {"python": platform.python_version()} | {package: _version(package) for package in PACKAGES}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _own(name: str) -> list[str]:
    try:
        return metadata("sphereorient").get_all(name) or []
    except PackageNotFoundError:  # a folder that is not installed
        return []


def _poor(extra: str = "") -> list[Requirement]:
    """Return the missing or too old packages that are always required, or required by an extra."""
    required = map(Requirement, _own("Requires-Dist"))
    wanted = [one for one in required if (one.marker.evaluate({"extra": extra}) if one.marker else not extra)]
    found = {one: _version(one.name) for one in wanted}
    return [one for one, got in found.items() if got[0].isalpha() or not one.specifier.contains(got, prereleases=True)]


def lacking() -> dict[str, str]:
    """Return the missing or too old packages of each extra, and their purpose, as text."""
    poor = {extra: _poor(extra) for extra in _own("Provides-Extra") if extra != "dev"}
    return {
        extra: f"{', '.join(one.name for one in some)} (for {OF_EXTRA.get(extra, extra)})"
        for extra, some in poor.items()
        if some
    }


def package_faults() -> list[str]:
    """Return the always required packages that are missing, too old, or cannot be imported, a line each."""
    faults = []
    for one in _poor():
        do = f"run `pip install '{one.name}{one.specifier}'`"
        faults.append(refusal(one.name, expected=str(one.specifier), got=_version(one.name), do=do))
    for name in PACKAGES:
        try:
            import_module(IMPORTED_AS.get(name, name))
        except Exception as error:  # a damaged package may raise anything
            do = f"run `pip install --force-reinstall {name}`"
            faults.append(refusal(name, expected="a package that can be imported", got=error_words(error), do=do))
    return faults


def without_nan(value: Any) -> Any:
    """Return a value, also nested lists and mappings, with None, JSON's null, for NaN and infinity."""
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
    `inputs`: each path with its file or the pictures of its sequence in order, named relative to `folder`.
    """
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "platform": f"{platform.system()} {platform.machine()}, {sys.implementation.name}",
        "versions": versions(),
        # By path relative to experiment.yaml, as movies in different folders often have the same name.
        "sha256": {relative_path(path, folder): _digest(files) for path, files in inputs.items()},
    }
