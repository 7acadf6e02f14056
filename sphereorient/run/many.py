"""Many experiments, or one long movie, on many workers that may die: local processes, or a Dask cluster."""

import multiprocessing
import os
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import lru_cache
from multiprocessing import connection
from pathlib import Path
from typing import Any

import numpy as np

from sphereorient.errors import SettingsError, SphereOrientError, error_words, refusal
from sphereorient.files.provenance import package
from sphereorient.files.threads import Progress, limit_cores, silent
from sphereorient.follow.follower import Batch
from sphereorient.methods.method import one_thread
from sphereorient.run.stages import Task, Work, check_method, check_out, opened, stages
from sphereorient.run.store import FolderStore, Request
from sphereorient.trajectory import Tracks

POLL_S = 0.5  # between checks of the workers' progress
DEATHS = 3  # of workers on one experiment without progress


class ProcessExecutor:
    """`size` worker processes in separate pools, so that the death of one does not stop the others."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.workers = [_worker() for _ in range(size)]

    def submit(self, worker: int, task: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Start a task on an idle worker."""
        return self.workers[worker].submit(task, *arguments)

    def renew(self, worker: int) -> None:
        """Replace a worker that died."""
        self.workers[worker].shutdown(wait=False, cancel_futures=True)
        self.workers[worker] = _worker()

    def close(self) -> None:
        """Terminate the workers; finished work is in the stores."""
        for worker in self.workers:
            processes = list((getattr(worker, "_processes", None) or {}).values())
            worker.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.terminate()


def _worker() -> ProcessPoolExecutor:
    # Spawn: forked children of a process that used torch's threads hang.
    start = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, mp_context=start, initializer=end_with_parent)


def end_with_parent() -> None:
    """Exit when the parent process dies; a killed parent cannot signal its workers."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class DaskExecutor:
    """The workers of a Dask cluster (`distributed.Client`) with the same files; `cluster`: also closed, unless None."""

    def __init__(self, client: Any, cluster: Any = None) -> None:
        self._client, self.cluster = client, cluster
        self._executor = client.get_executor(pure=False, retries=0)

    @property
    def size(self) -> int:
        """Number of parallel tasks, at least one."""
        threads: dict[str, int] = self._client.nthreads()
        return max(1, sum(threads.values()))

    def submit(self, worker: int, task: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Start a task; the scheduler chooses the worker."""
        future: Future[Any] = self._executor.submit(task, *arguments)
        return future

    def renew(self, worker: int) -> None:
        """Do nothing: a cluster replaces its workers."""

    def close(self) -> None:
        """Disconnect."""
        self._executor.shutdown(wait=False)
        self._client.close()
        if self.cluster is not None:
            self.cluster.close()


Executor = ProcessExecutor | DaskExecutor


def dask_executor(cluster: str, workers: int | None = None) -> DaskExecutor:
    """Connect to Dask: tcp://host:8786, a scheduler's .json, or `local`. SettingsError: not installed, no answer."""
    distributed = package("distributed", "cluster", SettingsError)
    local = {"threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": None}
    try:
        if cluster == "local":
            here = distributed.LocalCluster(n_workers=workers or os.cpu_count() or 1, **local)
            return DaskExecutor(distributed.Client(here), here)
        file = "scheduler_file" if cluster.endswith(".json") else "address"
        return DaskExecutor(distributed.Client(**{file: cluster}, timeout=20))
    except (OSError, TimeoutError, ValueError) as error:
        do = "start one (docs/long-runs.md), and give its scheduler's address"
        name, got = f"--cluster {cluster}", error_words(error)
        raise SettingsError(refusal(name, expected="a Dask scheduler", got=got, do=do)) from error


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The result of one experiment."""

    request: Request
    seconds: float
    frames: int = 0
    valid: int = 0
    error: str | None = None  # None: tracked

    @property
    def name(self) -> str:
        """Name of the track."""
        return self.request.track.stem


@dataclass(eq=False)
class _Job:
    request: Request
    run_id: str
    began: float
    held: ExitStack
    todo: Generator[list[Task], list[Any], Any] | None = None
    waiting: deque[Task] = field(default_factory=deque)
    results: list[Any] = field(default_factory=list)
    running: int = 0
    batches: list[Batch] | None = None
    deaths: int = 0
    done_at_death: int = -1
    counts: tuple[int, int] | None = None  # frames and valid frames of the finished track
    error: str | None = None

    @property
    def over(self) -> bool:
        return self.error is not None or self.counts is not None

    def done(self) -> tuple[int, int]:
        if self.batches is None:
            return 0, 1
        left = FolderStore(self.request.parts).missing(self.batches) if self.counts is None else []
        total = self.batches[-1].last if self.batches else 0
        return total - sum(map(len, left)), total

    def advance(self) -> None:
        """Go to the next stage when all tasks of this one are done."""
        while self.todo is not None and not (self.waiting or self.running or self.over):
            results, self.results = self.results, []
            try:
                self.waiting.extend(self.todo.send(results))
            except StopIteration as end:
                self.counts = end.value


# Opening a run costs as much as hundreds of frames; a new `run_id` per `run_many` prevents reuse by later runs.
@lru_cache(maxsize=1)
def _work(request: Request, run_id: str) -> tuple[Work, ExitStack]:
    stack = ExitStack()
    return stack.enter_context(opened(request, FolderStore(request.parts))), stack


def do_task(request: Request, run_id: str, task: Task) -> Any:
    """Do one task in a worker; a track is returned as its numbers of frames and of valid frames."""
    limit_cores(1)
    with one_thread():
        result = _work(request, run_id)[0].do(task)
    if not isinstance(result, Tracks):
        return result
    return sum(map(len, result.values())), sum(int(np.sum(track.valid)) for track in result.values())


def run_many(
    requests: Sequence[Request], executor: Executor, *, resume: bool = False, progress: Progress = silent
) -> list[Outcome]:
    """Track experiments on the workers of an executor, which is closed; return the outcomes in the order of the
    requests. Tracks equal those of a single process to the last bit; failures and dead workers do not stop the others.
    `resume` continues from stores; `progress` gets a track's name, frames done and all frames. Raises SettingsError:
    two requests have the same track.
    """
    outs = [request.track.resolve() for request in requests]
    if twice := [str(out) for k, out in enumerate(outs) if out in outs[:k]]:
        do = "give the experiments different names, or track them one by one"
        raise SettingsError(refusal("--out", expected="a track for each experiment", got=f"{twice[0]} twice", do=do))
    todo = deque(range(len(requests)))
    jobs: dict[int, _Job] = {}
    busy: dict[Future[Any], tuple[int, _Job, Task]] = {}  # worker, job, task
    outcomes: dict[int, Outcome] = {}
    try:
        while len(outcomes) < len(requests):
            free = [worker for worker in range(executor.size) if worker not in {one for one, _, _ in busy.values()}]
            for worker in free:
                picked = _next(todo, jobs, requests, resume, executor.size)
                if picked is None:
                    break
                job, task = picked
                job.running += 1
                busy[executor.submit(worker, do_task, job.request, job.run_id, task)] = worker, job, task
            for future in wait(list(busy), POLL_S, FIRST_COMPLETED).done:
                worker, job, task = busy.pop(future)
                job.running -= 1
                _take(future, job, task, executor, worker)
                job.advance()
            for number, job in list(jobs.items()):
                progress(job.request.track.stem, *job.done())
                if job.over and not job.running:
                    del jobs[number]
                    job.held.close()
                    took_s, (frames, valid) = time.monotonic() - job.began, job.counts or (0, 0)
                    outcomes[number] = Outcome(
                        request=job.request, seconds=took_s, frames=frames, valid=valid, error=job.error
                    )
    finally:
        executor.close()
        for job in jobs.values():
            job.held.close()
    return [outcomes[number] for number in range(len(requests))]


def _next(
    todo: deque[int], jobs: dict[int, _Job], requests: Sequence[Request], resume: bool, workers: int
) -> tuple[_Job, Task] | None:
    for job in jobs.values():
        if job.waiting and not job.over:
            return job, job.waiting.popleft()
    while todo and sum(not job.over for job in jobs.values()) < workers:
        number = todo.popleft()
        job = jobs[number] = _begun(requests[number], resume, workers)
        if job.waiting:
            return job, job.waiting.popleft()
    return None


def _begun(request: Request, resume: bool, workers: int) -> _Job:
    job = _Job(request=request, run_id=uuid.uuid4().hex, began=time.monotonic(), held=ExitStack())
    store = FolderStore(request.parts)
    try:
        check_out(request)
        check_method(request)
        job.held.enter_context(store.held(request, resume=resume))
        job.todo = stages(store, workers)
        job.waiting.extend(next(job.todo))
    except SphereOrientError as error:
        job.error = str(error)
    return job


def _take(future: Future[Any], job: _Job, task: Task, executor: Executor, worker: int) -> None:
    """Handle the outcome of a task: a value, a refusal, or the death of its worker."""
    try:
        result = future.result()
    except SphereOrientError as error:
        job.error = job.error or str(error)
        return
    except Exception as error:  # a fault of a worker must not stop other experiments
        executor.renew(worker)
        done = job.done()[0]
        job.deaths = 1 if done > job.done_at_death else job.deaths + 1
        job.done_at_death = done
        if job.deaths >= DEATHS:
            job.error = f"{job.request.experiment}: worker {worker} died {DEATHS} times ({error_words(error)}); "
            job.error += "check its memory, then run again with --resume."
        else:
            job.waiting.appendleft(task)
        return
    if task.stage == "learn":
        job.batches = result
    job.results.append(result)


def tracks_of(experiments: Sequence[Path], out: Path) -> list[Path]:
    """Return the tracks' paths: `out` for one experiment, else files in folder `out`, named by experiment folder."""
    if len(experiments) == 1 and not out.is_dir():
        return [out]
    names = [path.resolve().parent.name for path in experiments]
    if len(set(names)) < len(names):
        names = [f"{path.resolve().parent.name}-{path.stem}" for path in experiments]
    return [out / f"{name}.h5" for name in names]
