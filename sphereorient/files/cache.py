"""Arrays that depend only on their inputs and take long to compute, kept in the user's cache folder between runs."""

import hashlib
import os
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.errors import OutputError, error_words
from sphereorient.files.whole_file import put_aside, writing

# Environment variables: one that disables the cache; one that names another folder.
WITHOUT, FOLDER = "SPHEREORIENT_NO_CACHE", "SPHEREORIENT_CACHE"
LARGEST_BYTES = 500_000_000  # of all files; the least recently used are deleted first
PACKAGE = Path(__file__).parents[1]
MAKERS = ("so3.py", "sphere", "search", "pose")  # modules whose code determines the kept arrays
Arrays = Mapping[str, NDArray[Any]]


def cache_folder() -> Path | None:
    """Return the folder of kept arrays, existing or not; None if `WITHOUT` is set."""
    if os.environ.get(WITHOUT):
        return None
    given = os.environ.get(FOLDER)
    return Path(given) if given else platformdirs.user_cache_path("sphereorient", appauthor=False)


def cached(kind: str, inputs: Iterable[Tensor | str | float | None], make: Callable[[], Arrays]) -> Arrays:
    """Return the result of `make`, from an earlier run with the same inputs, code, versions and processor if there is
    one. A damaged file is made again, with a warning; a folder that cannot be written causes one warning.
    """
    folder = cache_folder()
    if folder is None:
        return make()
    path = folder / f"{kind}-{_key(inputs)}.npz"
    kept = _read(path)
    if kept is None:
        kept = make()
        _write(path, kept)
    return kept


def _key(inputs: Iterable[Tensor | str | float | None]) -> str:
    total = hashlib.sha256(_code())
    for one in inputs:
        if isinstance(one, Tensor):
            total.update(f"{tuple(one.shape)} {one.dtype}".encode() + one.contiguous().numpy().tobytes())
        else:
            total.update(repr(one).encode())
        total.update(b"|")
    return total.hexdigest()[:32]


@lru_cache(maxsize=1)
def _code() -> bytes:
    """Return bytes that identify all that determines the last bits beside the inputs."""
    total = hashlib.sha256(f"{torch.__version__} {np.__version__} {torch.backends.cpu.get_cpu_capability()}".encode())
    for name in MAKERS:
        files = sorted((PACKAGE / name).rglob("*.py")) if (PACKAGE / name).is_dir() else [PACKAGE / name]
        for file in files:
            total.update(file.read_bytes())
    return total.digest()


def _read(path: Path) -> Arrays | None:
    """Return kept arrays with verified check sums; None if there are none."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        with suppress(OSError):
            os.utime(path)  # mark as used
        return arrays
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        warnings.warn(f"{path} in the cache is damaged ({error_words(error)}) and is computed again", stacklevel=2)
        return None


def _write(path: Path, arrays: Arrays) -> None:
    """Keep arrays under their final name atomically, despite other writers; delete the oldest files over the limit."""
    save: Any = np.savez  # its types do not allow names
    try:
        with writing(force=True), put_aside(path) as aside, aside.open("wb") as file:
            save(file, **arrays)
        _trim(path.parent)
    except OutputError as error:
        warn_once(f"nothing is kept in {path.parent} ({error_words(error)}): each run computes it again (--no-cache)")


@lru_cache(maxsize=8)
def warn_once(words: str) -> None:
    """Warn of each thing once per process."""
    warnings.warn(words, stacklevel=3)


def _trim(folder: Path) -> None:
    """Delete the least recently used files until the rest is below the limit, perhaps while another run deletes too."""
    files = []
    for path in folder.glob("[!.]*.npz"):
        with suppress(OSError):
            files.append((path.stat().st_mtime_ns, path.stat().st_size, path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= LARGEST_BYTES:
            return
        with suppress(OSError):
            path.unlink()
        total -= size
