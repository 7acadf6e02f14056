"""Figures of a learnt map: what was learnt from where, whether it explains the pictures, how far paint moved."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.experiment import Experiment
from sphereorient.files.outputs import put_aside
from sphereorient.mapping import LearntMap
from sphereorient.mapping.compare import MapComparison
from sphereorient.report.overlay import pictures_at, prepared
from sphereorient.report.overlay_model import crop
from sphereorient.report.overlay_page import crop_side
from sphereorient.report.plots.marks import note
from sphereorient.report.plots.style import DPI, WIDTH_IN, in_style, new_figure
from sphereorient.trajectory import Trajectory

EXAMPLES = 6  # frames that are shown
COMPARED = 200  # frames at most whose pictures are compared with the model
UNSEEN = "#C9B48A"  # sand: no grey, so nobody takes it for paint
REACH = 0.5  # of white less black paint: the ends of the residual's scale
SLANT = 0.3  # cosine of the angle of sight below which pixels are not compared: light falls off as it likes there
LEAST_ARROW_DEG = 4.0  # length on the page of the largest arrow, in degrees of the map
ARROW = "#D0021B"
CHANGE_REACH = 0.3  # of white less black: ends of the scale of what changed


@dataclass(frozen=True, kw_only=True, eq=False)
class Example:
    """A picture, and what the map says that it must look like."""

    title: str
    filmed: NDArray[np.float32]  # (S, S), grey levels
    model: NDArray[np.float32]  # (S, S), NaN beside the ball
    contrast: float  # white less black paint, grey levels
    correlation: float  # over the ball


def compare_pictures(track: Trajectory, experiment: Experiment, texture: Path) -> list[Example]:
    """Render what the cameras must have seen, and compare; hidden places are left out.

    Args:
        track: with the attitudes.
        experiment: that it is of.
        texture: the map's file.

    Returns:
        Frames spread over the movie, camera by camera in each.
    """
    compared = []
    with ExitStack() as opened:
        page, streams = prepared(track, replace(experiment, texture_path=texture), None, opened)
        rows = np.flatnonzero(track.valid)
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(COMPARED, len(rows))).round().astype(int))]
        readers = [pictures_at(stream, rows) for stream in streams.values()]
        for k, *pictures in zip(rows.tolist(), *readers, strict=True):
            for view, picture in zip(page.views, pictures, strict=True):
                if picture is None or view.light is None:
                    continue
                window = view.model.window(k, view.half_px, crop_side(view.half_px))
                seen, filmed = view.model.look(k, window), crop(picture, window)
                model = view.light.picture(seen, filmed)
                with np.errstate(invalid="ignore"):
                    good = np.isfinite(model) & np.isfinite(filmed) & (seen.basis[..., 3] > SLANT)
                shown = streams[view.name].shown
                if shown is not None:
                    good &= crop((255 * shown).astype(np.uint8), window) > 254
                alike = float(np.corrcoef(filmed[good], model[good])[0, 1]) if good.sum() > 8 else float("nan")
                compared.append(
                    Example(
                        title=f"{view.name}, frame {int(page.numbers[k])}",
                        filmed=filmed,
                        model=model,
                        contrast=view.light.contrast,
                        correlation=alike,
                    )
                )
    return compared


@in_style
def map_figure(learnt: LearntMap, compared: Sequence[Example]) -> Figure:
    """Draw map, coverage, attitudes' rounds, and examples of picture, model and residual."""
    figure = new_figure(WIDTH_IN, 8.2)
    grid = figure.add_gridspec(4, EXAMPLES, height_ratios=[2.6, 1.0, 1.0, 1.0])
    top = grid[0, :].subgridspec(2, 2, width_ratios=[2, 1])
    paint = figure.add_subplot(top[:, 0])
    _draw_map(paint, learnt)
    _draw_counts(figure, figure.add_subplot(top[0, 1]), learnt)
    _draw_rounds(figure.add_subplot(top[1, 1]), learnt)
    chosen = [compared[k] for k in np.linspace(0, len(compared) - 1, min(EXAMPLES, len(compared))).round().astype(int)]
    for column, example in enumerate(chosen):
        _draw_example([figure.add_subplot(grid[row, column]) for row in (1, 2, 3)], example, column == 0)
    note(
        figure,
        "Map: longitude to the right, latitude upwards, as seen from outside; sand where no picture shows the ball. "
        "Examples: as filmed, as the map says that it must look, and the difference, red where the picture is "
        f"brighter; full colour is {REACH:g} of the step from black to white paint.",
    )
    return figure


def _draw_map(axes: Axes, learnt: LearntMap) -> None:
    equirectangular(axes)
    axes.set_facecolor(UNSEEN)
    grey = np.ma.masked_invalid(learnt.texture.numpy())
    axes.imshow(grey, cmap="gray", vmin=0, vmax=1, extent=(-180, 180, -90, 90), interpolation="nearest")
    axes.set_title("the map of the paint")


def _draw_counts(figure: Figure, axes: Axes, learnt: LearntMap) -> None:
    equirectangular(axes)
    axes.set_facecolor(UNSEEN)
    counts = np.ma.masked_less(learnt.seen.numpy(), 1)
    most = max(int(learnt.seen.max()), 2)
    shown = axes.imshow(counts, cmap="viridis", norm=LogNorm(1, most), extent=(-180, 180, -90, 90))
    bar = figure.colorbar(shown, ax=axes, shrink=0.8)
    ticks = [tick for tick in (1, 3, 10, 30, 100, 300, 1000, 3000) if tick <= most]
    bar.set_ticks(ticks, labels=[str(tick) for tick in ticks])
    bar.minorticks_off()
    axes.set_title("pictures that show it")
    axes.set_xlabel("")


def _draw_rounds(axes: Axes, learnt: LearntMap) -> None:
    moved = np.rad2deg([one.moved_rad for one in learnt.rounds])
    axes.semilogy(np.arange(1, len(moved) + 1), moved, color="black", marker="o")
    axes.set(xlabel="round", ylabel="degrees")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_title("attitudes' moves, rms")


def _draw_example(rows: Sequence[Axes], example: Example, first: bool) -> None:
    known = example.filmed[np.isfinite(example.filmed)]
    low, high = np.percentile(known, (0.5, 99.8)) if known.size else (0.0, 1.0)
    residual = (example.filmed - example.model) / example.contrast
    for axes, title in zip(rows, ("picture", "re-rendered", "difference"), strict=True):
        axes.set(xticks=[], yticks=[])
        axes.grid(visible=False)
        if first:
            axes.set_ylabel(title)
    rows[0].imshow(example.filmed, cmap="gray", vmin=low, vmax=high)
    rows[0].set_title(example.title, fontsize=7)
    rows[1].set_facecolor(UNSEEN)
    rows[1].imshow(np.ma.masked_invalid(example.model), cmap="gray", vmin=low, vmax=high)
    rows[2].imshow(np.ma.masked_invalid(residual), cmap="RdBu_r", vmin=-REACH, vmax=REACH)
    rows[2].set_xlabel(f"correlation {example.correlation:.3f}", fontsize=7)


def equirectangular(axes: Axes) -> None:
    """Make axes of a map, longitude to the right and latitude upwards, degrees."""
    axes.set(xlim=(-180, 180), ylim=(-90, 90), xticks=[-180, -90, 0, 90, 180], yticks=[-90, -45, 0, 45, 90])
    axes.set(xlabel="longitude (degrees)", aspect="equal")
    axes.grid(visible=False)


@in_style
def moved_figure(texture: Tensor, comparison: MapComparison, change: Tensor | None = None) -> Figure:
    """Draw how far paint lies from where a reference has it, and where the paint itself changed.

    Args:
        texture: (H, 2 H), the reference.
        comparison: of another map with it.
        change: (H, 2 H), of `paint_change`; None: not drawn.
    """
    figure = new_figure(WIDTH_IN, 4.3 if change is None else 7.7)
    panels = figure.subplots(1 if change is None else 2, 1, squeeze=False)[:, 0]
    axes = panels[0]
    equirectangular(axes)
    axes.set_facecolor(UNSEEN)
    grey = np.ma.masked_invalid(texture.numpy())
    axes.imshow(0.55 + 0.45 * grey, cmap="gray", vmin=0, vmax=1, extent=(-180, 180, -90, 90))
    times = _draw_arrows(axes, comparison)
    axes.set_title("how far the paint lies from where the old map has it")
    if change is not None:
        _draw_change(figure, panels[1], change)
    count = len(comparison.length_rad)
    sizes = "no patch could be located"
    if count:
        rms, most = np.rad2deg([comparison.rms_rad, comparison.max_rad])
        sizes = f"{count} patches located: {rms:.2f}° rms, {most:.2f}° at most; arrows {times:g} times as long"
    words = ""
    if change is not None:
        words = " Below: how much brighter (red) or darker (blue) than all that the old map has within 1°; 1 is white."
    note(figure, f"{sizes}, from where the old map has a patch to where it is. Sand: unknown.{words}")
    return figure


def _draw_arrows(axes: Axes, comparison: MapComparison) -> float:
    """Draw the displacements, and return how much longer than they are."""
    known = torch.isfinite(comparison.moved_rad).all(-1)
    if not known.any():
        return 1.0
    x, y, z = comparison.direction_body[known].unbind(-1)
    longitude, latitude = torch.atan2(y, x), torch.asin(z.clamp(-1, 1))
    moved = torch.rad2deg(comparison.moved_rad[known])
    largest = float(moved.norm(dim=-1).quantile(0.95).clamp_min(1e-6))
    steps = (1, 2, 5, 10, 20, 50)
    times = max([step for step in steps if step * largest <= 2 * LEAST_ARROW_DEG], default=1)
    # East is stretched by the map away from the equator.
    along = moved[:, 0] / latitude.cos().clamp_min(0.1)
    axes.quiver(
        *(torch.rad2deg(part).numpy() for part in (longitude, latitude)),
        *(times * part.numpy() for part in (along, moved[:, 1])),
        angles="xy",
        scale_units="xy",
        scale=1,
        color=ARROW,
        width=0.0022,
        headwidth=4,
        headlength=4.5,
    )
    return float(times)


def _draw_change(figure: Figure, axes: Axes, change: Tensor) -> None:
    equirectangular(axes)
    axes.set_facecolor(UNSEEN)
    values = np.ma.masked_invalid(change.numpy())
    shown = axes.imshow(values, cmap="RdBu_r", vmin=-CHANGE_REACH, vmax=CHANGE_REACH, extent=(-180, 180, -90, 90))
    figure.colorbar(shown, ax=axes, shrink=0.8, extend="both")
    axes.set_title("where the paint itself changed")


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure; the same figure gives the same bytes.

    Raises:
        OutputError: the file cannot be written.
    """
    with put_aside(path) as aside:
        figure.savefig(aside, dpi=DPI, metadata={"Software": None})
