"""The request of a run, and the fingerprint that distinguishes it from others."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sphereorient import __version__
from sphereorient.errors import OutputError, refusal
from sphereorient.experiment import Experiment, input_files, load_experiment
from sphereorient.methods.learnt import Learnt
from sphereorient.methods.proposers import checkpoint_path
from sphereorient.methods.settings import DEFAULT_METHOD, Settings, settings_yaml


@dataclass(frozen=True, kw_only=True)
class Request:
    """One experiment to be tracked; sent to workers."""

    experiment: Path | Experiment
    out: Path | None = None  # the track; None: it is not written
    method: str = DEFAULT_METHOD
    settings: Settings = field(default_factory=Settings)
    cameras: tuple[str, ...] | None = None
    device: str = "cpu"
    learnt: Path | Learnt | None = None  # what another run learnt, to measure with
    save_learnt: Path | None = None
    command: str = "sphereorient.run"

    @property
    def track(self) -> Path:
        """The path of the track; raise OutputError if the request has none."""
        if self.out is None:
            raise OutputError(refusal("out", expected="the path of a track", got="none", do="pass out="))
        return self.out

    @property
    def parts(self) -> Path:
        """The folder beside the track that keeps intermediate results until the track is complete."""
        return self.track.with_name(self.track.name + ".parts")


def fingerprint(request: Request) -> dict[str, str]:
    """Return the identity of a run: inputs by size and time, text of experiment.yaml, settings, version."""
    given = request.experiment
    experiment = given if isinstance(given, Experiment) else load_experiment(given)
    found = {
        "version": __version__,
        "method": request.method,
        "settings": _digest(settings_yaml(request.settings)),
        "cameras": "all" if request.cameras is None else ",".join(request.cameras),
        "device": request.device,
        "experiment": _digest(experiment.path.read_text(encoding="utf-8")),
    }
    return found | {
        path.name if n == 0 else f"{path.name} ({n})": _stamp(path) for (path, n) in _files(request, experiment)
    }


def differing(one: Mapping[str, str], other: Mapping[str, str]) -> list[str]:
    """Return the names of the entries that differ between two fingerprints."""
    return sorted(name for name in {*one, *other} if one.get(name) != other.get(name))


def _files(request: Request, experiment: Experiment) -> list[tuple[Path, int]]:
    """Return the input files, each with the number of earlier files of the same name."""
    named = [path for paths in input_files(experiment, request.cameras).values() for path in paths]
    named = [path for path in named if path != experiment.path]  # compared by its text
    if isinstance(request.learnt, Path):
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
