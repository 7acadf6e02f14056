"""The stages of a run, for commands, Python API and workers: learn, follow, join."""

from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from sphereorient.errors import ExperimentError, SettingsError, error_words, refusal
from sphereorient.experiment import Experiment, input_files
from sphereorient.experiment.recording import open_recording
from sphereorient.files.hdf5 import UNNAMED
from sphereorient.files.provenance import provenance, sha256
from sphereorient.files.threads import Progress, silent
from sphereorient.files.whole_file import check_folder, check_target
from sphereorient.follow.follower import Batch, Follower
from sphereorient.methods import results
from sphereorient.methods.method import Job, Learnt, Method, load_learnt, one_thread, save_learnt
from sphereorient.methods.paper import PAPER
from sphereorient.methods.precise import PRECISE
from sphereorient.methods.proposers import checkpoint_path
from sphereorient.methods.settings import DEFAULT_METHOD, Settings, check_settings, settings_yaml
from sphereorient.run.store import MemoryStore, Request, Store, writing_of
from sphereorient.trajectory import Tracks, Trajectory

METHODS: dict[str, Method] = {"precise": PRECISE, "paper": PAPER}  # of `track`, by name
TASK_BATCHES = 16  # most batches in a task; a worker that dies loses less than one batch
TASKS_A_WORKER = 2  # of a short movie, so that workers end together


@dataclass(frozen=True)
class Task:
    """A part of a run for one worker."""

    stage: str  # learn, follow or join
    batches: tuple[Batch, ...] = ()  # to follow


def run(request: Request, store: Store, *, resume: bool = False, progress: Progress = silent) -> Trajectory | Tracks:
    """Track one experiment as `run_tracks`; return the track of an unnamed ball, or the tracks of all by name."""
    tracks = run_tracks(request, store, resume=resume, progress=progress)
    return tracks.get(UNNAMED, tracks)


def run_tracks(request: Request, store: Store, *, resume: bool = False, progress: Progress = silent) -> Tracks:
    """Track one experiment in this process; `progress` gets stage, frames done and all frames.
    `resume` continues an interrupted run from a folder store; the track is the same to the last bit.
    Raises SphereOrientError: unusable inputs, a store of another run, or a track that cannot be written.
    """
    check_out(request)
    with opened(request, store, progress) as work, store.held(request, resume=resume):
        todo = stages(store)
        tasks = next(todo)
        while True:
            try:
                tasks = todo.send([work.do(task) for task in tasks])
            except StopIteration as end:
                tracks: Tracks = end.value
                return tracks


def stages(store: Store, workers: int | None = None) -> Generator[list[Task], list[Any], Any]:
    """Yield the tasks of a run, stage by stage; send all results of a stage to get the next one.
    The tasks of one stage are independent. The `workers` share the frames; None: one task follows all.
    """
    (batches,) = yield [Task("learn")]
    left = store.missing(batches)
    size = max(1, len(left))
    if workers is not None:
        size = min(TASK_BATCHES, max(1, -(-len(left) // (TASKS_A_WORKER * workers))))
    yield [Task("follow", tuple(left[k : k + size])) for k in range(0, len(left), size)]
    (tracks,) = yield [Task("join")]
    return tracks


@dataclass(eq=False)
class Work:
    """A run whose inputs are open; made by `opened`."""

    request: Request
    method: Method
    job: Job
    store: Store
    progress: Progress = silent

    def do(self, task: Task) -> Any:
        """Do one task: learn returns the batches, follow the number of batches, join the tracks."""
        if task.stage == "learn":
            return self.batches
        return self.follow(task.batches) if task.stage == "follow" else self.join()

    @cached_property
    def follower(self) -> Follower | None:
        """The follower of frames: from kept results, or learnt and kept now; None: the method needs none."""
        known = self.job.given or self.store.known
        if known is not None and self.method.resume is not None:
            return self.method.resume(self.job, known)
        follower = self.method.learn(self.job, self.progress)
        if follower is not None:
            self.store.keep({name: Learnt.of(appearance) for name, appearance in follower.appearances.items()})
        return follower

    @property
    def batches(self) -> list[Batch]:
        """The batches to follow."""
        return [] if self.follower is None else self.follower.batches

    def follow(self, batches: Sequence[Batch]) -> int:
        """Measure some batches, keep their poses, and return how many batches were measured."""
        assert self.follower is not None  # only a follower has batches
        every = self.batches
        total = sum(map(len, every))
        done = total - sum(map(len, self.store.missing(every)))
        self.progress("track", done, total)
        for batch, poses in self.follower.follow(batches):
            self.store.write(batch, poses)
            done += len(batch)
            self.progress("track", done, total)
        return len(batches)

    def join(self) -> Tracks:
        """Join the measured batches to the track of each ball, write them, and empty the store."""
        measured = (self.store.read(batch) for batch in self.batches)
        self.progress("join", 0, 1)
        with ThreadPoolExecutor(1) as pool:  # digests of movies release the interpreter lock
            experiment, names = self.job.recording.experiment, list(self.job.recording.cameras)
            inputs = input_files(experiment, names)
            origin = pool.submit(provenance, inputs, experiment.folder, self.request.command)
            joined = self.method.join(self.job, self.follower, measured, self.progress)
        learnt = {name: known for name, (_, known) in joined.items() if known is not None}
        tracks = Tracks(
            {
                name: finished(track, self.job.of(name), self.request, known, origin.result())
                for name, (track, known) in joined.items()
            }
        )
        with writing_of(self.request):
            if learnt and self.request.save_learnt is not None:
                save_learnt(learnt, self.request.save_learnt)
            if self.request.out is not None:
                tracks.save(self.request.out)
        self.store.remove()
        self.progress("join", 1, 1)
        return tracks


@contextmanager
def opened(request: Request, store: Store, progress: Progress = silent) -> Iterator[Work]:
    """Open the inputs of a request; raise SphereOrientError if they are missing, unreadable or inconsistent."""
    method = check_method(request)
    given = load_learnt(request.learnt) if isinstance(request.learnt, Path) else request.learnt
    device = torch_device(request.device)
    with open_recording(request.experiment, request.cameras) as recording, one_thread():
        job = Job(recording=recording, settings=request.settings, device=device, given=given)
        yield Work(request=request, method=method, job=job, store=store, progress=progress)


def track_movies(
    experiment: Experiment | str | Path,
    *,
    method: str = DEFAULT_METHOD,
    settings: Settings | None = None,
    cameras: Sequence[str] | None = None,
    device: str = "cpu",
    progress: Progress = silent,
) -> Trajectory | Tracks:
    """Measure position (mm) and orientation of the sphere in every frame; see docs/data-format.md for the result.
    `run` with a `Request` can also use learnt results of another run, and writes files.
    `experiment`: as loaded, or the path of its experiment.yaml; `method`: "precise", fitted poses with covariances, or
    "paper", Zimmermann et al. 2011, corrected (docs/errata.md); `cameras`: their names, None: all; `device`: torch's
    name; `progress` gets stage, frames done and all frames.
    Raises SphereOrientError: missing, unreadable or inconsistent inputs.
    """
    try:
        source = experiment if isinstance(experiment, Experiment) else Path(experiment)
    except TypeError as error:
        got, do = type(experiment).__name__, "name the movies in it; `sphereorient init MOVIE...` writes one"
        expected = "the path of an experiment.yaml"
        raise ExperimentError(refusal("experiment", expected=expected, got=got, do=do)) from error
    request = Request(
        experiment=source,
        method=method,
        settings=settings or Settings(),
        cameras=None if cameras is None else tuple(cameras),
        device=device,
        command="sphereorient.track_movies",
    )
    return run(request, MemoryStore(), progress=progress)


def finished(
    track: Trajectory, job: Job, request: Request, known: Learnt | None, origin: Mapping[str, Any]
) -> Trajectory:
    """Add the errors that fits do not include, and the provenance; `origin`: that of the whole run."""
    recording, settings = job.recording, job.settings
    remarks = [*recording.remarks, *track.provenance.get("remarks", ()), *results.missed_text(track)]
    track, doubts = results.with_errors(track, recording, None if known is None else known.lasting, compared=True)
    origin = {**track.provenance, **origin, "remarks": remarks + doubts}
    if settings.propose.checkpoint is not None:
        origin["proposer_sha256"] = sha256(checkpoint_path(settings.propose.checkpoint))
    return replace(track, method=request.method, settings=settings_yaml(settings), provenance=origin)


def with_proposer(settings: Settings | None, proposer: str | Path | None) -> Settings:
    """Return settings (None: the defaults) with a checkpoint as proposer; unchanged for None."""
    settings = settings or Settings()
    if proposer is None:
        return settings
    return settings.model_copy(update={"propose": settings.propose.model_copy(update={"checkpoint": str(proposer)})})


def check_method(request: Request) -> Method:
    """Return the method of a request; raise SettingsError if it is unknown, or does not read the settings."""
    if request.method not in METHODS:
        got, do = repr(request.method), "choose one of these"
        raise SettingsError(refusal("method", expected=" or ".join(METHODS), got=got, do=do))
    if request.learnt is not None and METHODS[request.method].resume is None:
        do = "leave it out, or use method precise"
        raise SettingsError(refusal("learnt", expected="method precise", got=f"method {request.method}", do=do))
    check_settings(request.settings, request.method)
    return METHODS[request.method]


def check_out(request: Request) -> None:
    """Check before starting that outputs can be written and replace no file of the user; may raise OutputError."""
    if request.out is not None:
        check_folder(request.out, str(request.out))
    with writing_of(request):
        for path in filter(None, (request.out, request.save_learnt)):
            check_target(path)


def torch_device(name: str) -> torch.device:
    """Return a torch device; raise SettingsError if torch cannot use it."""
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        got, do = f"'{name}': {error_words(error)}", "choose cpu, or install torch for your GPU"
        raise SettingsError(refusal("device", expected="a device that torch can use", got=got, do=do)) from None
    return device
