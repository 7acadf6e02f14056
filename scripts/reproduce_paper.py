"""Redo the paper: film synthetic movies as in its experiment, track them by both methods, make its table and figures.

    scripts/reproduce_paper.py --out DIR [--quick] [--docs]

DIR/movies and DIR/tracks keep what is done: a killed run continues. DIR/paper.md is the page. `--quick` films 3 x 90
frames instead of 40 x 375. `--docs` copies page and pictures into docs/.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import torch
from paper_movies import film
from paper_table import markdown, measured, single_views, table

from sphereorient.errors import BenchError, SphereOrientError, refusal
from sphereorient.files.whole_file import make_folder, write_text
from sphereorient.run import MemoryStore, Request, run
from sphereorient.statistics import StatisticsSettings


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is filmed, and what counts in the statistics."""

    movies: int
    frames: int
    views: int  # single synthetic views
    statistics: StatisticsSettings


T_L_S = 0.3  # integral time of the paper's flow
FULL = Plan(movies=40, frames=375, views=400, statistics=StatisticsSettings(integral_time_s=T_L_S))
QUICK = Plan(
    movies=3,
    frames=90,
    views=40,
    statistics=StatisticsSettings(integral_time_s=T_L_S, min_frames=20, min_integral_times=0.1, resamples=200),
)
METHODS = ("paper", "precise")


def place_of(out: Path, number: int, method: str = "") -> Path:
    """Return the folder of a movie, or the file of its track."""
    return out / "tracks" / f"{number:03d}-{method}.h5" if method else out / "movies" / f"{number:03d}"


def make_movie(out: Path, number: int, frames: int) -> list[str]:
    """Film one movie and track it by both methods, as far as it is not done; return the errors of methods."""
    torch.set_num_threads(1)
    folder, failed = place_of(out, number), []
    if not folder.exists():
        timed(out, number, "film", lambda: film(folder, number, frames))
    for method in METHODS:
        track = place_of(out, number, method)
        request = Request(experiment=folder / "experiment.yaml", out=track, method=method, command="reproduce_paper.py")
        if not track.exists():
            try:
                timed(out, number, method, lambda request=request: run(request, MemoryStore()))
            except SphereOrientError as error:
                failed.append(f"movie {number:03d}, {method}: {error}")
    return failed


def timed(out: Path, number: int, step: str, work: Callable[[], Any]) -> None:
    """Do a step, print its time, and append it to costs.csv."""
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    work()
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    print(f"movie {number:03d}: {step:8} {wall_s:5.0f} s, {cpu_s:5.0f} s of CPU", file=sys.stderr, flush=True)
    with (out / "costs.csv").open("a", encoding="utf-8") as file:
        file.write(f"{number},{step},{wall_s:.1f},{cpu_s:.1f}\n")


def make_movies(out: Path, plan: Plan) -> list[str]:
    """Film and track all movies on all cores, and return the errors of methods; refuse a broken folder."""
    for part in ("movies", "tracks"):
        make_folder(out / part, f"folder {out / part}")
    for number in range(1, plan.movies + 1):
        check_movie(place_of(out, number), plan.frames)
    begin, failed = time.perf_counter(), []
    context = multiprocessing.get_context("spawn")  # forked children of a process that used torch's threads hang
    with ProcessPoolExecutor(min(plan.movies, os.cpu_count() or 1), mp_context=context) as pool:
        made = [pool.submit(make_movie, out, number, plan.frames) for number in range(1, plan.movies + 1)]
        for done, future in enumerate(as_completed(made), 1):
            failed += future.result()
            minutes = (time.perf_counter() - begin) / 60
            left = minutes / done * (plan.movies - done)
            print(
                f"{done} of {plan.movies} movies, {minutes:.0f} min, {left:.0f} min left", file=sys.stderr, flush=True
            )
    return failed


def check_movie(folder: Path, frames: int) -> None:
    """Refuse a folder that is there but is no whole movie of this many frames."""
    if not folder.exists():
        return
    do = "remove it, or choose another --out"
    expected = f"experiment.yaml, truth.h5 and two movies of {frames} frames"
    lacking = [
        name for name in ("experiment.yaml", "truth.h5", "cam1.mkv", "cam2.mkv") if not (folder / name).is_file()
    ]
    if lacking:
        raise BenchError(refusal(str(folder), expected=expected, got=f"no {lacking[0]}", do=do))
    with h5py.File(folder / "truth.h5") as file:
        got = len(file["time"])
    if got != frames:
        raise BenchError(refusal(str(folder), expected=expected, got=f"{got} frames", do=do))


def main() -> None:
    """Read the options, and print a refusal as one line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--docs", action="store_true")
    options = parser.parse_args()
    try:
        make_folder(options.out, f"--out {options.out}")
        failed = make_movies(options.out, QUICK if options.quick else FULL)
        write_page(options.out, QUICK if options.quick else FULL, failed)
    except SphereOrientError as error:
        sys.exit(f"reproduce_paper.py: {error}")


def write_page(out: Path, plan: Plan, failed: list[str]) -> None:
    numbers = range(1, plan.movies + 1)
    folders = [place_of(out, number) for number in numbers]
    found = {
        method: measured(folders, [place_of(out, number, method) for number in numbers], plan.statistics)
        for method in METHODS
    }
    views = single_views(folders[0] / "texture.png", plan.views)
    text = markdown(table(found, views, plan.statistics))
    write_text(out / "paper.md", text)
    print(text)


if __name__ == "__main__":
    main()
