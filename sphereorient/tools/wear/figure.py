import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from sphereorient.mapping.compare import RADIUS_DEG
from sphereorient.report.map_figure import CHANGE_REACH, UNSEEN, equirectangular
from sphereorient.report.plots.style import ALL, BLACK, GREY, WIDTH_IN, in_style, new_figure, note
from sphereorient.tools.wear.series import WearSeries

SHOWN = 6  # maps that are drawn at most, spread over the series
NAMED = 6  # places that have their number in the maps, and their own curve
EXTENT = (-180, 180, -90, 90)
LEAST_PERCENT = 0.1  # height of the smallest scale of the curve


@in_style
def wear_figure(first: Tensor, series: WearSeries, names: Sequence[str]) -> Figure:
    """Draw the wear of a series of maps against the first (H, 2 H), NaN where unknown; `names` are of all maps."""
    count = len(series.wear)
    drawn = np.unique(np.linspace(0, count - 1, min(SHOWN, count)).round().astype(int)).tolist()
    rows = math.ceil((len(drawn) + 1) / 2)
    figure = new_figure(WIDTH_IN, 1.75 * rows + 2.7)
    grid = figure.add_gridspec(rows + 1, 2, height_ratios=[1.0] * rows + [1.15])
    maps = [figure.add_subplot(grid[k // 2, k % 2]) for k in range(len(drawn) + 1)]
    maps[0].imshow(np.ma.masked_invalid(first.numpy()), cmap="gray", vmin=0, vmax=1, extent=EXTENT)
    _label(maps[0], f"{names[0]}: the first map")
    for axes, k in zip(maps[1:], drawn, strict=True):
        shown = axes.imshow(
            np.ma.masked_invalid(series.wear[k].change.numpy()),
            cmap="RdBu_r", vmin=-CHANGE_REACH, vmax=CHANGE_REACH, extent=EXTENT,
        )  # fmt: skip
        _label(axes, f"{names[k + 1]}: {100 * series.growth[k].worn:.1f} % worn")
        _mark(axes, series, k)
    figure.colorbar(shown, ax=maps, shrink=0.6, extend="both", label="change, red where brighter")
    _draw_growth(figure.add_subplot(grid[rows, :]), series, names)
    note(
        figure,
        f"Change is what lies outside of all grey levels that the first map has within {RADIUS_DEG:g}°; 1 is the step "
        "from black to white. Outlined: worn places, the largest ones numbered. Sand: unknown.",
    )
    return figure


def _label(axes: Axes, title: str) -> None:
    equirectangular(axes)
    axes.set_xlabel("")
    axes.set_facecolor(UNSEEN)
    axes.set_title(title, fontsize=8)


def _mark(axes: Axes, series: WearSeries, k: int) -> None:
    worn = series.wear[k].worn.numpy()
    if worn.any():
        axes.contour(worn.astype(float), [0.5], colors=BLACK, linewidths=0.6, extent=EXTENT, origin="upper")
    for number, place in enumerate(series.places[:NAMED], start=1):
        if place.share[k] > 0:
            axes.annotate(
                str(number),
                (place.longitude_deg, place.latitude_deg),
                xytext=(7, 7),
                textcoords="offset points",
                fontsize=7,
                bbox={"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": GREY, "linewidth": 0.5},
            )


def _draw_growth(axes: Axes, series: WearSeries, names: Sequence[str]) -> None:
    at = np.arange(1, len(series.wear) + 1)
    whole = 100 * np.array([one.worn for one in series.growth])
    axes.plot(np.append(0, at), np.append(0, whole), marker=ALL.marker, label="all, of the known area", **ALL.drawn)
    for number, place in enumerate(series.places[:NAMED], start=1):
        shares = 100 * np.array([0, *place.share])
        axes.plot(np.append(0, at), shares, marker=".", linewidth=0.9, label=f"place {number}")
    axes.set(ylabel="worn (% of the ball)", xticks=np.append(0, at), ylim=(0, None))
    axes.set_ylim(0, max(LEAST_PERCENT, axes.get_ylim()[1]))
    axes.set_xticklabels(list(names))
    axes.yaxis.set_major_locator(MaxNLocator(6))
    axes.legend(loc="upper left")
