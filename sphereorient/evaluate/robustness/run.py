"""Runs the benchmark: scene by scene, each kept, so that a run that was cut off goes on."""

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from sphereorient.errors import BenchError, OutputError, SphereOrientError, refusal
from sphereorient.evaluate.robustness.measure import Outcome, measure, no_track
from sphereorient.evaluate.robustness.results import SCHEMA, Results, as_tree, from_tree, save_results
from sphereorient.evaluate.robustness.scenes import Scene, scenes_of, write_scene
from sphereorient.evaluate.robustness.settings import BenchSettings
from sphereorient.files.outputs import put_aside
from sphereorient.files.provenance import versions
from sphereorient.methods.settings import Settings
from sphereorient.trajectory import Trajectory

Tracker = Callable[[Path], Trajectory]  # experiment.yaml to a track; must go through pickle
Progress = Callable[[int, int], None]
PLAN, RESULTS, KEPT = "plan.json", "results.json", "scenes"


def precise(experiment: Path) -> Trajectory:
    """Track with `--method precise`."""
    from sphereorient.run.stages import track_movies

    return track_movies(experiment, method="precise", settings=Settings())


def paper(experiment: Path) -> Trajectory:
    """Track with `--method paper`."""
    from sphereorient.run.stages import track_movies

    return track_movies(experiment, method="paper", settings=Settings())


def precise_network(experiment: Path) -> Trajectory:
    """Track with `--method precise --proposer default`."""
    from sphereorient.run.stages import track_movies

    return track_movies(experiment, method="precise", settings=Settings(), proposer="default")


TRACKERS: dict[str, Tracker] = {"precise": precise, "paper": paper, "precise_network": precise_network}
USUAL = ("precise", "paper")  # those of a run that does not name them


def run_benchmark(
    folder: Path,
    settings: BenchSettings,
    trackers: dict[str, Tracker] | None = None,
    *,
    jobs: int = 1,
    progress: Progress = lambda done, total: None,
) -> Results:
    """Render all scenes, track each with all methods, measure; what an earlier run of the same plan did is kept.

    Args:
        folder: of the run; made where it is missing. Its results.json holds everything at the end.
        settings: which scenes.
        trackers: by the method's name, see `TRACKERS`; None: paper and precise. Another proposer comes in here.
        jobs: processes, one scene each.
        progress: called with scenes done and all scenes.

    Returns:
        The results.

    Raises:
        OutputError: the folder holds another run, or cannot be written.
    """
    chosen = trackers_of(USUAL) if trackers is None else trackers
    _prepare(folder, settings)
    scenes = scenes_of(settings)
    missing = [scene for scene in scenes if _missing(folder, scene, chosen)]
    progress(len(scenes) - len(missing), len(scenes))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, _one_thread) as pool:
        tasks = [pool.submit(run_scene, folder, scene, _missing(folder, scene, chosen)) for scene in missing]
        try:
            for done, task in enumerate(as_completed(tasks), start=len(scenes) - len(missing) + 1):
                task.result()
                progress(done, len(scenes))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    outcomes = [_kept(_place(folder, scene, name)) for scene in scenes for name in chosen]
    results = Results(settings=settings, versions=versions(), outcomes=outcomes)
    save_results(results, folder / RESULTS)
    return results


def _one_thread() -> None:
    """Keep a worker to one core: as many workers as cores are running."""
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    import torch

    torch.set_num_threads(1)


def _prepare(folder: Path, settings: BenchSettings) -> None:
    """Make the folder, or refuse one that holds something else."""
    plan: dict[str, Any] = {"schema": SCHEMA, "settings": settings.model_dump(mode="json")}
    path = folder / PLAN
    do = "choose a new --out, or the same settings to go on"
    if folder.exists() and not folder.is_dir():
        raise OutputError(refusal(f"--out {folder}", expected="a folder", got="a file", do=do))
    try:
        (folder / KEPT).mkdir(parents=True, exist_ok=True)
        known = json.loads(path.read_text("utf-8")) if path.exists() else None
    except (OSError, ValueError) as error:
        got = f"'{' '.join(str(error).split())[:120]}'"
        raise OutputError(refusal(f"--out {folder}", expected="a folder to write to", got=got, do=do)) from None
    if known is not None and known != plan:
        raise OutputError(refusal(f"--out {folder}", expected="a run of this plan", got="another run's", do=do))
    if known is None:
        with put_aside(path) as aside:
            aside.write_text(json.dumps(plan, indent=1) + "\n", "utf-8")


def _place(folder: Path, scene: Scene, method: str) -> Path:
    return folder / KEPT / f"{scene.name}.{method}.json"


def _missing(folder: Path, scene: Scene, trackers: dict[str, Tracker]) -> dict[str, Tracker]:
    return {name: tracker for name, tracker in trackers.items() if not _place(folder, scene, name).exists()}


def _kept(path: Path) -> Outcome:
    try:
        return from_tree(json.loads(path.read_text("utf-8")))
    except (OSError, ValueError, KeyError, TypeError):
        do = "delete the file and run again"
        raise BenchError(refusal(str(path), expected="a kept outcome", got="something else", do=do)) from None


def run_scene(folder: Path, scene: Scene, trackers: dict[str, Tracker]) -> None:
    """Render a scene, track it, keep the outcomes; the movies are not kept."""
    with tempfile.TemporaryDirectory(prefix="scene") as place:
        experiment = write_scene(Path(place), scene)
        for name, tracker in trackers.items():
            outcome = track_scene(experiment, scene, name, tracker)
            with put_aside(_place(folder, scene, name)) as aside:
                aside.write_text(json.dumps(as_tree(outcome), separators=(",", ":")), "utf-8")


def track_scene(experiment: Path, scene: Scene, method: str, tracker: Tracker) -> Outcome:
    """Track a scene and measure; what the method refuses is an outcome, too."""
    begin = time.perf_counter()
    try:
        track = tracker(experiment)
    except SphereOrientError as error:
        numbers = no_track(scene.frames, " ".join(str(error).split()), time.perf_counter() - begin)
    else:
        numbers = measure(track, experiment.parent / "truth.h5", time.perf_counter() - begin)
    about: dict[str, Any] = {
        "scene": scene.name,
        "kind": scene.kind,
        "level": scene.level,
        "seed": scene.seed,
        "degradations": dict(scene.degradations),
        "method": method,
    }
    return Outcome(**about, **numbers)


def trackers_of(names: Sequence[str]) -> dict[str, Tracker]:
    """Return the trackers of some methods.

    Raises:
        BenchError: an unknown name.
    """
    for name in names:
        if name not in TRACKERS:
            do = "choose among these"
            raise BenchError(refusal("--methods", expected=", ".join(TRACKERS), got=repr(name)[:60], do=do))
    return {name: TRACKERS[name] for name in names}
