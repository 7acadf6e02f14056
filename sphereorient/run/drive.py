"""Many experiments, or one long movie, on many workers: who does what next, and what to do when one dies."""

from __future__ import annotations

import time
import uuid
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sphereorient.errors import SettingsError, SphereOrientError, refusal
from sphereorient.experiment.recording import Progress, silent
from sphereorient.methods.precise import Window
from sphereorient.run.crew import Crew
from sphereorient.run.parts import Parts
from sphereorient.run.request import Request
from sphereorient.run.run import check_out
from sphereorient.run.work import Tracked, join_work, learn_work, measure_work, whole_work

POLL_S = 0.5  # between looks at what the workers have written
TASK_WINDOWS = 16  # at most in one task; a worker that dies loses less than one window
TASKS_A_PLACE = 2  # of a short movie: so that nobody waits long for the last one
DEATHS = 3  # of workers on one experiment without anything new being done


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one experiment."""

    request: Request
    seconds: float
    frames: int = 0
    valid: int = 0
    error: str | None = None  # None: tracked

    @property
    def name(self) -> str:
        """Of the track."""
        return self.request.out.stem


Task = tuple[Callable[..., Any], tuple[Any, ...]]


@dataclass(eq=False)
class _Case:
    """One experiment on its way."""

    request: Request
    run_id: str
    began: float
    held: ExitStack
    waiting: deque[Task] = field(default_factory=deque)
    running: int = 0
    windows: list[Window] | None = None
    deaths: int = 0
    done_at_death: int = -1
    tracked: Tracked | None = None
    error: str | None = None

    @property
    def over(self) -> bool:
        return self.error is not None or self.tracked is not None

    def done(self) -> tuple[int, int]:
        """Frames measured and frames in all."""
        if self.windows is None:
            return 0, 1
        left = Parts(self.request.parts).missing(self.windows) if self.tracked is None else []
        total = self.windows[-1].last if self.windows else 0
        return total - sum(window.last - window.first for window in left), total


def track_experiments(
    requests: Sequence[Request], crew: Crew, *, resume: bool = False, progress: Progress = silent
) -> list[Outcome]:
    """Track experiments on the places of a crew: stages of several of them, windows of one movie, side by side.

    Every track is the same as that of a single process, to the last bit. An experiment that fails does not stop the
    others. A worker that dies is replaced, and its experiment goes on from what it had done.

    Args:
        requests: with different tracks.
        crew: closed at the end.
        resume: go on with the parts of runs that were cut off.
        progress: told how far each experiment is, by the name of its track.

    Returns:
        What became of each, in the order of the requests.
    """
    _refuse_same(requests)
    todo = deque(range(len(requests)))
    cases: dict[int, _Case] = {}
    busy: dict[Future[Any], tuple[int, _Case, Task]] = {}  # place, case, task
    outcomes: dict[int, Outcome] = {}
    try:
        while len(outcomes) < len(requests):
            free = [place for place in range(crew.size) if place not in {place for place, _, _ in busy.values()}]
            for place in free:
                picked = _next(todo, cases, requests, resume, crew.size)
                if picked is None:
                    break
                case, task = picked
                case.running += 1
                busy[crew.submit(place, task[0], *task[1])] = place, case, task
            for future in wait(list(busy), POLL_S, FIRST_COMPLETED).done:
                place, case, task = busy.pop(future)
                case.running -= 1
                _take(future, case, task, crew, place)
            for number, case in list(cases.items()):
                progress(case.request.out.stem, *case.done())
                if case.over and not case.running:
                    outcomes[number] = _outcome(cases.pop(number))
    finally:
        crew.close()
        for case in cases.values():
            case.held.close()
    return [outcomes[number] for number in range(len(requests))]


def _refuse_same(requests: Sequence[Request]) -> None:
    outs = [request.out.resolve() for request in requests]
    twice = next((out for k, out in enumerate(outs) if out in outs[:k]), None)
    if twice is not None:
        do = "give the experiments different names, or track them apart"
        raise SettingsError(refusal("--out", expected="a track for each experiment", got=f"{twice} twice", do=do))


def _next(
    todo: deque[int], cases: dict[int, _Case], requests: Sequence[Request], resume: bool, places: int
) -> tuple[_Case, Task] | None:
    """Return the next task: of an experiment that was begun first, else of a new one."""
    for case in cases.values():
        if case.waiting and not case.over:
            return case, case.waiting.popleft()
    while todo and sum(not case.over for case in cases.values()) < places:
        number = todo.popleft()
        case = cases[number] = _begun(requests[number], resume)
        if case.waiting:
            return case, case.waiting.popleft()
    return None


def _begun(request: Request, resume: bool) -> _Case:
    """Make ready what keeps an experiment's parts, or say why that cannot be."""
    case = _Case(request=request, run_id=uuid.uuid4().hex, began=time.monotonic(), held=ExitStack())
    try:
        check_out(request)
        if request.method == "paper":
            case.waiting.append((whole_work, (request,)))
        else:
            case.held.enter_context(Parts(request.parts).held(request, resume=resume))
            case.waiting.append((learn_work, (request, case.run_id)))
    except SphereOrientError as error:
        case.error = str(error)
    return case


def _take(future: Future[Any], case: _Case, task: Task, crew: Crew, place: int) -> None:
    """Take what a task gave: a result, a refusal, or the death of its worker."""
    try:
        result = future.result()
    except SphereOrientError as error:
        case.error = case.error or str(error)
        return
    except Exception as error:  # whatever befell a worker must not stop the other experiments
        crew.renew(place)
        done = case.done()[0]
        case.deaths = 1 if done > case.done_at_death else case.deaths + 1
        case.done_at_death = done
        if case.deaths >= DEATHS:
            got = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'no word'}"
            do = "check its memory, then run again with --resume"
            case.error = refusal(str(case.request.experiment), expected="a worker that lives", got=got, do=do)
        else:
            case.waiting.appendleft(task)
        return
    if isinstance(result, Tracked):
        case.tracked = result
    elif task[0] is learn_work:
        case.windows = result
        _share_out(case, crew.size)
    if case.windows is not None and not case.waiting and not case.running and task[0] is not join_work:
        case.waiting.append((join_work, (case.request, case.run_id)))


def _share_out(case: _Case, places: int) -> None:
    """Cut what is still to be measured into tasks of neighbouring windows."""
    left = Parts(case.request.parts).missing(case.windows or [])
    size = min(TASK_WINDOWS, max(1, -(-len(left) // (TASKS_A_PLACE * places))))
    for k in range(0, len(left), size):
        case.waiting.append((measure_work, (case.request, case.run_id, left[k : k + size])))


def _outcome(case: _Case) -> Outcome:
    case.held.close()
    seconds = time.monotonic() - case.began
    if case.tracked is None:
        return Outcome(request=case.request, seconds=seconds, error=case.error)
    tracked = case.tracked
    return Outcome(request=case.request, seconds=seconds, frames=tracked.frames, valid=tracked.valid)


def tracks_of(experiments: Sequence[Path], out: Path) -> list[Path]:
    """Return where the tracks of experiments go: the file itself for one, a folder for several.

    In a folder each track has the name of its experiment's folder; of its file, where two share that.
    """
    if len(experiments) == 1 and not out.is_dir():
        return [out]
    names = [path.resolve().parent.name for path in experiments]
    if len(set(names)) < len(names):
        names = [f"{path.resolve().parent.name}-{path.stem}" for path in experiments]
    return [out / f"{name}.h5" for name in names]
