"""`live`: the set-up learnt from its movie (without a map its position only), and the loop over frames of a source."""

import gc
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import torch

from sphereorient.errors import ExperimentError, SettingsError, refusal
from sphereorient.experiment import Experiment, load_experiment
from sphereorient.experiment.recording import Recording, open_recording
from sphereorient.files.threads import limited_cores, silent
from sphereorient.files.whole_file import writing
from sphereorient.live.feed import Feed, FrameBytes, Log
from sphereorient.live.lines import FicTracLines, Forms, Quantities
from sphereorient.live.live import LiveTracker, OnlineTracker, measured
from sphereorient.live.outputs import Output
from sphereorient.live.page import Monitor, PageProcess
from sphereorient.live.sources import Source
from sphereorient.methods import precise
from sphereorient.methods.method import Job, load_learnt, one_thread
from sphereorient.methods.settings import Settings
from sphereorient.preflight.fictrac import fictrac_axes

MOST_WAITING, MOST_BYTES = 512, 64 << 20  # frames that wait


@dataclass(frozen=True, kw_only=True, eq=False)
class LiveSetup:
    """An opened experiment and the tracker of its balls."""

    recording: Recording
    tracker: LiveTracker
    save_map: Callable[[], str] | None = None  # writes the map learnt live, and returns a message


@contextmanager
def open_live(
    source: Experiment | Path, settings: Settings, cameras: Sequence[str] | None, learnt: Path | None
) -> Iterator[LiveSetup]:
    """Open an experiment. Without a texture map, the map of a fixed ball is learnt live. Raises SphereOrientError:
    unusable inputs; ExperimentError: cameras contradict each other, or no map of a moving ball; SettingsError: cameras
    in another order than the experiment's.
    """
    experiment = load_experiment(source)
    _check_order(experiment, cameras)
    if experiment.mapless and learnt is None:
        with _learning(experiment, settings, cameras, experiment.new_map_path()) as opened:
            yield opened
        return
    refine = settings.refine.model_copy(update={"chunks": 1})  # frames come one by one
    chosen = settings.model_copy(update={"refine": refine})
    with open_recording(experiment, cameras) as recording, one_thread():
        given = None if learnt is None else load_learnt(learnt)
        job = Job(recording=recording, settings=chosen, device=torch.device("cpu"), given=given)
        follower = precise.learn(job, silent) if given is None else precise.resume(job, given)
        if not follower.tracker.balls:
            do = "run `sphereorient check`, or name one camera with --cameras"
            raise ExperimentError(refusal("movies", expected="cameras that agree", got="others", do=do))
        yield LiveSetup(recording=recording, tracker=OnlineTracker(follower.tracker.balls, follower.appearances))


def _check_order(experiment: Experiment, cameras: Sequence[str] | None) -> None:
    """Refuse cameras in another order than the movies, or named twice: devices are paired with them in that order."""
    order = [name for name in experiment.movie_paths if name in (cameras or ())]
    if cameras is not None and {*cameras} == {*order} and [*cameras] != order:
        expected, do = f"the order of movies: {', '.join(order)}", "write them in this order, and devices too"
        raise SettingsError(refusal("--cameras", expected=expected, got=", ".join(cameras), do=do))


@contextmanager
def _learning(
    experiment: Experiment, settings: Settings, cameras: Sequence[str] | None, path: Path
) -> Iterator[LiveSetup]:
    # Imported only if a map is learnt.
    from sphereorient.live.learning import LearningTracker
    from sphereorient.mapping.disks import held_place
    from sphereorient.report.texture_map import write_map

    if not experiment.fixed:
        got, do = "one that moves, and no map", "learn the map from a movie with `sphereorient track`"
        raise ExperimentError(refusal("sphere.fixed", expected="a fixed ball", got=got, do=do))
    with open_recording(experiment, cameras, textured=False) as recording, one_thread():
        tracker = LearningTracker(held_place(recording, settings.paint, settings.locate))

        def save() -> str:
            with writing(force=True):  # the earlier map of this run
                write_map(tracker.texture(), path)
            named = "" if experiment.texture_path is not None else f"; next: add texture: {path.name} under sphere:"
            return f"Wrote {path}{named}"

        try:
            yield LiveSetup(recording=recording, tracker=tracker, save_map=save)
        finally:
            tracker.close()


def run_live(
    opened: LiveSetup,
    source: Source,
    outputs: Sequence[tuple[Output, str]],
    page: PageProcess | None,
    log: Log,
    fictrac: Path | None = None,
) -> Monitor:
    """Track the frames of a source until its end or Ctrl-C. `outputs`: each with its attribute of `Forms`;
    `log` gets messages for the user; `fictrac`: see `fictrac_axes`.
    """
    recording, tracker = opened.recording, opened.tracker
    first = next(iter(tracker.appearances))  # the page shows the first ball
    experiment, views = recording.experiment, tracker.appearances[first].fitter.views
    table = FicTracLines(fictrac_axes(views[0].camera, fictrac))
    known = {ball: Quantities(experiment.of(ball).fixed, experiment.length_unit, ball) for ball in tracker.appearances}
    gc.collect()
    gc.freeze()  # permanent objects: garbage collection skips them
    size = FrameBytes(recording.streams).size
    feed = Feed(source.frames(recording), min(MOST_WAITING, max(MOST_BYTES // size, 16)), wait=source.waits, log=log)
    monitor = Monitor(feed, log)
    try:
        if page is not None:
            page.begin(recording, monitor.running, opened.save_map)
        # In one thread: a second one may wait for a core that another program uses.
        with suppress(KeyboardInterrupt), limited_cores(1):
            for now in measured(tracker, views, monitor):
                forms = Forms(now, table, known[now.ball])
                for output, form in outputs:
                    output.send(getattr(forms, form))
                if now.found:
                    feed.restart()
                monitor.saw(now)
                if page is not None and now.ball == first:
                    page.saw(monitor.arrival, now)
    finally:
        feed.close()
    return monitor
