"""Batches on all cores: torch computes without Python's lock."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
MOST = 8  # batches in memory


def side_by_side(task: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield the results of all items in their order, computed on as many threads as there are cores."""
    rest, threads = iter(items), min(os.cpu_count() or 1, MOST)
    with ThreadPoolExecutor(threads) as pool:
        waiting = deque(pool.submit(task, item) for item in islice(rest, threads))
        while waiting:
            found = waiting.popleft().result()
            waiting.extend(pool.submit(task, item) for item in islice(rest, 1))
            yield found
