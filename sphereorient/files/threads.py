"""Long computations: independent pieces on all cores (torch, numpy and compiled code release the GIL), and progress."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress = Callable[[str, int, int], None]  # (stage, steps done, all steps); the command line draws a bar
MOST = 8  # pieces in memory
_limit = [os.cpu_count() or 1]  # of this process; less in a worker on a shared machine


def silent(stage: str, done: int, total: int) -> None:
    """Report no progress."""


def counted(stage: str, items: Iterable[Item], total: int, progress: Progress) -> Iterator[Item]:
    """Yield items, and report the number done, before each and at the end."""
    for done, item in enumerate(items):
        progress(stage, done, total)
        yield item
    progress(stage, total, total)


def cores() -> int:
    """Return the number of computing threads: one per core, or as set by `limit_cores`."""
    return _limit[0]


def limit_cores(count: int) -> None:
    """Limit the threads of this process from now on."""
    _limit[:] = [count]


@contextmanager
def limited_cores(count: int) -> Iterator[None]:
    """Limit the threads of this process for a while."""
    before = cores()
    limit_cores(count)
    try:
        yield
    finally:
        limit_cores(before)


def side_by_side(task: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield the results of all items in their order, computed on as many threads as there are cores."""
    rest, threads = iter(items), min(cores(), MOST)
    with ThreadPoolExecutor(threads) as pool:
        waiting = deque(pool.submit(task, item) for item in islice(rest, threads))
        while waiting:
            found = waiting.popleft().result()
            waiting.extend(pool.submit(task, item) for item in islice(rest, 1))
            yield found
