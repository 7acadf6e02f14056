"""Find patches of one texture map in another, to hundredths of a degree."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.sphere.texture_table import TextureTable

RADIUS_DEG = 7.5  # of a patch
REACH_DEG = 4.0  # of the search
ROUGH_DEG, FINE_DEG = 1.0, 0.5  # steps of the search, and of the places of a patch
STEPS = 8  # of the refinement
CONTRAST_MIN = 0.15  # deviation of the texture in a patch, of black to white
ONE_WAY = 0.15  # share of the weaker direction below which all edges run one way: no shift along them is measured
NEIGHBOURS, FEWEST, NEAR_DEG = 6, 3, 20.0  # compared with, needed for a decision, largest distance
APART_DEG = 1.0  # from the neighbours' median shift, beyond which a patch was found in the wrong place
ALIKE_MIN = 0.8  # correlation below which a patch was not found


@dataclass(frozen=True, kw_only=True, eq=False)
class Patches:
    """Round patches about directions of the reference, in tangent planes whose axes point east and north."""

    direction: Tensor  # (D, 3) float64, no poles
    R_other_reference: Tensor  # (3, 3)

    def points(self, step_deg: float) -> Tensor:
        """Return the sample places of all patches, (D, P, 3), at a spacing in degrees."""
        return self.shifted(_offsets(step_deg), torch.zeros(len(self.direction), 2, dtype=torch.float64))

    def shifted(self, offset: Tensor, shift: Tensor) -> Tensor:
        """Return places (D, P, 3) at offsets (P, 2), rad east and north, from patches shifted by (D, 2)."""
        d = self.direction[:, None]
        east, north = (axis[:, None] for axis in compass(self.direction))
        at = (offset + shift[:, None]).tan()
        return torch.nn.functional.normalize(d + at[..., :1] * east + at[..., 1:] * north, dim=-1)


def _offsets(step_deg: float) -> Tensor:
    count = math.floor(RADIUS_DEG / step_deg)
    at = torch.arange(-count, count + 1, dtype=torch.float64) * math.radians(step_deg)
    grid = torch.stack(torch.meshgrid(at, at, indexing="xy"), dim=-1).reshape(-1, 2)
    return grid[grid.norm(dim=-1) <= math.radians(RADIUS_DEG) + 1e-9]


def compass(direction: Tensor) -> tuple[Tensor, Tensor]:
    """Return the unit vectors to the east and to the north of directions (..., 3) other than the poles."""
    x, y, z = direction.unbind(-1)
    level = (x * x + y * y).sqrt().clamp_min(1e-12)
    east = torch.stack([-y / level, x / level, torch.zeros_like(x)], dim=-1)
    return east, torch.stack([-z * x / level, -z * y / level, level], dim=-1)


def patch_shifts(rough: list[TextureTable], fine: list[TextureTable], patches: Patches) -> tuple[Tensor, Tensor]:
    """Return shifts (D, 2) float64, rad east and north, of the reference's patches in another map, and (D,) found.

    `rough` and `fine`: blurred tables of the other map and of the reference, for search and refinement.

    Source: normalised correlation, then direct alignment with gain and offset, Lucas and Kanade 1981.
    """
    shift = start = _searched(rough, patches)
    offset = _offsets(FINE_DEG)
    reference, _ = fine[1].sample(patches.points(FINE_DEG).mT.float())
    for _ in range(STEPS):
        grey, by_shift = _sampled(fine[0], patches, offset, shift)
        # Unknowns: shift, gain and offset that take the other map's grey to the reference's.
        columns = torch.stack([-by_shift[:, 0], -by_shift[:, 1], reference, torch.ones_like(reference)], dim=1).double()
        normal, right = columns @ columns.mT, columns @ grey.double()[..., None]
        step = torch.linalg.solve(normal + 1e-9 * torch.eye(4).double(), right)[:, :2, 0]
        longest = math.radians(0.5)
        shift = shift + step * (longest / step.norm(dim=-1, keepdim=True).clamp_min(1e-12)).clamp_max(1.0)
    grey, by_shift = _sampled(fine[0], patches, offset, shift)
    own = (by_shift.double() @ by_shift.double().mT) / len(offset)
    weaker = torch.linalg.eigvalsh(own)[:, 0]
    sure = (weaker > ONE_WAY * own.diagonal(dim1=1, dim2=2).sum(-1)) & (reference.std(1) > CONTRAST_MIN)
    sure &= (_correlation(grey, reference) > ALIKE_MIN) & (shift.norm(dim=-1) < math.radians(REACH_DEG))
    sure &= (shift - start).norm(dim=-1) < math.radians(ROUGH_DEG)  # else the refinement has left its peak
    return shift, sure & ~_contradicted(patches.direction, shift, sure)


def _contradicted(direction: Tensor, shift: Tensor, sure: Tensor) -> Tensor:
    """Return which patches (D,) contradict their overlapping neighbours: they match another edge."""
    east, north = compass(direction)
    moved = shift[:, :1] * east + shift[:, 1:] * north
    near = (direction @ direction.mT).fill_diagonal_(-1) * sure - (~sure).double()
    cosine, which = near.topk(min(NEIGHBOURS, len(direction)), dim=1)
    close = cosine > math.cos(math.radians(NEAR_DEG))
    others = torch.where(close[..., None], moved[which], torch.nan)
    apart = (moved - others.nanmedian(1).values).norm(dim=-1)
    contradicted: Tensor = (close.sum(1) >= FEWEST) & (apart > math.radians(APART_DEG))
    return contradicted


def _searched(tables: list[TextureTable], patches: Patches) -> Tensor:
    count, offset = len(patches.direction), _offsets(2 * FINE_DEG)
    reference, _ = tables[1].sample(patches.points(2 * FINE_DEG).mT.float())
    steps = round(REACH_DEG / ROUGH_DEG)
    at = torch.arange(-steps, steps + 1, dtype=torch.float64) * math.radians(ROUGH_DEG)
    tried = torch.stack(torch.meshgrid(at, at, indexing="ij"), dim=-1).reshape(-1, 2)
    scores = [
        _correlation(_sampled(tables[0], patches, offset, shift.expand(count, 2))[0], reference) for shift in tried
    ]
    return tried[torch.stack(scores).argmax(0)]


def _sampled(table: TextureTable, patches: Patches, offset: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    place = patches.shifted(offset, shift)
    value, slope = table.sample((place @ patches.R_other_reference.mT).mT.float())
    in_reference = slope.mT.double() @ patches.R_other_reference
    flat = (patches.direction[:, None] * place).sum(-1)  # cosine of the angle from the patch's middle
    columns = [
        (in_reference * axis[:, None]).sum(-1) * flat / (offset[:, k] + shift[:, k, None]).cos().square()
        for k, axis in enumerate(compass(patches.direction))
    ]
    return value, torch.stack(columns, dim=1).float()


def _correlation(a: Tensor, b: Tensor) -> Tensor:
    a, b = a - a.mean(1, keepdim=True), b - b.mean(1, keepdim=True)
    return (a * b).sum(1) / ((a * a).sum(1) * (b * b).sum(1)).clamp_min(1e-12).sqrt()
