"""Executors: workers that do one task at a time, processes of this machine or of a Dask cluster."""

import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing.connection import wait
from typing import Any, Protocol

from sphereorient.errors import SettingsError, refusal


class Executor(Protocol):
    """Workers that run side by side."""

    @property
    def size(self) -> int:
        """Number of workers."""

    def submit(self, worker: int, task: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Start a task on an idle worker."""

    def renew(self, worker: int) -> None:
        """Replace a worker that died."""

    def close(self) -> None:
        """Stop all workers."""


class ProcessExecutor:
    """`size` worker processes, each in a pool of its own: one that dies does not stop the others."""

    def __init__(self, size: int) -> None:
        self._workers = [_worker() for _ in range(size)]

    @property
    def size(self) -> int:
        """Number of workers."""
        return len(self._workers)

    def submit(self, worker: int, task: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Start a task on an idle worker."""
        return self._workers[worker].submit(task, *arguments)

    def renew(self, worker: int) -> None:
        """Replace a worker that died."""
        self._workers[worker].shutdown(wait=False, cancel_futures=True)
        self._workers[worker] = _worker()

    def close(self) -> None:
        """Terminate the workers; finished work is in the stores."""
        for worker in self._workers:
            processes = list((getattr(worker, "_processes", None) or {}).values())
            worker.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.terminate()


def _worker() -> ProcessPoolExecutor:
    # Spawn: forked children of a process that used torch's threads hang.
    start = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, mp_context=start, initializer=_prepare)


def _prepare() -> None:
    """Exit when the parent process dies; a killed parent cannot signal its workers."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class DaskExecutor:
    """The workers of a Dask cluster (`distributed.Client`); they must see the same files under the same names."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._executor = client.get_executor(pure=False, retries=0)

    @property
    def size(self) -> int:
        """Number of tasks that the cluster does in parallel, at least one."""
        threads: dict[str, int] = self._client.nthreads()
        return max(1, sum(threads.values()))

    def submit(self, worker: int, task: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Start a task; the scheduler chooses the worker."""
        future: Future[Any] = self._executor.submit(task, *arguments)
        return future

    def renew(self, worker: int) -> None:
        """Do nothing: a cluster replaces its workers itself."""

    def close(self) -> None:
        """Disconnect; the cluster continues for others."""
        self._executor.shutdown(wait=False)
        self._client.close()


def dask_executor(cluster: str, workers: int | None = None) -> DaskExecutor:
    """Connect to Dask: a scheduler (tcp://host:8786), its file (.json), or `local` (workers None: one per core).

    Raises:
        SettingsError: Dask is not installed, or the scheduler does not answer.
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
            return DaskExecutor(join(scheduler_file=cluster, timeout=20))
        return DaskExecutor(join(cluster, timeout=20))
    except (OSError, TimeoutError, ValueError) as error:
        do = "start one (docs/long-runs.md), and name its scheduler's address"
        got = f"'{str(error).splitlines()[0] if str(error) else type(error).__name__}'"
        raise SettingsError(refusal(f"--cluster {cluster}", expected="a Dask scheduler", got=got, do=do)) from error


class _Owning(DaskExecutor):
    def __init__(self, client: Any, cluster: Any) -> None:
        super().__init__(client)
        self._cluster = cluster

    def close(self) -> None:
        super().close()
        self._cluster.close()
