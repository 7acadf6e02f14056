"""Files read whole, or written atomically, never replacing files of other origin."""

import os
import re
import secrets
import stat
import zlib
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from sphereorient.errors import OutputError, SphereOrientError, error_words, refusal

TEXT_BYTES = 1_000_000  # of a text file written by hand, a hundred times the usual size
TABLE_BYTES = 5_000_000  # of a table of points: 100,000 of them
LARGEST_RATIO = 1200  # compression ratio of constant content; a file that claims more is damaged
ROOM = "choose a folder that exists, may be written and has room"
MARK = "made by sphereorient"  # of files that a later run may replace
HEAD_BYTES = 512  # of a file, which contain the mark
# Beginnings of texts: a first comment, also of older versions, or keys of JSON. Users write a schema, so it is no mark.
TEXT_MARK = re.compile(
    rb"(?:#|<!--).*made by sphereorient|# repaired by sphereorient |# experiment: .*\n# method: .*\n# frame_rate_hz: "
    rb'|\{\s*(?:"map": .*,\s*)?(?:"command": ?"sphereorient |"schema": ?"sphereorient-robustness)'
)
# The first line of a draft for users, see `sealed`.
SEAL = re.compile(rb"##? Until it is changed, init may replace it: ([0-9a-f]{8})\n")
DRAFT = b"by `sphereorient init`"  # in the head of each draft, even if its first line was edited
OLD_PAGE = b'<footer class="faint">sphereorient '
PNG, PNG_HEAD = b"\x89PNG\r\n\x1a\n", 33  # signature; bytes of signature and first chunk
HDF5 = b"\x89HDF\r\n\x1a\n"
Identity = tuple[int, int]  # of a file, independent of its name: device and number

_inputs: ContextVar[frozenset[Identity]] = ContextVar("inputs", default=frozenset())
_forced: ContextVar[bool] = ContextVar("forced", default=False)
_made: dict[Path, tuple[int, int, int]] = {}  # files made by this process, with their state


def read_whole(path: Path, largest: int, expected: str, error: type[SphereOrientError], do: str) -> bytes:
    """Read a plain file of at most `largest` bytes; raise `error` for anything else, with `expected` and remedy `do`.
    Refuse a pipe or a device before opening it: reading it might never end.
    """
    try:
        found = os.stat(path)  # noqa: PTH116 -- follows links as open does, and gives the reason, which Path.is_file does not
        if stat.S_ISREG(found.st_mode) and found.st_size <= largest:
            with path.open("rb") as file:
                return file.read(found.st_size)  # not more: files under /proc claim 0 bytes, and some never end
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
        return read_whole(path, largest, expected, error, do).decode("utf-8-sig")  # some editors write a mark
    except UnicodeDecodeError:
        got, do = "bytes that are not UTF-8", "save it as UTF-8"
        raise error(refusal(str(path), expected=expected, got=got, do=do)) from None


@contextmanager
def writing(inputs: Iterable[Path] = (), *, force: bool = False) -> Iterator[None]:
    """In this context `inputs` are not replaced; with `force` all other plain files may be."""
    found = set()
    for path in inputs:
        with suppress(OSError, ValueError):  # reading reports the fault
            status = path.stat()
            found.add((status.st_dev, status.st_ino))
    known, forced = _inputs.set(_inputs.get() | found), _forced.set(_forced.get() or force)
    try:
        yield
    finally:
        _inputs.reset(known)
        _forced.reset(forced)


def is_forced() -> bool:
    """Return whether files without the mark may be replaced."""
    return _forced.get()


def check_target(path: Path) -> None:
    """Raise OutputError if `path` may not be replaced: an input, a link, a device, a file of other origin."""
    do = "choose another name"
    try:
        found = path.lstat()
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        raise OutputError(refusal(str(path), expected="a name to write to", got=error_words(error), do=do)) from None
    if stat.S_ISLNK(found.st_mode):
        got = "a link"
    elif stat.S_ISDIR(found.st_mode):
        got, do = "a folder", "name a file in it"
    elif not stat.S_ISREG(found.st_mode):
        got = "a pipe, a socket or a device"
    elif (found.st_dev, found.st_ino) in _inputs.get():
        got = "an input of the same command"
    elif is_forced() or _made.get(path.absolute()) == _state(found) or has_mark(path):
        return
    else:
        got, do = _foreign(path), f"{do}, or add --force to replace it"
    raise OutputError(refusal(str(path), expected="a new file, or one made by sphereorient", got=got, do=do))


def _foreign(path: Path) -> str:
    """Return a description of a file without the mark."""
    try:
        with path.open("rb") as file:
            drafted = DRAFT in file.read(HEAD_BYTES)
    except OSError:
        drafted = False
    return "a changed draft of `sphereorient init`" if drafted else "a file without its mark"


def has_mark(path: Path) -> bool:
    """Return whether a file has this program's mark: HDF5 attribute, PNG text, first comment, tag of a page."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
            if head.startswith(b"<!doctype html>"):
                return MARK.encode() in head or OLD_PAGE in file.read()
            seal = SEAL.match(head)
            if seal is not None:
                file.seek(seal.end())
                return f"{zlib.crc32(file.read(TEXT_BYTES)):08x}".encode() == seal[1]
        if head.startswith(HDF5):
            return _hdf5_has_mark(path)
        return MARK.encode() in head if head.startswith(PNG) else TEXT_MARK.match(head) is not None
    except (OSError, RuntimeError, ValueError, TypeError, LookupError):  # for damaged HDF5
        return False


def sealed(text: str) -> str:
    """Return a text with a first line by which `has_mark` detects changes."""
    return f"## Until it is changed, init may replace it: {zlib.crc32(text.encode()):08x}\n{text}"


def _hdf5_has_mark(path: Path) -> bool:
    import h5py

    with h5py.File(path, "r") as file:
        found = [file.attrs.get(name) for name in ("made_by", "schema")]  # the second is of older versions
    return any(isinstance(one, str) and one.startswith("sphereorient") for one in found)


def _add_mark(path: Path) -> None:
    """Add the mark to a PNG file, as its first text."""
    content = path.read_bytes()
    if content.startswith(PNG) and MARK.encode() not in content[:HEAD_BYTES]:
        chunk = b"tEXtSoftware\0" + MARK.encode()
        text = (len(chunk) - 4).to_bytes(4) + chunk + zlib.crc32(chunk).to_bytes(4)
        path.write_bytes(content[:PNG_HEAD] + text + content[PNG_HEAD:])


def _state(found: os.stat_result) -> tuple[int, int, int]:
    return found.st_ino, found.st_size, found.st_mtime_ns


def unfinished(path: Path) -> Path:
    """Return an unguessable name beside `path`, with its suffix, for an unfinished file."""
    return path.with_name(f".{path.stem[:40]}.{secrets.token_hex(8)}.partial{path.suffix}")


@contextmanager
def put_aside(path: Path, do: str = ROOM, also: tuple[type[Exception], ...] = ()) -> Iterator[Path]:
    """Yield the path of an empty file with the same suffix that replaces `path` at the end (`check_target`), or is
    deleted after an error. OutputError with the remedy `do` for OSError or an error of `also`; the old file is kept.
    """
    failures: tuple[type[Exception], ...] = (OSError, *also)
    check_target(path)
    aside = unfinished(path)
    make_folder(path.parent, str(path))
    try:
        aside.touch(exist_ok=False)  # exclusive, so that a link is not followed
        _made[aside.absolute()] = _state(aside.stat())
        yield aside
        if path.suffix.lower() == ".png":
            _add_mark(aside)
        check_target(path)  # again, as hours may have passed
        aside.replace(path)
        _made[path.absolute()] = _state(path.stat())
    except failures as error:
        expected = "a file that can be written"
        raise OutputError(refusal(str(path), expected=expected, got=error_words(error), do=do)) from error
    finally:
        if _made.pop(aside.absolute(), None) is not None:
            aside.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8 with `put_aside`; it is on the disk before it gets its name."""
    with put_aside(path) as aside, aside.open("w", encoding="utf-8", newline="\n") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def make_folder(path: Path, name: str) -> None:
    """Make a folder and its parents if missing; raise OutputError, with `name`, if that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        expected, do = "a folder that can be made", "choose another --out"
        raise OutputError(refusal(name, expected=expected, got=error_words(error), do=do)) from error


def relative_path(path: Path | str, folder: Path) -> str:
    """Return a path relative to `folder`, with / on every system."""
    return Path(os.path.relpath(path, folder)).as_posix()


def check_folder(path: Path, name: str) -> None:
    """Raise OutputError, with `name`, if the folder of a file to write cannot be made or is not writable."""
    folder = next((one for one in path.absolute().parents if one.exists()), Path("/"))
    if not (folder.is_dir() and os.access(folder, os.W_OK)):
        got = f"{folder}, which may not be written" if folder.is_dir() else f"{folder}, a file"
        raise OutputError(refusal(name, expected="a folder to write in", got=got, do="choose another --out"))


def check_ending(path: Path, option: str, endings: Collection[str]) -> None:
    """Raise OutputError if the name of a file to write, given with `option`, has none of the endings."""
    if path.suffix.lower() not in endings:
        do = f"end the name in {next(iter(endings))}"
        raise OutputError(refusal(f"{option} {path}", expected=" ".join(endings), got=f"'{path.suffix}'", do=do))
