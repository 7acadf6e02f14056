"""Light as maps over the disk of each camera: sums of functions, and glints."""

import math
from dataclasses import dataclass, replace
from functools import cache, cached_property

import torch
from torch import Tensor

from sphereorient.pose.compiled import fitted_residuals
from sphereorient.pose.model import (
    IN_SIGHT,
    Light,
    LightTables,
    SphereModel,
    SphereView,
    by_pose,
    even_light,
    scene_beside,
)
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses
from sphereorient.pose.residuals import Residuals, learn_stray, noise_curves
from sphereorient.so3 import inverse_damped
from sphereorient.sphere.view import polynomials

MAP_SIDE = 256  # cells of a look-up map across the disk: a third of a pixel for an 80 px disk
ORDER, DEPTH_ORDER = 4, 3  # of the polynomials in x, y and of those times the depth sqrt(1 - x^2 - y^2)
GLINTS = 32  # cells across the disk
RIDGE = 1e-5  # of light maps, relative to the diagonal


@dataclass(frozen=True, kw_only=True, eq=False)
class DiskLight(Light):
    """Light on the disk, one map per camera."""

    difference: Tensor  # (C, K), of `light_basis`
    black: Tensor  # (C, K)
    glints: Tensor  # (C, G, G), added to black, over the square about the disk

    of_cameras = ("difference", "black", "noise", "stray", "lean", "dark", "glints")
    linear = True

    @classmethod
    def unknown(cls, cameras: int, noise: Tensor) -> "DiskLight":
        """Return flat light, for the first fits: difference is 1 everywhere, black and glints are 0."""
        count = light_basis(torch.zeros(1, 2, 1)).shape[-2]
        difference = torch.zeros(cameras, count)
        difference[:, 0] = 1.0
        parts = {"glints": no_glints(cameras), "noise": noise, **even_light(cameras)}
        return cls(difference=difference, black=torch.zeros(cameras, count), known=False, **parts)

    @cached_property
    def _map(self) -> Tensor:
        """Return difference and black over the square about the disk, (C * S * S, 2), for look-up."""
        across, basis = (part.to(self.difference.device) for part in _on_map())
        black = self.black @ basis + glints_at(self.glints, across.mT.expand(len(self.glints), -1, -1))
        return torch.stack([self.difference @ basis, black], dim=-1).reshape(-1, 2)

    @property
    def tables(self) -> LightTables:
        """The maps, (C * side^2, 2)."""
        return LightTables(kind=0, cells=self._map, side=MAP_SIDE)

    def at(self, view: SphereView, pixels: Pixels) -> tuple[Tensor, Tensor]:
        """Look up difference and black; see `Light.at`."""
        across, cameras = view.across, len(self.difference)
        column, row = ((across + 1.0) * (0.5 * MAP_SIDE)).to(torch.int32).clamp_(0, MAP_SIDE - 1).unbind(1)
        camera = torch.arange(len(across), device=across.device, dtype=torch.int32) % cameras
        cell = (camera[:, None] * MAP_SIDE + row) * MAP_SIDE + column
        found = self._map.index_select(0, cell.reshape(-1)).to(across.dtype)
        return found[:, 0].reshape(cell.shape), found[:, 1].reshape(cell.shape)

    def mirrors(self, view: SphereView, pixels: Pixels) -> Tensor:
        """Return the glints, grey levels; see `Light.mirrors`."""
        disks = len(view.across) // len(self.glints)
        return view.coverage * glints_at(self.glints.repeat(disks, 1, 1), view.across.mT)

    def learnt(
        self, pixels: Pixels, fit: FittedPoses, use: Tensor, model: SphereModel, *, glints: bool = True
    ) -> "DiskLight":
        """Estimate light and noise anew, with the poses, see `Light.learnt`: fixed poses would be favoured."""
        cameras = use.shape[1]
        at = fitted_residuals(pixels, fit, model)
        stray = learn_stray(at, pixels, use, self.stray)
        found = learn_glints(at, use, self.glints) if glints else no_glints(cameras)
        mirrored = replace(self, glints=found).mirrors(at.view, pixels)
        lit = replace(pixels, behind=scene_beside(at.view, pixels, stray), grey=pixels.grey - mirrored)
        columns = torch.cat([at.design[:, :6], light_columns(at.view)], dim=1)
        normal, right = light_sums(columns, at.view, lit, at.weight / at.variance * use.reshape(-1, 1))
        normal, right = by_pose(normal, cameras), by_pose(right, cameras)
        by_light = normal[..., 6:, :6].flatten(1, 2)  # (B, C 2K, 6): the pose is common to all cameras
        mixed = by_light @ inverse_damped(normal[..., :6, :6].sum(1))
        each = torch.einsum("cd,cij->cidj", torch.eye(cameras, dtype=torch.float64), normal[..., 6:, 6:].sum(0))
        whole = each.flatten(2, 3).flatten(0, 1) - (mixed @ by_light.mT).sum(0)
        force = right[..., 6:].sum(0).flatten() - (mixed @ right[..., :6].sum(1)[..., None])[..., 0].sum(0)
        difference, black = solved_light(whole, force).reshape(cameras, -1).chunk(2, dim=-1)
        counted = at.inside & ~pixels.clipped & use.reshape(-1, 1)
        noise = noise_curves(at.model, at.residual, counted, cameras)
        parts = {"difference": difference, "black": black, "noise": noise, "stray": stray, "glints": found}
        return replace(self, known=True, **parts).with_lean(at.view, pixels, use)


def light_basis(across: Tensor) -> Tensor:
    """Return the basis of light maps, (..., K, P): polynomials in the normal's components."""
    depth = (1.0 - across.square().sum(-2)).clamp_min(0).sqrt()
    return torch.cat([polynomials(across, ORDER), polynomials(across, DEPTH_ORDER) * depth[..., None, :]], dim=-2)


@cache
def _on_map() -> tuple[Tensor, Tensor]:
    """Return the places of a look-up map, (2, S * S), radii, and the basis of light maps there."""
    at = (torch.arange(MAP_SIDE, dtype=torch.float32) + 0.5) * (2.0 / MAP_SIDE) - 1.0
    y, x = torch.meshgrid(at, at, indexing="ij")
    # Cells cut by the limb get the value inside it.
    across = (torch.stack([x, y]) / torch.hypot(x, y).clamp_min(1.0)).reshape(2, -1)
    return across, light_basis(across)


def no_glints(cameras: int) -> Tensor:
    """Return zero glints."""
    return torch.zeros(cameras, GLINTS, GLINTS)


def glints_at(glints: Tensor, across: Tensor) -> Tensor:
    """Return the glints (L, G, G) of L disks at places (L, P, 2), radii: grey levels (L, P), linear between cells."""
    sampled = torch.nn.functional.grid_sample(
        glints[:, None], across[:, None].to(glints), padding_mode="border", align_corners=False
    )
    return sampled[:, 0, 0]


def learn_glints(at: Residuals, use: Tensor, known: Tensor) -> Tensor:
    """Estimate the glints (C, G, G), see `Light`, from the residuals that B * C disks, those in `use` (B, C), have in
    common in a cell of the disk, without the limb. Each disk's pose and own light are fitted too, since they had
    absorbed part of the glints. `known` (C, G, G): the glints in the residuals' model.
    """
    cameras, others = use.shape[1], at.design.double()
    precision = (at.weight / at.variance * use.reshape(-1, 1)).double()
    there, weight, pull, by_others = _in_cells(at, precision, cameras, others)
    now = known.reshape(cameras, -1)[:, there].double()
    drawn = _drawn(weight, pull, now + pull.sum(0) / weight.sum(0).clamp_min(1e-30))
    weighted = others * precision[:, None]
    own = inverse_damped(weighted @ others.mT)
    taken = by_pose(by_others.mT @ own, cameras)
    mixed = torch.einsum("bcip,bcpj->cij", taken, by_pose(by_others, cameras))
    left = by_pose((weighted @ at.residual.double()[..., None])[..., 0], cameras)
    force = pull.sum(0) - torch.einsum("bcip,bcp->ci", taken, left) - drawn * now
    found = now.new_zeros(cameras, GLINTS**2)
    found[:, there] = now + torch.linalg.solve(torch.diag_embed(weight.sum(0) + drawn) - mixed, force)
    return found.reshape(known.shape).float()


def glint_shares(at: Residuals, use: Tensor, mirrored: Tensor) -> Tensor:
    """Return the share of a common residual in a cell of B * C disks, those in `use` (B, C), that the glint takes up,
    (C, G * G), 0 .. 1; 0 for a light without glints. `mirrored` (L, P): what the light mirrors there.
    """
    cameras, precision = use.shape[1], (at.weight / at.variance * use.reshape(-1, 1)).double()
    there, weight, pull, sums = _in_cells(at, precision, cameras, mirrored[:, None].double())
    now = by_pose(sums[:, 0], cameras).sum(0) / weight.sum(0).clamp_min(1e-30)
    shares = weight.new_zeros(cameras, GLINTS**2)
    shares[:, there] = 1.0 / (1.0 + _drawn(weight, pull, now) / weight.sum(0).clamp_min(1e-30))
    return shares


def glint_cells(across: Tensor) -> Tensor:
    """Return the cells (L, P) of positions (L, 2, P) on the disk."""
    column, row = ((across + 1.0) * (0.5 * GLINTS)).long().clamp(0, GLINTS - 1).unbind(1)
    return row * GLINTS + column


def _in_cells(at: Residuals, precision: Tensor, cameras: int, others: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the n cells that some disk shows (not beyond the limb, not always hidden), and the sums in them of
    precision (L, P), residuals (B, C, n) and others (L, k, P): (L, k, n). Pixels cut by the limb are left out.
    """
    inside = precision * (at.view.coverage > IN_SIGHT)
    parts = torch.cat([inside[:, None], (inside * at.residual)[:, None], inside[:, None] * others], dim=1)
    sums = parts.new_zeros(*parts.shape[:2], GLINTS**2)
    sums.scatter_add_(2, glint_cells(at.view.across)[:, None].expand(parts.shape), parts)
    there = sums[:, 0].any(0).nonzero()[:, 0]
    sums = sums[..., there]
    weight, pull = (by_pose(sums[:, k], cameras) for k in range(2))
    return there, weight, pull, sums[:, 2:]


def _drawn(weight: Tensor, pull: Tensor, glint: Tensor) -> Tensor:
    """Return the prior precision of the n cells of a glint about 0, (C, n), from the glint's size (C, n) and the
    scatter of residuals over the disks: precision and its product with residuals (B, C, n). For a mat ball the prior
    dominates.
    Source: empirical Bayes, James and Stein 1961.
    """
    whole = weight.sum(0).clamp_min(1e-30)
    mean, number = pull.sum(0) / whole, (weight > 0).sum(0)
    error2 = (pull - weight * mean).square().sum(0) / whole.square() * number / (number - 1)
    known = number > 1
    signal2 = torch.where(known, glint.square() - error2, 0.0).sum(1) / known.sum(1).clamp_min(1)
    drawn = torch.where(known, whole * error2 / signal2.clamp_min(1e-12)[:, None], math.inf)
    return drawn.nan_to_num(posinf=1e30)


def light_columns(view: SphereView) -> Tensor:
    """Return what each coefficient of the light maps, K of difference and K of black, adds to L disks, (L, 2 K, P)."""
    basis = light_basis(view.across)
    return torch.cat([(view.coverage * view.paint)[:, None] * basis, view.coverage[:, None] * basis], dim=1)


def light_sums(columns: Tensor, view: SphereView, pixels: Pixels, precision: Tensor) -> tuple[Tensor, Tensor]:
    """Return the normal equations (L, n, n), (L, n) of columns (L, n, P) in L disks; precision (L, P)."""
    weighted = columns * precision[:, None]
    target = pixels.grey - (1.0 - view.coverage) * pixels.behind
    return (weighted @ columns.mT).double(), (weighted @ target[..., None])[..., 0].double()


def solved_light(normal: Tensor, right: Tensor) -> Tensor:
    """Solve summed normal equations (..., n, n), (..., n) for coefficients of light maps, (..., n)."""
    # The basis is nearly dependent (x^2 + y^2 + depth^2 = 1): a ridge selects the smallest coefficients.
    ridge = RIDGE * normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-9)
    solution: Tensor = torch.linalg.solve(normal + torch.diag_embed(ridge), right)
    return solution.float()
