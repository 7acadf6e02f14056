"""Wear of a ball from a series of its texture maps: worn places followed from map to map, and their figure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from sphereorient.errors import PaintError, refusal
from sphereorient.experiment.recording import spread_frames
from sphereorient.report.plots.style import ALL, BLACK, GREY, WIDTH_IN, in_style, new_figure, note
from sphereorient.report.texture_map import CHANGE_REACH, EXTENT, draw_map
from sphereorient.sphere.compare import (
    CHANGED,
    HALF,
    RADIUS_DEG,
    MapComparison,
    compare_maps,
    fit_levels,
    texture_change,
    turned_map,
    without_changed,
)
from sphereorient.sphere.texture import map_directions, texel_areas

BEYOND = 5.0  # times the scatter of unworn texture, seldom exceeded by noise
LEAST_DEG = 1.5  # radius of the smallest reported place
SHOWN = 6  # most maps drawn, spread over the series
NAMED = 6  # places with a number in the maps, and a curve


@dataclass(frozen=True, kw_only=True, eq=False)
class Wear:
    """One map compared with the first of its series, in that one's body frame and size."""

    comparison: MapComparison  # displacements, without patches of changed texture
    change: Tensor  # (H, 2 H), -1 .. 1, negative where darker; NaN where either map is unknown
    scatter: float  # standard deviation of grey between the two maps where unworn, black to white being 1
    worn: Tensor  # (H, 2 H) bool: places whose change exceeds the scatter

    @property
    def known(self) -> Tensor:
        """Where both maps are known, (H, 2 H) bool."""
        return torch.isfinite(self.change)


@dataclass(frozen=True, kw_only=True, eq=False)
class WearFigures:
    """Wear of one map in figures; shares are of area, NaN where undefined."""

    known: float  # share of the ball known in this map and the first
    worn: float  # of the known area
    grown: float  # worn now minus worn in the map before, of the area known in both; for the first map: `worn`
    stays: float  # still worn, of the area worn in the map before and known now


@dataclass(frozen=True, kw_only=True, eq=False)
class WornPlace:
    """A connected place that is worn in some map of a series."""

    longitude_deg: float  # of its centre, in the first map's body frame
    latitude_deg: float
    share: tuple[float, ...]  # of the ball's area, worn in each map but the first; NaN where hardly seen


@dataclass(frozen=True, kw_only=True, eq=False)
class WearSeries:
    """The wear of one ball from map to map."""

    wear: tuple[Wear, ...]  # of all maps but the first
    number: Tensor  # (H, 2 H) int64, place of each texel, from 1 on; 0 where no map is worn
    places: tuple[WornPlace, ...]  # by number, largest first

    @property
    def growth(self) -> tuple[WearFigures, ...]:
        """The figures of all maps but the first."""
        before = (None, *self.wear[:-1])
        return tuple(_figures(now, last) for now, last in zip(self.wear, before, strict=True))


def wear_series(maps: Sequence[Tensor], turned: bool = True) -> WearSeries:
    """Compare maps (H, 2 H), 0 black .. 1 white, NaN unknown, in time order with the first, in its body frame.
    `turned`: estimate the rotations between body frames. Raises PaintError: other balls; ShapeError: not 2:1.
    """
    if len(maps) < 2:
        do = "give the maps in the order of their movies"
        raise PaintError(refusal("maps", expected="two or more", got=str(len(maps)), do=do))
    wear = tuple(_wear(texture, maps[0], turned) for texture in maps[1:])
    number = connected_places(torch.stack([one.worn for one in wear]).any(0))
    sizes = _sizes(number)
    rank = torch.zeros(len(sizes), dtype=torch.int64)
    rank[sizes[1:].argsort(descending=True, stable=True) + 1] = torch.arange(1, len(sizes))
    number = rank[number]
    return WearSeries(wear=wear, number=number, places=tuple(_place(number == k, wear) for k in range(1, len(sizes))))


def _shares(height: int) -> Tensor:
    return texel_areas(height) / (4 * math.pi)


def _sizes(number: Tensor) -> Tensor:
    return torch.bincount(number.reshape(-1), _shares(len(number)).reshape(-1))


def _wear(texture: Tensor, first: Tensor, turned: bool) -> Wear:
    comparison = compare_maps(texture, first, turned)
    there = turned_map(texture, comparison.R_other_reference, len(first))
    change = texture_change(there, first)
    gain, offset = fit_levels(first, there)
    off = (there - (gain * first + offset)).abs()
    known = torch.isfinite(off)
    # The median ignores worn places and borders of displaced ones.
    scatter = 1.4826 * float(off[known].median()) if known.any() else math.nan
    number = connected_places(change.abs() > max(CHANGED, BEYOND * scatter))  # unknown texels are in no place
    large = _sizes(number) >= 0.5 * (1 - math.cos(math.radians(LEAST_DEG)))  # area of a cap over that of the sphere
    large[0] = False
    comparison = without_changed(comparison, change, CHANGED)
    return Wear(comparison=comparison, change=change, scatter=scatter, worn=large[number])


def _figures(now: Wear, before: Wear | None) -> WearFigures:
    area = _shares(len(now.change))

    def share(part: Tensor, whole: Tensor) -> float:
        total = float(area[whole].sum())
        return float(area[part & whole].sum()) / total if total else math.nan

    worn = grown = share(now.worn, now.known)
    stays = math.nan
    if before is not None:
        both = now.known & before.known
        grown = share(now.worn, both) - share(before.worn, both)
        stays = share(now.worn, before.worn & now.known)
    return WearFigures(known=float(area[now.known].sum()), worn=worn, grown=grown, stays=stays)


def _place(inside: Tensor, wear: Sequence[Wear]) -> WornPlace:
    area = _shares(len(inside))
    direction = map_directions(len(inside))[inside].double()
    x, y, z = (direction * area[inside][:, None]).sum(0).tolist()
    least = HALF * float(area[inside].sum())
    shares = []
    for one in wear:
        seen = float(area[inside & one.known].sum()) >= least
        shares.append(float(area[inside & one.worn].sum()) if seen else math.nan)
    return WornPlace(
        longitude_deg=math.degrees(math.atan2(y, x)),
        latitude_deg=math.degrees(math.atan2(z, math.hypot(x, y))),
        share=tuple(shares),
    )


def connected_places(worn: Tensor) -> Tensor:
    """Number the connected places of a mask (H, 2 H) from 1 on, also across the map's edge and its poles."""
    mask = worn.numpy()
    node = np.arange(mask.size).reshape(mask.shape)
    pairs = [(node, np.roll(node, -1, axis=1)), (node[:-1], node[1:])]
    pairs += [(node[row], np.full_like(node[row], node[row][mask[row]].min())) for row in (0, -1) if mask[row].any()]
    a, b = (np.concatenate([pair[k].reshape(-1) for pair in pairs]) for k in (0, 1))
    joined = mask.flat[a] & mask.flat[b]
    graph = coo_matrix((np.ones(int(joined.sum())), (a[joined], b[joined])), shape=(mask.size, mask.size))
    label: NDArray[np.int32] = connected_components(graph, directed=False)[1]
    number = np.zeros(mask.shape, np.int64)
    number[mask] = np.unique(label.reshape(mask.shape)[mask], return_inverse=True)[1] + 1
    return torch.from_numpy(number)


@in_style
def wear_figure(first: Tensor, series: WearSeries, names: Sequence[str]) -> Figure:
    """Draw the wear of a series of maps against the first (H, 2 H), NaN where unknown; `names` are of all maps."""
    count = len(series.wear)
    drawn = spread_frames(range(count), SHOWN)
    rows = math.ceil((len(drawn) + 1) / 2)
    figure = new_figure(WIDTH_IN, 1.75 * rows + 2.7)
    grid = figure.add_gridspec(rows + 1, 2, height_ratios=[1.0] * rows + [1.15])
    maps = [figure.add_subplot(grid[k // 2, k % 2]) for k in range(len(drawn) + 1)]
    draw_map(maps[0], first, f"{names[0]}: the first map")
    style = {"cmap": "RdBu_r", "vmin": -CHANGE_REACH, "vmax": CHANGE_REACH}
    for axes, k in zip(maps[1:], drawn, strict=True):
        worn = f"{names[k + 1]}: {100 * series.growth[k].worn:.1f} % worn"
        shown = draw_map(axes, series.wear[k].change, worn, **style)
        _mark(axes, series, k)
    for axes in maps:
        axes.set_xlabel("")
        axes.title.set_fontsize(8)
    figure.colorbar(shown, ax=maps, shrink=0.6, extend="both", label="change, red where brighter")
    _draw_growth(figure.add_subplot(grid[rows, :]), series, names)
    note(
        figure,
        f"Change: distance from the range of grey levels of the first map within {RADIUS_DEG:g}°; 1 is the step "
        "from black to white. Outlined: worn places, the largest ones numbered. Sand: unknown.",
    )
    return figure


def _mark(axes: Axes, series: WearSeries, k: int) -> None:
    worn = series.wear[k].worn.numpy()
    if worn.any():
        axes.contour(worn.astype(float), [0.5], colors=BLACK, linewidths=0.6, extent=EXTENT, origin="upper")
    for number, place in enumerate(series.places[:NAMED], start=1):
        if place.share[k] > 0:
            at, beside = (place.longitude_deg, place.latitude_deg), (7, 7)
            box = {"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": GREY, "linewidth": 0.5}
            axes.annotate(str(number), at, beside, textcoords="offset points", fontsize=7, bbox=box)


def _draw_growth(axes: Axes, series: WearSeries, names: Sequence[str]) -> None:
    at = np.arange(len(series.wear) + 1)
    whole = 100 * np.array([0, *(one.worn for one in series.growth)])
    axes.plot(at, whole, marker=ALL.marker, label="all, of the known area", **ALL.drawn)
    for number, place in enumerate(series.places[:NAMED], start=1):
        axes.plot(at, 100 * np.array([0, *place.share]), marker=".", linewidth=0.9, label=f"place {number}")
    axes.set_xticks(at, list(names))
    # Least height of the axis.
    axes.set(ylabel="worn (% of the ball)", ylim=(0, max(0.1, axes.get_ylim()[1])))
    axes.yaxis.set_major_locator(MaxNLocator(6))
    axes.legend(loc="upper left")
