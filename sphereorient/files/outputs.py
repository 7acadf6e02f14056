from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sphereorient.errors import OutputError, refusal

ROOM = "choose a folder that exists, may be written and has room"


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
        got = f"'{(getattr(error, 'strerror', None) or str(error)).splitlines()[0]}'"
        raise OutputError(refusal(str(path), expected="a file that can be written", got=got, do=do)) from error
    finally:
        aside.unlink(missing_ok=True)
