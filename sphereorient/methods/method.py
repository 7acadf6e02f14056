"""The interface between `run` and a method."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from sphereorient.experiment.recording import Progress, Recording
from sphereorient.follow.follower import Follower
from sphereorient.follow.poses import Poses
from sphereorient.methods.learnt import Learnt
from sphereorient.methods.settings import Settings
from sphereorient.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True, eq=False)
class Job:
    """An experiment opened for a method; made by `run.opened`, read by the methods."""

    recording: Recording
    settings: Settings
    device: torch.device
    given: Learnt | None = None  # what another run learnt


@dataclass(frozen=True, kw_only=True, eq=False)
class Method:
    """The stages of a method, in the order of `run`; without a follower, `join` does all (paper)."""

    learn: Callable[[Job, Progress], Follower | None]
    resume: Callable[[Job, Learnt], Follower] | None  # instead of learn, with what is known; None: it learns nothing
    join: Callable[[Job, Follower | None, Iterable[list[Poses]], Progress], tuple[Trajectory, Learnt | None]]


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch to one thread: its tensors here are small, and idle threads that spin slow down decoding."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
