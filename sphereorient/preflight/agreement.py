"""Do the cameras agree, and is there one ball? A short stretch is tracked, and judged as `track` judges a movie."""

import math
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import replace

from sphereorient.calibration.consistency import FEWEST, compare_cameras
from sphereorient.errors import SphereOrientError
from sphereorient.experiment import Experiment
from sphereorient.methods.method import Learnt
from sphereorient.methods.results import TWO_BALLS, said_alone
from sphereorient.methods.settings import Settings
from sphereorient.preflight.finding import FAULT, Finding, judged, warning
from sphereorient.run import MemoryStore, Request, run
from sphereorient.run.stages import opened

TITLE = "cameras agree"


def study(experiment: Experiment, settings: Settings) -> Learnt:
    """Learn light, blur and noise of the movies as `track` does; raise SphereOrientError where that refuses."""
    with opened(Request(experiment=experiment, settings=settings), MemoryStore()) as work:
        assert work.follower is not None  # the precise method follows frames
        return Learnt.of(work.follower.appearance)


def cameras_agree(
    experiment: Experiment, settings: Settings, learning: Future[Learnt], frames: tuple[int, int]
) -> Iterator[Finding]:
    """Track the frames first .. last - 1 with what was learnt; yield the findings on cameras and balls."""
    try:
        learnt = learning.result()
        some = replace(experiment, frames=frames)
        track = run(Request(experiment=some, settings=settings, learnt=learnt), MemoryStore())
    except SphereOrientError as error:
        measured, _, do = str(error).rpartition("; ")
        yield judged(TITLE, f"a run stops: {measured}", (True, FAULT, do.rstrip(".")))
        return
    if learnt.second_ball:
        measured, _, do = TWO_BALLS.rpartition("; ")
        yield judged("one ball", measured, (True, FAULT, do))
    found = compare_cameras(*said_alone(track, experiment.cameras, 2 * experiment.radius_mm, consecutive=True))
    if found.frames < FEWEST or math.isnan(found.turn_deg):
        measured = f"cannot tell: both cameras show the ball and its paint in {found.frames} of {len(track)} frames"
        yield warning(TITLE, measured, "see the findings on the ball and on the map")
        return
    measured = f"{found} (median of {found.frames} frames)"
    yield judged(TITLE, measured, (found.contradicts, FAULT, found.advice))
