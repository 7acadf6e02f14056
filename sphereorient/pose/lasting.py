"""Errors that last over frames: errors by light and map in the same part of every picture.
The fit's covariance describes errors that differ from frame to frame. A path averages those, but not these.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.systematic import lasting_in_use
from sphereorient.pose.compiled import fitted_residuals
from sphereorient.pose.lights.disk import RIDGE, glint_cells, glint_shares, light_columns
from sphereorient.pose.model import IN_SIGHT, SphereModel, by_pose
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses
from sphereorient.so3 import inverse_damped, solve_damped

TILES = 4  # along each axis of the disk: errors of light extend far
DARKEST = 0.5  # grey levels; darker places do not determine the power of the light
LIMB_PX = 0.04  # standard deviation of the limb's position over 23 movies of one camera (scripts/stated_errors.py)
WHOLE = 0.98  # least coverage of a pixel inside the limb; the limb has its own tiles


@dataclass(frozen=True, kw_only=True, eq=False)
class Lasting:
    """Covariances of the errors that all frames of a movie share."""

    covariance: Tensor  # (6, 6), of delta (rad, lab) and position (mm), all cameras together
    own_rad2: Tensor  # (C, 3, 3), of the rotation, each camera alone, position held
    alone: Tensor  # (C, 6, 6), as `covariance`, each camera alone

    @classmethod
    def none(cls, cameras: int) -> "Lasting":
        """Return zero errors."""
        zeros = torch.zeros(cameras, 6, 6, dtype=torch.float64)
        return cls(covariance=zeros[0], own_rad2=zeros[:, :3, :3], alone=zeros)

    def of(self, *cameras: int) -> "Lasting":
        """Return the errors of some of the cameras."""
        own, alone = self.own_rad2[list(cameras)], self.alone[list(cameras)]
        return Lasting(covariance=alone[0] if len(cameras) == 1 else self.covariance, own_rad2=own, alone=alone)

    def with_place(self, covariance: Tensor) -> "Lasting":
        """Add the error (6, 6) of the held position of all poses."""
        return replace(self, covariance=self.covariance + covariance, alone=self.alone + covariance)

    def of_use(self, use: Tensor) -> Tensor:
        """Return the covariance (6, 6) of a pose by the cameras in use, (C,) bool."""
        return lasting_in_use(use[None], self.covariance, self.alone)[0]

    def widened(self, one: FittedPoses, other: FittedPoses, use: Tensor) -> "Lasting":
        """Return errors that include the mean difference of B poses between two equally good models, `use` (B, C)."""
        turn = so3.log(other.R_lab_body @ one.R_lab_body.mT)
        way = torch.cat([turn, other.position_lab_mm - one.position_lab_mm], dim=1)
        seen = use.to(turn.dtype)[..., None]
        own = torch.cat([other.own_turn - one.own_turn, other.own_move - one.own_move], dim=-1)
        each = (seen * (way[:, None] + own)).sum(0) / seen.sum(0).clamp_min(1)
        return Lasting(
            covariance=_holding(self.covariance, way.mean(0)),
            own_rad2=_holding(self.own_rad2, each[:, :3]),
            alone=_holding(self.alone, each),
        )


def lasting_errors(
    pixels: Pixels, fit: FittedPoses, use: Tensor, model: SphereModel, wider: SphereModel | None = None
) -> Lasting:
    """Estimate the errors that B poses share from the fits of B * C disks, those in `use` (B, C) bool.
    One common rotation and displacement is fitted to all frames, leaving out one tile of one camera's disk at a time;
    its scatter from tile to tile is the error. Also fitted are each camera's light and glints, its limb's position and
    width and, with a model of `wider` blur, the paint's blur and the response. The error holds what is wrong in the
    same part of every picture and what light, glints or limb can absorb; with few frames also their noise.
    Source: the jackknife over clusters, CR3 of Bell and McCaffrey 2002.
    """
    normal, right, ridge = _by_tile(pixels, fit, use, model, wider)
    others = normal.shape[-1] - 6
    limb = normal.shape[-1] - (2 if wider is None else 4)

    def by_each(kept: list[int], count: int) -> Tensor:
        parts = [part[..., kept] for part in (normal[..., kept, :], right, ridge[..., kept, :])]
        return torch.stack([of_left_out(*of_camera)[:count, :count] for of_camera in zip(*parts, strict=True)])

    together = of_left_out(*_joined(normal, right, ridge))[:6, :6]
    own = by_each([0, 1, 2, *range(6, 6 + others)], 3)
    # One camera cannot separate its limb's position from the distance: the scatter over movies is used.
    free = [k for k in range(6 + others) if k != limb]
    alone = by_each(free, 6)
    whole = normal.sum(1) + ridge
    by_limb = solve_damped(whole[:, free][..., free], whole[:, free, limb])[:, :6]
    return Lasting(covariance=together, own_rad2=own, alone=alone + LIMB_PX**2 * by_limb[:, :, None] * by_limb[:, None])


def limb_wider_px(pixels: Pixels, fit: FittedPoses, use: Tensor, model: SphereModel) -> float:
    """Return the extra blur, px, of the limb of B * C disks, those in `use` (B, C), over the model's.
    A common rotation and displacement, each camera's light and its limb's position are fitted with it.
    """
    normal, right, ridge = _by_tile(pixels, fit, use, model)
    joined, pulled, ridges = _joined(normal, right, ridge)
    wider = torch.arange(1, len(normal) + 1) * (normal.shape[-1] - 6) + 5
    bread = inverse_damped(joined.sum(0) + ridges)
    weight = use.any(0).double() / bread.diagonal()[wider].clamp_min(1e-30)
    found = (bread @ pulled.sum(0))[wider]
    return -float((weight * found).sum() / weight.sum().clamp_min(1e-30))


def response_exponents(
    pixels: Pixels, fit: FittedPoses, use: Tensor, model: SphereModel, wider: SphereModel
) -> tuple[Tensor, Tensor]:
    """Return the logarithm of the power of the light that fits each camera's pictures best, (C,), and its standard
    deviation by the jackknife of `lasting_errors`. The other unknowns, and `wider`: as there.
    """
    joined, pulled, ridge = _joined(*_by_tile(pixels, fit, use, model, wider))
    last = torch.arange(1, use.shape[1] + 1) * ((ridge.shape[-1] - 6) // use.shape[1]) + 5
    found = solve_damped(joined.sum(0) + ridge, pulled.sum(0))[last]
    return found, of_left_out(joined, pulled, ridge).diagonal()[last].sqrt()


def _px_mm(pixels: Pixels, fit: FittedPoses) -> Tensor:
    """Return the size of a pixel at the sphere, (B * C,), mm."""
    origin = pixels.origin[..., 0].double()
    X = fit.position_lab_mm.repeat_interleave(len(origin) // len(fit.position_lab_mm), 0)
    px_mm: Tensor = pixels.pitch_mm + pixels.pitch_rad * (X - origin).norm(dim=-1)
    return px_mm.to(pixels.grey)


def _joined(normal: Tensor, right: Tensor, ridge: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the normal equations of all cameras, (C * T, n, n), (C * T, n), (n, n), from those of each camera: the
    pose is common; light and limb are each camera's own.
    """
    cameras, others = len(normal), normal.shape[-1] - 6
    place = torch.zeros(cameras, 6 + cameras * others, 6 + others, dtype=torch.float64)
    for camera in range(cameras):
        place[camera, :6, :6] = torch.eye(6)
        place[camera, 6 + camera * others :][:others, 6:] = torch.eye(others)
    joined = (place[:, None] @ normal @ place[:, None].mT).flatten(0, 1)
    pulled = (place[:, None] @ right[..., None])[..., 0].flatten(0, 1)
    return joined, pulled, (place @ ridge @ place.mT).sum(0)


def _holding(covariance: Tensor, difference: Tensor) -> Tensor:
    """Widen covariances (..., n, n) until differences (..., n) are at most one standard deviation."""
    size = (difference * solve_damped(covariance, difference)).sum(-1)[..., None, None]
    return covariance + (1 - 1 / size.clamp_min(1)) * difference[..., :, None] * difference[..., None, :]


def _by_tile(
    pixels: Pixels, fit: FittedPoses, use: Tensor, model: SphereModel, wider: SphereModel | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return normal equations of pose, light and limb for each tile, (C, T, n, n) and (C, T, n), and a ridge of all
    unknowns but the pose, (C, n, n), float64. They are sums over frames, each frame's own light and the common glints
    eliminated. The limb has its own tiles. The last two unknowns are its position and width, px; with a model of
    `wider` blur the share of that blur and the logarithm of the power of the light follow.
    """
    cameras, at = use.shape[1], fitted_residuals(pixels, fit, model)
    precision = at.weight / at.variance * use.reshape(-1, 1)
    limb = _px_mm(pixels, fit)[:, None] * at.over * at.view.coverage_by_position.norm(dim=1)
    width = limb * torch.special.ndtri(at.view.coverage.clamp(1e-6, 1 - 1e-6))
    of_camera = [limb, width]
    if wider is not None:
        of_camera.append(fitted_residuals(pixels, fit, wider).model - at.model)
        scale = at.model.mean()  # the scale of the light is free
        of_camera.append((1.0 - at.view.coverage) * by_power(at.beside, scale) - by_power(at.model, scale))
    columns = torch.cat([at.design[:, :6], light_columns(at.view), torch.stack(of_camera, dim=1)], dim=1)
    weighted = at.design[:, 6:] * precision[:, None]
    mixed = solve_damped(
        (weighted @ at.design[:, 6:].mT).double()[:, None], (columns @ weighted.mT).double(), ridge=1e-7
    )
    size = by_pose((columns.square() @ precision[..., None])[..., 0].double(), cameras).sum(0)
    size[:, :6] = 0.0
    columns = columns - mixed.to(columns.dtype) @ at.design[:, 6:]
    column, row = ((at.view.across + 1.0) * (0.5 * TILES)).long().clamp(0, TILES - 1).unbind(1)
    tile = (row * TILES + column) * 2 + (at.view.coverage < WHOLE).long()
    cell, in_cells = glint_cells(at.view.across), precision * (at.view.coverage > IN_SIGHT)
    shares = glint_shares(at, use, model.light.mirrors(at.view, pixels)).to(columns)
    columns, count = torch.cat([columns, at.residual[:, None]], dim=1), columns.shape[1]
    normal = columns.new_zeros(cameras, 2 * TILES**2, count, count)
    right = normal.new_zeros(normal.shape[:3])
    for camera in range(cameras):
        own = slice(camera, None, cameras)
        values = columns[own].transpose(1, 2).contiguous()
        values -= cell_means(values, in_cells[own], cell[own], shares[camera])
        for k in range(normal.shape[1]):
            there = tile[own] == k
            here = values[there]
            pulls = here[:, :count] * precision[own][there][:, None]
            both = pulls.mT @ here
            normal[camera, k], right[camera, k] = both[:, :count], both[:, count]
    return normal.double(), right.double(), torch.diag_embed(RIDGE * size)


def cell_means(values: Tensor, weight: Tensor, cell: Tensor, shares: Tensor) -> Tensor:
    """Return what to subtract from values (B, P, n) so that a coefficient of each cell is eliminated from their sums of
    products, (B, P, n); weight and cell (B, P), shares (cells,) as `glint_shares`.
    Source: random effects by partial demeaning, Fuller and Battese 1974.
    """
    flat, of = values.flatten(0, 1), cell.flatten()
    whole = values.new_zeros(len(shares)).index_add_(0, of, weight.flatten())
    means = values.new_zeros(len(shares), values.shape[-1]).index_add_(0, of, flat * weight.flatten()[:, None])
    means *= ((1.0 - (1.0 - shares).clamp_min(0.0).sqrt()) / whole.clamp_min(1e-30))[:, None]
    return means.index_select(0, of).reshape(values.shape) * (weight > 0)[..., None]


def by_power(light: Tensor, scale: Tensor) -> Tensor:
    """Return the derivative of light, grey levels, by the logarithm of its power; `scale` is a fixed point."""
    some = light.clamp_min(DARKEST)
    return some * (some / scale).log()


def of_left_out(normal: Tensor, right: Tensor, ridge: Tensor) -> Tensor:
    """Return the jackknife covariance (n, n) of a solution when each of T parts is left out.
    Normal equations (T, n, n), (T, n) of the parts, and a ridge (n, n) of all.
    """
    determined = normal.diagonal(dim1=-2, dim2=-1).any(-1)
    whole, pull = normal.sum(0) + ridge, right.sum(0)
    moved = solve_damped(whole - normal[determined], pull - right[determined]) - solve_damped(whole, pull)
    return (1 - 1 / max(len(moved), 1)) * (moved.mT @ moved)
