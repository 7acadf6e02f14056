"""Reading small files whole: only plain ones, and none that would fill the memory."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from sphereorient.errors import SphereOrientError, refusal

TEXT_BYTES = 1_000_000  # of a file that people write: a hundred times what ours have
TABLE_BYTES = 5_000_000  # of a table of points: 100,000 of them


def read_whole(path: Path, largest: int, expected: str, error: type[SphereOrientError], do: str) -> bytes:
    """Read a file that is no larger than some size.

    A pipe or a device is refused before it is opened: reading it might wait for ever, or never end.

    Args:
        path: the file.
        largest: bytes; a file that has more, or claims to, is refused unread.
        expected: what the file should be, for the message.
        error: the error to raise.
        do: the remedy where there is no such file, for the message.

    Raises:
        error: missing, a folder, no plain file, too large, or unreadable.
    """
    try:
        found = os.stat(path)  # noqa: PTH116 -- follows links as open does, and tells why where Path.is_file only says no
        if stat.S_ISREG(found.st_mode) and found.st_size <= largest:
            with path.open("rb") as file:
                return file.read(found.st_size)  # no more: files under /proc claim 0 bytes, and some never end
        got, do = _what_stands_there(found, largest)
    except (FileNotFoundError, NotADirectoryError):
        got = "no such file"
    except (OSError, ValueError) as fault:  # ValueError: a zero byte in the name, or half a character
        got = f"'{getattr(fault, 'strerror', None) or 'a name that no file can have'}'"
    raise error(refusal(str(path), expected=expected, got=got, do=do))


def _what_stands_there(found: os.stat_result, largest: int) -> tuple[str, str]:
    """Return what was found where a file that can be read was wanted, and what to do."""
    if stat.S_ISDIR(found.st_mode):
        return "a folder", "name a file in it"
    if not stat.S_ISREG(found.st_mode):
        return "a pipe, a socket or a device", "name a plain file"
    return f"{found.st_size / 1e6:.3g} MB", f"name a file of at most {largest / 1e6:.3g} MB"
