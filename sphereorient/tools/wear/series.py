"""Wear of a ball from a series of its texture maps: the same worn places followed from map to map."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from sphereorient.errors import PaintError, refusal
from sphereorient.mapping.compare import (
    CHANGED,
    MapComparison,
    compare_maps,
    fit_levels,
    texture_change,
    turned_map,
    without_changed,
)
from sphereorient.mapping.grid import texel_areas
from sphereorient.synth.textures import map_directions

BEYOND = 5.0  # times the scatter of the unworn texture: noise alone seldom exceeds this
LEAST_DEG = 1.5  # radius of the smallest place that is reported
HALF = 0.5  # share of a place that a map must know to give its worn share


@dataclass(frozen=True, kw_only=True, eq=False)
class Wear:
    """One map compared with the first of its series, in that one's body frame and size."""

    comparison: MapComparison  # displacements, without patches whose texture changed
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

    known: float  # share of the ball that this map and the first know
    worn: float  # of the known area
    grown: float  # worn now less worn in the map before, of the area known in both; against the first map: `worn`
    stays: float  # still worn, of the area worn in the map before and known now


@dataclass(frozen=True, kw_only=True, eq=False)
class WornPlace:
    """A connected place that is worn in some map of a series."""

    longitude_deg: float  # of its middle, in the first map's body frame
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

    `turned`: find the rotations between body frames. Raise PaintError for other balls, ShapeError if not 2:1.
    """
    if len(maps) < 2:
        do = "give the maps in the order of their movies"
        raise PaintError(refusal("maps", expected="two or more", got=str(len(maps)), do=do))
    wear = tuple(_wear(texture, maps[0], turned) for texture in maps[1:])
    number = _places(torch.stack([one.worn for one in wear]).any(0))
    sizes = _sizes(number)
    rank = torch.zeros(len(sizes), dtype=torch.int64)
    rank[sizes[1:].argsort(descending=True, stable=True) + 1] = torch.arange(1, len(sizes))
    number = rank[number]
    return WearSeries(wear=wear, number=number, places=tuple(_place(number == k, wear) for k in range(1, len(sizes))))


def _shares(height: int) -> Tensor:
    return texel_areas(height) / (4 * math.pi)


def _sizes(number: Tensor) -> Tensor:
    area = _shares(len(number)).reshape(-1)
    return torch.zeros(int(number.max()) + 1, dtype=torch.float64).index_add(0, number.reshape(-1), area)


def _wear(texture: Tensor, first: Tensor, turned: bool) -> Wear:
    comparison = compare_maps(texture, first, turned)
    there = turned_map(texture, comparison.R_other_reference, len(first))
    change = texture_change(there, first)
    gain, offset = fit_levels(first, there)
    off = (there - (gain * first + offset)).abs()
    known = torch.isfinite(off)
    # The median ignores worn places and borders of displaced ones.
    scatter = 1.4826 * float(off[known].median()) if known.any() else math.nan
    worn = _large_enough(change.abs() > max(CHANGED, BEYOND * scatter))  # an unknown texel is not
    return Wear(comparison=without_changed(comparison, change, CHANGED), change=change, scatter=scatter, worn=worn)


def _figures(now: Wear, before: Wear | None) -> WearFigures:
    area = _shares(len(now.change))

    def share(part: Tensor, whole: Tensor) -> float:
        total = float(area[whole].sum())
        return float(area[part & whole].sum()) / total if total else math.nan

    worn = share(now.worn, now.known)
    known = float(area[now.known].sum())
    if before is None:
        return WearFigures(known=known, worn=worn, grown=worn, stays=math.nan)
    both = now.known & before.known
    grown = share(now.worn, both) - share(before.worn, both)
    return WearFigures(known=known, worn=worn, grown=grown, stays=share(now.worn, before.worn & now.known))


def _place(inside: Tensor, wear: Sequence[Wear]) -> WornPlace:
    area = _shares(len(inside))
    direction = map_directions(len(inside))[inside].double()
    x, y, z = (direction * area[inside][:, None]).sum(0).tolist()
    shares = []
    for one in wear:
        seen = float(area[inside & one.known].sum()) >= HALF * float(area[inside].sum())
        shares.append(float(area[inside & one.worn].sum()) if seen else math.nan)
    return WornPlace(
        longitude_deg=math.degrees(math.atan2(y, x)),
        latitude_deg=math.degrees(math.atan2(z, math.hypot(x, y))),
        share=tuple(shares),
    )


def _large_enough(worn: Tensor) -> Tensor:
    number = _places(worn)
    kept = _sizes(number) >= 0.5 * (1 - math.cos(math.radians(LEAST_DEG)))  # area of a cap over that of the sphere
    kept[0] = False
    found: Tensor = kept[number]
    return found


def _places(worn: Tensor) -> Tensor:
    """Number the connected places of a mask (H, 2 H) from 1 on, also across the map's edge and its poles."""
    mask = worn.numpy()
    node = np.arange(mask.size).reshape(mask.shape)
    pairs = [(node, np.roll(node, -1, axis=1)), (node[:-1], node[1:])]
    pairs += [(node[row], np.full_like(node[row], node[row][mask[row]].min())) for row in (0, -1) if mask[row].any()]
    a, b = (np.concatenate([pair[k].reshape(-1) for pair in pairs]) for k in (0, 1))
    joined = mask.reshape(-1)[a] & mask.reshape(-1)[b]
    graph = coo_matrix((np.ones(int(joined.sum())), (a[joined], b[joined])), shape=(mask.size, mask.size))
    label: NDArray[np.int32] = connected_components(graph, directed=False)[1]
    number = np.zeros(mask.size, np.int64)
    number[mask.reshape(-1)] = np.unique(label[mask.reshape(-1)], return_inverse=True)[1] + 1
    return torch.from_numpy(number.reshape(mask.shape))
