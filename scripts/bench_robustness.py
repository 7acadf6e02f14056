"""Run the robustness benchmark and put its figures into the docs.

    scripts/bench_robustness.py [--out out/robustness] [--full] [--jobs 2]

Does the same as `sphereorient bench robustness`; also writes docs/robustness.png, the table in docs/robustness.md and
docs/robustness-baseline.json, the reference of later runs, and prints where `precise` is not better than `paper`, and
the calibration of the confidence. Half an hour on two cores; an interrupted run continues.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sphereorient.bench import BenchSettings, Results, SceneResult, run_benchmark
from sphereorient.bench.figures import robustness_figure, write_table
from sphereorient.bench.results import WRONG_DEG, ResultSummary, save_results, summaries
from sphereorient.bench.scenes import CLEAN, FULL, TOGETHER
from sphereorient.cli.app import progress_bar
from sphereorient.files.whole_file import writing
from sphereorient.learn.metrics import reliability
from sphereorient.report.plots.style import write_figure

DOCS = Path(__file__).resolve().parents[1] / "docs"
BEGIN, END = "<!-- table: scripts/bench_robustness.py -->", "<!-- end of the table -->"


def main() -> None:
    """Read the options, run, write, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=DOCS.parent / "out" / "robustness")
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    options.out.parent.mkdir(exist_ok=True)
    settings = FULL if options.full else BenchSettings()
    with progress_bar(unit="") as advance:
        found = run_benchmark(options.out, settings, jobs=options.jobs, progress=lambda *at: advance("scenes", *at))
    figure = robustness_figure(found)
    with writing(force=True):
        write_table([found], options.out / "results.csv")
        write_figure(figure, options.out / "robustness")
    (DOCS / "robustness.png").write_bytes((options.out / "robustness.png").read_bytes())
    save_results(found, DOCS / "robustness-baseline.json")
    page = DOCS / "robustness.md"
    text = page.read_text("utf-8")
    head, tail = text.split(BEGIN)[0], text.split(END)[1]
    page.write_text(f"{head}{BEGIN}\n{markdown(found)}{END}{tail}", "utf-8")
    print_methods(found)
    print_confidence([one for one in found.outcomes if one.method == "precise"])


def markdown(results: Results) -> str:
    """Return the table of docs/robustness.md: median error and bad frames of each method and level by degradation."""
    lines = {(line.kind, line.level, line.method): line for line in summaries(results)}
    levels = sorted({level for kind, level, _ in lines if kind != CLEAN})
    head = ["degradation", *(f"{method}, level {level}" for method in results.methods for level in levels)]
    text = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for kind in dict.fromkeys(kind for kind, _, _ in lines):
        own = [0] + [-1] * (len(levels) - 1) if kind == CLEAN else levels  # clean movies have one level
        cells = [_cell(lines.get((kind, level, method))) for method in results.methods for level in own]
        text.append(f"| {kind.replace('_', ' ')} | {' | '.join(cells)} |")
    return "\n".join(text) + "\n"


def _cell(line: ResultSummary | None) -> str:
    if line is None:
        return ""
    if not math.isfinite(line.p50_deg):
        return "refused" if line.refused else "nothing"
    bad_ones = f" ({100 * line.wrong_after:.0f}, {100 * line.lost:.0f})" if bad(line) else ""
    return f"{line.p50_deg:.3g}{bad_ones}"


def print_methods(found: Results) -> None:
    """Print in how many degradations and levels `precise` is better than `paper`."""
    lines = {(line.kind, line.level, line.method): line for line in summaries(found) if line.kind != CLEAN}
    places = [key[:2] for key in lines if key[2] == "precise"]
    nearer, steadier = [], []
    for place in places:
        precise, paper = lines[(*place, "precise")], lines[(*place, "paper")]
        nearer.append(is_nearer(precise, paper))
        steadier.append(bad(precise) < bad(paper) or bad(precise) == 0)
        if not (nearer[-1] and steadier[-1]):
            print(
                f"{place[0]} {place[1]}: precise {precise.p50_deg:.3g} degrees, {100 * bad(precise):.0f} % wrong or "
                f"lost; paper {paper.p50_deg:.3g}, {100 * bad(paper):.0f} %; {precise.refused[:100]}"
            )
    print(f"precise has the smaller median error in {sum(nearer)} of {len(places)} places,")
    print(f"and fewer frames wrong or lost, or none, in {sum(steadier)} of {len(places)}")


def is_nearer(precise: ResultSummary, paper: ResultSummary) -> bool:
    """Return whether `precise` has the smaller median error, or the only one."""
    return bool(precise.p50_deg < paper.p50_deg or (np.isfinite(precise.p50_deg) and np.isnan(paper.p50_deg)))


def bad(line: ResultSummary) -> float:
    """Return the share of frames wrong or lost."""
    return line.wrong_after + line.lost


def print_confidence(outcomes: Sequence[SceneResult]) -> None:
    """Print the calibration of the confidence."""
    for name, chosen in (("mixed scenes", [one for one in outcomes if one.kind == TOGETHER]), ("all", outcomes)):
        pairs = [
            (claimed, error <= WRONG_DEG)
            for one in chosen
            for claimed, error in zip(one.confidence, one.errors_deg.tolist(), strict=True)
            if claimed is not None and np.isfinite(error)
        ]
        if pairs:
            claimed, right = (np.array(x) for x in zip(*pairs, strict=True))
            found = reliability(claimed.astype(float), right.astype(bool))
            print(f"confidence, {name}: {len(pairs)} frames, expected calibration error {found.error:.4f}")


if __name__ == "__main__":
    main()
