"""Tables of the texture map by direction: paint for template banks, value and slope for fits."""

import ctypes
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from sphereorient.cameras import Rays
from sphereorient.files.compiled import compiled, record
from sphereorient.files.threads import side_by_side
from sphereorient.sphere.renderer import see_sphere
from sphereorient.sphere.texture import closed_texture, reduced_texture, sample_closed

# Nodes and weights of the 5-point and 3-point Gauss-Hermite rules for a unit normal.
FIVE = (
    (-2.8569700138728, 0.011257411327721),
    (-1.3556261799742659, 0.22207592200561264),
    (0.0, 0.5333333333333333),
    (1.3556261799742659, 0.22207592200561264),
    (2.8569700138728, 0.011257411327721),
)
THREE = ((-math.sqrt(3.0), 1 / 6), (0.0, 2 / 3), (math.sqrt(3.0), 1 / 6))
# The same in the plane: right, up and weight of each node.
SQUARE_25, SQUARE_9 = ([(a, b, p * q) for a, p in rule for b, q in rule] for rule in (FIVE, THREE))
BASE_RAD = 0.008  # blur of the finest table: below half a pixel for disks up to 160 px
CHUNK = 1 << 14  # directions per batch while a table is built
STEPS = 127.0  # white paint in a direction table; black is its negative
AT_ONCE = 1 << 17  # pixels looked up at once, so that temporaries stay in the cache
SIDE = 512  # cells per axis of the finest table: 0.4 degrees, 4 MB
SAME = 1 + 1e-9  # ratio of blurs that differ by rounding
WIDER = 1.6  # largest ratio of blur in a step: the 9-point rule is exact for maps smooth over the added width
CELLS_A_BLUR = 3.0  # least cells per blur sigma in coarser tables


SOURCE = Path(__file__).with_suffix("")
Widening = record(SOURCE, "Widening")
Cells = tuple[Tensor, Tensor, Tensor]  # directions and two tangents of each, (M, 3) float64


def octahedral_directions(side: int) -> Tensor:
    """Return unit directions at the cell centres of an octahedral map, (side^2, 3) float64, row by row.
    Source: Praun and Hoppe 2003 (octahedron unfolded into a square: no poles, cells of nearly equal size).
    """
    at = (torch.arange(side, dtype=torch.float64) + 0.5) * (2.0 / side) - 1.0
    y, x = torch.meshgrid(at, at, indexing="ij")
    z = 1.0 - x.abs() - y.abs()
    folded_x, folded_y = (1.0 - y.abs()) * torch.sign(x), (1.0 - x.abs()) * torch.sign(y)
    direction = torch.stack([torch.where(z < 0, folded_x, x), torch.where(z < 0, folded_y, y), z], dim=-1)
    return torch.nn.functional.normalize(direction, dim=-1).reshape(-1, 3)


def octahedral_cells(x: Tensor, y: Tensor, z: Tensor, side: int) -> Tensor:
    """Return the cell (...) int64 of each direction; directions may have any common length."""
    half = 0.5 * side
    scale = half / (x.abs() + y.abs() + z.abs())
    u, v = x * scale, y * scale
    below = z < 0
    u, v = (
        torch.where(below, torch.copysign(half - v.abs(), u), u),
        torch.where(below, torch.copysign(half - u.abs(), v), v),
    )
    column = (u + half).to(torch.int32).clamp_(0, side - 1)
    row = (v + half).to(torch.int32).clamp_(0, side - 1)
    cell: Tensor = row * side + column
    return cell


class DirectionTable(nn.Module):
    """Paint of a map (H, 2 H) as in the renderer, in `cells`^3 cells of the unit cube (128: 1 degree, 2 MB).
    Ten times faster than `SphereRenderer`; pixels at patch borders differ: for candidates, not for refinement.
    """

    paint: Tensor

    def __init__(self, texture: Tensor, cells: int = 128) -> None:
        super().__init__()
        self.cells = cells
        at = (torch.arange(cells, dtype=torch.float32) + 0.5) * (2.0 / cells) - 1.0
        outward = torch.stack(torch.meshgrid(at, at, at, indexing="ij"), dim=-1).reshape(-1, 3)
        inwards = Rays(origin_lab_mm=2 * outward, direction_lab=-outward)
        seen = see_sphere(inwards, torch.zeros(3), torch.eye(3), texture.float())
        self.register_buffer("paint", ((2 * seen.paint - 1) * STEPS).round().to(torch.int8))

    def render(self, R_view_body: Tensor, normal_view: Tensor) -> Tensor:
        """Return paint (K, P) int8, -127 black .. 127 white, of R_view_body (K, 3, 3) at normals (P, 3), float32."""
        n, count = self.cells, len(normal_view)
        columns = normal_view.T.contiguous() * (0.5 * n * (1.0 - 1e-6))
        rows = R_view_body.permute(2, 0, 1).reshape(3, -1, 3)
        out = self.paint.new_empty((len(R_view_body), count))
        size = max(1, AT_ONCE // max(1, count))
        for some, at in zip(torch.split(rows, size, 1), torch.split(out, size), strict=True):
            place = torch.addmm(columns.new_tensor(0.5 * n), some.reshape(-1, 3), columns)
            x, y, z = place.to(torch.int32).reshape(3, -1, count)
            at.copy_(self.paint.index_select(0, x.mul_(n).add_(y).mul_(n).add_(z).reshape(-1)).reshape(at.shape))
        return out


class TextureTable:
    """Texture map blurred by a Gaussian on the sphere (sigma `blur_rad`), as tangent planes in cells of directions.
    `rows` (side^2, 4) float32 come from `texture_table`; the value's error is of second order in cell size over blur.
    `unseen`: table of the share of texels without paint, equally blurred; None: all are paint.
    """

    def __init__(self, rows: Tensor, blur_rad: float, unseen: "TextureTable | None" = None) -> None:
        self.rows = rows
        self.unseen = unseen
        self.side = math.isqrt(len(rows))
        self.blur_rad = blur_rad

    def sample(self, direction_body: Tensor) -> tuple[Tensor, Tensor]:
        """Return values (L, P), 0 .. 1, and tangent gradients (L, 3, P), 1/rad, at unit body directions (L, 3, P)."""
        x, y, z = direction_body.unbind(1)
        cell = octahedral_cells(x, y, z, self.side)
        found = self.rows.index_select(0, cell.reshape(-1)).reshape(*cell.shape, 4)
        slope = found[..., 1:].movedim(-1, 1)
        value = found[..., 0] + slope[:, 0] * x + slope[:, 1] * y + slope[:, 2] * z
        return value, slope

    def to(self, device: torch.device) -> "TextureTable":
        """Return the table on another device for `sample`; `blurred` needs the CPU."""
        return TextureTable(self.rows.to(device), self.blur_rad, self.unseen and self.unseen.to(device))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return arrays from which `of` makes the same table."""
        own: dict[str, NDArray[Any]] = {"rows": self.rows.cpu().numpy(), "blur_rad": np.array(self.blur_rad)}
        unseen = {} if self.unseen is None else self.unseen.arrays()
        return own | {f"unseen_{name}": array for name, array in unseen.items()}

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> "TextureTable":
        """Return the table of `arrays`."""
        hidden = {name.removeprefix("unseen_"): part for name, part in arrays.items() if name.startswith("unseen_")}
        rows, blur_rad = torch.from_numpy(arrays["rows"]), float(arrays["blur_rad"])
        return cls(rows, blur_rad, cls.of(hidden) if hidden else None)

    def blurred(self, blur_rad: float) -> "TextureTable":
        """Return a table whose total blur is `blur_rad`, or itself if that is not wider but for rounding: a fit then
        uses a map that grows.
        """
        if blur_rad <= SAME * self.blur_rad:
            return self
        return self._wider.blurred(blur_rad) if blur_rad > WIDER * self.blur_rad else self._widened(blur_rad)

    @cached_property
    def _wider(self) -> "TextureTable":
        """An intermediate table for all wider blurs."""
        return self._widened(WIDER * self.blur_rad)

    def _widened(self, target: float) -> "TextureTable":
        added = math.sqrt(target**2 - self.blur_rad**2)
        # A cell is 2.2 / side wide: a wider blur allows fewer cells.
        side = min(self.side, 1 << math.ceil(math.log2(2.2 * CELLS_A_BLUR / target)))

        def rows(cells: Cells) -> Tensor:
            centre = cells[0]
            if (code := compiled(SOURCE, Widening)) is not None:
                return _widened_by(code, self.rows, added, cells)
            value, slope = torch.zeros(len(centre)), torch.zeros(len(centre), 3)
            for share, _, at in _disk_nodes(cells, added, SQUARE_9):
                v, g = self.sample(at.T[None])
                value, slope = value + share * v[0], slope + share * g[0].T
            return _rows(value, slope, centre.float())

        unseen = self.unseen and self.unseen.blurred(target)
        return TextureTable(_in_chunks(rows, side), target, unseen)


def texture_table(texture: Tensor, blur_rad: float, side: int = SIDE, unseen: Tensor | None = None) -> TextureTable:
    """Return the table of a map (H, 2 H) for a Gaussian blur, rad; `side` counts cells per axis.
    `unseen` (H, 2 H) bool: texels that are no paint.
    """
    finest = min(blur_rad, BASE_RAD)
    hidden = None if unseen is None else texture_table(unseen.float(), finest, side)
    closed = closed_texture(reduced_texture(texture.float(), 2.0 / finest))  # pixels as wide as the blur, against steps

    def rows(cells: Cells) -> Tensor:
        centre = cells[0]
        value, slope = torch.zeros(len(centre)), torch.zeros(len(centre), 3)
        for share, offset, at in _disk_nodes(cells, finest, SQUARE_25):
            v = sample_closed(closed, at)
            value = value + share * v
            slope = slope + share * v[:, None] * offset / finest**2
        return _rows(value, slope, centre.float())

    return TextureTable(_in_chunks(rows, side), finest, hidden).blurred(blur_rad)


def _widened_by(code: ctypes.CDLL, rows: Tensor, width: float, cells: Cells) -> Tensor:
    """Return the rows of some cells of a more blurred table, by compiled code."""
    found, nodes = torch.empty(len(cells[0]), 4), torch.tensor(SQUARE_9, dtype=torch.float64)
    sizes = math.isqrt(len(rows)), len(found), len(nodes)
    parts = rows.float().contiguous(), *(part.contiguous() for part in cells), nodes
    first, *others = (part.data_ptr() for part in parts)
    code.widen(ctypes.byref(Widening(first, *sizes, *others, width, found.data_ptr())))
    return found


def _in_chunks(rows: Callable[[Cells], Tensor], side: int) -> Tensor:
    """Return the rows (side^2, 4) of all cells of directions."""
    return torch.cat([torch.zeros(0, 4), *side_by_side(rows, _cells(side))])


@lru_cache(maxsize=4)  # 19 MB at most for each
def _cells(side: int) -> list[Cells]:
    """Return the directions of all cells, and two tangents of each, (M, 3) float64 each, in chunks."""
    return [(some, *tangents(some)) for some in torch.split(octahedral_directions(side), CHUNK)]


def _disk_nodes(
    cells: Cells, width: float, rule: Sequence[tuple[float, float, float]]
) -> Iterator[tuple[float, Tensor, Tensor]]:
    """Yield weight, tangent offset (M, 3) and direction (M, 3) of the nodes of a Gaussian about M cells."""
    centre, right, up = cells
    right, up, centre = (width * right).float(), (width * up).float(), centre.float()
    for a, b, share in rule:
        offset = a * right + b * up
        yield share, offset, (centre + offset) / math.hypot(1.0, width * math.hypot(a, b))


def tangents(direction: Tensor) -> tuple[Tensor, Tensor]:
    """Return two unit vectors (M, 3) at right angles to each of some directions (M, 3) and to each other."""
    z, x = direction.new_tensor([0.0, 0, 1]), direction.new_tensor([1.0, 0, 0])
    helper = torch.where(direction[:, 2:].abs() < 0.9, z, x)
    right = torch.nn.functional.normalize(torch.linalg.cross(helper, direction), dim=-1)
    return right, torch.linalg.cross(direction, right)


def _rows(value: Tensor, slope: Tensor, centre: Tensor) -> Tensor:
    """Return table rows: the tangent plane's value at the origin, and its slope."""
    slope = slope - (slope * centre).sum(-1, keepdim=True) * centre
    return torch.cat([value[:, None] - (slope * centre).sum(-1, keepdim=True), slope], dim=-1)
