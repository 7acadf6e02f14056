"""Figure and table of the robustness benchmark."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sphereorient.bench.results import Results, ResultSummary, summaries
from sphereorient.bench.scenes import CLEAN
from sphereorient.report.plots.style import new_figure, plain_logarithms
from sphereorient.report.tables import write_csv
from sphereorient.synth.severities import DEGRADATIONS

COLUMNS = 5
PANEL = 2.6, 2.5  # inches
LOOKS = (("#0072B2", "-", "o"), ("#D55E00", "--", "s"), ("#009E73", "-.", "^"), ("#CC79A7", ":", "v"))
LEAST_DEG, MOST_DEG = 3e-3, 180.0


def robustness_figure(results: Results) -> Figure:
    """Draw errors and bad frames (above 10 degrees, or lost) against severity, a panel per degradation; without any,
    those of the clean scenes.
    """
    lines = summaries(results)
    kinds = worst_first(lines, results.methods) or [CLEAN]
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
    _plain_axes(above, below)


def _plain_axes(*panels: Any) -> None:
    for axes in panels:
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)


def density_figure(runs: Sequence[Results]) -> Figure:
    """Draw errors and shares of frames against the number density of balls, a curve per number of cameras."""
    figure = new_figure(3 * PANEL[0] + 1.0, PANEL[1] + 0.9)
    turn, place, shares = figure.subplots(1, 3)
    for k, cameras in enumerate(sorted({run.settings.cameras for run in runs})):
        own = sorted((run for run in runs if run.settings.cameras == cameras), key=lambda run: run.settings.per_litre)
        lines, x = [summaries(run)[0] for run in own], [run.settings.per_litre for run in own]
        colour, style, marker = LOOKS[k]
        drawn: dict[str, Any] = {"color": colour, "linestyle": style}
        for axes, unit in ((turn, "deg"), (place, "mm")):
            p50, p95 = ([getattr(line, f"{part}_{unit}") for line in lines] for part in ("p50", "p95"))
            axes.plot(x, p50, marker=marker, ms=4, label=f"{cameras} cameras, median", **drawn)
            axes.plot(x, p95, lw=0.8, label=f"{cameras} cameras, 95 %", **drawn)
        shares.plot(x, [100 * line.lost for line in lines], marker=marker, ms=4, label="lost", **drawn)
        shares.plot(x, [100 * line.given for line in lines], marker="x", lw=0.8, label="given to another", **drawn)
        shares.plot(x, [100 * line.hidden for line in lines], lw=0.8, alpha=0.5, label="more than half hidden", **drawn)
    for axes, what in ((turn, "orientation error (degrees)"), (place, "position error (mm)")):
        axes.set_yscale("log")
        plain_logarithms(axes.yaxis)
        axes.set_ylabel(what, fontsize=8)
    shares.set_ylabel("share of the frames (%)", fontsize=8)
    shares.set_ylim(0, max(5.0, shares.get_ylim()[1]))
    balls = sorted({(run.settings.per_litre, run.settings.balls) for run in runs})
    for axes in (turn, place, shares):
        axes.set_xlabel("balls per litre", fontsize=8)
        above = axes.secondary_xaxis("top")
        above.set_xticks([density for density, _ in balls], [str(count) for _, count in balls], fontsize=7)
        above.set_xlabel("balls", fontsize=8)
    _plain_axes(turn, place, shares)
    handles, names = turn.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=4, fontsize=8, frameon=False)
    handles = shares.get_legend_handles_labels()[0][:3]
    shares.legend(handles=handles, fontsize=7)
    return figure


def level_labels(kind: str, levels: Sequence[int]) -> list[str]:
    """Return the values of a degradation at some levels as text."""
    if kind not in DEGRADATIONS:
        return [str(level) for level in levels]
    return [f"{DEGRADATIONS[kind].values[level - 1]:g}" for level in levels]


def unit_of(kind: str) -> str:
    """Return the unit of a degradation's values."""
    return DEGRADATIONS[kind].unit if kind in DEGRADATIONS else "severity of each"


def write_table(runs: Sequence[Results], path: Path) -> None:
    """Write the summaries of runs as CSV, whole or not at all."""
    rows: list[dict[str, Any]] = [
        {"cameras": run.settings.cameras, "balls": run.settings.balls, "per_litre": run.settings.per_litre}
        | asdict(line)
        for run in runs
        for line in summaries(run)
    ]
    for row in rows:
        row |= {f"recall_{first}": share for first, share in row.pop("recall").items()}
    write_csv(rows, path)
