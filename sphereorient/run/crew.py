"""Those who do the work, one task at a time at each place: processes of this machine, or a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing.connection import wait
from typing import Any, Protocol

from sphereorient.errors import SettingsError, refusal


class Crew(Protocol):
    """Places that work side by side."""

    @property
    def size(self) -> int:
        """How many places there are."""

    def submit(self, place: int, task: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Begin a task at a place that has none."""

    def renew(self, place: int) -> None:
        """Put a new worker where one died."""

    def close(self) -> None:
        """Stop all work."""


class ProcessCrew:
    """Worker processes, each by itself: one that dies takes nobody along.

    Args:
        size: how many.
    """

    def __init__(self, size: int) -> None:
        self._workers = [_worker() for _ in range(size)]

    @property
    def size(self) -> int:
        """How many workers there are."""
        return len(self._workers)

    def submit(self, place: int, task: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Begin a task at a place that has none."""
        return self._workers[place].submit(task, *arguments)

    def renew(self, place: int) -> None:
        """Put a new worker where one died."""
        self._workers[place].shutdown(wait=False, cancel_futures=True)
        self._workers[place] = _worker()

    def close(self) -> None:
        """Stop the workers, whatever they do: what is done is in the parts."""
        for worker in self._workers:
            processes = list((getattr(worker, "_processes", None) or {}).values())
            worker.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.terminate()


def _worker() -> ProcessPoolExecutor:
    # Not forked: a process that has used torch's threads hangs in its children.
    start = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, mp_context=start, initializer=_prepare)


def _prepare() -> None:
    """Let a worker not outlive its master: killed, that one can tell nobody."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    master = multiprocessing.parent_process()
    if master is None:
        return

    def watch() -> None:
        wait([master.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class DaskCrew:
    """The workers of a Dask cluster; a place is a task at a time that the scheduler sends where it likes.

    Args:
        client: `distributed.Client` of a running cluster; its workers see the same files under the same names.
    """

    def __init__(self, client: Any) -> None:
        self._client = client
        self._executor = client.get_executor(pure=False, retries=0)

    @property
    def size(self) -> int:
        """How many tasks the cluster's workers do side by side, at least one."""
        threads: dict[str, int] = self._client.nthreads()
        return max(1, sum(threads.values()))

    def submit(self, place: int, task: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Begin a task."""
        future: Future[Any] = self._executor.submit(task, *arguments)
        return future

    def renew(self, place: int) -> None:
        """Do nothing: a cluster renews its workers itself."""

    def close(self) -> None:
        """Let go of the cluster; it goes on for others."""
        self._executor.shutdown(wait=False)
        self._client.close()


def dask_crew(cluster: str, workers: int | None = None) -> DaskCrew:
    """Join a Dask cluster.

    Args:
        cluster: address of a scheduler (tcp://host:8786), path of a scheduler file (.json), or `local`: workers of this
            machine, as many as `workers` says.
        workers: of a local cluster; None: one a core.

    Raises:
        SettingsError: Dask is not installed, or nobody answers.
    """
    try:
        import distributed
    except ImportError as error:
        do = "install it with `pip install sphereorient[cluster]`"
        raise SettingsError(refusal("--cluster", expected="the package distributed", got="none", do=do)) from error
    join: Any = distributed.Client  # without types of its own
    try:
        if cluster == "local":
            count = workers or os.cpu_count() or 1
            local: Any = distributed.LocalCluster
            here: Any = local(n_workers=count, threads_per_worker=1, host="127.0.0.1", dashboard_address=None)
            return _Owning(join(here), here)
        if cluster.endswith(".json"):
            return DaskCrew(join(scheduler_file=cluster, timeout=20))
        return DaskCrew(join(cluster, timeout=20))
    except (OSError, TimeoutError, ValueError) as error:
        do = "start one (docs/long-runs.md), and name its scheduler's address"
        got = f"'{str(error).splitlines()[0] if str(error) else type(error).__name__}'"
        raise SettingsError(refusal(f"--cluster {cluster}", expected="a Dask scheduler", got=got, do=do)) from error


class _Owning(DaskCrew):
    """A cluster of our own, stopped at the end."""

    def __init__(self, client: Any, cluster: Any) -> None:
        super().__init__(client)
        self._cluster = cluster

    def close(self) -> None:
        """Stop the cluster."""
        super().close()
        self._cluster.close()
