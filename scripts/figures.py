"""Make the tables and figures of the docs that hold numbers; list those older than the code they measure.

    scripts/figures.py --jobs 2          # what is older or was never made, two at a time; a second call goes on
    scripts/figures.py --only NAME ...   # these, in any case
    scripts/figures.py --list            # makes nothing; exits 1 where a figure is older than its code

A command writes its page itself, or prints Markdown whose tables go between the page's marks
`<!-- figure NAME -->` and `<!-- end NAME -->`; what it prints is kept in out/figures. Numbers within sentences are
copied by hand from there. docs/figures.md holds the CPU, and date, commit and CPU time of each figure. Figures of
times, and those that use another one, are made last, one by one.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import kept

from sphereorient.files.whole_file import write_text

REPO = kept.SCRIPTS.parent
DOCS, OUT, PAGE = REPO / "docs", REPO / "out" / "figures", REPO / "docs" / "figures.md"
SHARED = "../shared"
HEAD = "| figure | pages | command | made | commit | CPU s | code |"


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A table, a picture or numbers of the docs, and the command that makes them."""

    pages: tuple[str, ...]  # of docs/
    command: str  # a script of scripts/, or the program's name, with its arguments
    tables: tuple[str, ...] = ()  # marks of the tables that it prints, in their order; none: it writes, or text only
    last: bool = False  # it measures times or uses another figure: made alone, after the others
    keeps: str = ""  # folder of out/ with parts that an interrupted run goes on with; of older code: removed


FIGURES: dict[str, Figure] = {
    "parameters": Figure(pages=("parameters.md",), command="make_parameters.py"),
    "degradations": Figure(pages=("degradations.md",), command="figure_degradations.py"),
    "conventions": Figure(pages=("conventions.md",), command="figure_conventions.py"),
    "walkthrough": Figure(pages=("walkthrough.md",), command="figure_walkthrough.py"),
    "bound": Figure(pages=("errata.md",), command="bound_table.py"),
    "clean": Figure(pages=("accuracy.md",), command="clean_renders.py --count 100", tables=("clean",)),
    "basin": Figure(pages=("tracking.md",), command="basin.py", tables=("basin",)),
    "repair": Figure(pages=("assembly.md",), command="figure_repair.py"),
    "assembly": Figure(pages=("assembly.md",), command="bench_assembly.py", last=True),
    "calibration": Figure(pages=("calibration.md",), command="figure_calibration.py"),
    "paint": Figure(pages=("paint-design.md",), command="figure_paint_design.py"),
    "wear": Figure(pages=("map.md",), command="figure_wear_series.py"),
    "differentiable": Figure(pages=("differentiable.md",), command="example_differentiable.py"),
    "cold": Figure(pages=("accuracy.md",), command=f"cold_start.py {SHARED}/experiment", tables=("cold",)),
    "faults": Figure(pages=("long-runs.md",), command="faults.py", tables=("faults",)),
    "paper-method": Figure(
        pages=("accuracy.md",),
        command=f"accuracy.py {SHARED}/experiment --method paper --no-synth",
        tables=("paper-method",),
    ),
    "robustness": Figure(
        pages=("robustness.md",), command="bench_robustness.py --out out/robustness", keeps="robustness"
    ),
    "levels": Figure(
        pages=("robustness.md",),
        command="sphereorient bench robustness --levels 2,4 --out out/levels",
        keeps="levels",
    ),
    "accuracy": Figure(
        pages=("accuracy.md",),
        command=f"accuracy.py {SHARED}/experiment {SHARED}/tank {SHARED}/gloss --benchmark out/robustness/results.json",
        tables=("accuracy", "stated"),
        last=True,
    ),
    "stated-parts": Figure(
        pages=("accuracy.md",),
        command=f"stated_errors.py {SHARED} --only sets movies both stills",
        tables=("stated-sets", "stated-one", "stated-two", "stated-stills"),
        keeps="stated",
    ),
    "stills": Figure(pages=("robustness.md",), command="single_stills.py --stills 3"),
    "limits": Figure(pages=("robustness.md",), command="light_limits.py", tables=("limits",)),
    "density": Figure(pages=("robustness.md",), command="sphereorient bench balls --out out/balls", keeps="balls"),
    "several": Figure(pages=("tracking.md", "map.md"), command=f"several_balls.py {SHARED}/swarm", tables=("several",)),
    "reliability": Figure(pages=("robustness.md",), command="reliability.py", keeps="reliability"),
    "cameras": Figure(
        pages=("accuracy.md", "errors.md"),
        command=f"port_or_not.py {SHARED}/tank --figure docs/port_or_not.png",
        tables=("cameras",),
    ),
    "plates": Figure(pages=("accuracy.md",), command=f"plate_pictures.py {SHARED}/experiment"),
    "bumped": Figure(pages=("accuracy.md",), command=f"self_calibration.py {SHARED}/experiment"),
    "memory": Figure(
        pages=("accuracy.md",),
        command=f"bench_memory.py {SHARED}/experiment/experiment.yaml --times 1 5 10",
        last=True,
    ),
    "long": Figure(
        pages=("long-runs.md",), command="bench_long.py out/long/experiment.yaml --frames 15000 --jobs 1", last=True
    ),
    "departures": Figure(pages=("paper-map.md",), command=f"paper_departures.py {SHARED}/experiment"),
    "backgrounds": Figure(pages=("paper-map.md",), command=f"compare_backgrounds.py {SHARED}/experiment"),
    "search": Figure(pages=("accuracy.md",), command=f"bench_search.py {SHARED}/experiment", last=True),
    "speed": Figure(pages=("precise.md",), command=f"bench_speed.py {SHARED}/experiment", last=True),
    "proposer": Figure(pages=("proposer.md",), command="bench_proposer.py --docs", last=True),
    "designs": Figure(
        pages=("proposer.md",), command="proposer_designs.py --minutes 5", tables=("designs",), last=True
    ),
    "learnt-path": Figure(pages=("assembly.md",), command="learn_path.py"),
    "learnt-path-honest": Figure(pages=("assembly.md",), command="learn_path.py --honest"),
    "maps": Figure(pages=("map.md",), command="map_accuracy.py", tables=("maps", "fictrac", "old")),
    "map-figures": Figure(pages=("map.md",), command="figure_map.py"),
    "photographs": Figure(
        pages=("map.md",),
        command="photographs.py --moves --pairs-only --diameter 120 --sets 9 --counts 8 10 12 16 20 30",
    ),
    "photographs-maps": Figure(pages=("map.md",), command="photographs.py --moves --counts 12 30 --sets 3"),
    "fly": Figure(pages=("map.md",), command="real_fictrac.py"),
    "fictrac-axes": Figure(pages=("fictrac.md",), command="fictrac_axes.py"),
    "scenes": Figure(pages=("fictrac.md",), command="sphereorient bench ball --out out/ball", keeps="ball"),
    "minute": Figure(
        pages=("fictrac.md",),
        command="sphereorient bench ball --scenes clean_fly,noisy --frames 6000 --out out/minute",
        keeps="minute",
    ),
    "dots": Figure(pages=("photographs.md",), command="real_spindoe.py"),
    "moon": Figure(pages=("moon.md",), command=f"moon.py {SHARED}/real/moon", tables=("moon",)),
    "statistics": Figure(pages=("statistics.md",), command="ensemble_coverage.py"),
    "tests": Figure(pages=("statistics.md",), command="statistics_tests.py"),
    "long-report": Figure(pages=("report.md",), command="bench_report.py out/long-report"),
    "report": Figure(pages=("report.md", "walkthrough.md"), command="figure_report.py"),
    "live-faults": Figure(pages=("live.md",), command=f"live_faults.py {SHARED}/fixed_ball/experiment.yaml", last=True),
    "closed-loop": Figure(pages=("live.md",), command="closed_loop.py", last=True),
    "live": Figure(
        pages=("live.md",),
        command=f"sphereorient bench live {SHARED}/experiment/experiment.yaml --cameras cam1"
        " --rate 200,300,400,500 --load 1 --loop --seconds 30",
        last=True,
    ),
    "paper": Figure(pages=("paper.md",), command="reproduce_paper.py --out out/paper --docs"),
}


@dataclass(frozen=True)
class Made:
    """A row of docs/figures.md."""

    date: str = ""
    commit: str = ""
    cpu_s: str = ""
    code: str = ""  # the digest of the code that made it


def code_of(figure: Figure) -> str:
    """Return a digest of the code that a figure measures."""
    program = figure.command.split()[0]
    cli = kept.rooms.modules()["cli.app"]
    return kept.digest(kept.code_of([cli if program == "sphereorient" else kept.SCRIPTS / program]))


def rows() -> dict[str, Made]:
    """Return the row of each figure in docs/figures.md."""
    text = PAGE.read_text("utf-8") if PAGE.is_file() else ""
    found = re.findall(r"^\| (\S+) \| .* \| (\S*) \| (\S*) \| (\S*) \| (\w*)[^|]*\|$", text, re.MULTILINE)
    return {name: Made(*cells) for name, *cells in found}


def cpu_name() -> str:
    """Return name, family and model of the CPU, and the number of cores."""
    info = Path("/proc/cpuinfo")
    found = dict(re.findall(r"^([\w ]+?)\s*: (.*)$", info.read_text() if info.is_file() else "", re.MULTILINE))
    name = found.get("model name", platform.processor())
    numbers = [f"{key} {found[key]}" for key in ("cpu family", "model", "stepping") if key in found]
    return ", ".join([name, *numbers, f"{os.cpu_count()} cores"])


def write_page(made: dict[str, Made]) -> None:
    """Write docs/figures.md."""
    now = {name: code_of(figure) for name, figure in FIGURES.items()}
    older = [name for name, code in now.items() if made.get(name, Made()).code != code]
    lines = [
        "# Where the numbers of these pages come from",
        "",
        "Written by `scripts/figures.py`, which makes the tables and figures of these pages anew; `--only NAME` one of",
        "them. `code` is a digest of the code that made a figure; if that has changed, the figure is *older*.",
        "",
        f"**{len(FIGURES)} figures, {len(older)} of them older than the code that they measure.** CPU of the last one:",
        f"{cpu_name()}.",
        "",
        HEAD,
        "|---" * 7 + "|",
    ]
    for name, figure in FIGURES.items():
        row = made.get(name, Made())
        pages = ", ".join(f"[{page}]({page})" for page in figure.pages)
        mark = " *older*" if name in older else ""
        lines.append(
            f"| {name} | {pages} | `{figure.command}` | {row.date} | {row.commit} | {row.cpu_s} | {row.code}{mark} |"
        )
    write_text(PAGE, "\n".join(["<!-- made by sphereorient -->", *lines, ""]))


def make(name: str, figure: Figure, threads: int | None = None) -> tuple[Made, list[str]]:
    """Run the command of a figure; return its row and the tables that it prints. Raises RuntimeError: it failed."""
    program, *arguments = shlex.split(figure.command)
    place = Path(sys.executable).with_name(program) if program == "sphereorient" else kept.SCRIPTS / program
    command = [str(place), *arguments] if program == "sphereorient" else [sys.executable, str(place), *arguments]
    environment = os.environ | ({} if threads is None else {"OMP_NUM_THREADS": str(threads)})
    OUT.mkdir(parents=True, exist_ok=True)
    code = code_of(figure)  # before the run: a file that changes meanwhile is not what was measured
    if figure.keeps:
        remove_older(OUT.parent / figure.keeps, code)
    with (OUT / f"{name}.md").open("w+", encoding="utf-8") as file:
        run = subprocess.Popen(command, cwd=REPO, stdout=file, env=environment)
        _, status, used = os.wait4(run.pid, 0)
        run.returncode = os.waitstatus_to_exitcode(status)
        file.seek(0)
        printed = tables_of(file.read())
    if run.returncode:
        raise RuntimeError(f"{name}: {figure.command} ended with {run.returncode}; see above")
    if len(printed) < len(figure.tables):
        raise RuntimeError(f"{name}: expected {len(figure.tables)} tables, got {len(printed)}")
    cpu_s = f"{used.ru_utime + used.ru_stime:.0f}"
    return Made(time.strftime("%Y-%m-%d"), kept.commit(), cpu_s, code), printed


def remove_older(folder: Path, code: str) -> None:
    """Remove a folder whose parts other code has made; write which code makes them now."""
    if folder.is_dir() and kept.known(folder).get("code") != code:
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    kept.note(folder, code=code)


def tables_of(text: str) -> list[str]:
    """Return the Markdown tables of a text."""
    return [found.strip() for found in re.findall(r"(?:^\|.*\n?)+", text, re.MULTILINE)]


def insert(page: Path, mark: str, table: str) -> None:
    """Put a table between the marks of a page. Raises RuntimeError: the page lacks them."""
    text = page.read_text("utf-8")
    pattern = rf"(<!-- figure {re.escape(mark)} -->\n).*?(<!-- end {re.escape(mark)} -->)"
    if len(re.findall(pattern, text, re.DOTALL)) != 1:
        raise RuntimeError(f"{page}: expected one pair of marks of figure {mark}")
    page.write_text(re.sub(pattern, lambda found: f"{found[1]}{table}\n{found[2]}", text, flags=re.DOTALL), "utf-8")


def main() -> None:
    """Read the options; make, or list."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=list(FIGURES), default=None)
    parser.add_argument("--jobs", type=int, default=1, help="figures at a time, each on one thread if more than one")
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    made = rows()
    older = [name for name, figure in FIGURES.items() if made.get(name, Made()).code != code_of(figure)]
    if options.list:
        print("\n".join(f"{name:20} {'older' if name in older else 'as now'}" for name in FIGURES))
        sys.exit(bool(older))
    lock, failed = Lock(), []

    def one(name: str, threads: int | None = None) -> None:
        print(f"{name}: {FIGURES[name].command}", file=sys.stderr, flush=True)
        try:
            row, printed = make(name, FIGURES[name], threads)
            with lock:
                for mark, table in zip(FIGURES[name].tables, printed, strict=False):
                    insert(DOCS / FIGURES[name].pages[0], mark, table)
                write_page(rows() | {name: row})  # another call may have added its rows meanwhile
        except RuntimeError as error:  # the others go on
            failed.append(str(error))

    wanted = options.only or older
    with ThreadPoolExecutor(options.jobs) as pool:
        threads = 1 if options.jobs > 1 else None
        list(pool.map(lambda name: one(name, threads), [name for name in wanted if not FIGURES[name].last]))
    for name in wanted:
        if FIGURES[name].last:
            one(name)
    write_page(rows())
    sys.exit("figures.py: " + "\n".join(failed) if failed else 0)


if __name__ == "__main__":
    main()
