"""What is known before the first frame: light and blur of the set-up, learnt from a movie of it."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch

from sphereorient.errors import ExperimentError, refusal
from sphereorient.experiment.recording import Recording, open_recording, silent
from sphereorient.follow import Appearance
from sphereorient.follow.tracker import ChunkTracker, OnlineTracker
from sphereorient.methods import precise
from sphereorient.methods.method import Job, Learnt, one_thread
from sphereorient.methods.settings import Settings


@contextmanager
def open_live(
    experiment: Path, settings: Settings, cameras: Sequence[str] | None, learnt: Path | None
) -> Iterator[tuple[Recording, OnlineTracker, Appearance]]:
    """Yield an experiment's recording, who follows its ball, and how it looks.

    Raises:
        ExperimentError: cameras that contradict each other.
        SphereOrientError: missing, unreadable or inconsistent inputs.
    """
    refine = settings.refine.model_copy(update={"chunks": 1})  # frames come one by one
    chosen = settings.model_copy(update={"refine": refine})
    with open_recording(experiment, cameras) as recording, one_thread():
        given = None if learnt is None else Learnt.load(learnt)
        job = Job(recording=recording, settings=chosen, device=torch.device("cpu"), given=given)
        follower = precise.learn(job, silent) if given is None else precise.resume(job, given)
        if not isinstance(follower.tracker, ChunkTracker):
            do = "look with `sphereorient check`, or name one camera with --cameras"
            raise ExperimentError(refusal("movies", expected="cameras that agree", got="others", do=do))
        yield recording, OnlineTracker(follower.tracker), follower.appearance
