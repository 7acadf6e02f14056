import hashlib
import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from sphereorient.files.whole_file import ROOM, put_aside

# Exceptions of h5py on damaged files, depending on the damage.
DAMAGE = (OSError, RuntimeError, ValueError, TypeError, LookupError, ArithmeticError, MemoryError, AttributeError)
SPHERES = "spheres"  # group with a group for each of several balls
UNNAMED = ""  # name of a single ball: `sphere:` of an experiment, arrays at the top of a file


@contextmanager
def whole_hdf5(path: Path, do: str = ROOM) -> Iterator[h5py.File]:
    """Open an HDF5 file that replaces `path` when complete and on the disk; else OutputError with the remedy `do`."""
    # HDF5 reports a full disk as one of these errors.
    with put_aside(path, do, also=(RuntimeError,)) as aside, GuardedFile(aside) as guarded:
        with h5py.File(guarded, "w", track_order=False) as file:
            file.attrs["made_by"] = "sphereorient"
            yield file
        guarded.check()
        os.fsync(guarded.fileno())


def digest(file: h5py.File) -> str:
    """Return the SHA-256 of all data sets and attributes of a file except the attribute `sha256`."""
    total = hashlib.sha256()

    def add(name: str, thing: h5py.Group | h5py.Dataset) -> None:
        named = {key: np.asarray(value).tolist() for key, value in thing.attrs.items() if key != "sha256"}
        values = np.asarray(thing[()]) if isinstance(thing, h5py.Dataset) else np.zeros(0)
        total.update(f"{name} {values.dtype} {values.shape} {sorted(named.items())}".encode() + values.tobytes())

    add("", file)
    file.visititems(add)
    return total.hexdigest()


def names_a_group(name: str) -> bool:
    """Return whether a name can be that of a group in a track: not empty, not '.', without '/'."""
    return bool(name.strip()) and "/" not in name and name != "."


def ball_group(file: h5py.File, name: str) -> h5py.Group:
    """Return a new group for a ball; the file itself for an unnamed one."""
    return file.create_group(f"{SPHERES}/{name}") if name else file


def ball_groups(file: h5py.File) -> dict[str, h5py.Group]:
    """Return the groups made by `ball_group`, by name."""
    return dict(file[SPHERES].items()) if SPHERES in file else {UNNAMED: file}


class GuardedFile(io.FileIO):
    """A file that ignores writes after the first error, and keeps the error for `check`. HDF5 cannot close a file that
    it cannot write: it fails again at every object and may crash the process.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self._error: OSError | None = None

    def check(self) -> None:
        """Raise the error of an earlier write, if there was one."""
        if self._error is not None:
            raise self._error

    def write(self, content: bytes) -> int:  # type: ignore[override]
        """Write all bytes."""
        view = memoryview(content).cast("B")
        if self._error is None:
            try:
                done = 0
                while done < len(view):  # a nearly full disk accepts a part
                    done += super().write(view[done:])
            except OSError as error:
                self._error = error
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the length."""
        if self._error is None:
            try:
                return super().truncate(size)
            except OSError as error:
                self._error = error
        return size or 0
