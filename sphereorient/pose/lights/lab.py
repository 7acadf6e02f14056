"""One light in the lab for all cameras and places: light scattered by the paint, and mirrored by its gloss."""

import math
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from itertools import product

import numpy as np
import torch
from scipy.special import sph_legendre_p_all
from torch import Tensor

from sphereorient.files.threads import side_by_side
from sphereorient.pose.compiled import residuals_compiled
from sphereorient.pose.model import (
    LATER,
    Light,
    LightTables,
    SphereModel,
    SphereView,
    by_pose,
    scene_beside,
    surface_normals,
)
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses
from sphereorient.pose.residuals import Residuals, learn_stray, noise_curves
from sphereorient.so3 import inverse_damped
from sphereorient.sphere.texture import closed_texture, sample_at, texel_coordinates
from sphereorient.sphere.texture_table import octahedral_cells, octahedral_directions
from sphereorient.sphere.view import polynomials

SCATTERED, MIRRORED = 6, 16  # degrees of the harmonics over the normal and over the mirrored direction
KNOTS = (0.0, 0.12, 0.22, 0.32, 0.45, 0.6, 0.8, 1.0)  # depths, radii; the cover of the paint is linear between them
# Share of the light mirrored at the knots by a smooth cover of refractive index 1.5. Source: Fresnel 1823.
FRESNEL = (1.0, 0.421, 0.217, 0.125, 0.072, 0.051, 0.041, 0.04)
SIDE = 256  # cells per axis of a look-up map
BASIS_SIDE = 128  # the same for the harmonics of the estimate: 20 MB
DEPTHS = 1024  # entries of the look-up of the cover's functions
GRID = 360  # rows of latitude from which the look-up maps are interpolated: half a degree
ROUNDS, AGAIN = 5, 1  # Gauss-Newton steps from an even light, from a light in the lab
AT_ONCE = 4  # poses whose products are summed in single precision
INDEPENDENT = 0.1  # share of independent pixels, as errors of neighbours are correlated; other frames fit best with it
# Prior standard deviations. For harmonics of degree l, to be divided by 1 + l, in units of white less black paint:
LEVEL, SLOPES, GLOSS = 3.0, 0.2, 3.0  # the mean, all others, mirrored light: lamps are brighter than paint
THROUGH, FACE = 0.2, 0.3  # of the cover's two functions at a knot, the second one relative
TINT = (0.15, 0.08, 0.08)  # of a frame's own light, relative, by order
SHADE = (0.04, 0.02)  # of its own offset, in units of white less black paint


@dataclass(frozen=True, kw_only=True, eq=False)
class LabLight(Light):
    """Light that depends only on directions in the lab. At depth z below the disk's face, with normal n and line of
    sight d, a pixel of the sphere shows
    gain (through(z) (paint difference(n) + black(n)) + mirrored(z) gloss(d + 2 z n)).
    """

    difference: Tensor  # (K,), harmonics, grey levels
    black: Tensor  # (K,)
    gloss: Tensor  # (M,), harmonics of the mirrored surroundings, grey levels
    through: Tensor  # (n,), share of light that leaves the paint, at the KNOTS; 1 at the disk's middle
    mirrored: Tensor  # (n,), share of light that the surface mirrors
    gain: Tensor  # (C,), of each camera

    of_cameras = ("noise", "stray", "lean", "dark", "gain")
    linear = False

    @cached_property
    def _map(self) -> Tensor:
        """Return difference, black and gloss in cells of directions, (SIDE^2, 3)."""
        parts = ((self.difference, SCATTERED), (self.black, SCATTERED), (self.gloss, MIRRORED))
        grids = torch.stack([closed_texture(_on_grid(*part)) for part in parts])
        return sample_at(grids, *_cells_on_grid()).mT.float().contiguous().to(self.gloss.device)

    @cached_property
    def _cover(self) -> Tensor:
        """Return through and mirrored at depths from 0 to 1, (DEPTHS, 2)."""
        at = (torch.arange(DEPTHS, device=self.gloss.device) + 0.5) / DEPTHS
        return knot_shares(at) @ torch.stack([self.through, self.mirrored], dim=-1)

    @property
    def tables(self) -> LightTables:
        """The map of directions, (side^2, 3), and the cover's functions."""
        return LightTables(kind=1, cells=self._map, side=SIDE, cover=self._cover, gain=self.gain)

    def shown(self, view: SphereView, pixels: Pixels) -> tuple[Tensor, ...]:
        """Return difference, black, gloss (grey levels), through and mirrored of L disks, (L, P) each."""
        normal, mirror, depth = directions(view, pixels)
        cells = [octahedral_cells(part[:, 0], part[:, 1], part[:, 2], SIDE).reshape(-1) for part in (normal, mirror)]
        at = (depth * DEPTHS).to(torch.int32).clamp_(0, DEPTHS - 1).reshape(-1)
        scattered, gloss = self._map[:, :2].index_select(0, cells[0]), self._map[:, 2].index_select(0, cells[1])
        found = (*scattered.unbind(-1), gloss, *self._cover.index_select(0, at).unbind(-1))
        return tuple(part.reshape(depth.shape) for part in found)

    def at(self, view: SphereView, pixels: Pixels) -> tuple[Tensor, Tensor]:
        """Look up difference and black; see `Light.at`."""
        difference, black, gloss, through, mirrored = self.shown(view, pixels)
        gain = self.gain.repeat(len(gloss) // len(self.gain))[:, None]
        return gain * through * difference, gain * (through * black + mirrored * gloss)

    def mirrors(self, view: SphereView, pixels: Pixels) -> Tensor:
        """Return what the cover mirrors, grey levels; see `Light.mirrors`."""
        _, _, gloss, _, mirrored = self.shown(view, pixels)
        return view.coverage * self.gain.repeat(len(gloss) // len(self.gain))[:, None] * mirrored * gloss

    def learnt(
        self, pixels: Pixels, fit: FittedPoses, use: Tensor, model: SphereModel, *, glints: bool = True
    ) -> "LabLight":
        """Estimate light and noise, starting from this light; see `Light.learnt`."""
        return lab_light(pixels, fit, use, model, self)


UNKNOWN = ("difference", "black", "gloss", "through", "mirrored")


def directions(view: SphereView, pixels: Pixels) -> tuple[Tensor, Tensor, Tensor]:
    """Return unit normals and mirrored lines of sight, (L, 3, P) each, lab, and the depth (L, P), radii."""
    normal, depth = surface_normals(view, pixels)
    return normal, pixels.direction + 2.0 * depth[:, None] * normal, depth


def knot_shares(depth: Tensor) -> Tensor:
    """Return the shares (..., n) of the knots in a piecewise linear function at depths (...)."""
    knots = depth.new_tensor(KNOTS)
    low, high = knots[:-1], knots[1:]
    up = ((depth[..., None] - low) / (high - low)).clamp(0.0, 1.0)
    one = torch.ones_like(up[..., :1])
    return torch.cat([one, up], dim=-1) - torch.cat([up, 0 * one], dim=-1)


def harmonics(direction: Tensor, degree: int) -> Tensor:
    """Return the real spherical harmonics (..., (degree + 1)^2) float64 at unit directions (..., 3).
    Their mean square over the sphere is 1; degree l has the indices l^2 .. (l + 1)^2, order -l first.
    """
    x, y, z = direction.double().cpu().numpy().reshape(-1, 3).T
    polar, place = np.unique(np.arccos(np.clip(z, -1.0, 1.0)).round(14), return_inverse=True)  # many repeat in maps
    along = math.sqrt(8.0 * math.pi) * sph_legendre_p_all(degree, degree, polar)[0]
    turn = np.arange(degree + 1)[:, None] * np.arctan2(y, x)
    cos, sin = np.cos(turn), np.sin(turn)
    columns = []
    for n in range(degree + 1):
        here = along[n, : n + 1][:, place]
        columns += [here[m] * sin[m] for m in range(n, 0, -1)]
        columns += [here[0] / math.sqrt(2.0), *(here[m] * cos[m] for m in range(1, n + 1))]
    return torch.from_numpy(np.stack(columns, axis=-1)).reshape(*direction.shape[:-1], len(columns))


@lru_cache(maxsize=2)
def _harmonic_cells(degree: int) -> Tensor:
    """Return the harmonics in cells of directions, (BASIS_SIDE^2, K) float32."""
    return harmonics(octahedral_directions(BASIS_SIDE), degree).float()


@lru_cache(maxsize=2)
def _meridian(degree: int) -> Tensor:
    """Return the harmonics at the rows of a grid of latitudes, on the meridian y = 0."""
    polar = math.pi * (torch.arange(GRID, dtype=torch.float64) + 0.5) / GRID
    return harmonics(torch.stack([polar.sin(), torch.zeros_like(polar), polar.cos()], dim=-1), degree)


@lru_cache(maxsize=2)
def _longitudes(degree: int) -> Tensor:
    """Return the factor of each order, -degree .. degree, along a grid of longitudes, (2 degree + 1, 2 GRID)."""
    order = torch.arange(-degree, degree + 1)
    longitude = math.pi * (torch.arange(2 * GRID, dtype=torch.float64) + 0.5) / GRID - math.pi
    turn = order[:, None] * longitude
    return torch.where(order[:, None] < 0, (-turn).sin(), turn.cos())


def _on_grid(coefficients: Tensor, degree: int) -> Tensor:
    """Return a sum of harmonics on a grid of latitudes and longitudes, (GRID, 2 GRID)."""
    degrees, orders = torch.tensor([(n, m) for n in range(degree + 1) for m in range(-n, n + 1)]).T
    # On the meridian y = 0 only the cosine of orders m and -m is not 0; both have the same latitude factor.
    each = _meridian(degree)[:, degrees * (degrees + 1) + orders.abs()] * coefficients.double().cpu()
    return each.new_zeros(GRID, 2 * degree + 1).index_add(1, orders + degree, each) @ _longitudes(degree)


@cache
def _cells_on_grid() -> tuple[Tensor, Tensor]:
    """Return column and row of the cells of directions in that grid, (SIDE^2,) each."""
    return texel_coordinates(octahedral_directions(SIDE), GRID)


def lab_light(
    pixels: Pixels, fit: FittedPoses, use: Tensor, model: SphereModel, first: LabLight | None = None
) -> LabLight:
    """Estimate light and noise from the fits of B * C disks, those in `use` (B, C) bool.
    Gauss-Newton from the first light (None: an even one as bright as the model's). Each frame's light may differ a
    little, as in the fit, and poses are fitted too: a light at fixed poses would favour them.
    Source: irradiance as harmonics of the normal, Ramamoorthi and Hanrahan 2001.
    """
    used = use.reshape(-1, 1)
    at = residuals_compiled(pixels, fit.position_lab_mm, fit.R_lab_body, None, model)
    bases = _bases(at.view, pixels)
    light, rounds = (_flat(model.light, at.view, pixels, use), ROUNDS) if first is None else (first, AGAIN)
    light = replace(light, stray=learn_stray(at, pixels, use, light.stray))
    for _ in range(rounds):
        light = _better(light, at, pixels, used, bases)
        state, model = (at.model, at.weight), replace(model, light=light, shading=LATER)
        at = residuals_compiled(pixels, fit.position_lab_mm, fit.R_lab_body, state, model)
    counted = at.inside & ~pixels.clipped & used
    light = replace(light, noise=noise_curves(at.model, at.residual, counted, use.shape[1]))
    return light.with_lean(at.view, pixels, use)


def _bases(view: SphereView, pixels: Pixels) -> tuple[Tensor, Tensor, Tensor]:
    """Return the bases of the light, (L, n, P) each: harmonics of normal and mirrored direction, and the knots."""
    normal, mirror, depth = directions(view, pixels)
    over = []
    for part, degree in ((normal, SCATTERED), (mirror, MIRRORED)):
        cells = octahedral_cells(part[:, 0], part[:, 1], part[:, 2], BASIS_SIDE)
        over.append(_harmonic_cells(degree).index_select(0, cells.reshape(-1)).reshape(*cells.shape, -1).mT)
    return over[0], over[1], knot_shares(depth).mT


def _flat(known: Light, view: SphereView, pixels: Pixels, use: Tensor) -> LabLight:
    """Return an even light as bright as a known one, without gloss; a camera never in use has gain 1."""
    used, cameras = use.reshape(-1, 1), use.shape[1]
    share = by_pose(view.coverage.where(used, 0.0), cameras)
    bright = [by_pose(part.where(used, 0.0), cameras) for part in known.at(view, pixels)]
    difference, black = ((part * share).sum((0, 2)) / share.sum((0, 2)).clamp_min(1e-6) for part in bright)
    first = int(use.any(0).int().argmax())
    mean, knots = torch.zeros((SCATTERED + 1) ** 2), torch.ones(len(KNOTS))
    mean[0] = 1.0
    return LabLight(
        difference=difference[first] * mean,
        black=black[first] * mean,
        gloss=torch.zeros((MIRRORED + 1) ** 2),
        through=knots,
        mirrored=torch.tensor(FRESNEL),
        gain=torch.where(use.any(0), difference / difference[first], 1.0),
        noise=known.noise,
        stray=known.stray,
        lean=known.lean,
        dark=known.dark,
    )


def _better(
    light: LabLight, at: Residuals, pixels: Pixels, used: Tensor, bases: tuple[Tensor, Tensor, Tensor]
) -> LabLight:
    """Return the light after one step of Gauss-Newton; `used` (L, 1) bool."""
    unit, cameras, used = float(light.difference[0]), len(light.gain), used & (at.weight > 0).any(1, keepdim=True)
    unknown = [getattr(light, name) for name in UNKNOWN]
    now, sizes = torch.cat(unknown).double(), [len(part) for part in unknown]
    sums, factor = _sums(light, at, pixels, used, bases)
    expected, deviation = _beforehand(unit)
    known = deviation.double() ** -2
    step = torch.linalg.solve(sums[:-1, :-1] + known.diag(), sums[:-1, -1] + known * (expected - now))
    # A factor common to all frames belongs to the light; one common to a camera's frames is its gain.
    own_factor, number = factor[:, -1] - factor[:, :-1] @ step, by_pose(used[:, 0], cameras).sum(0)
    shared = (1.0 + by_pose(own_factor, cameras).sum(0) / number.clamp_min(1)).float()
    first = int((number > 0).int().argmax())
    gain = torch.where(number > 0, light.gain * shared / shared[first], light.gain)
    parts = dict(zip(UNKNOWN, (now + step).float().split(sizes), strict=True))
    return replace(light, gain=gain, **parts | {name: parts[name] * shared[first] for name in UNKNOWN[:3]})


def _sums(
    light: LabLight, at: Residuals, pixels: Pixels, used: Tensor, bases: tuple[Tensor, Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Return the products of all pairs of unknowns and the residuals, (n + 1, n + 1) float64, poses and the frames' own
    lights eliminated; and how each disk's own factor of the light changes with them, (L, n + 1).
    """
    unit, view, cameras = float(light.difference[0]), at.view, len(light.gain)
    precision = INDEPENDENT * (at.weight / at.variance).where(used, 0.0)
    tied = torch.tensor([TINT[0]] + [TINT[1]] * 2 + [TINT[2]] * 3 + [unit * SHADE[0]] + [unit * SHADE[1]] * 2)
    difference, black, gloss, through, mirrored = light.shown(view, pixels)
    cover = view.coverage * light.gain.repeat(len(gloss) // cameras)[:, None]
    shown = view.paint * difference + black
    learnt = cover * (through * shown + mirrored * gloss)
    left = pixels.grey - (1.0 - view.coverage) * scene_beside(view, pixels, light.stray) - learnt
    tints = polynomials(view.across, 2)
    own = torch.cat([learnt[:, None] * tints, view.coverage[:, None] * tints[:, :3]], dim=1)
    last = ((view.coverage > 0).any(0) * torch.arange(1, view.coverage.shape[1] + 1)).amax()
    there = slice(int(last))  # places are in order of distance from the disk's middle
    width = sum(len(getattr(light, name)) for name in UNKNOWN) + 1

    def of_disk(k: int) -> tuple[Tensor, Tensor, Tensor]:
        over_normal, over_mirror, over_depth = (basis[k, :, there] for basis in bases)
        share, paint = cover[k, there], view.paint[k, there]
        scattered = (share * through[k, there]) * over_normal
        columns = [paint * scattered, scattered, (share * mirrored[k, there]) * over_mirror]
        columns += [(share * part[k, there]) * over_depth for part in (shown, gloss)]
        rows = torch.cat([*columns, left[k : k + 1, there]])
        return rows, torch.cat([own[k, :, there], at.design[k, :6, there]]), precision[k, there]

    def of_poses(some: list[int]) -> tuple[list[int], Tensor, Tensor]:
        """Join the cameras of a pose, which share it; each has its own light."""
        tints, count = len(tied), cameras * len(tied)
        sums = _SymmetricSums(width)
        mixed = torch.zeros(len(some), count + 6, width, dtype=torch.float64)
        others = torch.cat([tied.double().pow(-2).repeat(cameras), torch.zeros(6)]).diag().repeat(len(some), 1, 1)
        for (row, b), c in product(enumerate(some), range(cameras)):
            if not bool(used[b * cameras + c]):
                continue
            place = torch.cat([torch.arange(tints) + c * tints, torch.arange(6) + count])
            rows, beside, weight = of_disk(b * cameras + c)
            sums.add(rows, weight)
            weighted = beside * weight
            mixed[row, place] += (weighted @ rows.T).double()
            others[row, place[:, None], place] += (weighted @ beside.T).double()
        taken = inverse_damped(others) @ mixed
        left_over = sums.matrix().double() - mixed.flatten(0, 1).T @ taken.flatten(0, 1)
        return some, left_over, taken[:, :count:tints]

    # A few poses at a time: the columns of all need too much memory.
    blocks = torch.split(by_pose(used, cameras).any(1).nonzero()[:, 0], AT_ONCE)
    whole, factor = torch.zeros(width, width).double(), torch.zeros(len(used), width).double()
    for some, sums, own_part in side_by_side(of_poses, [part.tolist() for part in blocks]):
        by_pose(factor, cameras)[some] = own_part
        whole += sums
    return whole, factor


class _SymmetricSums:
    """Sums of weighted products of all pairs of n rows; two of the matrix' four quarters are each other's transpose."""

    def __init__(self, count: int) -> None:
        half, rest = count // 2, count - count // 2
        self._quarters = torch.zeros(half, half), torch.zeros(rest, half), torch.zeros(rest, rest)

    def add(self, rows: Tensor, weight: Tensor) -> None:
        """Add the products of rows (n, P) with weights (P,)."""
        upper, beside, lower = self._quarters
        first, last, weighted = rows[: len(upper)].T, rows[len(upper) :].T, rows * weight
        upper.addmm_(weighted[: len(upper)], first)
        beside.addmm_(weighted[len(upper) :], first)
        lower.addmm_(weighted[len(upper) :], last)

    def matrix(self) -> Tensor:
        """Return the sums (n, n)."""
        upper, beside, lower = self._quarters
        return torch.cat([torch.cat([upper, beside.T], dim=1), torch.cat([beside, lower], dim=1)])


def _beforehand(unit: float) -> tuple[Tensor, Tensor]:
    """Return the prior mean of the light's unknowns, and its standard deviation; `unit`: white less black."""
    degree = [torch.tensor([n for n in range(most + 1) for _ in range(2 * n + 1)]) for most in (SCATTERED, MIRRORED)]
    scattered = torch.where(degree[0] == 0, LEVEL, SLOPES / (1 + degree[0])) * unit
    mirrored = GLOSS / (1 + degree[1]) * unit
    knots = torch.ones(len(KNOTS))
    free = torch.cat([knots[:-1], 1e-6 * knots[-1:]])  # fixed at the disk's middle
    fresnel = torch.tensor(FRESNEL)
    deviation = torch.cat([scattered, scattered, mirrored, THROUGH * free, FACE * free * fresnel])
    harmonic = torch.zeros(len(deviation) - 2 * len(knots))
    return torch.cat([harmonic, knots, fresnel]), deviation
