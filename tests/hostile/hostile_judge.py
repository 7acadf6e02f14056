"""Judgement of the answers to hostile inputs."""

from __future__ import annotations

import os
import signal
import socket
import time
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from sphereorient.errors import SphereOrientError

resource = pytest.importorskip("resource")  # limits of memory, which Windows lacks, as named pipes

PATIENCE_S = 8  # a load that takes longer hangs
LONGEST = 500  # characters of a message, without the folder of the test
MEMORY_MB = 300  # by which a load may raise the peak of the process
SPARSE_BYTES = 1_000_000_000
ROOM_MB = 2000  # of address space beyond that of the process: a larger allocation fails at once

Load = Callable[[Path], Any]


@dataclass(frozen=True)
class Case:
    """One hostile input: its name, the content of its file, and what replaces the file."""

    name: str
    content: bytes = b""
    place: str = "file"  # or one of PLACES

    def put(self, path: Path) -> Path:
        """Make the input at a path, and return the path to open."""
        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        path.unlink(missing_ok=True)
        if self.place in BEHIND:
            path.write_bytes(self.content)
            os.truncate(path, max(len(self.content), BEHIND[self.place](len(self.content))))
        elif self.place == "long name":
            return path.with_name("x" * 300 + path.suffix)
        elif self.place == "folder":
            path.mkdir()
        elif self.place == "fifo":
            os.mkfifo(path)
        elif self.place == "socket":
            with socket.socket(socket.AF_UNIX) as listener:
                listener.bind(str(path))
        elif self.place in LINKS:
            path.symlink_to(LINKS[self.place] or path.name)
        return path


LINKS = {"device": "/dev/zero", "loop": ""}
# Bytes of a file with zeros after its content, none of them on the disk. Padded: a recording whose file was
# made large beforehand, which video libraries search for a next frame.
BEHIND: dict[str, Callable[[int], int]] = {
    "file": lambda size: size,
    "sparse": lambda size: SPARSE_BYTES,
    "padded": lambda size: size + SPARSE_BYTES // 20,
}
PLACES = ("missing", "folder", "fifo", "device", "socket", "loop", "long name", "sparse", "padded")


@dataclass
class Tally:
    """Results of one family."""

    refused: int = 0
    accepted: int = 0
    faults: list[str] = field(default_factory=list)
    seen: set[tuple[str, bytes]] = field(default_factory=set)
    slowest_s: float = 0.0
    slowest: str = ""

    def judge(self, case: Case, load: Load, path: Path) -> None:
        """Load one input, unless the same was loaded before, and note the result."""
        if (case.place, case.content) in self.seen:
            return
        self.seen.add((case.place, case.content))
        opened = case.put(path)
        begun, peak = time.perf_counter(), _peak_mb()
        fault = self._answer(load, opened)
        grown, took = _peak_mb() - peak, time.perf_counter() - begun
        if took > self.slowest_s:
            self.slowest_s, self.slowest = took, case.name
        if took > PATIENCE_S and "Hang" not in fault:  # signals wait where a library does not return
            fault = f"{fault}; took {took:.0f} s"
        if grown > MEMORY_MB:
            fault = f"{fault}; took {grown:.0f} MB"
        if fault:
            self.faults.append(f"{case.name} ({case.place}): {fault.strip('; ')[:400]}; {case.content[:60]!r}")

    def _answer(self, load: Load, path: Path) -> str:
        """Return what is wrong with the answer; nothing where the input was refused in one line, or accepted."""
        try:
            with _alarm():
                load(path)
        except SphereOrientError as error:
            self.refused += 1
            return _wrong_with(str(error), path)
        except BaseException as error:  # any other error is a finding
            if isinstance(error, KeyboardInterrupt):
                raise
            return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        self.accepted += 1
        return ""


def _wrong_with(message: str, path: Path) -> str:
    if len(message.splitlines()) != 1 or any(unicodedata.category(letter) in ("Cc", "Cs") for letter in message):
        return f"not one line without controls: {message[:200]!r}"
    # Where the hostile file names another one by an absolute path, the fault may be there.
    if path.name not in message and str(path.parent) not in message and not message.startswith("/"):
        return f"does not name the file: {message[:200]}"
    if len(message.replace(str(path.parent), "")) > LONGEST + (len(path.name) if len(path.name) > 255 else 0):
        return f"{len(message)} characters: {message[:200]}"
    return ""


class Hang(Exception):
    """The load took too long."""


@contextmanager
def _alarm() -> Iterator[None]:
    def ring(*_: object) -> None:
        raise Hang(f"no answer in {PATIENCE_S} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@contextmanager
def little_memory() -> Iterator[None]:
    """Limit the process to ROOM_MB of address space beyond its present one."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + ROOM_MB * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
