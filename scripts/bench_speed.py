"""Where the time goes: each stage of the precise method, against the paper's literal method and against its floor.

    scripts/bench_speed.py EXPERIMENT_FOLDER [--frames 240]

CPU seconds of one thread for the stages, best of the repetitions, and wall seconds of the whole command in a fresh
process. Other programs on the machine only ever make them longer: compare within one run. Prints Markdown.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import yaml

from sphereorient import locate, so3
from sphereorient.experiment import Experiment, load_experiment, open_movies
from sphereorient.experiment.recording import open_recording, silent
from sphereorient.follow import Appearance, ChunkTracker
from sphereorient.follow.appearance import estimate_appearance
from sphereorient.follow.follower import sample_frames
from sphereorient.follow.initialise import Initialiser
from sphereorient.locate import Frame, screened_frames
from sphereorient.methods.proposers import open_view
from sphereorient.methods.settings import Settings
from sphereorient.pose import CameraView, base_table
from sphereorient.pose.fitter import FIRST_BLUR_PX, first_fitter, widest_px
from sphereorient.search import GreySearch, crop_disk, extract_paint
from sphereorient.sphere import load_texture, orthographic_view, reduced_texture

FOLLOWED = 48  # frames over which one prediction after the other is timed
TOLD = """
import json, sys, time
begun = time.perf_counter()
from sphereorient import track_movies
told = []
track = track_movies(sys.argv[1], progress=lambda *what: told.append((*what, time.perf_counter() - begun)))
print(json.dumps({"told": told, "end": time.perf_counter() - begun, "cpu": time.process_time()}))
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """What the stages work on: the first frames of an experiment, and all that is learnt before."""

    experiment: Experiment
    eyes: list[CameraView]
    shots: list[list[Frame]]  # per eye
    times: list[float]  # of the same frames, s
    search: GreySearch
    learnt: Appearance


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=240)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("| what | figure |\n|---|---|")
    bench = prepared(arguments.folder)
    mean_s = stages(bench)
    literal(bench, mean_s)
    with tempfile.TemporaryDirectory() as folder:
        whole("FFV1", arguments.folder / "experiment.yaml", len(bench.eyes))
        whole(".npy", as_npy(arguments.folder, Path(folder), arguments.frames), len(bench.eyes))


def say(what: str, figure: str) -> None:
    print(f"| {what} | {figure} |", flush=True)


def cpu_s(work: Callable[[], object], repetitions: int = 5) -> float:
    """Least CPU seconds of some calls."""
    spent = []
    for _ in range(repetitions):
        begin = time.process_time()
        work()
        spent.append(time.process_time() - begin)
    return min(spent)


def prepared(folder: Path) -> Bench:
    """Learn what the stages need, as the pipeline does."""
    settings = Settings()
    with open_recording(folder / "experiment.yaml") as recording:
        eyes = [open_view(recording, reel, settings, silent) for reel in recording.streams]
        shots = [
            list(screened_frames(reel, eye.background, 0, FOLLOWED))
            for reel, eye in zip(recording.streams, eyes, strict=True)
        ]
        sampled, _ = sample_frames(recording, eyes, settings.refine.appearance_frames)
        for reel in recording.streams:
            decoding = cpu_s(lambda reel=reel: list(reel.pictures(0, 20)), 3) / 20
            say(f"decoding {reel.name}, CPU ms a frame (floor of a movie)", f"{1e3 * decoding:.2f}")
        texture, times = recording.texture, recording.timeline.time_s[:FOLLOWED].tolist()
        experiment, radius_mm = recording.experiment, recording.experiment.radius_mm
    search = GreySearch(texture, settings.search)
    say("search bank, CPU s", f"{cpu_s(lambda: GreySearch(texture, settings.search), 2):.2f}")
    base = base_table(texture, widest_px(eyes))
    proposers = {eye.name: search for eye in eyes}
    begin = time.process_time()
    first = Initialiser(
        fitter=first_fitter(eyes, radius_mm, base, FIRST_BLUR_PX),
        proposers=proposers,
        locating=settings.locate,
        candidates=settings.refine.candidates,
    )
    learnt = estimate_appearance(first, sampled, base, settings.refine)
    say("study (light, blur, noise), CPU s", f"{time.process_time() - begin:.2f}")
    return Bench(experiment=experiment, eyes=eyes, shots=shots, times=times, search=search, learnt=learnt)


def initialiser(bench: Bench) -> Initialiser:
    """Return who finds the sphere without history."""
    return Initialiser(
        fitter=bench.learnt.fitter,
        proposers={eye.name: bench.search for eye in bench.eyes},
        locating=Settings().locate,
        candidates=Settings().refine.candidates,
        score_min=bench.learnt.clear_score,
    )


def stages(bench: Bench) -> float:
    """Time single frames: found from nothing, and predicted; return CPU s of a block's mean frame, a camera."""
    settings, cameras = Settings(), len(bench.eyes)
    first = [movie[0] for movie in bench.shots]
    frames = [shot.picture for shot in first]
    for eye, frame in zip(bench.eyes, frames, strict=True):
        seen = cpu_s(
            lambda eye=eye, frame=frame: locate.find_ball(frame, eye.background, eye.diameter_px, settings.locate)
        )
        say(f"outline in a full frame, {eye.name}, CPU ms", f"{1e3 * seen:.1f}")
    outline, _ = locate.find_ball(frames[0], bench.eyes[0].background, bench.eyes[0].diameter_px, settings.locate)
    assert outline is not None

    def first_pose() -> object:
        disk = crop_disk(frames[0], outline.u_px, outline.v_px, outline.radius_px, bench.search.size_px)
        return bench.search.propose(torch.from_numpy(disk)[None])

    say("first pose of a disk without history (crop, search, climb), CPU ms; bar 20", f"{1e3 * cpu_s(first_pose):.1f}")
    search = initialiser(bench)
    found = cpu_s(lambda: replace(search, score_min=0.0).poses(first))
    say("frame without history, outlines to covariances, CPU ms a camera", f"{1e3 * found / cameras:.1f}")
    tracker = ChunkTracker(bench.learnt, search, settings.refine)
    # As many blocks side by side as the tracker follows: first frames are searched for, second ones approached.
    lanes = settings.refine.chunks
    begun, whole = [2] * lanes, [FOLLOWED // lanes] * lanes
    short = cpu_s(lambda: list(tracker.track([movie[: sum(begun)] for movie in bench.shots], begun, bench.times)), 3)
    long = cpu_s(lambda: list(tracker.track([movie[: sum(whole)] for movie in bench.shots], whole, bench.times)), 3)
    each = (long - short) / (sum(whole) - sum(begun)) / cameras
    say("predicted frame, decoded already, with covariance, CPU ms a camera; bar 3.7", f"{1e3 * each:.2f}")
    say("refinement, camera-frames per CPU second (two cores: twice); bar 300", f"{1 / each:.0f}")
    block = settings.refine.chunk_frames
    return (short / lanes / cameras + (block - 2) * each) / block


def literal(bench: Bench, mean_s: float) -> None:
    """Time the paper's literal search: 12 then 3 degrees, every template rendered at full size."""
    settings = Settings().orient
    eye, frame = bench.eyes[0], bench.shots[0][0].picture
    outline, _ = locate.find_ball(frame, eye.background, eye.diameter_px, Settings().locate)
    assert outline is not None
    size_px = round(2 * outline.radius_px)
    view = orthographic_view(size_px)
    texture = reduced_texture(load_texture(bench.experiment.texture_path), size_px)
    disk = torch.from_numpy(crop_disk(frame, outline.u_px, outline.v_px, outline.radius_px, size_px))[None]
    signs = extract_paint(disk, view.inside, settings)[0][view.inside]
    coarse = so3.lattman_grid(math.radians(12.0)).float()
    fine = so3.local_grid(math.radians(3.0), math.radians(12.0)).float()

    def quality(R: torch.Tensor) -> torch.Tensor:
        parts = [torch.sign(view.paint(texture, part) - 0.5) @ signs / len(signs) for part in torch.split(R, 64)]
        return 0.5 + 0.5 * torch.cat(parts)

    def once() -> None:
        first = quality(coarse)
        keep = coarse[first > first.max() - 0.1]
        groups: list[torch.Tensor] = []
        for R in keep:
            if all(so3.geodesic_distance(R, other) > math.radians(30) for other in groups):
                groups.append(R)
        for R in groups:
            quality(R @ fine)

    paper = cpu_s(once, 1)
    frames = [movie[0] for movie in bench.shots]
    search = replace(initialiser(bench), score_min=0.0)
    ours = cpu_s(lambda: search.poses(frames)) / len(bench.eyes)
    say("the paper's literal search, full-size renderings, CPU s a camera and frame", f"{paper:.1f}")
    say("ratio to a frame without history, outline and refinement included", f"{paper / ours:.0f}")
    block = Settings().refine.chunk_frames
    say(f"ratio to the mean frame of a block of {block}, refinement included; bar 100", f"{paper / mean_s:.0f}")


def as_npy(folder: Path, out: Path, count: int) -> Path:
    """Write an experiment's movies as .npy, forwards and backwards until there are `count` frames."""
    entry = yaml.safe_load((folder / "experiment.yaml").read_text())
    experiment = load_experiment(folder / "experiment.yaml")
    movies = open_movies(experiment, list(experiment.cameras))
    for name, movie in movies.items():
        frames = np.stack(list(movie.frames(0, len(movie))))
        there_and_back = np.concatenate([frames, frames[::-1]])
        np.save(out / f"{name}.npy", there_and_back[np.arange(count) % len(there_and_back)])
    entry["movies"] = {name: str(out / f"{name}.npy") for name in movies}
    entry["cameras"] = str((folder / "cameras.yaml").resolve())
    entry["sphere"]["texture"] = str(experiment.texture_path.resolve())
    (out / "experiment.yaml").write_text(yaml.safe_dump(entry))
    return out / "experiment.yaml"


def whole(kind: str, experiment: Path, cameras: int) -> None:
    """Time the whole command in a fresh process."""
    run = subprocess.run([sys.executable, "-c", TOLD, str(experiment)], stdout=subprocess.PIPE, text=True, check=True)
    result = json.loads(run.stdout)
    tracked = [(done, total, at) for stage, done, total, at in result["told"] if stage == "track"]
    begin, (_, total, _) = tracked[0][2], tracked[0]
    say(f"{kind}: start-up to tracking, wall s; bar 5", f"{begin:.1f}")
    rate = cameras * total / (result["end"] - begin)
    say(f"{kind}: camera-frames per wall second, start-up apart; bars 120 (FFV1), 250 (.npy)", f"{rate:.0f}")
    say(f"{kind}: CPU s in all, {total} frames of {cameras} cameras", f"{result['cpu']:.1f}")


if __name__ == "__main__":
    main()
