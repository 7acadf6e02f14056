"""Figure and table of the robustness benchmark."""

import csv
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sphereorient.evaluate.robustness.results import Results, ResultSummary, summaries
from sphereorient.evaluate.robustness.scenes import CLEAN, TOGETHER
from sphereorient.files.whole_file import put_aside
from sphereorient.report.columns import plain_cell
from sphereorient.report.plots.style import new_figure
from sphereorient.synth.severities import DEGRADATIONS

COLUMNS = 5
PANEL = 2.6, 2.5  # inches
LOOKS = (("#0072B2", "-", "o"), ("#D55E00", "--", "s"), ("#009E73", "-.", "^"), ("#CC79A7", ":", "v"))
LEAST_DEG, MOST_DEG = 3e-3, 180.0


def robustness_figure(results: Results) -> Figure:
    """Draw errors and bad frames (above 10 degrees, or lost) against severity, a panel for each degradation."""
    lines = summaries(results)
    kinds = worst_first(lines, results.methods)
    rows = math.ceil(len(kinds) / COLUMNS)
    figure = new_figure(COLUMNS * PANEL[0], rows * PANEL[1] + 0.6)
    parts = np.ravel(figure.subfigures(rows, COLUMNS, squeeze=False))
    for place, (part, kind) in enumerate(zip(parts, kinds, strict=False)):
        _panel(part, kind, [line for line in lines if line.kind == kind], results.methods, place % COLUMNS == 0)
    handles, names = parts[0].axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=len(names), fontsize=9, frameon=False)
    return figure


def worst_first(lines: Sequence[ResultSummary], methods: Sequence[str]) -> list[str]:
    """Return the degradations, sorted by bad frames, then by error, of the first method."""

    def hardness(kind: str) -> tuple[float, float]:
        own = [line for line in lines if line.kind == kind and line.method == methods[0]]
        bad = max((line.wrong_after + line.lost for line in own), default=0.0)
        error = max((line.p95_deg for line in own if math.isfinite(line.p95_deg)), default=MOST_DEG)
        return -bad, -error

    return sorted(dict.fromkeys(line.kind for line in lines if line.kind != CLEAN), key=hardness)


def _panel(part: Any, kind: str, lines: Sequence[ResultSummary], methods: Sequence[str], first: bool) -> None:
    above, below = part.subplots(2, 1, sharex=True, height_ratios=(2.2, 1), gridspec_kw={"hspace": 0.08})
    levels = sorted({line.level for line in lines})
    for k, method in enumerate(methods):
        colour, style, marker = LOOKS[k % len(LOOKS)]
        own = sorted((line for line in lines if line.method == method), key=lambda line: line.level)
        x, p50, p95 = ([getattr(line, key) for line in own] for key in ("level", "p50_deg", "p95_deg"))
        above.plot(x, p50, style, color=colour, marker=marker, ms=4, label=f"{method}, median")
        above.plot(x, p95, style, color=colour, lw=0.8, alpha=0.8, label=f"{method}, 95 %")
        share = [100 * (line.wrong_after + line.lost) for line in own]
        below.plot(x, share, style, color=colour, marker=marker, ms=4, clip_on=False)
    above.set(yscale="log", ylim=(LEAST_DEG, MOST_DEG), yticks=[0.01, 0.1, 1, 10, 100])
    above.set_yticklabels(["0.01", "0.1", "1", "10", "100"])
    below.set(ylim=(0, 100), yticks=[0, 50, 100], xticks=levels)
    below.set_xticklabels(level_labels(kind, levels), fontsize=7)
    below.set_xlabel(unit_of(kind), fontsize=8)
    above.set_title(kind.replace("_", " "), fontsize=9, pad=3)
    if first:
        above.set_ylabel("error (degrees)", fontsize=8)
        below.set_ylabel("wrong or\nlost (%)", fontsize=8)
    for axes in (above, below):
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)


def level_labels(kind: str, levels: Sequence[int]) -> list[str]:
    """Return the values of a degradation at some levels as text."""
    if kind == TOGETHER:
        return [str(level) for level in levels]
    return [f"{DEGRADATIONS[kind].values[level - 1]:g}" for level in levels]


def unit_of(kind: str) -> str:
    """Return the unit of a degradation's values."""
    return "severity of each" if kind == TOGETHER else DEGRADATIONS[kind].unit


def write_table(results: Results, path: Path) -> None:
    """Write the summaries as CSV, whole or not at all."""
    rows = [asdict(line) for line in summaries(results)]
    for row in rows:
        row |= {f"recall_{first}": share for first, share in row.pop("recall").items()}
    with put_aside(path) as aside, aside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: plain_cell(value) for name, value in row.items()} for row in rows)
