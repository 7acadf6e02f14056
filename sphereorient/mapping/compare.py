"""Compare two texture maps of one sphere: body frame, displacements, changes; correct an old map."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from sphereorient import so3
from sphereorient.errors import PaintError, refusal
from sphereorient.mapping.grid import texel_areas
from sphereorient.mapping.learn import LearntMap
from sphereorient.mapping.patches import Patches, compass, patch_shifts
from sphereorient.sphere.texture import check_texture_shape, sample_texture, texture_coordinates
from sphereorient.sphere.texture_table import TextureTable, texture_table
from sphereorient.synth.textures import map_directions

SEARCH_DEG = 10.0  # step of the grid of rotations
SEARCH_BLUR_DEG = 7.0  # detail finer than the step only hides the right place
SEARCH_PLACES, PLACES = 1200, 5000
CHUNK = 256  # rotations tried at once
PEAKS = 6  # best rotations that are refined
BLURS_DEG = (5.0, 2.0, 0.8)  # of the refinement
STEPS = 8
TURN_ITERATIONS = 5  # of robust weights
KNOWN_USUAL = 0.1  # share of the sphere of which a correlation is half believed
ALIKE_MIN = 0.55  # correlation below which two maps do not show one ball; of two balls, or mirrored: up to 0.5
DIRECTIONS = 500  # in which the displacement is measured
FINE_BLUR_DEG = 0.5
SIDE = 256  # of the tables: 0.7 degrees, tangent planes between
HALF = 0.5  # share of a patch that must have been seen
RADIUS_DEG = 1.0  # within which the other map must show a grey level: displacement alone is no wear
CHANGED = 0.15  # of black to white: a change that is reported
CHANGED_SHARE = 0.01  # of a patch
REACHES = 16  # directions of that search


@dataclass(frozen=True, kw_only=True, eq=False)
class MapComparison:
    """How two maps of one sphere differ; directions are in the reference's body frame."""

    R_other_reference: Tensor  # (3, 3) float64: what the reference shows at d, the other shows at R d
    correlation: float  # of both maps after that rotation, where both are known
    direction_body: Tensor  # (D, 3) float64, where the displacement was measured
    moved_rad: Tensor  # (D, 2) float64, displacement to the east and north in the other map; NaN if unknown

    @property
    def length_rad(self) -> Tensor:
        """Length of the measured displacements, rad, (n,)."""
        length = self.moved_rad.norm(dim=-1)
        known: Tensor = length[torch.isfinite(length)]
        return known

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
    shares = [share for _, share in maps]
    place = fibonacci_directions(PLACES)
    R = _best_rotation(tables, shares, place) if turned else torch.eye(3, dtype=torch.float64)
    correlation, known = _correlations(tables[BLURS_DEG[-1]], shares, place, R[None])
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
    if turned:  # on grey levels alone a worn place would turn the whole map a little
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
    columns = torch.stack([x, torch.ones_like(x)], dim=1)
    weight = torch.ones_like(x)
    for _ in range(5):
        gain, offset = _weighted_fit(columns, weight, y).tolist()
        left = (y - gain * x - offset).abs()
        weight = 1 / (1 + (left / left.median().clamp_min(1e-3) / 2) ** 2)
    return gain, offset


def _weighted_fit(columns: Tensor, weight: Tensor, values: Tensor) -> Tensor:
    """Return the coefficients (K,) of columns (n, K) that fit values (n,) at weights (n,) best."""
    weighted = columns * weight[:, None]
    ridge = 1e-9 * torch.eye(columns.shape[1], dtype=columns.dtype)
    return torch.linalg.solve(weighted.mT @ columns + ridge, weighted.mT @ values)


def texture_change(new: Tensor, old: Tensor) -> Tensor:
    """Return the change of grey (H, 2 H), -1 darker .. 1, of a map from an old one in the same frame; NaN: unknown.

    0: a displacement up to `RADIUS_DEG` explains it. The old grey levels are fitted to the new ones first.
    """
    gain, offset = fit_levels(old, new)
    grey = old * gain + offset
    known = torch.isfinite(grey)
    lowest, highest = (torch.where(known, grey, fill).reshape(-1) for fill in (torch.inf, -torch.inf))
    direction = map_directions(len(old)).reshape(-1, 3)
    east, north = compass(direction)
    filled = torch.where(known, grey, 0.5)
    for k in range(REACHES):
        angle, far = 2 * math.pi * k / REACHES, math.radians(RADIUS_DEG) * (1 if k % 2 else 0.5)
        near = F.normalize(direction + far * (math.cos(angle) * east + math.sin(angle) * north), dim=-1)
        value = sample_texture(filled.double(), near).to(grey.dtype)
        lowest, highest = torch.minimum(lowest, value), torch.maximum(highest, value)
    flat = new.reshape(-1)
    change = flat - torch.minimum(torch.maximum(flat, lowest), highest)
    return torch.where(known.reshape(-1), change, torch.nan).reshape(new.shape)


def without_changed(comparison: MapComparison, change: Tensor, most: float) -> MapComparison:
    """Return a comparison without displacements of patches whose texture changed by more than `most`."""
    spots = Patches(direction=comparison.direction_body, R_other_reference=comparison.R_other_reference).points(1.0)
    changed = (change.abs() > most).double()  # an unknown texel has not changed
    spoilt = sample_texture(changed, spots).mean(1) > CHANGED_SHARE
    return replace(comparison, moved_rad=torch.where(spoilt[:, None], torch.nan, comparison.moved_rad))


def fibonacci_directions(count: int) -> Tensor:
    """Return evenly spread directions, (count, 3) float64, without the poles (Swinbank and Purser 2006)."""
    k = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * k / count
    angle = math.pi * (1 + math.sqrt(5.0)) * k
    level = (1 - z * z).sqrt()
    return torch.stack([level * angle.cos(), level * angle.sin(), z], dim=-1)


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
    """Return the rotation (3,), rad, that most displacements (D, 2) share, and the displacements without it."""
    east, north = compass(direction)
    # turn x d to the east is turn . (d x east), and d x east is north; to the north it is -turn . east.
    columns = torch.stack([north, -east], dim=1)
    known = torch.isfinite(moved).all(1)
    turn = torch.zeros(3, dtype=torch.float64)
    for _ in range(TURN_ITERATIONS):
        left = moved[known] - columns[known] @ turn
        length = left.norm(dim=-1)
        weight = 1 / (1 + (length / (2 * length.median().clamp_min(1e-6))) ** 2) if len(length) else length
        normal = torch.einsum("n,nki,nkj->ij", weight, columns[known], columns[known]) + 1e-9 * torch.eye(3).double()
        turn = turn + torch.linalg.solve(normal, torch.einsum("n,nki,nk->i", weight, columns[known], left))
    return turn, moved - columns @ turn


def _shrunk(score: Tensor, known: Tensor) -> Tensor:
    return score * known / (known + KNOWN_USUAL)


def _correlations(tables: list[TextureTable], shares: list[Tensor], place: Tensor, R: Tensor) -> tuple[Tensor, Tensor]:
    """Return correlations of the other map, rotated by (M, 3, 3), with the reference, and known shares, (M,) each."""
    there = R @ place.T
    a, _ = tables[0].sample(there.float())
    b, _ = tables[1].sample(place.T[None].float())
    weight = sample_texture(shares[1], place.float())[None] * sample_texture(shares[0], there.mT.float())
    total = weight.sum(1).clamp_min(1e-9)
    a, b = a - ((weight * a).sum(1) / total)[:, None], b - ((weight * b).sum(1) / total)[:, None]
    power = (weight * a * a).sum(1) * (weight * b * b).sum(1)
    return (weight * a * b).sum(1) / power.clamp_min(1e-18).sqrt(), total / len(place)


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


def corrected(learnt: LearntMap, old: Tensor) -> tuple[LearntMap, MapComparison, float]:
    """Express a learnt map in the frame of an old one (h, 2 h), used where unseen; raise PaintError on a mismatch.

    Return also the displacement against the old map, and the share of the sphere with the old map's texture.
    """
    comparison = compare_maps(learnt.texture, old)
    Q = comparison.R_other_reference
    height = max(len(old), len(learnt.texture))
    texture = turned_map(learnt.texture, Q, height)
    known = torch.isfinite(texture)
    before = old.to(texture) if len(old) == height else turned_map(old.to(texture), torch.eye(3), height)
    gain, offset = fit_levels(before, texture)
    new = replace(
        learnt,
        texture=torch.where(known, texture, (gain * before + offset).clamp(0, 1)),
        seen=torch.where(known, nearest_texels(learnt.seen, Q, height), 0),
        sigma=torch.where(known, nearest_texels(learnt.sigma, Q, height), torch.inf),
        R_lab_body=learnt.R_lab_body @ Q,
    )
    return new, comparison, float((texel_areas(height) * ~known).sum() / texel_areas(height).sum())


def nearest_texels(values: Tensor, R_map_new: Tensor, height: int) -> Tensor:
    """Return a map's values in another body frame by the nearest texel, (height, 2 height)."""
    rows = len(values)
    longitude, latitude = texture_coordinates(map_directions(height) @ R_map_new.double().mT)
    column = ((longitude / torch.pi + 1) * rows).long() % (2 * rows)
    row = ((0.5 - latitude / torch.pi) * rows).long().clamp(0, rows - 1)
    return values[row, column]
