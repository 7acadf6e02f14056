"""Make the tables and figures of the docs that hold numbers; list those older than the code they measure.

    scripts/figures.py                   # what is older or was never made, in order; a second call goes on
    scripts/figures.py --only NAME ...   # these, in any case
    scripts/figures.py --list            # makes nothing; exits 1 where a figure is older than its code

A command writes its page itself, or prints Markdown whose tables go between the page's marks
`<!-- figure NAME -->` and `<!-- end NAME -->`; what it prints is kept in out/figures. Numbers within sentences are
copied by hand from there. docs/figures.md holds the CPU, and date, commit and CPU time of each figure.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import resource
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

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


FIGURES: dict[str, Figure] = {
    "parameters": Figure(pages=("parameters.md",), command="make_parameters.py"),
    "degradations": Figure(pages=("degradations.md",), command="figure_degradations.py"),
    "conventions": Figure(pages=("conventions.md",), command="figure_conventions.py"),
    "walkthrough": Figure(pages=("walkthrough.md",), command="figure_walkthrough.py"),
    "bound": Figure(pages=("errata.md",), command="bound_table.py"),
    "clean": Figure(pages=("accuracy.md",), command="clean_renders.py --count 100", tables=("clean",)),
    "basin": Figure(pages=("tracking.md",), command="basin.py", tables=("basin",)),
    "repair": Figure(pages=("assembly.md",), command="figure_repair.py"),
    "assembly": Figure(pages=("assembly.md",), command="bench_assembly.py"),
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
    "robustness": Figure(pages=("robustness.md",), command="bench_robustness.py --out out/robustness"),
    "accuracy": Figure(
        pages=("accuracy.md",),
        command=f"accuracy.py {SHARED}/experiment {SHARED}/tank {SHARED}/gloss --benchmark out/robustness/results.json",
        tables=("accuracy", "stated"),
    ),
    "stated-parts": Figure(
        pages=("accuracy.md",),
        command=f"stated_errors.py {SHARED} --only sets movies both stills",
        tables=("stated-sets", "stated-one", "stated-two", "stated-stills"),
    ),
    "stills": Figure(pages=("robustness.md",), command="single_stills.py --stills 3"),
    "limits": Figure(pages=("robustness.md",), command="light_limits.py", tables=("limits",)),
    "density": Figure(pages=("robustness.md",), command="sphereorient bench balls --out out/balls"),
    "reliability": Figure(pages=("robustness.md",), command="reliability.py"),
    "cameras": Figure(
        pages=("accuracy.md", "errors.md"),
        command=f"port_or_not.py {SHARED}/tank --figure docs/port_or_not.png",
        tables=("cameras",),
    ),
    "plates": Figure(pages=("accuracy.md",), command=f"plate_pictures.py {SHARED}/experiment"),
    "bumped": Figure(pages=("accuracy.md",), command=f"self_calibration.py {SHARED}/experiment"),
    "memory": Figure(
        pages=("accuracy.md",), command=f"bench_memory.py {SHARED}/experiment/experiment.yaml --times 1 5 10"
    ),
    "departures": Figure(pages=("paper-map.md",), command=f"paper_departures.py {SHARED}/experiment"),
    "backgrounds": Figure(pages=("paper-map.md",), command=f"compare_backgrounds.py {SHARED}/experiment"),
    "search": Figure(pages=("accuracy.md",), command=f"bench_search.py {SHARED}/experiment"),
    "speed": Figure(pages=("precise.md",), command=f"bench_speed.py {SHARED}/experiment"),
    "proposer": Figure(pages=("proposer.md",), command="bench_proposer.py --docs"),
    "designs": Figure(pages=("proposer.md",), command="proposer_designs.py --minutes 5", tables=("designs",)),
    "learnt-path": Figure(pages=("assembly.md",), command="learn_path.py"),
    "learnt-path-honest": Figure(pages=("assembly.md",), command="learn_path.py --honest"),
    "maps": Figure(pages=("map.md",), command="map_accuracy.py", tables=("maps", "fictrac")),
    "map-figures": Figure(pages=("map.md",), command="figure_map.py"),
    "photographs": Figure(
        pages=("map.md",),
        command="photographs.py --moves --pairs-only --diameter 120 --sets 9 --counts 8 10 12 16 20 30",
    ),
    "photographs-maps": Figure(pages=("map.md",), command="photographs.py --moves --counts 12 30 --sets 3"),
    "fly": Figure(pages=("map.md",), command="real_fictrac.py"),
    "fictrac-axes": Figure(pages=("fictrac.md",), command="fictrac_axes.py"),
    "scenes": Figure(pages=("fictrac.md",), command="sphereorient bench ball --out out/ball"),
    "dots": Figure(pages=("photographs.md",), command="real_spindoe.py"),
    "moon": Figure(pages=("moon.md",), command=f"moon.py {SHARED}/real/moon", tables=("moon",)),
    "statistics": Figure(pages=("statistics.md",), command="ensemble_coverage.py"),
    "tests": Figure(pages=("statistics.md",), command="statistics_tests.py"),
    "long-report": Figure(pages=("report.md",), command="bench_report.py out/long-report"),
    "report": Figure(pages=("report.md", "walkthrough.md"), command="figure_report.py"),
    "live-faults": Figure(pages=("live.md",), command=f"live_faults.py {SHARED}/fixed_ball/experiment.yaml"),
    "closed-loop": Figure(pages=("live.md",), command="closed_loop.py"),
    "live": Figure(
        pages=("live.md",),
        command=f"sphereorient bench live {SHARED}/experiment/experiment.yaml --cameras cam1"
        " --rate 200,300,400,500 --load 1 --loop --seconds 30",
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


def make(name: str, figure: Figure) -> Made:
    """Run the command of a figure and put its tables into their pages."""
    program, *arguments = shlex.split(figure.command)
    place = Path(sys.executable).with_name(program) if program == "sphereorient" else kept.SCRIPTS / program
    command = [str(place), *arguments] if program == "sphereorient" else [sys.executable, str(place), *arguments]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    run = subprocess.run(command, cwd=REPO, stdout=subprocess.PIPE, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if run.returncode:
        raise SystemExit(f"figures.py: {name}: {figure.command} ended with {run.returncode}; see above")
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / f"{name}.md").write_text(run.stdout, "utf-8")
    printed = tables_of(run.stdout)
    if len(printed) < len(figure.tables):
        raise SystemExit(f"figures.py: {name}: expected {len(figure.tables)} tables, got {len(printed)}")
    for mark, table in zip(figure.tables, printed, strict=False):
        insert(DOCS / figure.pages[0], mark, table)
    cpu_s = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return Made(time.strftime("%Y-%m-%d"), kept.commit(), f"{cpu_s:.0f}", code_of(figure))


def tables_of(text: str) -> list[str]:
    """Return the Markdown tables of a text."""
    return [found.strip() for found in re.findall(r"(?:^\|.*\n?)+", text, re.MULTILINE)]


def insert(page: Path, mark: str, table: str) -> None:
    """Put a table between the marks of a page."""
    text = page.read_text("utf-8")
    pattern = rf"(<!-- figure {re.escape(mark)} -->\n).*?(<!-- end {re.escape(mark)} -->)"
    if len(re.findall(pattern, text, re.DOTALL)) != 1:
        raise SystemExit(f"figures.py: {page}: expected one pair of marks of figure {mark}")
    page.write_text(re.sub(pattern, lambda found: f"{found[1]}{table}\n{found[2]}", text, flags=re.DOTALL), "utf-8")


def main() -> None:
    """Read the options; make, or list."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=list(FIGURES), default=None)
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    made = rows()
    older = [name for name, figure in FIGURES.items() if made.get(name, Made()).code != code_of(figure)]
    if options.list:
        print("\n".join(f"{name:20} {'older' if name in older else 'as now'}" for name in FIGURES))
        sys.exit(bool(older))
    for name in options.only or older:
        print(f"{name}: {FIGURES[name].command}", file=sys.stderr, flush=True)
        row = make(name, FIGURES[name])
        write_page(rows() | {name: row})  # another call may have added its rows meanwhile
    write_page(rows())


if __name__ == "__main__":
    main()
