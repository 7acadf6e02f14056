import json
import math
import multiprocessing
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import TypeAdapter

from sphereorient.bench.results import FIRST, SCHEMA, WRONG_DEG, Results, SceneResult, save_results
from sphereorient.bench.scenes import BenchmarkScene, BenchSettings, scenes_of, write_scene
from sphereorient.bench.score import (
    Floats,
    given_to_others,
    named_as_true,
    score_track,
    true_orientations,
    true_positions,
)
from sphereorient.errors import BenchError, OutputError, SphereOrientError, error_words, refusal
from sphereorient.experiment import load_experiment
from sphereorient.files.cache import FOLDER
from sphereorient.files.provenance import versions
from sphereorient.files.threads import limit_cores
from sphereorient.files.whole_file import make_folder, write_text
from sphereorient.run.stages import track_movies, with_proposer
from sphereorient.synth.scene import hidden_shares
from sphereorient.trajectory import CameraTrack, Tracks, Trajectory
from sphereorient.trajectory.rotations import distance_deg

_Tracker = Callable[[Path], Trajectory | Tracks]  # experiment.yaml to a track; can be pickled
Advance = Callable[[int, int], None]
PLAN, RESULTS, KEPT, CACHE = "plan.json", "results.json", "scenes", "cache"
DIGITS = 5
TRACKERS: dict[str, _Tracker] = {
    "precise": partial(track_movies, method="precise"),
    "paper": partial(track_movies, method="paper"),
    "precise_network": partial(track_movies, method="precise", settings=with_proposer(None, "default")),
}
DEFAULT = ("precise", "paper")


def trackers_of(names: Sequence[str]) -> dict[str, _Tracker]:
    """Return the trackers of some methods; raise BenchError for an unknown name."""
    for name in names:
        if name not in TRACKERS:
            do = "choose among these"
            raise BenchError(refusal("--methods", expected=", ".join(TRACKERS), got=repr(name)[:60], do=do))
    return {name: TRACKERS[name] for name in names}


def run_benchmark(
    folder: Path,
    settings: BenchSettings,
    trackers: Mapping[str, _Tracker] | None = None,
    *,
    jobs: int = 1,
    progress: Advance = lambda done, total: None,
) -> Results:
    """Render all scenes, track each with all methods (None: precise and paper), and measure; results.json holds all. An
    interrupted run of the same plan is continued. `jobs` processes do one scene each; `progress` gets finished and all
    scenes. Raise OutputError if the folder is unwritable, or holds another run.
    """
    chosen = trackers_of(DEFAULT) if trackers is None else trackers
    _prepare(folder, settings)
    scenes = scenes_of(settings)
    # The hardest first, as they take longest, so that processes end together.
    missing = sorted((scene for scene in scenes if _missing(folder, scene, chosen)), key=lambda scene: -scene.level)
    tasks = [partial(run_scene, folder, scene, _missing(folder, scene, chosen)) for scene in missing]
    run_all(tasks, folder / CACHE, jobs, lambda left: progress(len(scenes) - left, len(scenes)))
    outcomes = [one for scene in scenes for name in chosen for one in kept_results(_path(folder, scene, name))]
    results = Results(settings=settings, versions=versions(), outcomes=outcomes)
    save_results(results, folder / RESULTS)
    shutil.rmtree(folder / CACHE, ignore_errors=True)
    return results


def run_all(
    tasks: Sequence[Callable[[], None]], cache: Path, jobs: int, progress: Callable[[int], None] = lambda left: None
) -> None:
    """Run tasks in `jobs` processes of one thread each, see `limit_threads`; `progress` gets the number left."""
    progress(len(tasks))
    context = multiprocessing.get_context("spawn")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # inherited by workers, and read when torch is imported
    with ProcessPoolExecutor(jobs, context, limit_threads, (cache,)) as pool:
        running = [pool.submit(task) for task in tasks]
        try:
            for done, task in enumerate(as_completed(running), start=1):
                task.result()
                progress(len(tasks) - done)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def run_benchmarks(
    folder: Path,
    plans: Mapping[str, BenchSettings],
    trackers: Mapping[str, _Tracker],
    *,
    jobs: int = 1,
    progress: Advance = lambda done, total: None,
) -> list[Results]:
    """Run plans in turn, each in a folder of its name; `progress` counts the scenes of all."""
    counts = [len(scenes_of(plan)) for plan in plans.values()]
    found = []
    for before, (name, plan) in zip(accumulate(counts, initial=0), plans.items(), strict=False):

        def of_all(done: int, _: int, before: int = before) -> None:
            progress(before + done, sum(counts))

        found.append(run_benchmark(folder / name, plan, trackers, jobs=jobs, progress=of_all))
    return found


def limit_threads(cache: Path) -> None:
    """Limit a worker to one thread; tables of the maps, shared by scenes, are cached in a folder of the run."""
    os.environ[FOLDER] = str(cache)
    torch.set_num_threads(1)
    limit_cores(1)


def _prepare(folder: Path, settings: BenchSettings) -> None:
    plan: dict[str, Any] = {"schema": SCHEMA, "settings": settings.model_dump(mode="json")}
    path, name, do = folder / PLAN, f"--out {folder}", "choose a new --out, or the same settings to continue"
    make_folder(folder / KEPT, name)
    try:
        known = json.loads(path.read_text("utf-8")) if path.exists() else None
    except (OSError, ValueError) as error:
        raise OutputError(refusal(name, expected=f"a readable {PLAN}", got=error_words(error), do=do)) from None
    if known is None:
        write_text(path, json.dumps(plan, indent=1) + "\n")
    elif known != plan:
        raise OutputError(refusal(name, expected="a run of this plan", got="another run's", do=do))


def _path(folder: Path, scene: BenchmarkScene, method: str) -> Path:
    return folder / KEPT / f"{scene.name}.{method}.json"


def _missing(folder: Path, scene: BenchmarkScene, trackers: Mapping[str, _Tracker]) -> dict[str, _Tracker]:
    return {name: tracker for name, tracker in trackers.items() if not _path(folder, scene, name).exists()}


def kept_results(path: Path) -> list[SceneResult]:
    """Read the results of a scene; raise BenchError if the file is damaged."""
    try:
        return TypeAdapter(list[SceneResult]).validate_json(path.read_bytes())
    except (OSError, ValueError):
        do = "delete the file and run again"
        raise BenchError(refusal(str(path), expected="the result of a scene", got="something else", do=do)) from None


def run_scene(folder: Path, scene: BenchmarkScene, trackers: Mapping[str, _Tracker]) -> None:
    """Render a scene, track it, keep the results but not the movies."""
    with tempfile.TemporaryDirectory(prefix="scene") as rendered:
        experiment = write_scene(Path(rendered), scene)
        for name, tracker in trackers.items():
            found = [asdict(one) for one in track_scene(experiment, scene, name, tracker)]
            write_text(_path(folder, scene, name), json.dumps(found, separators=(",", ":")))


def track_scene(experiment: Path, scene: BenchmarkScene, method: str, tracker: _Tracker) -> list[SceneResult]:
    """Track a scene and measure the track of each ball; a refusal of the method is also a result."""
    begin = time.perf_counter()
    balls, truth_path = scene.base.worn, experiment.parent / "truth.h5"
    try:
        tracks = Tracks.of(tracker(experiment))
    except SphereOrientError as error:
        seconds = time.perf_counter() - begin
        measured = dict.fromkeys(balls, no_track(scene.plan.frames, " ".join(str(error).split())))
    else:
        seconds = time.perf_counter() - begin
        for paint in set(balls.values()):
            tracks = named_as_true(tracks, truth_path, [name for name in balls if balls[name] == paint])
        others = given_to_others(tracks, truth_path)
        measured = {
            name: measure(tracks[name], truth_path) | dict(zip(("given", "exchanges"), others[name], strict=True))
            for name in balls
        }
    radii_mm = dict.fromkeys(balls, scene.base.diameter_mm / 2)
    hidden = hidden_shares(true_positions(truth_path, balls), load_experiment(experiment).cameras, radii_mm)
    return [
        SceneResult(
            scene=scene.name,
            kind=scene.kind,
            level=scene.level,
            seed=scene.seed,
            degradations=dict(scene.degradations),
            method=method,
            seconds=round(seconds / len(balls), 2),
            ball=name,
            hidden=round(float((hidden[name] > 0.5).mean()), DIGITS),
            **measured[name],
        )
        for name in balls
    ]


def measure(track: Trajectory, truth_path: Path) -> dict[str, Any]:
    """Return the measured fields of `SceneResult`."""
    score = score_track(track, truth_path)
    R_true = true_orientations(truth_path, track.time, track.sphere)
    ranks = np.concatenate([_ranks(seen, R_true) for seen in track.cameras.values()] or [np.zeros(0)])
    inside, stated = score.inside()
    orientation, position, confidence = (
        tuple(round(x, DIGITS) if math.isfinite(x) else None for x in np.where(score.valid, values, np.nan).tolist())
        for values in (score.orientation_deg, score.position_mm, track.confidence)
    )
    return {
        "refused": "",
        "frames": len(track),
        "orientation_deg": orientation,
        "position_mm": position,
        "confidence": confidence,
        "looks": len(ranks),
        "looks_wrong": int((ranks >= 1).sum()),
        "recall": {str(first): float((ranks < first).mean()) if len(ranks) else 0.0 for first in FIRST},
        "stated": stated,
        "inside": inside,
        "over_stated": round(over, DIGITS) if math.isfinite(over := score.over_stated()[0]) else None,
    }


def no_track(frames: int, message: str) -> dict[str, Any]:
    """Return the measured fields of `SceneResult` for a scene that the method refused."""
    unknown = dict.fromkeys(("orientation_deg", "position_mm", "confidence"), (None,) * frames)
    counts = {"frames": frames, "looks": 2 * frames, "looks_wrong": 2 * frames, "stated": 0, "inside": 0}
    return {"refused": message, "recall": {str(first): 0.0 for first in FIRST}, **unknown, **counts}


def _ranks(seen: CameraTrack, R_true: Floats) -> Floats:
    """Return the rank (N,), 0 the best, of the right orientation among a camera's candidates; inf: missing."""
    counts = np.diff(seen.candidate_offset)
    frame = np.repeat(np.arange(len(counts)), counts)
    right = distance_deg(seen.candidate_orientation, R_true[frame]) <= WRONG_DEG
    order = np.lexsort((-np.nan_to_num(seen.candidate_score, nan=-np.inf), frame))
    rank = np.empty(len(frame))
    rank[order] = np.arange(len(frame)) - seen.candidate_offset[:-1][frame[order]]
    ranks = np.full(len(counts), np.inf)
    np.minimum.at(ranks, frame[right], rank[right])
    return ranks
