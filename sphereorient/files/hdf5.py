"""HDF5 files that appear whole or not at all, also when the disk is full or the power fails."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

from sphereorient.files.outputs import put_aside

ROOM = "check the space left and the permissions of the folder"


@contextmanager
def whole_hdf5(path: Path, do: str = ROOM) -> Iterator[h5py.File]:
    """Give an HDF5 file to fill, which takes its place under its name, on the disk, when all is written.

    Args:
        path: the file; an old one is replaced at the end.
        do: the remedy, for the message.

    Raises:
        OutputError: it cannot be written; what was there before is still there.
    """
    # A full disk comes out of HDF5 as either error.
    with put_aside(path, do, also=(RuntimeError,)) as aside, GuardedFile(aside) as guarded:
        with h5py.File(guarded, "w", track_order=False) as file:
            yield file
        guarded.check()
        guarded.to_disk()


class GuardedFile(io.RawIOBase):
    """A file that takes no more bytes after the first error, and keeps the error for `check`.

    HDF5 cannot close a file that it cannot write: it complains again at every object, and may take the program down
    with it. Here it closes in peace, and the error is raised afterwards.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("w+b", buffering=0)
        self._error: OSError | None = None

    def check(self) -> None:
        """Raise the error of an earlier write, if there was one."""
        if self._error is not None:
            raise self._error

    def to_disk(self) -> None:
        """Make sure that the bytes outlive a power cut before anything points at them."""
        os.fsync(self._file.fileno())

    def write(self, content: bytes) -> int:  # type: ignore[override]
        """Write all bytes, or none from the first error on."""
        view = memoryview(content).cast("B")
        if self._error is None:
            try:
                done = 0
                while done < len(view):  # a disk that is nearly full takes a part
                    done += self._file.write(view[done:])
            except OSError as error:
                self._error = error
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the length, unless there was an error."""
        if self._error is None:
            try:
                return self._file.truncate(size)
            except OSError as error:
                self._error = error
        return size or 0

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Read bytes."""
        return self._file.readinto(buffer)

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place."""
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """Return the place."""
        return self._file.tell()

    def readable(self) -> bool:
        """Return that it can be read."""
        return True

    def writable(self) -> bool:
        """Return that it can be written."""
        return True

    def seekable(self) -> bool:
        """Return that it has places."""
        return True

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()
