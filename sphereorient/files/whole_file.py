import os
import stat
from pathlib import Path

from sphereorient.errors import SphereOrientError, refusal

TEXT_BYTES = 1_000_000  # of a text file written by hand: a hundred times the usual size
TABLE_BYTES = 5_000_000  # of a table of points: 100,000 of them


def read_whole(path: Path, largest: int, expected: str, error: type[SphereOrientError], do: str) -> bytes:
    """Read a plain file of at most `largest` bytes; raise `error` for anything else, with `expected` and remedy `do`.
    Refuse a pipe or a device before opening it: reading it might never end.
    """
    try:
        found = os.stat(path)  # noqa: PTH116 -- follows links as open does, and gives the reason, which Path.is_file does not
        if stat.S_ISREG(found.st_mode) and found.st_size <= largest:
            with path.open("rb") as file:
                return file.read(found.st_size)  # no more: files under /proc claim 0 bytes, and some never end
        if stat.S_ISDIR(found.st_mode):
            got, do = "a folder", "name a file in it"
        elif not stat.S_ISREG(found.st_mode):
            got, do = "a pipe, a socket or a device", "name a plain file"
        else:
            got, do = f"{found.st_size / 1e6:.3g} MB", f"name a file of at most {largest / 1e6:.3g} MB"
    except (FileNotFoundError, NotADirectoryError):
        got = "no such file"
    except (OSError, ValueError) as fault:  # ValueError: a zero byte in the name, or half a character
        got = f"'{getattr(fault, 'strerror', None) or 'a name that no file can have'}'"
    raise error(refusal(str(path), expected=expected, got=got, do=do))
