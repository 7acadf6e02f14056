"""A folder beside the track that keeps what is done of it: a run that was cut off goes on from there."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from sphereorient.errors import OutputError, TrackError, refusal
from sphereorient.follow import Poses
from sphereorient.methods.learnt import Learnt
from sphereorient.methods.precise import Window
from sphereorient.run.poses_file import read_poses, write_poses
from sphereorient.run.request import Request, differing, fingerprint


@dataclass(frozen=True)
class Parts:
    """The parts of one run; every file appears whole or not at all."""

    folder: Path

    @property
    def learnt(self) -> Path:
        """What was learnt before the first frame."""
        return self.folder / "learnt.h5"

    def poses(self, window: Window) -> Path:
        """The poses of one window."""
        return self.folder / f"poses-{window.first:08d}.h5"

    @contextmanager
    def held(self, request: Request, *, resume: bool) -> Iterator[None]:
        """Make the folder, or go on with what it holds, and keep other runs off it.

        Raises:
            TrackError: to be resumed, but of a run on other inputs or settings.
            OutputError: it cannot be written, or another run is writing it.
        """
        with ExitStack() as locks:
            if self._run.is_file():
                self._lock(locks)
            told, before = fingerprint(request), self._told()
            if before is None or not resume:
                self._make(told)
                self._lock(locks)
            elif others := differing(before, told):
                do = "run without --resume to start over"
                got = f"parts of a run with another {', '.join(others)}"
                raise TrackError(refusal(str(self.folder), expected="parts of this run", got=got, do=do))
            try:
                yield
            finally:
                if self.folder.is_dir() and not any(self.folder.glob("*.h5")):
                    self.remove()  # a run that came to nothing leaves nothing

    def _make(self, told: Mapping[str, str]) -> None:
        try:
            self.remove()
            self.folder.mkdir()
            aside = self.folder / ".run.json.part"
            with aside.open("w", encoding="utf-8") as file:
                json.dump(dict(told), file, indent=1)
                file.flush()
                os.fsync(file.fileno())
            aside.replace(self._run)
        except OSError as error:
            do = "check the space left and the permissions of the folder"
            raise OutputError(refusal(str(self.folder), expected="a folder to write", got=str(error), do=do)) from error

    def _lock(self, locks: ExitStack) -> None:
        file = locks.enter_context(self._run.open("rb"))
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            do = "wait for it, or stop it"
            got = "another run that is writing it"
            raise OutputError(refusal(str(self.folder), expected="a track of our own", got=got, do=do)) from None
        except OSError:  # file systems without locks
            return

    @property
    def _run(self) -> Path:
        return self.folder / "run.json"

    def _told(self) -> dict[str, str] | None:
        """Return the fingerprint of the run that made the parts; None where there is none."""
        try:
            told = json.loads(self._run.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return {str(name): str(value) for name, value in told.items()} if isinstance(told, dict) else None

    def write(self, window: Window, poses: Sequence[Poses]) -> None:
        """Keep the poses of one window."""
        write_poses(self.poses(window), poses)

    def read(self, window: Window) -> list[Poses] | None:
        """Return the poses of one window, None where they are not there, whole."""
        path = self.poses(window)
        poses = read_poses(path) if path.is_file() else None
        return poses if poses is not None and len(poses) == window.last - window.first else None

    def missing(self, windows: Sequence[Window]) -> list[Window]:
        """Return the windows that are still to be measured."""
        return [window for window in windows if not self.poses(window).is_file()]

    def known(self) -> Learnt | None:
        """Return what was learnt before the first frame, None where that is not there, whole."""
        try:
            return Learnt.load(self.learnt)
        except TrackError:
            return None

    def remove(self) -> None:
        """Take the folder away."""
        if self.folder.exists():
            shutil.rmtree(self.folder)
