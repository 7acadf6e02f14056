"""The measuring model: what a picture of the painted sphere depends on, and its light."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import ClassVar, Self

import torch
from torch import Tensor

from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses
from sphereorient.so3 import solve_damped
from sphereorient.sphere.texture_table import TextureTable
from sphereorient.sphere.view import polynomials

UNSEEN = 0.02  # a pixel with a larger share of unknown paint is not used
STRAY_ORDER = 4  # of the harmonics over the angle about the disk
LEAN_ORDER = 3  # of the polynomials of the light's slope
EVERY = 4  # n-th place is used for statistics of a disk: they are in order of distance from its middle
SHADOW, BRIGHT = 0.05, 0.9  # share of the bright light below which the limb is in shadow; its quantile over the disk
IN_SIGHT = 0.99  # least coverage of a pixel inside the limb
DARKEST = 0.05  # of the brightest light of white paint: lower limit before the logarithm


@dataclass(frozen=True, kw_only=True, eq=False)
class Shading:
    """Orders of the polynomials by which a frame's light may differ from the learnt light."""

    difference: int
    black: int

    @property
    def counts(self) -> tuple[int, int]:
        """Numbers of coefficients of difference and black."""
        difference, black = ((order + 1) * (order + 2) // 2 for order in (self.difference, self.black))
        return difference, black


FIRST = Shading(difference=4, black=2)  # before the light is estimated
LATER = Shading(difference=2, black=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class SphereView:
    """The sphere in the pixels of L disks at one pose each."""

    paint: Tensor  # (L, P), blurred paint seen, 0 .. 1
    coverage: Tensor  # (L, P), share of the pixel's blurred aperture that the sphere fills
    across: Tensor  # (L, 2, P), place on the disk along the camera's x and y, radii
    outward: Tensor  # (L, 3, P), unit, lab, from the centre to the line of sight
    aside: Tensor  # (L, P), distance of the place from the line of sight through the centre, radii
    paint_by_rotation: Tensor  # (L, 3, P), derivative by delta in exp([delta]x) R, 1/rad
    paint_by_position: Tensor  # (L, 3, P), derivative by the centre, lab, 1/mm
    coverage_by_position: Tensor  # (L, 3, P), 1/mm
    known: Tensor | None  # (L, P) bool, whether all paint of the pixel is known; None: everywhere
    blur: Tensor  # (L, 1), standard deviation of the aperture, radii


@dataclass(frozen=True, kw_only=True, eq=False)
class LightTables:
    """Tables that compiled code reads instead of `Light.at`."""

    kind: int  # of light, as numbered in `shine` of refine.c
    cells: Tensor  # (n, k) float32, grey levels
    side: int  # cells along each axis of a map
    cover: Tensor | None = None  # (depths, 2), of light in the lab
    gain: Tensor | None = None  # (C,), of light in the lab


@dataclass(frozen=True, kw_only=True, eq=False)
class Light(ABC):
    """Light and noise of the pictures of C cameras: a pixel of the sphere shows paint * difference + black.
    The noise of grey level I has the variance noise[0] + noise[1] I + noise[2] I^2 + noise[3] I^3 (read-out; photons;
    grain of all paint; grain of white paint). Stray light (a lens with glare, a wall that the sphere lights) is a sum
    of `stray_basis` beside the sphere.
    """

    difference: Tensor  # coefficients of white less black paint, grey levels
    black: Tensor  # coefficients of black paint
    noise: Tensor  # (C, 4), grey levels^2 .. 1 / grey level
    stray: Tensor  # (C, K), grey levels added to the empty scene
    lean: Tensor  # (C, 2, K), slope of the logarithm of `difference` across the disk, 1/radii: see `leaning`
    dark: Tensor  # (C,), `difference`, grey levels: darker places on the limb are not used
    known: bool = True  # whether estimated from pictures

    of_cameras: ClassVar[tuple[str, ...]]  # parts with an entry for each camera
    linear: ClassVar[bool]  # whether one estimate at given poses is final; otherwise repetition improves it

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return the names of the light's tensors."""
        return tuple(field.name for field in fields(cls) if field.name != "known")

    def parts(self) -> dict[str, Tensor]:
        """Return these tensors by name, on the CPU."""
        return {name: getattr(self, name).cpu() for name in self.names()}

    def of(self, *cameras: int) -> Self:
        """Return the light of some of the cameras."""
        return replace(self, **{name: getattr(self, name)[list(cameras)] for name in self.of_cameras})

    def with_lean(self, view: SphereView, pixels: Pixels, use: Tensor) -> Self:
        """Return the light with slopes and shadows estimated from B * C disks, those in `use` (B, C) bool."""
        cameras, some = use.shape[1], slice(None, None, EVERY)
        parts = (self.at(view, pixels)[0], view.coverage, view.across)
        difference, coverage, across = (part[..., some].double().nan_to_num() for part in parts)
        size = difference.abs().amax(1, keepdim=True).clamp_min(1e-6)
        weight = coverage * (difference / size).clamp_min(0.0).square() * use.reshape(-1, 1)
        columns = polynomials(across, LEAN_ORDER + 1)
        target = (difference / size).clamp_min(DARKEST).log()
        weighted = columns * weight[:, None]
        normal, right = weighted @ columns.mT, (weighted @ target[..., None])[..., 0]
        normal, right = (by_pose(part, cameras).sum(0) for part in (normal, right))
        found = solve_damped(normal, right, ridge=1e-7)
        lean = torch.stack([found @ by.mT for by in _slopes()], dim=1).float()
        lit = torch.where(coverage > IN_SIGHT, difference, torch.nan).nanquantile(BRIGHT, 1).nan_to_num()
        bright = by_pose(lit * use.reshape(-1), cameras).sum(0) / use.sum(0).clamp_min(1)
        return replace(self, lean=lean, dark=(SHADOW * bright).float())

    def to(self, device: torch.device) -> Self:
        """Return the light on another device."""
        return replace(self, **{name: getattr(self, name).to(device) for name in self.names()})

    @abstractmethod
    def at(self, view: SphereView, pixels: Pixels) -> tuple[Tensor, Tensor]:
        """Return difference and black, grey levels, (L, P) each, of L disks, the C cameras of a pose side by side."""

    @abstractmethod
    def mirrors(self, view: SphereView, pixels: Pixels) -> Tensor:
        """Return the light that the surface mirrors in L disks, whatever the paint, grey levels (L, P)."""

    @property
    @abstractmethod
    def tables(self) -> LightTables:
        """Tables that `at` reads."""

    @abstractmethod
    def learnt(
        self, pixels: Pixels, fit: FittedPoses, use: Tensor, model: "SphereModel", *, glints: bool = True
    ) -> Self:
        """Estimate light and noise anew from the fits of B * C disks, those in `use` (B, C) bool. `model` has this
        light; without `glints`, maps of the disk have none.
        """


@dataclass(frozen=True, kw_only=True, eq=False)
class SphereModel:
    """What a picture of the sphere depends on, except its pose."""

    radius_mm: float
    paint: TextureTable  # with the blur at the disk's middle
    blur_px: float  # of the limb: standard deviation by optics, pixel and added blur, px
    light: Light  # of the C cameras
    shading: Shading = LATER  # how far a frame's light may differ from `light`
    limb_px: Tensor | None = None  # (C,), error of the limb: outwards from its position by all cameras; None: 0
    near_rad: float = math.inf  # another step follows a longer one: grey levels are linear only within the blur


def surface_normals(view: SphereView, pixels: Pixels) -> tuple[Tensor, Tensor]:
    """Return the unit normals (L, 3, P), lab, where lines of sight meet the sphere, and the depth (L, P), radii."""
    depth = (1.0 - view.aside.square()).clamp_min(0.0).sqrt()
    return view.aside[:, None] * view.outward - depth[:, None] * pixels.direction, depth


def by_pose(disks: Tensor, cameras: int) -> Tensor:
    """Return (B * C, ...) as (B, C, ...)."""
    return disks.reshape(-1, cameras, *disks.shape[1:])


@cache
def _slopes() -> tuple[Tensor, Tensor]:
    """Return the derivatives by x and by y, (n, K) float64 each, of polynomials of order LEAN_ORDER + 1."""
    powers = [(order - k, k) for order in range(LEAN_ORDER + 2) for k in range(order + 1)]
    by_x, by_y = torch.zeros(2, len(powers) - LEAN_ORDER - 2, len(powers), dtype=torch.float64)
    for column, (x, y) in enumerate(powers):
        if x:
            by_x[powers.index((x - 1, y)), column] = x
        if y:
            by_y[powers.index((x, y - 1)), column] = y
    return by_x, by_y


def leaning(view: SphereView, pixels: Pixels, model: SphereModel) -> SphereView:
    """Return the view of L disks with paint corrected for light brighter on one side. The blur of light times paint is
    the product of both blurred, with the paint shifted towards the light by blur^2 times the slope of its logarithm.
    """
    lean = model.light.lean.to(view.paint)
    if not bool(lean.any()):
        return view
    slope = (lean.repeat(len(view.paint) // len(lean), 1, 1) @ polynomials(view.across, LEAN_ORDER)).mT
    nearer = (slope @ pixels.axes.to(slope)).mT * view.paint_by_position
    return replace(view, paint=view.paint - model.radius_mm * view.blur.square() * nearer.sum(1))


def stray_basis(across: Tensor) -> Tensor:
    """Return the harmonics over the angle about the disk, (..., K, P), at places (..., 2, P): 1, cos, sin, cos 2 .."""
    x, y = across.unbind(-2)
    length = torch.hypot(x, y).clamp_min(1e-12)
    cos, sin = x / length, y / length
    columns = [torch.ones_like(cos), cos, sin]
    for _ in range(STRAY_ORDER - 1):
        last_cos, last_sin = columns[-2:]
        columns += [last_cos * cos - last_sin * sin, last_sin * cos + last_cos * sin]
    return torch.stack(columns, dim=-2)


def even_light(cameras: int) -> dict[str, Tensor]:
    """Return the parts of a light without stray light, slopes and shadows."""
    stray = torch.zeros(cameras, 1 + 2 * STRAY_ORDER)
    lean = torch.zeros(cameras, 2, (LEAN_ORDER + 1) * (LEAN_ORDER + 2) // 2)
    return {"stray": stray, "lean": lean, "dark": torch.full((cameras,), -math.inf)}


def scene_beside(view: SphereView, pixels: Pixels, stray: Tensor) -> Tensor:
    """Return what L disks show beside the sphere, grey levels (L, P): the empty scene, and stray light (C, K) of the C
    cameras, computed only near the limb.
    """
    if not bool(stray.any()):
        return pixels.behind
    outer = slice(pixels.inner, None)
    more = stray.repeat(len(view.across) // len(stray), 1)[:, None] @ stray_basis(view.across[..., outer])
    return torch.cat([pixels.behind[:, : pixels.inner], pixels.behind[:, outer] + more[:, 0]], dim=1)
