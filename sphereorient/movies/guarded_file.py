"""A file for HDF5 to write to that keeps calm when the disk is full."""

from __future__ import annotations

import io
from pathlib import Path


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
