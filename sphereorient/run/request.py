"""What a run is asked to do, and how it is told from another one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sphereorient import __version__
from sphereorient.experiment import Experiment, input_files, load_experiment
from sphereorient.methods.proposers import checkpoint_path
from sphereorient.methods.settings import DEFAULT_METHOD, Settings, settings_yaml


@dataclass(frozen=True, kw_only=True)
class Request:
    """One experiment to be tracked; made by the command line, sent to workers."""

    experiment: Path
    out: Path  # the track
    method: str = DEFAULT_METHOD
    settings: Settings = field(default_factory=Settings)
    cameras: tuple[str, ...] | None = None
    device: str = "cpu"
    learnt: Path | None = None  # what another run learnt, to measure with
    save_learnt: Path | None = None
    command: str = "sphereorient.jobs"

    @property
    def parts(self) -> Path:
        """The folder of what is done, beside the track, until the track is whole."""
        return self.out.with_name(self.out.name + ".parts")


def fingerprint(request: Request) -> dict[str, str]:
    """Tell a run from all others by what goes into it; files by their size and time, experiment.yaml by its text.

    Raises:
        SphereOrientError: the experiment or its cameras cannot be read.
    """
    experiment = load_experiment(request.experiment)
    told = {
        "version": __version__,
        "method": request.method,
        "settings": _digest(settings_yaml(request.settings)),
        "cameras": "all" if request.cameras is None else ",".join(request.cameras),
        "device": request.device,
        "experiment": _digest(request.experiment.read_text(encoding="utf-8")),
    }
    return told | {
        path.name if n == 0 else f"{path.name} ({n})": _stamp(path) for (path, n) in _files(request, experiment)
    }


def differing(one: Mapping[str, str], other: Mapping[str, str]) -> list[str]:
    """Return the names of what tells two runs apart."""
    return sorted(name for name in {*one, *other} if one.get(name) != other.get(name))


def run_id(told: Mapping[str, str]) -> str:
    """Return one word for a fingerprint."""
    return _digest(json.dumps(dict(told), sort_keys=True))


def _files(request: Request, experiment: Experiment) -> list[tuple[Path, int]]:
    """Return the input files, each with the number of others of its name before it."""
    named = [path for paths in input_files(experiment, request.cameras).values() for path in paths]
    named = [path for path in named if path != experiment.path]  # compared by its text
    if request.learnt is not None:
        named.append(request.learnt)
    if request.settings.propose.checkpoint is not None:
        named.append(checkpoint_path(request.settings.propose.checkpoint))
    names = [path.name for path in named]
    return [(path, names[:k].count(path.name)) for k, path in enumerate(named)]


def _stamp(path: Path) -> str:
    try:
        status = path.stat()
    except OSError:
        return "missing"
    return f"{status.st_size} {status.st_mtime_ns}"


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
