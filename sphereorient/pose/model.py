"""The measuring model: the painted sphere in the pixels of a camera, blurred, its derivatives by the pose, its light.

Light: brightness of white and black paint over the disk, low-order maps per camera, estimated from the movie; or
one light in the lab for all cameras (`lab_light`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.pose.pixels import Pixels
from sphereorient.so3 import cross_first_axis
from sphereorient.sphere.texture_table import TextureTable
from sphereorient.sphere.view import nearest_approach

SPREAD_MIN = 0.02  # least share of the blur's variance left inside the limb: keeps the look-up off the limb itself
RIM_NODES = 4  # look-ups along the radius near the limb, where the paint is compressed
UNSEEN = 0.02  # a pixel that looks at a larger share of unknown paint counts for nothing
DEPTH_MIN = 0.03  # least depth of a look-up below the limb, radii: the slope of the paint is infinite on the limb
COVER_MIN = 1e-4  # of a pixel, so that paint beyond the limb has a value
MAP_SIDE = 256  # cells of a look-up map across the disk: a third of a pixel of an 80 px disk
ORDER, DEPTH_ORDER = 4, 3  # of the polynomials in x, y and of those times the depth sqrt(1 - x^2 - y^2)
GLINTS = 32  # cells across the disk
STRAY_ORDER = 4  # of the harmonics over the angle about the disk


@dataclass(frozen=True, kw_only=True, eq=False)
class Shading:
    """Orders of the polynomials by which a frame's light may differ from the learnt one."""

    difference: int
    black: int

    @property
    def counts(self) -> tuple[int, int]:
        """Numbers of coefficients of difference and black."""
        difference, black = ((order + 1) * (order + 2) // 2 for order in (self.difference, self.black))
        return difference, black


FIRST = Shading(difference=4, black=2)  # before the light is estimated
LATER = Shading(difference=2, black=1)


def polynomials(across: Tensor, order: int) -> Tensor:
    """Return all monomials of x and y up to an order, (..., K, P), from places (..., 2, P)."""
    x, y = across[..., 0, :], across[..., 1, :]
    columns = [torch.ones_like(x)]
    last = columns
    for _ in range(order):
        last = [last[0] * x, *(column * y for column in last)]
        columns = [*columns, *last]
    return torch.stack(columns, dim=-2)


def light_basis(across: Tensor) -> Tensor:
    """Return the basis of light maps, (..., K, P): polynomials in the normal's components, which fit grazing lamps."""
    depth = (1.0 - across.square().sum(-2)).clamp_min(0).sqrt()
    return torch.cat([polynomials(across, ORDER), polynomials(across, DEPTH_ORDER) * depth[..., None, :]], dim=-2)


def stray_basis(across: Tensor) -> Tensor:
    """Return the harmonics over the angle about the disk, (..., K, P), at places (..., 2, P): 1, cos, sin, cos 2 .."""
    cos, sin = torch.nn.functional.normalize(across, dim=-2).unbind(-2)
    columns = [torch.ones_like(cos), cos, sin]
    for _ in range(STRAY_ORDER - 1):
        last_cos, last_sin = columns[-2:]
        columns += [last_cos * cos - last_sin * sin, last_sin * cos + last_cos * sin]
    return torch.stack(columns, dim=-2)


def scene_beside(view: "SphereView", pixels: Pixels, stray: Tensor) -> Tensor:
    """Return what L disks show beside the sphere, grey levels (L, P): the empty scene, and stray light (C, K) of the
    C cameras, which only pixels that the limb may reach are asked for.
    """
    outer = slice(pixels.inner, None)
    more = stray.repeat(len(view.across) // len(stray), 1)[:, None] @ stray_basis(view.across[..., outer])
    return torch.cat([pixels.behind[:, : pixels.inner], pixels.behind[:, outer] + more[:, 0]], dim=1)


def no_stray(cameras: int) -> Tensor:
    """Return the coefficients of no stray light."""
    return torch.zeros(cameras, 1 + 2 * STRAY_ORDER)


def no_glints(cameras: int) -> Tensor:
    """Return the glints of a surface that mirrors no lamp."""
    return torch.zeros(cameras, GLINTS, GLINTS)


def glints_at(glints: Tensor, across: Tensor) -> Tensor:
    """Return the glints (L, G, G) of L disks at places (L, P, 2), radii: grey levels (L, P), linear between cells."""
    sampled = torch.nn.functional.grid_sample(
        glints[:, None], across[:, None].to(glints), padding_mode="border", align_corners=False
    )
    return sampled[:, 0, 0]


class Lighting(Protocol):
    """How bright paint appears in the pictures of C cameras, and their noise: `Light`, or `LabLight`."""

    @property
    def stray(self) -> Tensor:
        """Coefficients of the light beside the sphere that the empty scene lacks, (C, K), grey levels; `stray_basis`.
        A lens with glare, or light that the sphere throws on a wall, makes it.
        """

    @property
    def noise(self) -> Tensor:
        """Coefficients of the noise's variance, (C, 4); see `Light`."""

    @property
    def known(self) -> bool:
        """Whether it is estimated from pictures."""

    def at(self, view: "SphereView", pixels: Pixels) -> tuple[Tensor, Tensor]:
        """Return white less black paint and black paint, grey levels, (L, P) each, of L disks."""

    @property
    def tables(self) -> "LightTables":
        """What `at` looks up."""

    def of(self, *cameras: int) -> "Lighting":
        """Return the light of some cameras."""

    def to(self, device: torch.device) -> "Lighting":
        """Return the light on another device."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightTables:
    """Look-up tables of a light: over the disk, or over directions in the lab."""

    cells: Tensor  # (C * side^2, 2), difference and black on each camera's disk; or (side^2, 3), with gloss, in the lab
    side: int
    cover: Tensor | None = None  # (n, 2), shares of light through and mirrored at depths 0 .. 1; None: on the disk
    gain: Tensor | None = None  # (C,), of light in the lab


@dataclass(frozen=True, kw_only=True, eq=False)
class SphereModel:
    """What a picture of the sphere depends on, its pose aside."""

    radius_mm: float
    paint: TextureTable  # blurred by `blur_px` as seen at the disk's middle
    blur_px: float  # standard deviation of optics, pixel and whatever was laid over the frame, px
    light: Lighting  # of the C cameras
    shading: Shading = LATER  # how far a frame's light may differ from it
    limb_px: Tensor | None = None  # (C,), how far the limb lies outside of its place by all cameras: an error; None: 0


@dataclass(frozen=True, kw_only=True, eq=False)
class SphereView:
    """The sphere in the pixels of L disks at one pose each; made by `sphere_view`."""

    paint: Tensor  # (L, P), blurred paint seen, 0 .. 1
    coverage: Tensor  # (L, P), share of the pixel's blurred aperture that the sphere fills
    across: Tensor  # (L, 2, P), place on the disk along the camera's x and y, radii
    outward: Tensor  # (L, 3, P), unit, lab, from the centre to the line of sight
    aside: Tensor  # (L, P), distance of the place from the line of sight through the centre, radii
    paint_by_rotation: Tensor  # (L, 3, P), derivative by delta in exp([delta]x) R, 1/rad
    paint_by_position: Tensor  # (L, 3, P), derivative by the centre, lab, 1/mm
    coverage_by_position: Tensor  # (L, 3, P), 1/mm
    known: Tensor | None  # (L, P) bool, whether all paint that the pixel looks at is known; None: everywhere


@dataclass(frozen=True, kw_only=True, eq=False)
class Light:
    """Light on the disk and noise of a movie's pictures, one entry per camera; made by `learn_light`.
    A pixel of the sphere shows paint * difference + black, each a map over the disk; its noise has the variance
    noise[0] + noise[1] I + noise[2] I^2 + noise[3] I^3 (read-out; photons; grain of all paint, of white paint alone).
    """

    difference: Tensor  # (C, K), white less black paint, grey levels
    black: Tensor  # (C, K)
    noise: Tensor  # (C, 4), grey levels^2 .. 1 / grey level
    glints: Tensor  # (C, G, G), more of black, over the square about the disk: lamps that the surface mirrors
    stray: Tensor  # (C, K), see `Lighting`
    known: bool  # False: difference is 1 everywhere, black and glints 0

    @cached_property
    def _map(self) -> Tensor:
        """Return difference and black over the square about the disk, (C * S * S, 2): a look-up beats 25 functions."""
        at = (torch.arange(MAP_SIDE, dtype=torch.float32, device=self.difference.device) + 0.5) * (2.0 / MAP_SIDE) - 1.0
        y, x = torch.meshgrid(at, at, indexing="ij")
        across = torch.stack([x, y]).reshape(2, -1)
        # Cells that the limb cuts take their value on the disk.
        across = across / across.norm(dim=0).clamp_min(1.0)
        basis = light_basis(across)
        black = self.black @ basis + glints_at(self.glints, across.mT.expand(len(self.glints), -1, -1))
        return torch.stack([self.difference @ basis, black], dim=-1).reshape(-1, 2)

    @property
    def tables(self) -> LightTables:
        """What `at` looks up."""
        return LightTables(cells=self._map, side=MAP_SIDE)

    def at(self, view: SphereView, pixels: Pixels) -> tuple[Tensor, Tensor]:
        """Return difference and black, grey levels, (L, P) each, of L disks, the C cameras of a pose side by side."""
        across, cameras = view.across, len(self.difference)
        column, row = ((across + 1.0) * (0.5 * MAP_SIDE)).to(torch.int32).clamp_(0, MAP_SIDE - 1).unbind(1)
        camera = torch.arange(len(across), device=across.device, dtype=torch.int32) % cameras
        cell = (camera[:, None] * MAP_SIDE + row) * MAP_SIDE + column
        found = self._map.index_select(0, cell.reshape(-1)).to(across.dtype)
        return found[:, 0].reshape(cell.shape), found[:, 1].reshape(cell.shape)

    def of(self, *cameras: int) -> "Light":
        """Return the light of some cameras."""
        return replace(self, **{name: getattr(self, name)[list(cameras)] for name in LIGHT_PARTS})

    def to(self, device: torch.device) -> "Light":
        """Return the light on another device."""
        return replace(self, **{name: getattr(self, name).to(device) for name in LIGHT_PARTS})

    @classmethod
    def unknown(cls, cameras: int, noise: Tensor) -> "Light":
        """Return flat light, for the first fits."""
        count = light_basis(torch.zeros(1, 2, 1)).shape[-2]
        difference = torch.zeros(cameras, count)
        difference[:, 0] = 1.0
        black, glints, stray = torch.zeros(cameras, count), no_glints(cameras), no_stray(cameras)
        return cls(difference=difference, black=black, glints=glints, noise=noise, stray=stray, known=False)


LIGHT_PARTS = tuple(field.name for field in fields(Light) if field.name != "known")


def sphere_view(pixels: Pixels, position_lab_mm: Tensor, R_lab_body: Tensor, model: SphereModel) -> SphereView:
    """Render the sphere at position_lab_mm (L, 3) and R_lab_body (L, 3, 3) through pixels with a Gaussian aperture.
    Where it moves during the exposure, the mean of `pixels.instants` instants of it, the pose in the middle.
    """
    poses, shares = during_exposure(pixels, position_lab_mm, R_lab_body)
    views = [_view_at(pixels, X, R, model) for X, R in poses]
    return views[0] if len(views) == 1 else _mean_view(views, shares)


def during_exposure(pixels: Pixels, X: Tensor, R: Tensor) -> tuple[list[tuple[Tensor, Tensor]], list[float]]:
    """Return positions (L, 3) and rotations (L, 3, 3) of L spheres at the instants that are rendered, and the instants'
    shares of the light; X and R are those in the middle of the exposure.
    """
    if pixels.instants == 1:
        return [(X, R)], [1.0]
    instants, shares = exposure_instants(pixels.instants)
    turn, move = pixels.moved[:, :3], pixels.moved[:, 3:]
    return [(X + at * move, so3.exp(at * turn) @ R) for at in instants], shares


@cache
def exposure_instants(instants: int) -> tuple[list[float], list[float]]:
    """Return instants from -1/2 to 1/2 of the exposure, and their shares of its light: Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(instants)
    return (nodes / 2).tolist(), (weights / 2).tolist()


def _mean_view(views: Sequence[SphereView], shares: Sequence[float]) -> SphereView:
    """Return the mean of views, each of a share of the exposure; paint counts as far as the sphere covers the pixel."""

    def mean(parts: Sequence[Tensor]) -> Tensor:
        total = parts[0] * shares[0]
        for part, share in zip(parts[1:], shares[1:], strict=True):
            total = total + part * share
        return total

    coverage = mean([view.coverage for view in views])
    counts = [view.coverage + COVER_MIN for view in views]
    whole = mean(counts)
    told = [view.known for view in views if view.known is not None]

    def painted(name: str) -> Tensor:
        parts: list[Tensor] = [getattr(view, name) for view in views]
        return mean(
            [part * (count if part.ndim == 2 else count[:, None]) for part, count in zip(parts, counts, strict=True)]
        ) / (whole if parts[0].ndim == 2 else whole[:, None])

    return SphereView(
        paint=painted("paint"),
        coverage=coverage,
        across=painted("across"),
        outward=torch.nn.functional.normalize(painted("outward"), dim=1),
        aside=painted("aside"),
        paint_by_rotation=painted("paint_by_rotation"),
        paint_by_position=painted("paint_by_position"),
        coverage_by_position=mean([view.coverage_by_position for view in views]),
        known=torch.stack(told).all(0) if told else None,
    )


def _view_at(pixels: Pixels, position_lab_mm: Tensor, R_lab_body: Tensor, model: SphereModel) -> SphereView:
    """Render the sphere at rest, as `sphere_view`.
    Two look-ups per pixel, four near the limb, reproduce mean and width of the Gaussian cut off at the limb, as the
    curvature stretches it over the paint. Derivatives hold their spread fixed. The model's light is not used.
    Source: docs/errata.md A4 (the cap and the ellipse that a perspective camera sees); mean and variance of a cut-off
    Gaussian, Johnson, Kotz and Balakrishnan 1994, section 13.10.
    """
    radius_mm, blur_px = model.radius_mm, model.blur_px
    d = pixels.direction
    R = R_lab_body.to(d.dtype)
    # In double precision, once: half a metre less half a metre.
    to_centre = (position_lab_mm[:, :, None] - pixels.origin.double()).to(d.dtype)
    aside = nearest_approach(to_centre, d, 1)
    nearest = (aside * aside).sum(1).sqrt().clamp_min(1e-6 * radius_mm)
    outward = aside / nearest[:, None]  # unit, from the centre to the line of sight
    q0 = nearest / radius_mm
    distance = to_centre[..., 0].norm(dim=1, keepdim=True)
    blur = blur_px * (pixels.pitch_mm[:, None] + pixels.pitch_rad[:, None] * distance) / radius_mm
    # Half of an aperture on the limb of a disk lies within blur^2 / 2 less than within a straight edge.
    edge = (1.0 - 0.5 * blur * blur - q0) / blur
    coverage, density, pull, variance = limb_shape(edge)
    q = (q0 - blur * pull).clamp(0.0, 1.0)
    inner = pixels.inner
    variance = variance[:, :inner]
    spread = blur * variance.sqrt() * q[:, :inner]
    at = torch.stack([q[:, :inner] - spread, q[:, :inner] + spread], dim=1)
    line = d, outward, nearest
    parts = [_sample(at, variance[:, None], [part[..., :inner] for part in line], R, model)]
    if inner < d.shape[-1]:
        outer = slice(inner, None)
        z, moves = rim_shape(coverage[:, None, outer], density[:, None, outer])
        middle = q[:, None, outer]
        at = middle + middle * (q0[:, None, outer] + blur[:, None] * z - middle)
        parts.append(_sample(at, moves, [part[..., outer] for part in line], R, model))
    body, turn, shift, *known = (torch.cat(pieces, dim=-1) for pieces in zip(*parts, strict=True))
    return SphereView(
        paint=body,
        coverage=coverage,
        across=q[:, None] * (pixels.axes @ outward),
        outward=outward,
        aside=q,
        paint_by_rotation=turn,
        paint_by_position=shift,
        coverage_by_position=(density / (blur * radius_mm))[:, None] * outward,
        known=known[0] if known else None,
    )


def surface_normals(view: SphereView, pixels: Pixels) -> tuple[Tensor, Tensor]:
    """Return the unit normals (L, 3, P), lab, where lines of sight meet the sphere, and the depth (L, P), radii."""
    depth = (1.0 - view.aside.square()).clamp_min(0.0).sqrt()
    return view.aside[:, None] * view.outward - depth[:, None] * pixels.direction, depth


def limb_shape(edge: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return how a limb cuts a Gaussian aperture `edge` (...) standard deviations inside of it: the share that is left,
    the density at the limb, how far the mean of the rest lies inwards (deviations), and its variance.
    """
    coverage = torch.special.ndtr(edge)
    density = torch.exp(-0.5 * edge * edge) * (1.0 / math.sqrt(2.0 * math.pi))
    pull = density / coverage.clamp_min(1e-4)
    return coverage, density, pull, (1.0 - pull * (edge + pull)).clamp(SPREAD_MIN, 1.0)


def rim_shape(coverage: Tensor, density: Tensor) -> tuple[Tensor, Tensor]:
    """Return look-ups along the radius near the limb, quantiles of the cut-off Gaussian in standard deviations, and how
    far each moves with the sphere, (L, n, P) each, of coverage and density (L, 1, P).
    """
    share = ((torch.arange(RIM_NODES, dtype=coverage.dtype, device=coverage.device) + 0.5) / RIM_NODES)[:, None]
    z = torch.special.ndtri((share * coverage).clamp(1e-6, 1 - 1e-6))
    # The limb holds a node back the more, the nearer it is.
    moves = 1.0 - share * density / (torch.exp(-0.5 * z * z) * (1.0 / math.sqrt(2.0 * math.pi)))
    return z, moves.clamp(0.0, 1.0)


def _sample(at: Tensor, moves: Tensor, line: Sequence[Tensor], R: Tensor, model: SphereModel) -> tuple[Tensor, ...]:
    """Return the mean paint of look-ups (L, P), derivatives (L, 3, P), and, if not everywhere, where the paint is
    known, (L, P) bool; `at` in radii, `moves` per pixel moved.
    `line`: direction and outward, unit (L, 3, P), and the distance from the centre (L, P), mm, of lines of sight.
    """
    d, outward, nearest = line
    # In body components, as the texture: the derivatives are rotated back once, at the end.
    sight_b, outward_b = (R.mT @ d)[:, :, None], (R.mT @ outward)[:, :, None]
    qt = at.clamp(0.0, math.sqrt(1.0 - DEPTH_MIN**2))
    depth = (1.0 - qt * qt).sqrt()
    normal_b = qt[:, None] * outward_b - depth[:, None] * sight_b
    value, slope = model.paint.sample(normal_b.flatten(2))
    value, slope = value.reshape(qt.shape), slope.reshape(normal_b.shape)
    shares = [] if model.paint.unseen is None else [model.paint.unseen.sample(normal_b.flatten(2))[0]]
    known = [share.reshape(qt.shape).amax(1) < UNSEEN for share in shares]
    # Moving the centre along -outward lets the look-up slide outwards over the sphere.
    slide = (slope * outward_b).sum(1) + qt / depth * (slope * sight_b).sum(1)
    radial = (moves * slide).mean(1)
    flat_b = (qt[:, None] * slope).mean(2)
    by_sight, by_outward = (flat_b * sight_b[:, :, 0]).sum(1), (flat_b * outward_b[:, :, 0]).sum(1)
    # Across the radius a look-up stays at its share of it, q / q0.
    flat = R @ flat_b - by_sight[:, None] * d - by_outward[:, None] * outward
    shift = flat * (-1.0 / nearest)[:, None] - (radial / model.radius_mm)[:, None] * outward
    return value.mean(1), R @ cross_first_axis(slope, normal_b).mean(2), shift, *known
