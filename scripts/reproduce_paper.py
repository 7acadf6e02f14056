"""Redo the paper: film synthetic movies as in its experiment, track them by both methods, make its table and figures.

    scripts/reproduce_paper.py --out DIR [--quick] [--docs]

DIR/movies and DIR/tracks keep results with their records: an interrupted run continues, and results of changed code are
made anew. DIR/paper.md is the page. `--quick` films 3 x 90 frames instead of 40 x 375. `--docs` copies
page and pictures into docs/.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shutil
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path

import kept
import paper_movies
import torch
from paper_figures import OF_EXAMPLE, OF_PRECISE, OF_TRACKS, example_of
from paper_table import markdown, measured, single_views, table

from sphereorient.errors import BenchError, OutputError, SphereOrientError, refusal
from sphereorient.files.threads import limit_cores
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
# Modules that `paper` imports and does not run, as tests/end_to_end/test_reproduce_paper.py checks.
NOT_OF_PAPER = ("follow", "pose", "mapping", "learn", "methods.precise", "methods.paint")
DOCS = Path(__file__).resolve().parents[1] / "docs"
DPI, LARGEST_BYTES = 130, 3_000_000  # of the pictures


def made_by(out: Path, number: int, stage: str) -> Path:
    """Return what a stage makes of a movie: its folder (film), or the file of its track (a method)."""
    return out / "movies" / f"{number:03d}" if stage == "film" else out / "tracks" / f"{number:03d}-{stage}.h5"


@lru_cache(maxsize=1)
def code() -> dict[str, str]:
    """Return a digest of each stage's code: films do not depend on trackers, nor `paper` on `precise`."""
    stages = kept.rooms.modules()
    track = [stages["run.stages"], stages["methods.paper"]]
    return {
        "film": kept.digest(kept.code_of([Path(paper_movies.__file__)])),
        "paper": kept.digest(kept.code_of(track, NOT_OF_PAPER)),
        "precise": kept.digest(kept.code_of(track)),
    }


def key_of(number: int, stage: str, frames: int) -> str:
    """Return a digest of everything that the work of a stage depends on."""
    return " ".join([f"{number} {frames}", code()["film"], *([code()[stage]] if stage != "film" else [])])


def todo(out: Path, plan: Plan, stages: Sequence[str]) -> list[tuple[int, str]]:
    """Return the missing results, movie and stage; BenchError for a folder that no run has made."""
    missing = []
    for number, stage in product(range(1, plan.movies + 1), stages):
        made = made_by(out, number, stage)
        found = kept.known(made)
        if stage == "film" and made.exists() and "key" not in found:
            expected, do = f"a movie with its {kept.RECORD}", "remove it, or choose another --out"
            raise BenchError(refusal(str(made), expected=expected, got="a folder without", do=do))
        whole = made.exists() or found.get("failed")
        if not whole or found.get("key") != key_of(number, stage, plan.frames):
            missing.append((number, stage))
    return missing


def make(out: Path, number: int, stage: str, frames: int, key: str) -> None:
    """Film a movie or track it, and write its record; a refusal of a method is a result."""
    torch.set_num_threads(1)
    limit_cores(1)
    made, failed = made_by(out, number, stage), ""
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    if stage == "film":
        aside = made.with_name(f"{made.name}.part")
        for old in (aside, made):
            shutil.rmtree(old, ignore_errors=True)
        paper_movies.film(aside, number, frames)
    else:
        kept.record_of(made).unlink(missing_ok=True)
        experiment = made_by(out, number, "film") / "experiment.yaml"
        try:
            run(Request(experiment=experiment, out=made, method=stage, command="reproduce_paper.py"), MemoryStore())
        except OutputError:
            raise
        except SphereOrientError as error:
            made.unlink(missing_ok=True)
            failed = f"movie {number:03d}, {stage}: {error}"
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    words = {"key": key, "failed": failed, "wall_s": round(wall_s, 1), "cpu_s": round(cpu_s, 1)}
    kept.note(aside if stage == "film" else made, **words)
    if stage == "film":
        aside.rename(made)  # a movie under this name is complete
    print(f"movie {number:03d}: {stage:8} {wall_s:5.0f} s, {cpu_s:5.0f} s of CPU", file=sys.stderr, flush=True)


def make_movies(out: Path, plan: Plan, methods: Sequence[str] = METHODS) -> None:
    """Film all movies, then track them, the methods side by side on all cores.

    Results of the present code stay.
    """
    for part in ("movies", "tracks"):
        make_folder(out / part, f"folder {out / part}")
    # One worker a core: idle threads of their libraries would take the processor from the other workers.
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    context = multiprocessing.get_context("spawn")  # forked children of a process that used torch's threads hang
    with ProcessPoolExecutor(os.cpu_count() or 1, mp_context=context, initializer=end_with_parent) as pool:
        for stages in (("film",), methods):
            missing, begin = todo(out, plan, stages), time.perf_counter()
            jobs = [(out, number, stage, plan.frames, key_of(number, stage, plan.frames)) for number, stage in missing]
            making = [pool.submit(make, *job) for job in jobs]
            try:
                for done, future in enumerate(as_completed(making), 1):
                    future.result()
                    minutes = (time.perf_counter() - begin) / 60
                    left = minutes / done * (len(making) - done)
                    message = f"{' and '.join(stages)}: {done} of {len(making)}, {minutes:.0f} min, {left:.0f} min left"
                    print(message, file=sys.stderr, flush=True)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


def write_page(out: Path, plan: Plan) -> list[Path]:
    """Write paper.md and the figures from all tracks, and return the pictures."""
    numbers = range(1, plan.movies + 1)
    folders = [made_by(out, number, "film") for number in numbers]
    failed = [kept.known(made_by(out, number, method)).get("failed") for number, method in product(numbers, METHODS)]
    found = {
        method: measured(folders, [made_by(out, number, method) for number in numbers], plan.statistics)
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
        costs=costs(out, plan),
        failed="".join(f"- {line}\n" for line in failed if line) or "- none\n",
        table=markdown(table(found, views, plan.statistics)),
        figures="\n".join(parts),
    )
    write_text(out / "paper.md", f"<!-- {MARK} -->\n{text}")
    return pictures


def costs(out: Path, plan: Plan) -> str:
    """Return the processor time of each stage, s per movie, and the sum."""
    spent: dict[str, list[float]] = {}
    for number, stage in product(range(1, plan.movies + 1), ("film", *METHODS)):
        cpu_s = kept.known(made_by(out, number, stage)).get("cpu_s", 0.0)
        spent.setdefault(stage, []).append(float(cpu_s))
    each = ", ".join(f"{stage} {sum(times) / len(times):.0f} s" for stage, times in spent.items())
    return f"{each}; {sum(map(sum, spent.values())) / 3600:.1f} h in all"


PAGE = """# The paper, redone

`scripts/reproduce_paper.py --out out/paper{option}` films synthetic movies as in the experiment of Zimmermann et al.
2011, tracks them by the methods `paper` and `precise`, and makes this page. A second call continues a killed one.
Processor time per movie: {costs}.

## The movies

- Size: {movies} movies of {frames} frames ({total} in all), two cameras, 600 Hz, 650 x 650 px, 8 bit.
- Sphere: 18 mm, 70 to 90 px; it enters and leaves the field once in each movie.
- Motion: random, with the rms values of the paper's Table I; omega and alpha with flatness 4 and 7.6.
- Scene: driving disks rotate behind the sphere; lamps from one side; up to four bubbles; no background pictures.

## The numbers

Truth: the exact motion in the frames that `paper` measured (`law`: of the random process, without end). ±: standard
errors; whole movies or segments are resampled. Codes such as E6: [errata.md](errata.md). Segments count from {least}
frames and {share} T_L on, with T_L = 0.3 s.

{table}

`paper` computes alpha from averages of omega. This low-pass removes most of the strong bursts, so rms and flatness are
too small. `precise` estimates the spectrum of the motion itself. It measures more frames, so its truth is of other
frames, too. The acceleration of these movies is Gaussian; the paper's is not (a = 0.6). No segment is longer than a
movie.

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
        make_movies(options.out, plan)
        pictures = write_page(options.out, plan)
        if options.docs:
            copy_to_docs(options.out, pictures)
    except (SphereOrientError, OSError) as error:
        sys.exit(f"reproduce_paper.py: {error}")
    print(f"Page: {options.out / 'paper.md'}")


if __name__ == "__main__":
    main()
