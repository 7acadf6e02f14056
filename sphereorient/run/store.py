"""The request of a run, and the store of its intermediate results: memory, or a folder beside the track."""

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from sphereorient import __version__
from sphereorient.errors import OutputError, TrackError, error_words, refusal
from sphereorient.experiment import Experiment, input_files, load_experiment
from sphereorient.files.whole_file import is_forced, write_text, writing
from sphereorient.follow.follower import Batch
from sphereorient.methods.method import Followed, Learnt, load_learnt, read_poses, save_learnt, write_poses
from sphereorient.methods.proposers import checkpoint_path
from sphereorient.methods.settings import DEFAULT_METHOD, Settings, settings_yaml

LOCK, PROCESS = "lock", "process"  # files in the folder of a run
TRACES = re.compile(rf"{LOCK}|{PROCESS}|\..*\.part.*")  # left by a run killed at its start


@dataclass(frozen=True, kw_only=True)
class Request:
    """One experiment to be tracked; sent to workers."""

    experiment: Path | Experiment
    out: Path | None = None  # the track; None: it is not written
    method: str = DEFAULT_METHOD
    settings: Settings = field(default_factory=Settings)
    cameras: tuple[str, ...] | None = None
    device: str = "cpu"
    learnt: Path | Mapping[str, Learnt] | None = None  # learnt results of another run, to use
    save_learnt: Path | None = None
    command: str = "sphereorient.run"
    force: bool = field(default_factory=is_forced)  # whether files without this program's mark may be replaced

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


@contextmanager
def writing_of(request: Request) -> Iterator[None]:
    """Context in which no input of the request is replaced."""
    experiment = load_experiment(request.experiment)
    with writing([experiment.path, *(path for path, _ in _files(request, experiment))], force=request.force):
        yield


def fingerprint(request: Request) -> dict[str, str]:
    """Return the identity of a run: inputs by size and time, text of experiment.yaml, settings, version."""
    experiment = load_experiment(request.experiment)
    found = {
        "version": __version__,
        "method": request.method,
        "settings": _digest(settings_yaml(request.settings)),
        "cameras": "all" if request.cameras is None else ",".join(request.cameras),
        "device": request.device,
        "experiment": _digest(experiment.path.read_text(encoding="utf-8")),
        "fields": _digest(_fields(experiment)),  # Python may change them
    }
    return found | {
        path.name if n == 0 else f"{path.name} ({n})": _stamp(path) for (path, n) in _files(request, experiment)
    }


def _fields(experiment: Experiment) -> str:
    """Return the fields of an experiment as text; of paths the name, as the same file may be named in other ways."""

    def plain(value: Any) -> Any:
        return value.name if isinstance(value, Path) else getattr(value, "tolist", partial(str, value))()

    times = experiment.times and Path(experiment.times).name
    return json.dumps(asdict(replace(experiment, times=times)), default=plain)


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


@dataclass(eq=False)
class MemoryStore:
    """Keeps a run in this process."""

    known: Mapping[str, Learnt] | None = None  # learnt results of each ball before the first frame
    _poses: dict[int, Followed] = field(default_factory=dict)

    @contextmanager
    def held(self, request: Request, *, resume: bool) -> Iterator[None]:
        """Do nothing: no other process uses this store."""
        yield

    def keep(self, learnt: Mapping[str, Learnt]) -> None:
        """Keep the learnt results of each ball."""
        self.known = learnt

    def write(self, batch: Batch, poses: Followed) -> None:
        """Keep the poses of each ball in one batch."""
        self._poses[batch.first] = poses

    def read(self, batch: Batch) -> Followed:
        """Return the poses of each ball in one batch."""
        return self._poses.pop(batch.first)

    def missing(self, batches: Sequence[Batch]) -> list[Batch]:
        """Return the batches that are not measured yet."""
        return [batch for batch in batches if batch.first not in self._poses]

    def remove(self) -> None:
        """Forget the poses."""
        self._poses.clear()


@dataclass(frozen=True)
class FolderStore:
    """Keeps a run in a folder; each file is written whole or not at all."""

    folder: Path

    def poses(self, batch: Batch) -> Path:
        """Return the file of the poses of one batch."""
        return self.folder / f"poses-{batch.first:08d}.h5"

    @contextmanager
    def held(self, request: Request, *, resume: bool) -> Iterator[None]:
        """Create the folder, or resume from it, and lock it. Raises TrackError: it is of a run with other inputs or
        settings; OutputError: it cannot be written, is not of a run, or another run is writing it.
        """
        with self._locked():
            now, before = fingerprint(request), self._fingerprint()
            if before is None or not resume:
                self.remove()
                write_text(self._run, json.dumps(dict(now), indent=1))
            elif others := sorted(name for name in {*before, *now} if before.get(name) != now.get(name)):
                do = "run without --resume to start over"
                got = f"parts of a run with another {', '.join(others)}"
                raise TrackError(refusal(str(self.folder), expected="parts of this run", got=got, do=do))
            try:
                yield
            finally:
                if not any(self.folder.glob("*.h5")):
                    self.remove()  # an empty run leaves nothing

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Make the folder if missing, refuse one that is not of a run, and lock it."""
        name, lock = str(self.folder), FileLock(self.folder / LOCK, blocking=False)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if self._fingerprint() is None and not all(TRACES.fullmatch(path.name) for path in self.folder.iterdir()):
                expected, do = "the parts of a run, or no such folder", "move it away, or choose another --out"
                raise OutputError(refusal(name, expected=expected, got="another folder", do=do))
        except OSError as error:
            do = "check the space left and the permissions of the folder"
            raise OutputError(refusal(name, expected="a folder to write", got=error_words(error), do=do)) from error
        try:
            lock.acquire()
            (self.folder / PROCESS).write_text(str(os.getpid()), encoding="utf-8")
        except Timeout:
            writer, do = self._writer(), "wait for it, or stop it"
            raise OutputError(f"{name} is being written by another run{writer}; {do}.") from None
        except OSError:  # file systems without locks; a full one fails at the next file
            pass
        try:
            yield
        finally:
            lock.release()  # first, as Windows does not delete open files
            if not self._run.exists():
                with suppress(OSError):  # foreign files stay
                    (self.folder / LOCK).unlink(missing_ok=True)
                    (self.folder / PROCESS).unlink(missing_ok=True)
                    self.folder.rmdir()

    def _writer(self) -> str:
        try:
            return f" (process {int((self.folder / PROCESS).read_text(encoding='utf-8'))})"
        except (OSError, ValueError):
            return ""

    @property
    def _run(self) -> Path:
        return self.folder / "run.json"

    def _fingerprint(self) -> dict[str, str] | None:
        try:
            known = json.loads(self._run.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        if not isinstance(known, dict) or not {"version", "method", "settings", "experiment"} <= known.keys():
            return None
        return {str(name): str(value) for name, value in known.items()}

    @property
    def known(self) -> Mapping[str, Learnt] | None:
        """Learnt results of each ball before the first frame; None if the file is missing or damaged."""
        try:
            return load_learnt(self.folder / "learnt.h5")
        except TrackError:
            return None

    def keep(self, learnt: Mapping[str, Learnt]) -> None:
        """Write the learnt results of each ball."""
        with writing(force=True):  # also over a damaged file, as the folder is of this run
            save_learnt(learnt, self.folder / "learnt.h5")

    def write(self, batch: Batch, poses: Followed) -> None:
        """Write the poses of each ball in one batch."""
        with writing(force=True):
            write_poses(poses, self.poses(batch))

    def read(self, batch: Batch) -> Followed:
        """Return the poses of each ball in one batch; raise TrackError and remove the file if it is damaged."""
        path = self.poses(batch)
        poses = read_poses(path) if path.is_file() else None
        if poses is None or any(len(of_ball) != len(batch) for of_ball in poses.values()):
            path.unlink(missing_ok=True)
            do = "run again with --resume; only this part is measured again"
            raise TrackError(refusal(str(path), expected="the poses of a batch", got="a damaged file", do=do))
        return poses

    def missing(self, batches: Sequence[Batch]) -> list[Batch]:
        """Return the batches that are not measured yet."""
        return [batch for batch in batches if not self.poses(batch).is_file()]

    def remove(self) -> None:
        """Remove the files of a run; `held` removes the empty folder."""
        if self._fingerprint() is not None:
            known = (self.folder / name for name in ("learnt.h5", "map.h5"))
            for path in [*self.folder.glob("poses-*.h5"), *self.folder.glob(".*.part*"), *known]:
                path.unlink(missing_ok=True)
            self._run.unlink()  # last, as it identifies the folder


Store = MemoryStore | FolderStore
