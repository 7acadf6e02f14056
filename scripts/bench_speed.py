"""Time each stage of the precise method, beside the paper's literal method and the cost of decoding.

    scripts/bench_speed.py EXPERIMENT_FOLDER [--frames 1200] [--fixed EXPERIMENT] [--long EXPERIMENT ...]

`--fixed`: one camera and a fixed ball, frame by frame; `--long`: whole runs of these experiments as well. Stages: CPU
seconds of one thread, least of the repetitions. The whole command: wall seconds in a fresh process. Other programs on
the machine make them longer: compare within one run. Compiled stages are also timed without compiled code, five times
in turn: median, least and largest. Prints Markdown.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import av
import numpy as np
import torch
import yaml

from sphereorient import locate, so3
from sphereorient.experiment import Experiment, load_experiment, open_movies
from sphereorient.experiment.recording import open_recording
from sphereorient.files.cache import WITHOUT as WITHOUT_CACHE
from sphereorient.files.compiled import WITHOUT
from sphereorient.files.threads import silent
from sphereorient.follow import Appearance, Tracker
from sphereorient.follow.appearance import estimate_appearance
from sphereorient.follow.ball import BallTracker
from sphereorient.follow.follower import sample_frames
from sphereorient.follow.initialise import Initialiser
from sphereorient.locate import Frame, screened_frames
from sphereorient.methods import precise
from sphereorient.methods.method import Job
from sphereorient.methods.paint import open_views
from sphereorient.methods.settings import Settings
from sphereorient.motion import kalman
from sphereorient.motion.kalman import Prior
from sphereorient.motion.path import RotationTrack, rotation_of
from sphereorient.movies import write_ffv1
from sphereorient.pose import CameraView, base_table, compiled
from sphereorient.pose.camera_view import FIRST_BLUR_PX, widest_px
from sphereorient.pose.fitter import first_fitter
from sphereorient.search import GreySearch, crop_disk, extract_paint
from sphereorient.sphere import load_texture, orthographic_view, reduced_texture
from sphereorient.synth import SynthSettings, write_synthetic_experiment

TURNS, SMOOTHED = 5, 3000  # repetitions; frames of the smoother
FOLLOWED = 48  # predicted frames in a row that are timed
MANY = 128  # the same for several balls
TIMED = """
import json, sys, time
begun = time.perf_counter()
from sphereorient import track_movies
stages = []
track = track_movies(sys.argv[1], progress=lambda *what: stages.append((*what, time.perf_counter() - begun)))
pictures = len(track) * len(track.cameras)
end = time.perf_counter() - begun
print(json.dumps({"stages": stages, "end": end, "cpu": time.process_time(), "pictures": pictures}))
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """Input of the stages: the first frames of an experiment, and everything learnt before them."""

    experiment: Experiment
    eyes: list[CameraView]
    frames: list[list[Frame]]  # by camera
    times: list[float]  # of the same frames, s
    search: GreySearch
    learnt: Appearance


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=1200, help="length of the repeated movies")
    parser.add_argument("--fixed", type=Path)
    parser.add_argument("--long", type=Path, nargs="*", default=[])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("| what | figure |\n|---|---|")
    bench = prepared(arguments.folder)
    mean_s = stages(bench)
    literal(bench, mean_s)
    smoother()
    sizes()
    three_balls()
    if arguments.fixed:
        live(arguments.fixed)
    with tempfile.TemporaryDirectory() as folder:
        whole("as it is", arguments.folder / "experiment.yaml")
        for kind in ("as it is, repeated", "24 slices", ".npy"):
            out = Path(folder) / kind.replace(" ", "")
            whole(kind, repeated(arguments.folder, out, arguments.frames, kind))
    for path in arguments.long:
        whole(str(path), path)


def show(what: str, figure: str) -> None:
    print(f"| {what} | {figure} |", flush=True)


def cpu_s(work: Callable[[], object], repetitions: int = 5) -> float:
    """Return the least CPU seconds of some calls."""
    spent = []
    for _ in range(repetitions):
        begin = time.process_time()
        work()
        spent.append(time.process_time() - begin)
    return min(spent)


def spread(values: list[float], scale: float = 1.0, digits: int = 2) -> str:
    """Return median, least and largest as text."""
    median, low, high = (
        f"{scale * value:.{digits}f}" for value in (statistics.median(values), min(values), max(values))
    )
    return f"{median} ({low} to {high})"


def in_turn(work: Callable[[], float]) -> tuple[list[float], list[float]]:
    """Measure five times in turn: with compiled code, and without."""
    pairs = []
    for _ in range(TURNS):
        fast = work()
        with (
            mock.patch.object(compiled, "refine_library", return_value=None),
            mock.patch.object(kalman, "kalman_library", return_value=None),
        ):
            pairs.append((fast, work()))
    return [fast for fast, _ in pairs], [slow for _, slow in pairs]


def smoother() -> None:
    """Time the smoother's two passes over a smooth random rotation."""
    turns = np.cumsum(np.cumsum(1e-4 * np.random.default_rng(0).standard_normal((SMOOTHED, 3)), axis=0), axis=0)
    time_, noise = np.arange(SMOOTHED, dtype=np.float64), np.broadcast_to(1e-6 * np.eye(3), (SMOOTHED, 3, 3))
    track = RotationTrack.of(time_, rotation_of(turns), noise, np.ones(SMOOTHED, bool))
    chain = track.chain(Prior(pole=0.3, deviation=0.01))
    wanted = np.eye(len(chain.start))[:9]

    def passes() -> float:
        begin = time.process_time()
        kalman.smooth(chain, kalman.run_filter(chain), wanted)
        return (time.process_time() - begin) / SMOOTHED

    fast, slow = in_turn(passes)
    show("smoother, there and back, compiled, CPU us a frame", spread(fast, 1e6, 1))
    show("the same in numpy", spread(slow, 1e6, 1))


def prepared(folder: Path, cameras: list[str] | None = None, show: Callable[[str, str], None] = show) -> Bench:
    """Learn what the stages need, as the pipeline does."""
    settings = Settings()
    with open_recording(folder / "experiment.yaml", cameras) as recording:
        eyes = [open_views(recording, reel, settings, silent)[""] for reel in recording.streams]
        frames = [
            list(screened_frames(reel, eye.background, 0, FOLLOWED))
            for reel, eye in zip(recording.streams, eyes, strict=True)
        ]
        sampled, _ = sample_frames(recording, eyes, settings.refine.appearance_frames)
        for reel in recording.streams:
            decoding = cpu_s(lambda reel=reel: list(reel.pictures(0, 20)), 3) / 20
            show(f"decoding {reel.name}, CPU ms a frame (floor of a movie)", f"{1e3 * decoding:.2f}")
        texture, times = recording.texture, recording.timeline.time_s[:FOLLOWED].tolist()
        experiment, radius_mm = recording.experiment, recording.experiment.radius_mm
    search = GreySearch(texture, settings.search)
    show("search bank, CPU s", f"{cpu_s(lambda: GreySearch(texture, settings.search), 2):.2f}")
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
    show("appearance (light, blur, noise), CPU s", f"{time.process_time() - begin:.2f}")
    return Bench(experiment=experiment, eyes=eyes, frames=frames, times=times, search=search, learnt=learnt)


def initialiser(bench: Bench) -> Initialiser:
    """Return the initialiser with the learnt appearance."""
    return Initialiser(
        fitter=bench.learnt.fitter,
        proposers={eye.name: bench.search for eye in bench.eyes},
        locating=Settings().locate,
        candidates=Settings().refine.candidates,
        score_min=bench.learnt.clear_score,
    )


def stages(bench: Bench) -> float:
    """Time single frames, without history and predicted; return the CPU s of a block's mean frame, per camera."""
    settings, cameras = Settings(), len(bench.eyes)
    first = [movie[0] for movie in bench.frames]
    frames = [frame.picture for frame in first]
    for eye, frame in zip(bench.eyes, frames, strict=True):
        seen = cpu_s(
            lambda eye=eye, frame=frame: locate.find_ball(frame, eye.background, eye.diameter_px, settings.locate)
        )
        show(f"outline in a full frame, {eye.name}, CPU ms", f"{1e3 * seen:.1f}")
    outline, _ = locate.find_ball(frames[0], bench.eyes[0].background, bench.eyes[0].diameter_px, settings.locate)
    assert outline is not None

    def first_pose() -> object:
        disk = crop_disk(frames[0], outline.u_px, outline.v_px, outline.radius_px, bench.search.size_px)
        return bench.search.propose(torch.from_numpy(disk)[None])

    show("first pose of a disk without history (crop, search, climb), CPU ms; bar 20", f"{1e3 * cpu_s(first_pose):.1f}")
    search = initialiser(bench)
    found = cpu_s(lambda: replace(search, score_min=0.0).poses(first))
    show("frame without history, outlines to covariances, CPU ms a camera", f"{1e3 * found / cameras:.1f}")
    fast, slow = in_turn(lambda: predicted(bench))
    each, (short, _) = statistics.median(fast), steps(bench, settings.refine.chunks)
    show("predicted frame, decoded already, with covariance, compiled, CPU ms a camera; bar 0.8", spread(fast, 1e3))
    show("the same in torch; bar: no slower than before, 4.3 to 5.0", spread(slow, 1e3))
    show("torch over compiled", spread([b / a for a, b in zip(fast, slow, strict=True)]))
    block = settings.refine.chunk_frames
    return (short + (block - 2) * each) / block


def steps(bench: Bench, lanes: int) -> tuple[float, float]:
    """Return CPU s per camera of a block's first two frames and of a predicted one, with blocks side by side."""
    ball = BallTracker(bench.learnt, initialiser(bench), Settings().refine.model_copy(update={"chunks": lanes}))
    short, each = steps_of(Tracker({"": ball}), bench.frames, bench.times, lanes)
    return short / lanes / len(bench.eyes), each / lanes / len(bench.eyes)


def steps_of(tracker: Tracker, frames: list[list[Frame]], times: list[float], lanes: int) -> tuple[float, float]:
    """Return CPU s of the first two frames of all blocks side by side, and of a predicted one (median)."""
    at: list[float] = []
    real = tracker.step

    def step(*given: Any) -> Any:
        at.append(time.process_time())
        return real(*given)

    length = len(times) // lanes
    with mock.patch.object(tracker, "step", step):
        list(tracker.track([movie[: lanes * length] for movie in frames], [length] * lanes, times))
    at.append(time.process_time())
    # First frames are searched for, second ones approached.
    return at[2] - at[0], statistics.median(np.diff(at[2:]).tolist())


def predicted(bench: Bench) -> float:
    """Return the CPU s of a predicted frame, per camera."""
    return steps(bench, Settings().refine.chunks)[1]


def sizes() -> None:
    """Time predicted frames of rendered balls of several sizes, by one camera and by two."""
    for diameter_px in (20, 80, 160, 400):
        side = max(400, 3 * diameter_px)
        settings = SynthSettings(frames=FOLLOWED, diameter_px=diameter_px, image_size=(side, side), volume_mm=9.0)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name) / "movie"
            write_synthetic_experiment(folder, settings)
            for cameras in (["cam1"], None):
                bench = prepared(folder, cameras, show=lambda *_: None)
                spent = [predicted(bench) for _ in range(TURNS)]
                what = f"predicted frame of {diameter_px} px, {len(bench.eyes)} camera(s), CPU ms a camera"
                show(what, spread(spent, 1e3))


def three_balls() -> None:
    """Time predicted frames of three balls that occlude each other, and of one of them."""
    lanes, spent = Settings().refine.chunks, {}
    with tempfile.TemporaryDirectory() as name:
        for balls in (1, 3):
            folder = Path(name) / str(balls)
            settings = SynthSettings(
                frames=MANY, balls=balls, cameras=3, diameter_mm=14.0, diameter_px=61.0, volume_mm=40.0
            )
            write_synthetic_experiment(folder, settings)
            with open_recording(folder / "experiment.yaml") as recording:
                job = Job(recording=recording, settings=Settings(), device=torch.device("cpu"))
                follower = precise.learn(job, silent)
                views = next(iter(follower.appearances.values())).fitter.views
                frames = [
                    list(screened_frames(reel, view.background, 0, MANY))
                    for reel, view in zip(recording.streams, views, strict=True)
                ]
                times = recording.timeline.time_s[:MANY].tolist()
            spent[balls] = follower.tracker, frames, times
        turns = [{n: steps_of(*of, lanes)[1] / (n * lanes * 3) for n, of in spent.items()} for _ in range(TURNS)]
    for balls in spent:
        show(f"predicted frame, {balls} ball(s), CPU ms a ball and camera", spread([one[balls] for one in turns], 1e3))
    show("three balls over one; bar 1.2", spread([one[3] / one[1] for one in turns]))


def live(experiment: Path) -> None:
    """Time one camera and a fixed ball, frame by frame, without later frames."""
    settings = Settings()
    settings = settings.model_copy(update={"refine": settings.refine.model_copy(update={"chunks": 1})})
    with open_recording(experiment) as recording:
        job = Job(recording=recording, settings=settings, device=torch.device("cpu"))
        follower = precise.learn(job, silent)
        view, stream = follower.appearance.fitter.views[0], recording.streams[0]
        frames = list(screened_frames(stream, view.background, 0, FOLLOWED))
        times = recording.timeline.time_s[:FOLLOWED].tolist()
    spent = []
    for _ in range(TURNS):
        ends = []
        for count in (2, FOLLOWED):
            begin = time.perf_counter()
            list(follower.tracker.track([frames[:count]], [count], times[:count]))
            ends.append(time.perf_counter() - begin)
        spent.append((ends[1] - ends[0]) / (FOLLOWED - 2))
    show("one camera, ball fixed, frame by frame, decoded, wall ms; bar 1.5", spread(spent, 1e3))


def literal(bench: Bench, mean_s: float) -> None:
    """Time the paper's literal search: 12 then 3 degrees, every template rendered at full size."""
    settings = Settings().orient
    eye, frame = bench.eyes[0], bench.frames[0][0].picture
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
    frames = [movie[0] for movie in bench.frames]
    search = replace(initialiser(bench), score_min=0.0)
    ours = cpu_s(lambda: search.poses(frames)) / len(bench.eyes)
    show("the paper's literal search, full-size renderings, CPU s a camera and frame", f"{paper:.1f}")
    show("ratio to a frame without history, outline and refinement included", f"{paper / ours:.0f}")
    block = Settings().refine.chunk_frames
    show(f"ratio to the mean frame of a block of {block}, refinement included; bar 100", f"{paper / mean_s:.0f}")


def repeated(folder: Path, out: Path, count: int, kind: str) -> Path:
    """Write an experiment's movies forwards and backwards until there are `count` frames: .npy, FFV1 with 24 slices, or
    the packets of the movie as it is.
    """
    out.mkdir()
    entry = yaml.safe_load((folder / "experiment.yaml").read_text())
    experiment = load_experiment(folder / "experiment.yaml")
    movies = open_movies(experiment, list(experiment.cameras))
    ending = "npy" if kind == ".npy" else "mkv"
    for name, movie in movies.items():
        order = [*range(len(movie)), *reversed(range(len(movie)))]
        some = [order[k % len(order)] for k in range(count)]
        target = out / f"{name}.{ending}"
        if kind == "as it is, repeated":
            repeat_packets(movie.path, target, some)
            continue
        frames = np.stack(list(movie.frames(0, len(movie))))
        if kind == ".npy":
            np.save(target, frames[some])
        else:
            write_ffv1(target, (frames[k] for k in some), 25.0)
    entry["movies"] = {name: str(out / f"{name}.{ending}") for name in movies}
    entry["cameras"] = str((folder / "cameras.yaml").resolve())
    entry["sphere"]["texture"] = str(experiment.texture_path.resolve())
    (out / "experiment.yaml").write_text(yaml.safe_dump(entry))
    return out / "experiment.yaml"


def repeat_packets(movie: Path, target: Path, order: list[int]) -> None:
    """Write a movie's packets, all of them key frames, in another order."""
    with av.open(str(movie)) as source, av.open(str(target), "w") as container:
        stream = container.add_stream_from_template(source.streams.video[0])
        packets = [bytes(packet) for packet in source.demux(video=0) if packet.size]
        step = 1 / (source.streams.video[0].average_rate * source.streams.video[0].time_base)
        for number, place in enumerate(order):
            packet = av.Packet(packets[place])
            packet.stream, packet.time_base = stream, source.streams.video[0].time_base
            packet.pts = packet.dts = round(number * step)
            packet.is_keyframe = True
            container.mux(packet)


def whole(kind: str, experiment: Path) -> None:
    """Time the whole command in fresh processes: with nothing in the cache, again, and without compiled code."""
    with tempfile.TemporaryDirectory() as cache:
        kept = {"XDG_CACHE_HOME": cache}
        cold, warm = (in_process(experiment, kept) for _ in range(2))
    plain = in_process(experiment, {WITHOUT: "1", WITHOUT_CACHE: "1"})
    seconds = [f"{each['end']:.1f}, {each['cpu']:.1f}" for each in (cold, warm, plain)]
    show(f"{kind}: whole run, wall and CPU s, cold cache; warm; without compiled code", "; ".join(seconds))
    begins, rates, joins = [], [], []
    for each in (cold, warm):
        stages = {stage: at for stage, _, _, at in each["stages"]}
        tracked = [(done, at) for stage, done, _, at in each["stages"] if stage == "track"]
        begins.append(f"{next(at for done, at in tracked if done):.1f}")
        rates.append(f"{each['pictures'] / (stages['track'] - tracked[0][1]):.0f}")
        joins.append(f"{each['end'] - stages['track']:.1f}")
    show(f"{kind}: start-up to the first batch tracked, wall s, cold; warm; bars 3.5, 2", "; ".join(begins))
    show(f"{kind}: camera-frames per wall second of following; bars 180 (FFV1), 300 (24 slices), 600 (.npy)", rates[1])
    show(f"{kind}: path, smoother and writing, wall s", joins[1])


def in_process(experiment: Path, environment: dict[str, str]) -> dict[str, Any]:
    """Track in a fresh process; return when each stage reported progress."""
    command = [sys.executable, "-c", TIMED, str(experiment)]
    run = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=os.environ | environment)
    return dict(json.loads(run.stdout))


if __name__ == "__main__":
    main()
