"""What a worker is sent: stages of one run, each leaving its result in the run's parts."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sphereorient.experiment.recording import silent
from sphereorient.methods.paper import track_paper
from sphereorient.methods.precise import Follower, Window
from sphereorient.run.request import Request
from sphereorient.run.run import Run, opened
from sphereorient.run.track import one_thread
from sphereorient.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class Tracked:
    """What a finished run tells of its track."""

    frames: int
    valid: int


@dataclass(frozen=True, eq=False)
class _Ready:
    """A run that a worker has open, to measure more of its frames."""

    run: Run
    seeing: Follower
    open_until: ExitStack


# A worker gets many tasks of one run: opening it costs as much as hundreds of frames. `run_id` is new for each call of
# the driver, so that no later run is measured with what an earlier one had learnt.
@lru_cache(maxsize=1)
def _ready(request: Request, run_id: str) -> _Ready:
    stack = ExitStack()
    run = stack.enter_context(opened(request))
    return _Ready(run=run, seeing=run.follower(), open_until=stack)


def learn_work(request: Request, run_id: str) -> list[Window]:
    """Learn what measuring takes, and return the windows there are to measure."""
    return _ready(request, run_id).seeing.windows


def measure_work(request: Request, run_id: str, windows: Sequence[Window]) -> int:
    """Measure some windows, and return how many were still missing."""
    ready = _ready(request, run_id)
    with one_thread():
        return sum(1 for _ in ready.run.measure(ready.seeing, windows))


def join_work(request: Request, run_id: str) -> Tracked:
    """Put the measured windows together, and write the track."""
    ready = _ready(request, run_id)
    with one_thread():
        return _told(ready.run.join(ready.seeing))


def whole_work(request: Request) -> Tracked:
    """Track with a method whose stages look at the whole movie."""
    with opened(request) as run:
        return _told(run.written(track_paper(run.recording, request.settings, silent)))


def _told(track: Trajectory) -> Tracked:
    return Tracked(frames=len(track), valid=int(np.sum(track.valid)))
