"""Files and figures of a texture map: grey values, pictures per texel, other results, displacement."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.experiment import Experiment
from sphereorient.experiment.recording import TextureMap, spread_frames
from sphereorient.files.picture import write_picture
from sphereorient.files.whole_file import put_aside
from sphereorient.mapping import LearntMap
from sphereorient.pose.worn import worn_share, worn_texels
from sphereorient.report.overlay import pictures_by_row, prepared
from sphereorient.report.overlay_model import contrast, crop, lit_picture
from sphereorient.report.overlay_page import RESIDUAL_REACH, crop_side
from sphereorient.report.plots.style import WIDTH_IN, in_style, new_figure, note
from sphereorient.sphere.compare import MapComparison
from sphereorient.sphere.texture import seen_path, texel_areas
from sphereorient.trajectory import Trajectory

EXTENT = -180, 180, -90, 90  # of the axes of a map, degrees
EXAMPLES = 6  # frames shown
UNSEEN = "#C9B48A"  # sand colour: differs from any paint
ARROW = "#D0021B"
LEARNT = {  # tensors of a learnt map in its file, without a unit
    "texture": "paint, 0 black .. 1 white; NaN where never seen",
    "seen": "pictures that show the texel",
    "sigma": "standard deviation of the paint by noise alone; inf: never seen",
    "paint": "correlation of the paint in pictures held out of the map for it",
    "jumps": "frames with a rotation unlike those before and after",
    "fitted": "frames that the map was fitted to; the others follow them",
}
CHANGE_REACH = 0.3  # of the contrast of white and black paint: ends of the scale of the change


def write_texture(texture: Tensor, path: Path) -> None:
    """Write a texture map (H, 2 H), 0 .. 1 or NaN (mid-grey), as 8-bit picture; may raise OutputError."""
    # Grey of unseen texels in the file.
    grey = torch.where(torch.isfinite(texture), 255 * texture, float(128))
    write_picture(path, grey.round().clamp(0, 255).byte().numpy())


def write_seen(seen: Tensor, texture: Path) -> None:
    """Write counts (H, 2 H) beside a texture map as 8-bit picture, limited to 255; may raise OutputError."""
    write_picture(seen_path(texture), seen.clamp(0, 255).byte().numpy())  # larger counts are clipped


def write_map(found: TextureMap, path: Path) -> None:
    """Write a texture map, and the seen texels beside it; may raise OutputError."""
    unseen = torch.zeros_like(found.grey, dtype=torch.bool) if found.unseen is None else found.unseen
    write_texture(found.grey, path)
    write_seen((~unseen).int(), path)


def write_learnt(learnt: LearntMap, track: Trajectory, path: Path) -> None:
    """Write the orientations as a track, and all other results in its group `map`; may raise OutputError."""
    with put_aside(path, also=(RuntimeError,)) as aside:
        track.save(aside)
        with h5py.File(aside, "a") as file:
            group = file.create_group("map")
            for name, description in LEARNT.items():
                _put(group, name, getattr(learnt, name).numpy(), "1", description)
            if learnt.rounds:
                names = [field.name for field in fields(learnt.rounds[0])]
                table = np.array([[getattr(one, name) for name in names] for one in learnt.rounds], np.float64)
                _put(group, "rounds", table, "as named", f"one row a round: {', '.join(names)}")
            for name, value in (vars(learnt.closure) | {"blur_px": learnt.blur_px, "arrived": learnt.arrived}).items():
                group.attrs[name] = value


def _put(group: h5py.Group, name: str, values: NDArray[np.generic], units: str, description: str) -> None:
    dataset = group.create_dataset(name, data=values, track_times=False, compression="gzip")
    dataset.attrs["units"], dataset.attrs["description"] = units, description


def shares_seen(seen: Tensor, counts: tuple[int, ...]) -> list[float]:
    """Return the shares of the sphere shown in at least so many pictures."""
    area = texel_areas(len(seen))
    return [float((area * (seen >= count)).sum() / area.sum()) for count in counts]


@dataclass(frozen=True, kw_only=True, eq=False)
class MapExample:
    """A picture, and the same rendered with the texture map."""

    title: str
    filmed: NDArray[np.float32]  # (S, S), grey levels
    model: NDArray[np.float32]  # (S, S), NaN outside the sphere
    contrast: float  # white minus black paint, grey levels
    correlation: float  # `LearntMap.paint`


def compare_pictures(learnt: LearntMap, track: Trajectory, experiment: Experiment, texture: Path) -> list[MapExample]:
    """Render frames spread over the movie, held-out ones if any, with a texture map file."""
    compared = []
    column = {view.name: c for c, view in enumerate(learnt.views)}
    with ExitStack() as opened:
        page, streams = prepared(track, experiment.with_sphere(texture_path=texture), None, opened)
        rows = np.flatnonzero(learnt.paint.isfinite().any(1).numpy() & track.valid)
        rows = rows if len(rows) else np.flatnonzero(track.valid)
        for k, pictures in pictures_by_row(streams, rows[spread_frames(range(len(rows)), EXAMPLES)]):
            for view in page.balls[0].views:
                picture = pictures[view.name]
                if picture is None or view.light is None:
                    continue
                window = view.model.window(k, view.half_px, crop_side(view.half_px))
                filmed = crop(picture, window)
                example = MapExample(
                    title=f"{view.name}, frame {int(page.numbers[k])}",
                    filmed=filmed,
                    model=lit_picture(view.light, view.model.look(k, window), filmed),
                    contrast=contrast(view.light),
                    correlation=float(learnt.paint[k, column[view.name]]),
                )
                compared.append(example)
    return compared


@in_style
def map_figure(learnt: LearntMap, compared: Sequence[MapExample]) -> Figure:
    """Draw texture map, coverage, the iterations of the orientations, and examples of picture, model and residual."""
    figure = new_figure(WIDTH_IN, 8.2)
    grid = figure.add_gridspec(4, EXAMPLES, height_ratios=[2.6, 1.0, 1.0, 1.0])
    top = grid[0, :].subgridspec(2, 2, width_ratios=[2, 1])
    draw_map(figure.add_subplot(top[:, 0]), learnt.texture, "texture map", interpolation="nearest")
    axes = figure.add_subplot(top[0, 1])
    most = max(int(learnt.seen.max()), 2)
    counts = torch.where(learnt.seen < 1, torch.nan, learnt.seen.double())
    shown = draw_map(axes, counts, "pictures that show it", cmap="viridis", norm=LogNorm(1, most))
    bar = figure.colorbar(shown, ax=axes, shrink=0.8)
    ticks = [tick for tick in (1, 3, 10, 30, 100, 300, 1000, 3000) if tick <= most]
    bar.set_ticks(ticks, labels=[str(tick) for tick in ticks])
    bar.minorticks_off()
    axes.set_xlabel("")
    axes = figure.add_subplot(top[1, 1])
    moved = np.rad2deg([one.moved_rad for one in learnt.rounds])
    axes.semilogy(np.arange(1, len(moved) + 1), moved, color="black", marker="o")
    axes.set(xlabel="round", ylabel="degrees", title="change of orientation, rms")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    for column, chosen in enumerate(spread_frames(range(len(compared)), EXAMPLES)):
        _draw_example([figure.add_subplot(grid[row, column]) for row in (1, 2, 3)], compared[chosen], column == 0)
    note(
        figure,
        "Map: longitude to the right, latitude upwards, as seen from outside; sand: unseen. Examples: "
        "as filmed, as rendered with the map, and the difference, red where the picture is "
        f"brighter; full colour is {RESIDUAL_REACH:g} of the step from black to white paint. Below: the correlation "
        "of the paint in pictures held out of the map.",
    )
    return figure


def _draw_example(rows: Sequence[Axes], example: MapExample, first: bool) -> None:
    known = example.filmed[np.isfinite(example.filmed)]
    low, high = np.percentile(known, (0.5, 99.8)) if known.size else (0.0, 1.0)
    residual = (example.filmed - example.model) / example.contrast
    for axes, title in zip(rows, ("picture", "re-rendered", "difference"), strict=True):
        axes.set(xticks=[], yticks=[], ylabel=title if first else "")
        axes.grid(visible=False)
    rows[0].imshow(example.filmed, cmap="gray", vmin=low, vmax=high)
    rows[0].set_title(example.title, fontsize=7)
    rows[1].set_facecolor(UNSEEN)
    rows[1].imshow(np.ma.masked_invalid(example.model), cmap="gray", vmin=low, vmax=high)
    rows[2].imshow(np.ma.masked_invalid(residual), cmap="RdBu_r", vmin=-RESIDUAL_REACH, vmax=RESIDUAL_REACH)
    rows[2].set_xlabel(f"paint: {example.correlation:.3f}", fontsize=7)


def draw_map(axes: Axes, values: Tensor, title: str, **style: Any) -> Any:
    """Draw a texture map (H, 2 H) over degrees, NaN as sand; grey from 0 to 1 unless `style` (of `imshow`) differs."""
    shown = {"cmap": "gray", "extent": EXTENT} | ({} if "norm" in style else {"vmin": 0, "vmax": 1}) | style
    drawn = axes.imshow(np.ma.masked_invalid(values.numpy()), **shown)
    axes.set(xlim=EXTENT[:2], ylim=EXTENT[2:], xticks=[-180, -90, 0, 90, 180], yticks=[-90, -45, 0, 45, 90])
    axes.set(xlabel="longitude (degrees)", aspect="equal", title=title)
    axes.grid(visible=False)
    axes.set_facecolor(UNSEEN)
    return drawn


@in_style
def worn_figure(worn: Tensor, texture: Tensor | None) -> Figure:
    """Draw the unused paint, cells as of `worn_cells`, over the texture map (H, 2 H) if known."""
    whole = torch.full((360, 720), 0.6) if texture is None else texture
    unused = worn_texels(worn, len(whole))
    figure = new_figure(WIDTH_IN, 4.0)
    axes, title = figure.subplots(), f"{100 * worn_share(worn):.0f} % of the paint differs from the map"
    draw_map(axes, whole.masked_fill(unused, torch.nan), title)
    axes.set_ylabel("latitude (degrees)")
    map_words = "" if texture is not None else " The map is not drawn: the report was made without --experiment."
    note(figure, f"Sand: paint that differs from the map and was not used.{map_words}")
    return figure


@in_style
def moved_figure(texture: Tensor, comparison: MapComparison, change: Tensor | None = None) -> Figure:
    """Draw the displacement from the reference `texture` (H, 2 H), and `change` (H, 2 H) of `paint_change` if given."""
    figure = new_figure(WIDTH_IN, 4.3 if change is None else 7.7)
    panels = figure.subplots(1 if change is None else 2, 1, squeeze=False)[:, 0]
    draw_map(panels[0], 0.55 + 0.45 * texture, "displacement of the paint from the old map")
    times = _draw_arrows(panels[0], comparison)
    words = ""
    if change is not None:
        style = {"cmap": "RdBu_r", "vmin": -CHANGE_REACH, "vmax": CHANGE_REACH}
        shown = draw_map(panels[1], change, "change of the paint itself", **style)
        figure.colorbar(shown, ax=panels[1], shrink=0.8, extend="both")
        words = " Below: brighter (red) or darker (blue) than everything within 1° in the old map; 1 is white."
    sizes = "no patch could be located"
    if count := len(comparison.length_rad):
        rms, most = np.rad2deg([comparison.rms_rad, comparison.max_rad])
        sizes = f"{count} patches located: {rms:.2f}° rms, {most:.2f}° at most; arrows {times:g} times as long"
    note(figure, f"{sizes}, from a patch's position in the old map to the present one. Sand: unknown.{words}")
    return figure


def _draw_arrows(axes: Axes, comparison: MapComparison) -> float:
    known = torch.isfinite(comparison.moved_rad).all(-1)
    if not known.any():
        return 1.0
    x, y, z = comparison.direction_body[known].unbind(-1)
    longitude, latitude = torch.atan2(y, x), torch.asin(z.clamp(-1, 1))
    moved = torch.rad2deg(comparison.moved_rad[known])
    largest = float(moved.norm(dim=-1).quantile(0.95).clamp_min(1e-6))
    # Drawn length of the largest arrow, in degrees of the map.
    times = max([step for step in (1, 2, 5, 10, 20, 50) if step * largest <= 2 * 4.0], default=1)
    # The map stretches longitude away from the equator.
    along = moved[:, 0] / latitude.cos().clamp_min(0.1)
    style: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "color": ARROW, "width": 0.0022}
    place = (torch.rad2deg(part).numpy() for part in (longitude, latitude))
    arrows = (times * part.numpy() for part in (along, moved[:, 1]))
    axes.quiver(*place, *arrows, **style, headwidth=4, headlength=4.5)
    return float(times)
