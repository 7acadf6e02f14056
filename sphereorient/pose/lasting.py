"""Errors that last over frames: what light and map leave in the same place of every picture, and the light's own noise.

The fit's covariance holds what differs from frame to frame. A path through all frames averages that away; these stay.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.pose.fit import RIDGE, FittedPoses, light_columns, settled
from sphereorient.pose.model import Light, SphereModel
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.residuals import Residuals, by_pose
from sphereorient.so3 import inverse_damped

FEWEST_FRAMES = 8  # from which it is seen what stays
TILES = 4  # along each axis of the disk: errors of light are wide
WHOLE = 0.98  # coverage of a pixel that the limb does not cut: the limb has tiles of its own
ASIDE_PX = 0.004  # by how much the model's limb and paint may lie aside: large balls would state less


@dataclass(frozen=True, kw_only=True, eq=False)
class Lasting:
    """Covariances of the errors that all frames of a movie share; made by `lasting_errors`."""

    covariance: Tensor  # (6, 6), of delta (rad, lab) and position (mm) by all cameras together
    own_rad2: Tensor  # (C, 3, 3), of the rotation by each camera alone, position held

    @classmethod
    def none(cls, cameras: int) -> "Lasting":
        """Return no such errors."""
        zeros = torch.zeros(cameras, 6, 6, dtype=torch.float64)
        return cls(covariance=zeros[0], own_rad2=zeros[:, :3, :3])

    def of(self, camera: int) -> "Lasting":
        """Return those of one camera by itself: its distance is not known, its rotation as well as `own_rad2` says."""
        own = self.own_rad2[camera]
        covariance = self.covariance.clone()
        covariance[:3] = covariance[:, :3] = 0.0
        covariance[:3, :3] = own
        return Lasting(covariance=covariance, own_rad2=own[None])


def lasting_errors(pixels: Pixels, fit: FittedPoses, use: Tensor, model: SphereModel) -> Lasting:
    """Estimate the errors that B poses share from the fits of B * C disks, those of `use` (B, C) bool.
    By how much tiles of the disk pull the pose (6 numbers a tile) in pairs of different frames: noise is not the same
    in two frames, what is wrong with light and map is. And what the light's own noise, as learnt from these frames,
    does to all poses. Where there are fewer than `FEWEST_FRAMES` frames, only `ASIDE_PX` is known.
    Source: clustered scores as in `refine`, between clusters of one tile and two frames.
    """
    cameras = use.shape[1]
    distance_mm = (fit.position_lab_mm.repeat_interleave(cameras, 0) - pixels.origin[..., 0]).norm(dim=-1)
    px_mm = float((pixels.pitch_mm + pixels.pitch_rad * distance_mm).min())
    aside = torch.tensor([1 / model.radius_mm] * 3 + [1.0] * 3, dtype=torch.float64) * ASIDE_PX * px_mm
    aside_rad2 = aside[:3].square().diag().expand(cameras, 3, 3)
    if len(use) < FEWEST_FRAMES:
        return Lasting(covariance=aside.square().diag(), own_rad2=aside_rad2)
    at = settled(pixels, fit, model, cameras)
    precision = at.weight / at.variance * use.reshape(-1, 1)
    columns = torch.cat([at.design, light_columns(at.view)], dim=1)
    normal = ((columns * precision[:, None]) @ columns.mT).double()
    # The frame's own coefficients of light are eliminated; left are 6 of the pose and 2 K of the light of all frames.
    free = at.design.shape[1]
    frame = normal[:, 6:free, 6:free]
    frame = frame + torch.diag_embed(1e-7 * frame.diagonal(dim1=-2, dim2=-1) + 1e-12)
    kept = [*range(6), *range(free, columns.shape[1])]
    mixed = torch.linalg.solve(frame, normal[:, 6:free][..., kept])
    left = by_pose(normal[:, kept][..., kept] - normal[:, kept, 6:free] @ mixed, cameras)

    information = left[..., :6, :6]
    bread, own_bread = inverse_damped(information.sum(1)), inverse_damped(information[..., :3, :3])
    score = at.design[:, :6] - mixed[..., :6].mT.to(at.design.dtype) @ at.design[:, 6:]
    pulls = by_pose(_by_tile(score * (precision * at.residual)[:, None], at), cameras)
    stays = _shared(bread[:, None] @ pulls).sum(0)
    own_stays = _shared(own_bread @ pulls[..., :3, :])
    if isinstance(model.light, Light):
        by_light = left[..., :6, 6:]
        whole = by_pose(normal, cameras)[..., free:, free:].diagonal(dim1=-2, dim2=-1).sum(0)
        ridge = torch.diag_embed(RIDGE * whole + 1e-12)
        shared = left[..., 6:, 6:].sum(0) + ridge
        joined = torch.cat(by_light.unbind(1), dim=-1)  # (B, 6, C 2K): the cameras share the pose
        each = torch.einsum("cd,cij->cidj", torch.eye(cameras, dtype=torch.float64), shared)
        noise = torch.linalg.inv(each.reshape(len(joined[0, 0]), -1) - (joined.mT @ bread @ joined).sum(0))
        moves = bread @ joined
        stays = stays + (moves @ noise @ moves.mT).mean(0)
        turned = by_light[..., :3, :]
        own_noise = torch.linalg.inv(shared - (turned.mT @ own_bread @ turned).sum(0))
        turns = own_bread @ turned
        own_stays = own_stays + (turns @ own_noise @ turns.mT).mean(0)
    covariance, own_rad2 = _not_negative(stays) + aside.square().diag(), _not_negative(own_stays) + aside_rad2
    return Lasting(covariance=covariance, own_rad2=own_rad2)


def _by_tile(score: Tensor, at: Residuals) -> Tensor:
    """Return scores (L, 6, P) summed over tiles of the disk, (L, 6, T) float64; the limb has its own."""
    column, row = ((at.view.across + 1.0) * (0.5 * TILES)).long().clamp(0, TILES - 1).unbind(1)
    tile = (row * TILES + column) * 2 + (at.view.coverage < WHOLE).long()
    sums = score.new_zeros(*score.shape[:2], 2 * TILES**2, dtype=torch.float64)
    return sums.scatter_add(2, tile[:, None].expand_as(score), score.double())


def _shared(pulls: Tensor) -> Tensor:
    """Return the mean over pairs of different frames of the tiles' outer products, (C, n, n), of (B, C, n, T)."""
    total, count = pulls.sum(0), len(pulls)
    return (total @ total.mT - (pulls @ pulls.mT).sum(0)) / (count * (count - 1))


def _not_negative(matrix: Tensor) -> Tensor:
    """Return symmetric matrices (..., n, n) without their negative eigenvalues: a mean over pairs may have some."""
    values, vectors = torch.linalg.eigh(0.5 * (matrix + matrix.mT))
    kept: Tensor = vectors @ torch.diag_embed(values.clamp_min(0.0)) @ vectors.mT
    return kept
