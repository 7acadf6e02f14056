"""Redo the paper: film synthetic movies as in its experiment, track them by both methods, make its table and figures.

    scripts/reproduce_paper.py --out DIR [--quick] [--docs]

DIR/movies and DIR/tracks keep what is done: a killed run continues. DIR/paper.md is the page. `--quick` films 3 x 90
frames instead of 40 x 375. `--docs` copies page and pictures into docs/.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shutil
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import torch
from paper_figures import OF_EXAMPLE, OF_PRECISE, OF_TRACKS, example_of
from paper_movies import film
from paper_table import markdown, measured, single_views, table

from sphereorient.errors import BenchError, OutputError, SphereOrientError, refusal
from sphereorient.files.whole_file import MARK, make_folder, write_text
from sphereorient.report.plots import style as look
from sphereorient.run import MemoryStore, Request, run
from sphereorient.run.many import end_with_parent
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
DOCS = Path(__file__).resolve().parents[1] / "docs"
DPI, LARGEST_BYTES = 130, 3_000_000  # of the pictures


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
    todo = [n for n in range(1, plan.movies + 1) if not all(place_of(out, n, method).exists() for method in METHODS)]
    begin, failed = time.perf_counter(), []
    # One worker a core: idle threads of their libraries would take the processor from the other workers.
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    context = multiprocessing.get_context("spawn")  # forked children of a process that used torch's threads hang
    workers = max(1, min(len(todo), os.cpu_count() or 1))
    with ProcessPoolExecutor(workers, mp_context=context, initializer=end_with_parent) as pool:
        made = [pool.submit(make_movie, out, number, plan.frames) for number in todo]
        for done, future in enumerate(as_completed(made), 1):
            failed += future.result()
            minutes = (time.perf_counter() - begin) / 60
            left = minutes / done * (len(todo) - done)
            print(f"{done} of {len(todo)} movies, {minutes:.0f} min, {left:.0f} min left", file=sys.stderr, flush=True)
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


def write_page(out: Path, plan: Plan, failed: list[str]) -> list[Path]:
    """Write paper.md and the figures from all tracks, and return the pictures."""
    numbers = range(1, plan.movies + 1)
    folders = [place_of(out, number) for number in numbers]
    found = {
        method: measured(folders, [place_of(out, number, method) for number in numbers], plan.statistics)
        for method in METHODS
    }
    make_folder(out / "paper", f"folder {out / 'paper'}")
    example, pictures, parts = example_of(found["paper"]), [], []
    for name, (draw, caption) in (OF_EXAMPLE | OF_TRACKS | OF_PRECISE).items():
        drawn = draw(example if name in OF_EXAMPLE else found["precise" if name in OF_PRECISE else "paper"])
        pictures += look.write_figure(drawn, out / "paper" / f"{name}.png", dpi=DPI)
        parts.append(f"![{name}](paper/{name}.png)\n\n**Figure {name[:2].lstrip('0')}.** {caption}\n")
    views = single_views(folders[0] / "texture.png", plan.views)
    text = PAGE.format(
        movies=plan.movies,
        frames=plan.frames,
        total=f"{plan.movies * plan.frames:,}",
        option=" --quick" if plan is QUICK else "",
        least=plan.statistics.min_frames,
        share=plan.statistics.min_integral_times,
        costs=costs(out),
        failed="".join(f"- {line}\n" for line in failed) or "- none\n",
        table=markdown(table(found, views, plan.statistics)),
        figures="\n".join(parts),
    )
    write_text(out / "paper.md", f"<!-- {MARK} -->\n{text}")
    return pictures


def costs(out: Path) -> str:
    """Return the processor time of each step, s per movie, and the sum."""
    rows = [line.split(",") for line in (out / "costs.csv").read_text(encoding="utf-8").splitlines()]
    spent: dict[str, list[float]] = {}
    for _, step, _, cpu_s in rows:
        spent.setdefault(step, []).append(float(cpu_s))
    each = ", ".join(f"{step} {sum(times) / len(times):.0f} s" for step, times in spent.items())
    return f"{each}; {sum(map(sum, spent.values())) / 3600:.1f} h in all"


PAGE = """# The paper, redone

`scripts/reproduce_paper.py --out out/paper{option}` films synthetic movies as in the experiment of Zimmermann et al.
2011, tracks them by the methods `paper` and `precise`, and makes this page. A second call continues where a killed one
stopped. Processor time per movie: {costs}.

## The movies

{movies} movies of {frames} frames ({total} frames in all), each of two cameras: 600 Hz, 650 x 650 px, 8 bit, a painted
sphere of 18 mm that is 70 to 90 px wide. The motion is random with known statistics: velocity, acceleration, omega and
alpha have the rms values of the paper's Table I; omega and alpha are intermittent, with flatness 4 and 7.6. The sphere
passes near the middle once in each movie, so it enters and leaves the field. Behind it the driving disks turn, and
their reflections move. Lamps light the sphere from one side and are mirrored in it; up to four bubbles are before it.
No background pictures are given: the methods learn the background from the movie, as the paper does.

## The numbers

Truth: the exact motion in the frames that `paper` measured (`law`: of the random process, without end). Errors behind
± are standard errors; whole movies or segments are resampled. Codes such as E6 name rows of [errata.md](errata.md).
Segments count from {least} frames and {share} T_L on, with T_L = 0.3 s.

{table}

Where the methods differ from the truth: `paper` computes alpha from averages of omega. This low-pass removes most of
the strong bursts, so its rms and its flatness are too small. `precise` estimates the spectrum of the motion itself;
its frames off by over 10° lie in a few movies, most of them measured by one camera (flag 4): mirrored lamps, bubbles
and the turning disks are taken for parts of the sphere there. They spoil its acceleration (flatness, rms).
The acceleration of these movies is Gaussian; the paper's is not (a = 0.6). The decay time of the durations follows from
the size of the field and the velocity of the sphere, as in any flow; the paper compares it with T_L. No segment is
longer than a movie.

Movies that a method could not track:

{failed}
## The figures

Figures 7 to 12 show the method `paper`, the last one `precise`. Figures 8 to 12 are those of `sphereorient report`.

{figures}"""


def copy_to_docs(out: Path, pictures: list[Path]) -> None:
    """Copy page and pictures into docs/; refuse pictures that are too large for a repository."""
    size = sum(path.stat().st_size for path in pictures)
    if size > LARGEST_BYTES:
        do = "lower DPI"
        raise OutputError(refusal("pictures", expected=f"{LARGEST_BYTES} bytes", got=f"{size}", do=do))
    shutil.rmtree(DOCS / "paper", ignore_errors=True)
    (DOCS / "paper").mkdir()
    for path in pictures:
        shutil.copy(path, DOCS / "paper")
    shutil.copy(out / "paper.md", DOCS)


def main() -> None:
    """Read the options, make everything; print a refusal as one line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--docs", action="store_true")
    options = parser.parse_args()
    plan = QUICK if options.quick else FULL
    try:
        make_folder(options.out, f"--out {options.out}")
        pictures = write_page(options.out, plan, make_movies(options.out, plan))
        if options.docs:
            copy_to_docs(options.out, pictures)
    except SphereOrientError as error:
        sys.exit(f"reproduce_paper.py: {error}")
    print(f"Page: {options.out / 'paper.md'}")


if __name__ == "__main__":
    main()
