"""Comparison of two texture maps of one sphere: body frame, displaced patches, changes."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from sphereorient import so3
from sphereorient.errors import PaintError, refusal
from sphereorient.sphere.texture import check_texture_shape, fibonacci_directions, map_directions, sample_texture
from sphereorient.sphere.texture_table import TextureTable, texture_table

SEARCH_DEG = 10.0  # step of the grid of rotations
SEARCH_BLUR_DEG = 7.0  # removes detail finer than the step
SEARCH_PLACES, PLACES = 1200, 5000
CHUNK = 256  # rotations tried at once
PEAKS = 6  # refined rotations, the best ones
BLURS_DEG = (5.0, 2.0, 0.8)  # of the refinement
STEPS = 8  # of each refinement, of rotations and of patches
KNOWN_USUAL = 0.1  # known share of the sphere at which a correlation is halved
ALIKE_MIN = 0.55  # least correlation of maps of one ball; of two balls, or mirrored: up to 0.5
DIRECTIONS = 500  # number of directions in which the displacement is measured
FINE_BLUR_DEG = 0.5  # of the finest tables: below one of their cells
SIDE = 256  # of the tables: 0.7 degrees, tangent planes between
HALF = 0.5  # least known share of a patch, or of a worn place
RADIUS_DEG = 1.0  # search radius for a grey level in the other map: displacement is not wear
CHANGED = 0.15  # of black to white: least reported change
CHANGED_SHARE = 0.01  # of a patch
REACHES = 16  # directions of that search
PATCH_DEG = 7.5  # radius of a patch
PATCH_REACH_DEG = 4.0  # of the search for it
ROUGH_DEG, FINE_DEG = 1.0, 0.5  # steps of the search, and of the samples of a patch
CONTRAST_MIN = 0.15  # deviation of the texture in a patch, of black to white
ONE_WAY = 0.15  # share of the weaker direction below which all edges are parallel: no shift along them is measured
NEIGHBOURS, FEWEST, NEAR_DEG = 6, 3, 20.0  # number compared, least number, largest distance
ASTRAY_DEG = 1.0  # from the neighbours' median shift, above which a patch was found in the wrong place
FOUND_MIN = 0.8  # least correlation of a found patch


@dataclass(frozen=True, kw_only=True, eq=False)
class MapComparison:
    """Differences of two maps of one sphere; directions are in the reference's body frame."""

    R_other_reference: Tensor  # (3, 3) float64: paint at d in the reference is at R d in the other
    correlation: float  # of both maps after that rotation, where both have known paint
    direction_body: Tensor  # (D, 3) float64, of the measured displacements
    moved_rad: Tensor  # (D, 2) float64, displacement to the east and north in the other map; NaN if unknown

    @property
    def angle_rad(self) -> float:
        """Angle between the body frames, rad."""
        return float(so3.angle(self.R_other_reference))

    @property
    def length_rad(self) -> Tensor:
        """Length of the measured displacements, rad, (n,)."""
        length: Tensor = self.moved_rad[torch.isfinite(self.moved_rad).all(1)].norm(dim=-1)
        return length

    @property
    def rms_rad(self) -> float:
        """Root mean square of the displacements, rad; NaN if none was measured."""
        return float(self.length_rad.square().mean().sqrt()) if len(self.length_rad) else math.nan

    @property
    def max_rad(self) -> float:
        """Largest displacement, rad; NaN if none was measured."""
        return float(self.length_rad.max()) if len(self.length_rad) else math.nan


def compare_maps(other: Tensor, reference: Tensor, turned: bool = True) -> MapComparison:
    """Measure the displacement of a map (H, 2 H), 0 black .. 1 white, against a reference (h, 2 h); NaN: unknown.
    `turned`: find the rotation between the body frames. Raise PaintError for different spheres, ShapeError if not 2:1.
    """
    maps = [_known(texture) for texture in (other, reference)]
    finest = [texture_table(grey, math.radians(FINE_BLUR_DEG), SIDE) for grey, _ in maps]
    blurs = (FINE_BLUR_DEG, *reversed(BLURS_DEG), SEARCH_BLUR_DEG)
    tables = {blur: [table.blurred(math.radians(blur)) for table in finest] for blur in blurs}
    shares, place = [share for _, share in maps], fibonacci_directions(PLACES)
    rows = [min(len(share), SIDE) for share in shares]  # as many as the tables have, for quick look-up
    coarse = [F.adaptive_avg_pool2d(share[None], (n, 2 * n))[0] for share, n in zip(shares, rows, strict=True)]
    R = _best_rotation(tables, coarse, place) if turned else torch.eye(3, dtype=torch.float64)
    correlation, known = _correlations(tables[BLURS_DEG[-1]], coarse, place, R[None])
    score = float(correlation[0]) if float(known[0]) > 0 else math.nan
    if turned and score < ALIKE_MIN:
        do = "compare maps of one ball; a mirrored map matches no rotation"
        raise PaintError(refusal("maps", expected="two of one ball", got=f"a correlation of {score:.2f}", do=do))
    direction = fibonacci_directions(DIRECTIONS)
    patches = Patches(direction=direction, R_other_reference=R)
    shift, sure = patch_shifts(tables[BLURS_DEG[1]], tables[FINE_BLUR_DEG], patches)
    spots = patches.points(1.0)
    seen = sample_texture(shares[1], spots.float()).amin(1) > HALF
    seen &= sample_texture(shares[0], (spots @ R.mT).float()).amin(1) > HALF
    moved = torch.where((sure & seen)[:, None], shift, torch.nan)
    if turned:  # with grey levels alone a worn place would rotate the whole map a little
        turn, moved = _common_turn(direction, moved)
        R = R @ so3.exp(turn)
    return MapComparison(R_other_reference=R, correlation=score, direction_body=direction, moved_rad=moved)


def turned_map(texture: Tensor, R_map_new: Tensor, height: int | None = None) -> Tensor:
    """Return a map (height, 2 height) in another body frame: new(d) = texture(R_map_new d), NaN where unknown."""
    height = len(texture) if height is None else height
    direction = map_directions(height).reshape(-1, 3) @ R_map_new.double().mT
    known = torch.isfinite(texture)
    grey = sample_texture(torch.where(known, texture, 0).double(), direction)
    share = sample_texture(known.double(), direction)
    value = torch.where(share >= HALF, grey / share.clamp_min(HALF), torch.nan)
    return value.reshape(height, 2 * height).to(texture.dtype)


def fit_levels(texture: Tensor, reference: Tensor) -> tuple[float, float]:
    """Return gain and offset, robust, that fit a map's grey levels to a reference's of the same size and frame."""
    known = torch.isfinite(texture) & torch.isfinite(reference)
    x, y = texture[known].double(), reference[known].double()
    columns, weight = torch.stack([x, torch.ones_like(x)], dim=1), torch.ones_like(x)
    for _ in range(5):
        gain, offset = _weighted_fit(columns, weight, y).tolist()
        left = (y - gain * x - offset).abs()
        weight = 1 / (1 + (left / left.median().clamp_min(1e-3) / 2) ** 2)
    return gain, offset


def _weighted_fit(columns: Tensor, weight: Tensor, values: Tensor) -> Tensor:
    """Return the coefficients (K,) of columns (n, K) of the weighted least-squares fit to values (n,)."""
    weighted = columns * weight[:, None]
    ridge = 1e-9 * torch.eye(columns.shape[1], dtype=columns.dtype)
    return torch.as_tensor(torch.linalg.solve(weighted.mT @ columns + ridge, weighted.mT @ values))


def texture_change(new: Tensor, old: Tensor) -> Tensor:
    """Return the change of grey (H, 2 H), -1 darker .. 1, of a map from an old one in the same frame; NaN: unknown.
    0: explained by a displacement up to `RADIUS_DEG`. The old grey levels are fitted to the new ones first.
    """
    gain, offset = fit_levels(old, new)
    grey = old * gain + offset
    known = torch.isfinite(grey)
    lowest, highest = (torch.where(known, grey, fill) for fill in (torch.inf, -torch.inf))
    direction = map_directions(len(old))
    east, north = compass(direction)
    filled = torch.where(known, grey, 0.5).double()
    for k in range(REACHES):
        angle, far = 2 * math.pi * k / REACHES, math.radians(RADIUS_DEG) * (1 if k % 2 else 0.5)
        near = F.normalize(direction + far * (math.cos(angle) * east + math.sin(angle) * north), dim=-1)
        value = sample_texture(filled, near).to(grey.dtype)
        lowest, highest = torch.minimum(lowest, value), torch.maximum(highest, value)
    return torch.where(known, new - torch.minimum(torch.maximum(new, lowest), highest), torch.nan)


def without_changed(comparison: MapComparison, change: Tensor, most: float) -> MapComparison:
    """Return a comparison without displacements of patches whose texture changed by more than `most`."""
    spots = Patches(direction=comparison.direction_body, R_other_reference=comparison.R_other_reference).points(1.0)
    changed = (change.abs() > most).double()  # an unknown texel counts as unchanged
    spoilt = sample_texture(changed, spots).mean(1) > CHANGED_SHARE
    return replace(comparison, moved_rad=torch.where(spoilt[:, None], torch.nan, comparison.moved_rad))


def _known(texture: Tensor) -> tuple[Tensor, Tensor]:
    """Return a map with its mean where unknown, and the mask of the known texels, (H, 2 H) float32 each."""
    check_texture_shape(texture)
    known = torch.isfinite(texture)
    middle = texture[known].mean() if known.any() else torch.tensor(0.5)
    return torch.where(known, texture, middle).float(), known.float()


def _best_rotation(tables: dict[float, list[TextureTable]], shares: list[Tensor], place: Tensor) -> Tensor:
    grid = so3.lattman_grid(math.radians(SEARCH_DEG)).double()
    few = fibonacci_directions(SEARCH_PLACES)
    tried = [_correlations(tables[SEARCH_BLUR_DEG], shares, few, some) for some in torch.split(grid, CHUNK)]
    scores = torch.cat([_shrunk(*each) for each in tried])
    found = []
    for R in grid[scores.topk(PEAKS).indices]:
        for blur in BLURS_DEG:
            R = _refined(tables[blur], shares, place, R)
        found.append((float(_shrunk(*_correlations(tables[BLURS_DEG[-1]], shares, place, R[None]))[0]), R))
    best: Tensor = max(found, key=lambda one: one[0])[1]
    return best


def _common_turn(direction: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
    """Return the common rotation (3,), rad, of most displacements (D, 2), and the displacements without it."""
    east, north = compass(direction)
    # turn x d has the east part turn . (d x east) = turn . north, and the north part -turn . east.
    columns = torch.stack([north, -east], dim=1)
    known, turn = torch.isfinite(moved).all(1), torch.zeros(3, dtype=torch.float64)
    for _ in range(5 if known.any() else 0):  # rounds of robust weights
        left = moved[known] - columns[known] @ turn
        length = left.norm(dim=-1)
        weight = 1 / (1 + (length / (2 * length.median().clamp_min(1e-6))) ** 2)
        turn = turn + _weighted_fit(columns[known].flatten(0, 1), weight.repeat_interleave(2), left.flatten())
    return turn, moved - columns @ turn


def _shrunk(score: Tensor, known: Tensor) -> Tensor:
    return score * known / (known + KNOWN_USUAL)


def _correlations(tables: list[TextureTable], shares: list[Tensor], place: Tensor, R: Tensor) -> tuple[Tensor, Tensor]:
    """Return correlations of the reference with the other map, rotated by (M, 3, 3), and known shares, (M,) each."""
    there = R @ place.T
    a, _ = tables[0].sample(there.float())
    b, _ = tables[1].sample(place.T[None].float())
    weight = sample_texture(shares[1], place.float())[None] * sample_texture(shares[0], there.mT.float())
    return weighted_correlation(a, b, weight).nan_to_num(0.0), weight.sum(1).clamp_min(1e-9) / len(place)


def weighted_correlation(a: Tensor, b: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return the correlations (M,) of values (M, P), weights (M, P) or None (equal); NaN without contrast."""
    weight = torch.ones_like(a) if weight is None else weight
    total = weight.sum(1).clamp_min(1e-9)
    a, b = (x - ((weight * x).sum(1) / total)[:, None] for x in (a, b))
    power = (weight * a * a).sum(1) * (weight * b * b).sum(1)
    return torch.where(power > 0, (weight * a * b).sum(1) / power.sqrt(), torch.nan)


def _refined(tables: list[TextureTable], shares: list[Tensor], place: Tensor, R: Tensor) -> Tensor:
    reference, _ = tables[1].sample(place.T[None].float())
    ones = torch.ones_like(reference[0])
    for _ in range(STEPS):
        there = R @ place.T
        grey, slope = tables[0].sample(there[None].float())
        weight = sample_texture(shares[1], place.float()) * sample_texture(shares[0], there.T.float())
        # grey(exp(delta) R d) = grey + slope . (delta x n) = grey + (n x slope) . delta
        turned = torch.linalg.cross(there.T.float(), slope[0].T)
        columns = torch.cat([-turned, reference[0][:, None], ones[:, None]], dim=1).double()
        step = _weighted_fit(columns, weight, grey[0].double())[:3]
        R = so3.exp(step * (0.1 / step.norm().clamp_min(1e-12)).clamp_max(1.0)) @ R
    return so3.nearest_rotation(R)


@dataclass(frozen=True, kw_only=True, eq=False)
class Patches:
    """Round patches about directions of the reference, in tangent planes whose axes point east and north."""

    direction: Tensor  # (D, 3) float64, no poles
    R_other_reference: Tensor  # (3, 3)

    def points(self, step_deg: float) -> Tensor:
        """Return the sample points of all patches, (D, P, 3), at a spacing in degrees."""
        return self.shifted(_offsets(step_deg), torch.zeros(len(self.direction), 2, dtype=torch.float64))

    def shifted(self, offset: Tensor, shift: Tensor) -> Tensor:
        """Return points (D, P, 3) at offsets (P, 2), rad east and north, from patches shifted by (D, 2)."""
        d = self.direction[:, None]
        east, north = (axis[:, None] for axis in compass(self.direction))
        at = (offset + shift[:, None]).tan()
        return F.normalize(d + at[..., :1] * east + at[..., 1:] * north, dim=-1)


def _offsets(step_deg: float) -> Tensor:
    count = math.floor(PATCH_DEG / step_deg)
    at = torch.arange(-count, count + 1, dtype=torch.float64) * math.radians(step_deg)
    grid = torch.stack(torch.meshgrid(at, at, indexing="xy"), dim=-1).reshape(-1, 2)
    return grid[grid.norm(dim=-1) <= math.radians(PATCH_DEG) + 1e-9]


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
        # Unknowns: shift, gain and offset from the other map's grey to the reference's.
        columns = torch.stack([-by_shift[:, 0], -by_shift[:, 1], reference, torch.ones_like(reference)], dim=1).double()
        normal, right = columns @ columns.mT, columns @ grey.double()[..., None]
        step = torch.linalg.solve(normal + 1e-9 * torch.eye(4).double(), right)[:, :2, 0]
        longest = math.radians(0.5)
        shift = shift + step * (longest / step.norm(dim=-1, keepdim=True).clamp_min(1e-12)).clamp_max(1.0)
    grey, by_shift = _sampled(fine[0], patches, offset, shift)
    own = (by_shift.double() @ by_shift.double().mT) / len(offset)
    weaker = torch.linalg.eigvalsh(own)[:, 0]
    sure = (weaker > ONE_WAY * own.diagonal(dim1=1, dim2=2).sum(-1)) & (reference.std(1) > CONTRAST_MIN)
    sure &= weighted_correlation(grey, reference) > FOUND_MIN
    sure &= shift.norm(dim=-1) < math.radians(PATCH_REACH_DEG)
    sure &= (shift - start).norm(dim=-1) < math.radians(ROUGH_DEG)  # else the refinement has left its peak
    return shift, sure & ~_contradicted(patches.direction, shift, sure)


def _contradicted(direction: Tensor, shift: Tensor, sure: Tensor) -> Tensor:
    """Return which patches (D,) contradict their overlapping neighbours, as they match another edge."""
    east, north = compass(direction)
    moved = shift[:, :1] * east + shift[:, 1:] * north
    near = (direction @ direction.mT).fill_diagonal_(-1) * sure - (~sure).double()
    cosine, which = near.topk(min(NEIGHBOURS, len(direction)), dim=1)
    close = cosine > math.cos(math.radians(NEAR_DEG))
    others = torch.where(close[..., None], moved[which], torch.nan)
    apart = (moved - others.nanmedian(1).values).norm(dim=-1)
    contradicted: Tensor = (close.sum(1) >= FEWEST) & (apart > math.radians(ASTRAY_DEG))
    return contradicted


def _searched(tables: list[TextureTable], patches: Patches) -> Tensor:
    count, offset = len(patches.direction), _offsets(2 * FINE_DEG)
    reference, _ = tables[1].sample(patches.points(2 * FINE_DEG).mT.float())
    steps = round(PATCH_REACH_DEG / ROUGH_DEG)
    at = torch.arange(-steps, steps + 1, dtype=torch.float64) * math.radians(ROUGH_DEG)
    tried = torch.stack(torch.meshgrid(at, at, indexing="ij"), dim=-1).reshape(-1, 2)
    greys = (_sampled(tables[0], patches, offset, shift.expand(count, 2))[0] for shift in tried)
    return tried[torch.stack([weighted_correlation(grey, reference) for grey in greys]).nan_to_num(-1).argmax(0)]


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
