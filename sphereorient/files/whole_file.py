"""Files that are read whole, or written whole or not at all."""

import os
import stat
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from sphereorient.errors import OutputError, SphereOrientError, error_words, refusal

TEXT_BYTES = 1_000_000  # of a text file written by hand: a hundred times the usual size
TABLE_BYTES = 5_000_000  # of a table of points: 100,000 of them
ROOM = "choose a folder that exists, may be written and has room"


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


def read_text(path: Path, largest: int, expected: str, error: type[SphereOrientError], do: str) -> str:
    """Read a text in UTF-8 with the arguments of `read_whole`; raise `error` also for other bytes."""
    try:
        return read_whole(path, largest, expected, error, do).decode("utf-8-sig")  # some editors begin with such a mark
    except UnicodeDecodeError:
        got, do = "bytes that are no text", "save it as UTF-8"
        raise error(refusal(str(path), expected=expected, got=got, do=do)) from None


@contextmanager
def put_aside(path: Path, do: str = ROOM, also: tuple[type[Exception], ...] = ()) -> Iterator[Path]:
    """Give a temporary name with the same suffix; the file replaces `path` at the end, or is deleted after an error.
    OutputError with the remedy `do` for OSError or an error of `also`; the old file is kept.
    """
    aside = path.with_name(f".{path.stem}.partial{path.suffix}")
    failures: tuple[type[Exception], ...] = (OSError, *also)
    try:
        yield aside
        aside.replace(path)
    except failures as error:
        expected = "a file that can be written"
        raise OutputError(refusal(str(path), expected=expected, got=error_words(error), do=do)) from error
    finally:
        aside.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8 with `put_aside`."""
    with put_aside(path) as aside:
        aside.write_text(text, encoding="utf-8")


def make_folder(path: Path, name: str) -> None:
    """Make a folder and its parents where there is none; raise OutputError, with `name`, if that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        expected, do = "a folder that can be made", "choose another --out"
        raise OutputError(refusal(name, expected=expected, got=error_words(error), do=do)) from error


def check_ending(path: Path, option: str, endings: Collection[str]) -> None:
    """Raise OutputError if the name of a file to write, given with `option`, has none of the endings."""
    if path.suffix.lower() not in endings:
        do = f"end the name in {next(iter(endings))}"
        raise OutputError(refusal(f"{option} {path}", expected=" ".join(endings), got=f"'{path.suffix}'", do=do))
