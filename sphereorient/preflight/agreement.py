"""Do the cameras agree, and is there one ball? A short stretch is tracked, and judged as `track` judges a movie."""

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from dataclasses import replace

import torch

from sphereorient.calibration.consistency import FEWEST, compare_cameras
from sphereorient.errors import SphereOrientError
from sphereorient.experiment import Experiment
from sphereorient.methods.method import Learnt
from sphereorient.methods.results import TWO_BALLS, said_alone
from sphereorient.methods.settings import Settings
from sphereorient.preflight.cameras import outline_stretch
from sphereorient.preflight.finding import FAULT, Finding, judged, warning
from sphereorient.preflight.sample import MovieSample
from sphereorient.run import MemoryStore, Request, run
from sphereorient.run.stages import opened
from sphereorient.trajectory import one_track

TITLE, STOPS = "cameras agree", "a run stops"
ENOUGH = 60  # frames of a movie that gives its own background: a ghost of the ball in 50 turned poses by 0.3 degrees


def study(experiment: Experiment, settings: Settings) -> Learnt:
    """Learn light, blur and noise of the movies as `track` does; raise SphereOrientError where that refuses."""
    with opened(Request(experiment=experiment, settings=settings), MemoryStore()) as work:
        assert work.follower is not None  # the precise method follows frames
        return Learnt.of(work.follower.appearance)


def cameras_agree(
    experiment: Experiment, settings: Settings, learning: Future[Learnt], stretch: Sequence[MovieSample], first: int
) -> Iterator[Finding]:
    """Track a stretch of consecutive frames from the first one on with what was learnt; yield findings on cameras and
    balls. `stretch` holds the frames of each camera.
    """
    total = len(stretch[0].stream)
    try:
        learnt = learning.result()
        # Each camera alone: a pose of both lies between what they say.
        request = Request(
            experiment=replace(experiment, frames=(first, first + len(stretch[0].frame))),
            settings=settings,
            learnt=replace(learnt, together=False, majority=()),
        )
        track = one_track(run(request, MemoryStore()))
    except SphereOrientError as error:
        measured, _, do = str(error).rpartition("; ")
        finding = judged(TITLE, f"{STOPS}: {measured}", (True, FAULT, do.rstrip(".")))
        yield replace(unsure(finding, experiment, total), severity=FAULT)  # the run stops whatever the cause is
        return
    if learnt.second_ball:
        measured, _, do = TWO_BALLS.rpartition("; ")
        yield judged("one ball", measured, (True, FAULT, do))
    seen, limits = said_alone(track, experiment.cameras, 2 * experiment.radius_mm, consecutive=True)
    position = torch.from_numpy(track.position)
    wider = [outline_stretch(sample, position, experiment.radius_mm) for sample in stretch]
    seen = replace(seen, outline_stretch=torch.stack(wider, 1))
    found = compare_cameras(seen, limits)
    if found.frames < FEWEST or math.isnan(found.turn_deg):
        both = "both" if len(stretch) == 2 else "two"
        measured = f"cannot tell: {both} cameras show the ball and its paint in {found.frames} of {len(track)} frames"
        yield warning(TITLE, measured, "see the findings on the ball and on the map")
        return
    measured = f"{found} (median of {found.frames} frames)"
    finding = judged(TITLE, measured, (found.contradicts, FAULT, found.advice))
    yield unsure(finding, experiment, total)


def unsure(finding: Finding, experiment: Experiment, total: int) -> Finding:
    """Return a fault as one that cannot be told where fewer than `ENOUGH` frames (`total`) give their own background.
    They leave a trace of the ball in it, which moves outlines and poses.
    """
    if (
        finding.severity is not FAULT
        or total >= ENOUGH
        or experiment.movie_paths.keys() <= experiment.background_paths.keys()
    ):
        return finding
    measured = f"cannot tell: {finding.measured}, but the background is learnt from {total} frames"
    return warning(finding.title, measured, "give backgrounds:, or check more frames")
