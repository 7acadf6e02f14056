"""Two maps of one ball: the rotation between their body frames, how far paint lies from where the other has it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from sphereorient import so3
from sphereorient.errors import PaintError, ShapeError, refusal
from sphereorient.mapping.patches import Patches, compass, patch_shifts
from sphereorient.sphere.texture import sample_texture
from sphereorient.sphere.texture_table import TextureTable, texture_table
from sphereorient.synth.textures import map_directions

SEARCH_DEG = 10.0  # step of the grid of rotations that are tried
SEARCH_BLUR_DEG = 7.0  # detail finer than the step only hides the right place
SEARCH_PLACES, PLACES = 1200, 5000
CHUNK = 256  # rotations tried at once
CLIMBS = 6  # best of them that are brought to the best fit nearby
BLURS_DEG = (5.0, 2.0, 0.8)  # on the way there
STEPS = 8
TURN_ROUNDS = 5  # of robust weights
KNOWN_USUAL = 0.1  # share of the sphere of which a correlation is half believed
ALIKE_MIN = 0.55  # correlation below which two maps do not show one ball; of two balls, or mirrored: up to 0.5
DIRECTIONS = 500  # in which the displacement is measured
FINE_BLUR_DEG = 0.5
SIDE = 256  # of the tables: 0.7 degrees, tangent planes between
HALF = 0.5  # share of a place's neighbourhood that must have been seen
RADIUS_DEG = 1.0  # within which the other map must show a brightness: what is only displaced is no wear
CHANGED = 0.15  # of black to white paint: a change that is told
CHANGED_SHARE = 0.01  # of a patch
REACHES = 16  # directions in which that is looked for


@dataclass(frozen=True, kw_only=True, eq=False)
class MapComparison:
    """How two maps of one ball differ; made by `compare_maps`. Directions are of the reference's body frame."""

    R_other_reference: Tensor  # (3, 3) float64: what the reference shows at d, the other shows at R d
    correlation: float  # of both maps once turned so, where both are known
    direction_body: Tensor  # (D, 3) float64, where the displacement was looked for
    moved_rad: Tensor  # (D, 2) float64, how far east and north of there the other map has its paint; NaN if unknown

    @property
    def length_rad(self) -> Tensor:
        """Length of the displacements that could be measured, (n,)."""
        length = self.moved_rad.norm(dim=-1)
        known: Tensor = length[torch.isfinite(length)]
        return known

    @property
    def rms_rad(self) -> float:
        """Root mean square of the displacements, NaN where none was measured."""
        return float(self.length_rad.square().mean().sqrt()) if len(self.length_rad) else math.nan

    @property
    def max_rad(self) -> float:
        """Largest displacement, NaN where none was measured."""
        return float(self.length_rad.max()) if len(self.length_rad) else math.nan


def compare_maps(other: Tensor, reference: Tensor, turned: bool = True) -> MapComparison:
    """Find how a map's paint is displaced against a reference.

    Args:
        other: (H, 2 H), 0 black .. 1 white, NaN where unknown.
        reference: (h, 2 h), likewise.
        turned: whether the body frames may differ by a rotation, which is found first; else they are one.

    Raises:
        PaintError: the maps do not show one ball.
        ShapeError: not 2:1.
    """
    maps = [_known(texture) for texture in (other, reference)]
    start = torch.eye(3, dtype=torch.float64)
    finest = [texture_table(grey, math.radians(FINE_BLUR_DEG), SIDE) for grey, _ in maps]
    blurs = (FINE_BLUR_DEG, *reversed(BLURS_DEG), SEARCH_BLUR_DEG)
    tables = {blur: [table.blurred(math.radians(blur)) for table in finest] for blur in blurs}
    shares = [share for _, share in maps]
    place = fibonacci(PLACES)
    R = _best_rotation(tables, shares, place) if turned else start
    score = _correlation(tables[BLURS_DEG[-1]], shares, place, R)
    if turned and score < ALIKE_MIN:
        do = "compare maps of one ball; a mirrored map matches no rotation"
        raise PaintError(refusal("maps", expected="two of one ball", got=f"a correlation of {score:.2f}", do=do))
    direction = fibonacci(DIRECTIONS)
    shifts = patch_shifts(
        tables[BLURS_DEG[1]], tables[FINE_BLUR_DEG], Patches(direction=direction, R_other_reference=R)
    )
    known = _seen_around(shares, direction, R)
    moved = torch.where((shifts.sure & known)[:, None], shifts.shift_rad, torch.nan)
    if turned:  # brightness alone lets a worn place turn the whole map a little
        turn, moved = _common_turn(direction, moved)
        R = R @ so3.exp(turn)
    return MapComparison(R_other_reference=R, correlation=score, direction_body=direction, moved_rad=moved)


def turned_map(texture: Tensor, R_map_new: Tensor, height: int | None = None) -> Tensor:
    """Return a map in another body frame: new(d) = texture(R_map_new d), NaN where that is unknown.

    Args:
        texture: (H, 2 H), NaN where unknown.
        R_map_new: (3, 3), from the new body frame to the map's.
        height: rows of the new map; None: as many.
    """
    height = len(texture) if height is None else height
    direction = map_directions(height).reshape(-1, 3) @ R_map_new.double().mT
    known = torch.isfinite(texture)
    grey = sample_texture(torch.where(known, texture, 0).double(), direction)
    share = sample_texture(known.double(), direction)
    value = torch.where(share >= HALF, grey / share.clamp_min(HALF), torch.nan)
    return value.reshape(height, 2 * height).to(texture.dtype)


def fit_levels(texture: Tensor, reference: Tensor) -> tuple[float, float]:
    """Return gain and offset by which a map's grey comes nearest to a reference's of the same size and frame.

    What lies far off (a new spot, a seam) has little weight.
    """
    known = torch.isfinite(texture) & torch.isfinite(reference)
    x, y = texture[known].double(), reference[known].double()
    columns = torch.stack([x, torch.ones_like(x)], dim=1)
    weight = torch.ones_like(x)
    for _ in range(5):
        scaled = columns * weight[:, None]
        gain, offset = torch.linalg.solve(scaled.mT @ columns + 1e-9 * torch.eye(2).double(), scaled.mT @ y).tolist()
        left = (y - gain * x - offset).abs()
        weight = 1 / (1 + (left / left.median().clamp_min(1e-3) / 2) ** 2)
    return gain, offset


def paint_change(new: Tensor, old: Tensor) -> Tensor:
    """Return where paint itself changed, (H, 2 H): how far the new map's grey is beyond all that the old one has near.

    Args:
        new: (H, 2 H), 0 black .. 1 white, NaN where unknown.
        old: (H, 2 H), of the same frame; its grey levels are brought to the new one's first.

    Returns:
        -1 .. 1, negative where paint became darker; 0 where a displacement of up to `RADIUS_DEG` explains all, NaN
        where either map is unknown.
    """
    gain, offset = fit_levels(old, new)
    grey = old * gain + offset
    known = torch.isfinite(grey)
    low, high = (torch.where(known, grey, fill) for fill in (torch.inf, -torch.inf))
    direction = map_directions(len(old)).reshape(-1, 3)
    east, north = compass(direction)
    filled = torch.where(known, grey, 0.5)
    lowest, highest = low.reshape(-1).clone(), high.reshape(-1).clone()
    for k in range(REACHES):
        angle, far = 2 * math.pi * k / REACHES, math.radians(RADIUS_DEG) * (1 if k % 2 else 0.5)
        near = F.normalize(direction + far * (math.cos(angle) * east + math.sin(angle) * north), dim=-1)
        value = sample_texture(filled.double(), near).to(grey.dtype)
        lowest, highest = torch.minimum(lowest, value), torch.maximum(highest, value)
    flat = new.reshape(-1)
    change = flat - torch.minimum(torch.maximum(flat, lowest), highest)
    return torch.where(known.reshape(-1), change, torch.nan).reshape(new.shape)


def without_changed(comparison: MapComparison, change: Tensor, most: float) -> MapComparison:
    """Return a comparison without the patches in which paint itself changed: their shift says nothing.

    Args:
        comparison: of two maps.
        change: (H, 2 H), of `paint_change`, in the reference's frame.
        most: change of a texel from which on it counts.
    """
    spots = Patches(direction=comparison.direction_body, R_other_reference=comparison.R_other_reference).points(1.0)
    changed = (change.abs() > most).double()  # what is unknown has not
    spoilt = sample_texture(changed, spots).mean(1) > CHANGED_SHARE
    return replace(comparison, moved_rad=torch.where(spoilt[:, None], torch.nan, comparison.moved_rad))


def fibonacci(count: int) -> Tensor:
    """Return evenly spread directions, (count, 3) float64, none of them a pole."""
    k = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * k / count
    angle = math.pi * (1 + math.sqrt(5.0)) * k
    level = (1 - z * z).sqrt()
    return torch.stack([level * angle.cos(), level * angle.sin(), z], dim=-1)


def _known(texture: Tensor) -> tuple[Tensor, Tensor]:
    """Return a map with the unknown filled, and where it is known, each (H, 2 H) float32."""
    if texture.ndim != 2 or texture.shape[1] != 2 * texture.shape[0]:
        raise ShapeError(refusal("map", expected="(H, 2 H)", got=str(tuple(texture.shape)), do="pass one map"))
    known = torch.isfinite(texture)
    middle = texture[known].mean() if known.any() else torch.tensor(0.5)
    return torch.where(known, texture, middle).float(), known.float()


def _best_rotation(tables: dict[float, list[TextureTable]], shares: list[Tensor], place: Tensor) -> Tensor:
    """Search all rotations, and climb from the best."""
    rough = tables[SEARCH_BLUR_DEG]
    grid = so3.lattman_grid(math.radians(SEARCH_DEG)).double()
    few = fibonacci(SEARCH_PLACES)
    tried = [_correlations(rough, shares, few, some) for some in torch.split(grid, CHUNK)]
    scores = torch.cat([_trusted(*each) for each in tried])
    found = []
    for R in grid[scores.topk(CLIMBS).indices]:
        for blur in BLURS_DEG:
            R = _climbed(tables[blur], shares, place, R)
        found.append((float(_trusted(*_correlations(tables[BLURS_DEG[-1]], shares, place, R[None]))[0]), R))
    best: Tensor = max(found, key=lambda one: one[0])[1]
    return best


def _common_turn(direction: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rotation (3,), rad, that most displacements (D, 2) share, and what they are without it."""
    east, north = compass(direction)
    # turn x d to the east is turn . (d x east), and d x east is north; to the north it is -turn . east.
    columns = torch.stack([north, -east], dim=1)
    known = torch.isfinite(moved).all(1)
    turn = torch.zeros(3, dtype=torch.float64)
    for _ in range(TURN_ROUNDS):
        left = moved[known] - columns[known] @ turn
        length = left.norm(dim=-1)
        weight = 1 / (1 + (length / (2 * length.median().clamp_min(1e-6))) ** 2) if len(length) else length
        normal = torch.einsum("n,nki,nkj->ij", weight, columns[known], columns[known]) + 1e-9 * torch.eye(3).double()
        turn = turn + torch.linalg.solve(normal, torch.einsum("n,nki,nk->i", weight, columns[known], left))
    return turn, moved - columns @ turn


def _trusted(score: Tensor, known: Tensor) -> Tensor:
    """Shrink correlations (M,) of little that both maps know: it says little."""
    return score * known / (known + KNOWN_USUAL)


def _correlation(tables: list[TextureTable], shares: list[Tensor], place: Tensor, R: Tensor) -> float:
    score, known = _correlations(tables, shares, place, R[None])
    return float(score[0]) if float(known[0]) > 0 else math.nan


def _correlations(tables: list[TextureTable], shares: list[Tensor], place: Tensor, R: Tensor) -> tuple[Tensor, Tensor]:
    """Correlate the other map, turned by (M, 3, 3), with the reference; and tell the share that both know, (M,)."""
    there = R @ place.T
    a, _ = tables[0].sample(there.float())
    b, _ = tables[1].sample(place.T[None].float())
    weight = sample_texture(shares[1], place.float())[None] * sample_texture(shares[0], there.mT.float())
    total = weight.sum(1).clamp_min(1e-9)
    a, b = a - ((weight * a).sum(1) / total)[:, None], b - ((weight * b).sum(1) / total)[:, None]
    power = (weight * a * a).sum(1) * (weight * b * b).sum(1)
    return (weight * a * b).sum(1) / power.clamp_min(1e-18).sqrt(), total / len(place)


def _climbed(tables: list[TextureTable], shares: list[Tensor], place: Tensor, R: Tensor) -> Tensor:
    """Gauss-Newton on the rotation, gain and offset between the maps."""
    reference, _ = tables[1].sample(place.T[None].float())
    ones = torch.ones_like(reference[0])
    for _ in range(STEPS):
        there = R @ place.T
        grey, slope = tables[0].sample(there[None].float())
        weight = sample_texture(shares[1], place.float()) * sample_texture(shares[0], there.T.float())
        # grey(exp(delta) R d) = grey + slope . (delta x n) = grey + (n x slope) . delta
        turned = torch.linalg.cross(there.T.float(), slope[0].T)
        columns = torch.cat([-turned, reference[0][:, None], ones[:, None]], dim=1).double()
        weighted = columns * weight[:, None]
        normal = weighted.mT @ columns + 1e-9 * torch.eye(5).double()
        step = torch.linalg.solve(normal, weighted.mT @ grey[0].double())[:3]
        R = so3.exp(step * (0.1 / step.norm().clamp_min(1e-12)).clamp_max(1.0)) @ R
    return so3.nearest_rotation(R)


def _seen_around(shares: list[Tensor], direction: Tensor, R: Tensor) -> Tensor:
    """Return which patches both maps know, (D,)."""
    spots = Patches(direction=direction, R_other_reference=R).points(1.0)
    own = sample_texture(shares[1], spots.float()).amin(1) > HALF
    return own & (sample_texture(shares[0], (spots @ R.mT).float()).amin(1) > HALF)
