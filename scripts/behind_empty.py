"""Put a movie behind frames of its own empty scene, and compare its track with that of the movie as it is.

    scripts/behind_empty.py [EXPERIMENT_FOLDER] [--out DIR] [--frames 150] [--period 25]

The folder holds experiment.yaml and truth.h5; its scene repeats after `--period` frames (turning blades). A pixel of an
empty frame is the median over the frames of its phase whose ball is elsewhere, with the noise of the movie put on.
DIR keeps movie and tracks beside what they were made of: what changed code made is made anew. Prints Markdown: the
figures of the movie's own frames, those of the empty ones, and the CPU time. Nothing should move by over 3 %, the CPU
time by over 20 %.
"""

from __future__ import annotations

import argparse
import multiprocessing
import shutil
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import chain
from pathlib import Path

import h5py
import kept
import numpy as np
import torch
from numpy.typing import NDArray
from reproduce_paper import code

from sphereorient.bench import score_track
from sphereorient.cameras import Camera, sphere_disk_px
from sphereorient.experiment import load_experiment
from sphereorient.files.threads import limit_cores
from sphereorient.movies import open_movie, write_ffv1
from sphereorient.run import MemoryStore, Request, run
from sphereorient.trajectory import Trajectory

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "experiment"
AROUND_PX = 8  # beyond the disk: blur, motion in the exposure, the ball's light on what is near
NOT_OF_MOVIE = ("reproduce_paper", "run", "bench", "trajectory")
PER_FRAME = ("valid", "orientation_deg", "position_mm", "orientation_sigmas", "position_sigmas")
Grey = NDArray[np.uint8]
Floats = NDArray[np.float32]


def covered(camera: Camera, position_mm: torch.Tensor, radius_mm: float) -> NDArray[np.bool_]:
    """Return the pixels (N, H, W) at which a ball at positions (N, 3), lab, may be seen."""
    middle, radius = (part.numpy() for part in sphere_disk_px(camera, position_mm, radius_mm))
    y, x = np.ogrid[: camera.image_size[1], : camera.image_size[0]]
    places = zip(middle, radius + AROUND_PX, strict=True)
    return np.stack([(x - at[0]) ** 2 + (y - at[1]) ** 2 < reach**2 for at, reach in places])


def median_without(pictures: Grey, ball: NDArray[np.bool_]) -> Floats:
    """Return the median (H, W) of pictures (N, H, W) where no ball is; NaN where it is in all."""
    ordered = np.sort(np.where(ball, np.inf, pictures).astype(np.float32), axis=0)
    count = (~ball).sum(0)
    low, high = (np.take_along_axis(ordered, k.clip(0)[None], 0)[0] for k in ((count - 1) // 2, count // 2))
    return np.where(count > 0, (low + high) / 2, np.nan).astype(np.float32)


def empty_scene(pictures: Grey, ball: NDArray[np.bool_], period: int) -> Floats:
    """Return the scene of each phase, (period, H, W); where the ball hides a pixel all along, of all phases."""
    phases = np.stack([median_without(pictures[k::period], ball[k::period]) for k in range(period)])
    hidden = np.isnan(phases).any(0)
    usual = median_without(pictures[:, hidden], ball[:, hidden])
    phases[:, hidden] = np.where(np.isnan(phases[:, hidden]), usual, phases[:, hidden])
    if np.isnan(phases).any():
        raise SystemExit("behind_empty.py: the ball hides a part of the scene in all frames")
    return phases


def noise_of(pictures: Grey, ball: NDArray[np.bool_], scene: Floats) -> tuple[float, float]:
    """Return the variance of the noise as a line, its value at grey level 0 and its slope.

    From the mean size of the residuals, which few outliers (bubbles) hardly move, of each grey level.
    """
    period, size, count = len(scene), np.zeros(256), np.zeros(256)
    for k in range(len(pictures)):
        expected = scene[k % period]
        level = np.rint(expected[~ball[k]]).astype(int)
        size += np.bincount(level, np.abs(pictures[k] - expected)[~ball[k]], minlength=256)
        count += np.bincount(level, minlength=256)
    known = count > 1e-4 * count.sum()
    variance = np.pi / 2 * (size[known] / count[known]) ** 2
    slope, at_zero = np.polyfit(np.flatnonzero(known), variance, 1, w=np.sqrt(count[known]))
    return float(at_zero), float(slope)


def empty_frames(scene: Floats, noise: tuple[float, float], frames: int, seed: int) -> Iterator[Grey]:
    """Yield frames of the scene (period, H, W), which ends where the movie's first phase begins."""
    rng, (at_zero, slope) = np.random.default_rng(seed), noise
    for k in range(-frames, 0):
        grey = scene[k % len(scene)]
        sigma = np.sqrt(np.maximum(at_zero + slope * grey, 0))
        yield np.rint(grey + sigma * rng.standard_normal(grey.shape, np.float32)).clip(0, 255).astype(np.uint8)


def write_truth(there: Path, here: Path, frames: int, frame_rate_hz: float) -> torch.Tensor:
    """Write a truth behind frames without a ball, NaN, and return the positions (N, 3) that are known."""
    with h5py.File(there) as old, h5py.File(here, "w") as new:
        new.attrs.update(old.attrs)
        for name in (key for key in old if isinstance(old[key], h5py.Dataset)):
            values = old[name][()]
            front = np.full((frames, *values.shape[1:]), np.nan)
            if name == "time":
                front = values[0] + np.arange(frames) / frame_rate_hz
                values = values + frames / frame_rate_hz
            new.create_dataset(name, data=np.concatenate([front, values])).attrs.update(old[name].attrs)
        return torch.from_numpy(old["position"][()])


def make_movie(folder: Path, out: Path, frames: int, period: int) -> None:
    """Write the movie behind empty frames, with its experiment and truth, into a new folder."""
    experiment = load_experiment(folder / "experiment.yaml")
    out.mkdir(parents=True)
    for path in (experiment.path, experiment.cameras_path, experiment.sphere.texture_path):
        assert path is not None
        shutil.copyfile(path, out / path.name)
    position = write_truth(folder / "truth.h5", out / "truth.h5", frames, experiment.frame_rate_hz)
    for index, (name, path) in enumerate(experiment.movie_paths.items()):
        with open_movie(path) as movie:
            pictures = np.stack(list(movie.frames()))
        ball = covered(experiment.cameras[name], position, experiment.radius_mm)
        scene = empty_scene(pictures, ball, period)
        noise = noise_of(pictures, ball, scene)
        print(f"{name}: variance of the noise {noise[0]:.2f} + {noise[1]:.4f} x grey level", file=sys.stderr)
        write_ffv1(
            out / path.name, chain(empty_frames(scene, noise, frames, index), pictures), experiment.frame_rate_hz
        )


def track(folder: Path, made: Path, key: str) -> None:
    """Track a movie on one core, and note what it cost."""
    torch.set_num_threads(1)
    limit_cores(1)
    kept.record_of(made).unlink(missing_ok=True)
    begin_s = time.process_time()
    request = Request(experiment=folder / "experiment.yaml", out=made, method="precise", command="behind_empty.py")
    run(request, MemoryStore())
    kept.note(made, key=key, cpu_s=round(time.process_time() - begin_s, 1))


def figures(track: Trajectory, truth: Path, first: int, cpu_s: float) -> dict[str, float]:
    """Return the figures of the frames from `first` on, and how many frames before it are valid."""
    score = score_track(track, truth)
    own = replace(score, **{name: getattr(score, name)[first:] for name in PER_FRAME})
    deg, mm, sigmas = own.percentiles_deg(), own.percentiles_mm(), own.over_stated()
    return {
        "orientation p50, degrees": deg[0],
        "orientation p95, degrees": deg[1],
        "orientation rms, degrees": float(np.sqrt(np.mean(own.orientation_deg[own.valid] ** 2))),
        "position p50, mm": mm[0],
        "position p95, mm": mm[1],
        "orientation error over sigma, rms": sigmas[0],
        "position error over sigma, rms": sigmas[1],
        "valid frames": float(own.valid.sum()),
        "valid frames without a ball": float(score.valid[:first].sum()),
        "CPU, s": cpu_s,
    }


def main() -> None:
    """Read the options, make what is missing, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=FOLDER)
    parser.add_argument("--out", type=Path, default=Path("out/behind_empty"))
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--period", type=int, default=25)
    given = parser.parse_args()
    inputs = [(path.name, path.stat().st_size, path.stat().st_mtime) for path in sorted(given.folder.glob("*.*"))]
    film = kept.digest(kept.code_of([Path(__file__)], NOT_OF_MOVIE), inputs, given.frames, given.period)
    behind = given.out / "movie"
    if kept.known(behind).get("key") != film:
        shutil.rmtree(behind, ignore_errors=True)
        make_movie(given.folder, behind, given.frames, given.period)
        kept.note(behind, key=film)
    found = []
    for name, folder, first in (("alone", given.folder, 0), ("behind", behind, given.frames)):
        made, key = given.out / f"{name}.h5", f"{film} {code()['precise']}"
        if not made.exists() or kept.known(made).get("key") != key:
            context = multiprocessing.get_context("spawn")  # each begins with nothing in memory
            with ProcessPoolExecutor(1, mp_context=context) as pool:
                pool.submit(track, folder, made, key).result()
        found.append(figures(Trajectory.load(made), folder / "truth.h5", first, float(kept.known(made)["cpu_s"])))
    print(f"| figure | the movie alone | behind {given.frames} empty frames | ratio |\n{'|---' * 4}|")
    for name, alone in found[0].items():
        ratio = f"{found[1][name] / alone:.3f}" if alone else ""
        print(f"| {name} | {alone:.4g} | {found[1][name]:.4g} | {ratio} |")


if __name__ == "__main__":
    main()
