"""Linearise pictures about map and poses, and solve for a joint Gauss-Newton step."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.sparse import csr_matrix, vstack
from torch import Tensor

from sphereorient.mapping.grid import READS, Array, SplineTable, conjugate_gradients, stiffness, texel_sums
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.residuals import Residuals, grey_by_pose, residuals

DEPTH_MIN = 0.2  # least cosine of the slant of a pixel used for the map
POSE = 6  # unknowns of a pose
DAMPING = 1e-5  # of the diagonal, as the body frame is free
RIDGE = 1e-7  # of the light's normal equations, against singularity by rounding
LONGEST_SHARE = 0.1  # typical size of a rotation, rad, and of a motion, radii
STEPS = 30  # of conjugate gradients: fewer leave smooth distortions of the map, more change nothing


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearisation(Residuals):
    """L disks of P pixels, each linearised about one pose and the map."""

    reads: list[tuple[Tensor, Tensor]]  # of the inner and the outer pixels: texels and weights, (L, n * P', 16) each
    inner: int  # number of first pixels, those of `reads[0]`

    @cached_property
    def depth(self) -> Tensor:
        """Cosine of the slant, (L, P)."""
        return (1 - self.view.across.square().sum(1)).clamp_min(0).sqrt()

    @property
    def precision(self) -> Tensor:
        """Weight over variance, (L, P), smaller towards the limb, where errors of the light grow."""
        slanted = torch.where(self.depth > DEPTH_MIN, self.depth.square(), 1.0)
        return self.weight / self.variance * slanted

    def by_texel(self, height: int) -> csr_matrix:
        """Return the derivative by the texels times the root of the precision, (L * P, T) float32."""
        factor = self.lit * self.precision.sqrt() * (self.depth > DEPTH_MIN)
        places, values, counts = [], [], []
        for k, (place, share) in enumerate(self.reads):
            own = factor[:, : self.inner] if k == 0 else factor[:, self.inner :]
            nodes = place.shape[1] // own.shape[1]
            several = (len(own), nodes, own.shape[1], READS)
            scaled = share.reshape(several) * (own / nodes)[:, None, :, None]
            places.append(place.reshape(several).transpose(1, 2).flatten(2))
            values.append(scaled.transpose(1, 2).flatten(2))
            counts.append(torch.full(own.shape, nodes * READS))
        count = torch.cat(counts, dim=1)
        start = np.concatenate([[0], count.reshape(-1).cumsum(0).numpy()])
        columns = torch.cat([part.flatten(1) for part in places], dim=1).reshape(-1).to(torch.int32)
        entries = torch.cat([part.flatten(1) for part in values], dim=1).reshape(-1).float()
        shape = (count.numel(), 2 * height * height)
        found = csr_matrix((entries.numpy(), columns.numpy(), start), shape=shape)
        found.sum_duplicates()  # a third of a pixel's texels are read twice
        return found


def linearise(
    fitter: Fitter, paint: SplineTable, pixels: Pixels, position_lab_mm: Tensor, R_lab_body: Tensor, blur_px: float
) -> Linearisation:
    """Linearise B * C disks, adjacent cameras, about a new table of a map of their blur and poses (B, 3) mm, (B, 3, 3).
    The light of each frame is optimal; the fitter gives views and light, not the map.
    """
    model = replace(fitter.model(), paint=paint, blur_px=blur_px)
    at = residuals(pixels, position_lab_mm, R_lab_body, None, model)
    return Linearisation(**vars(at), reads=paint.reads, inner=pixels.inner)


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearSystem:
    """The linear problem of some disks; all float32, times the root of the precision."""

    by_texel: csr_matrix  # (L * P, T)
    by_pose: Tensor  # (L, 6, P)
    by_light: Tensor  # (L, K, P), orthonormal rows
    residual: Tensor  # (L, P)


def linear_system(at: Linearisation, height: int) -> LinearSystem:
    """Return the linear system of a linearisation; `height` is the map's H."""
    root = at.precision.sqrt()
    # Orthonormal rows, to project out the frame's own light.
    rows = (at.design[:, POSE:] * root[:, None]).double()
    rows = rows / rows.square().sum(-1, keepdim=True).clamp_min(1e-12).sqrt()
    gram = rows @ rows.mT + RIDGE * torch.eye(rows.shape[1], dtype=rows.dtype)
    basis = torch.linalg.solve_triangular(torch.linalg.cholesky(gram), rows, upper=False).float()
    # Near the limb the map is not learnt, and must not affect the pose.
    by_pose = grey_by_pose(at.view, at.lit * (at.depth > DEPTH_MIN), at.over) * root[:, None]
    return LinearSystem(by_texel=at.by_texel(height), by_pose=by_pose, by_light=basis, residual=at.residual * root)


def joint_step(
    parts: Sequence[LinearSystem], use: Tensor, texture: Tensor, smooth: float, radius_mm: float, fixed: bool
) -> Tensor:
    """Return the step of all poses (N, 6) float64, rad and mm, from one solution for poses and map together.
    The map (H, 2 H) has its squared slopes penalised by `smooth`; use is (N, C) bool; `fixed`: one shared position.
    Source: each frame's light projected out, Golub and Pereyra 1973; bundle adjustment, Agarwal et al. 2010.
    """
    count, cameras = use.shape
    ties = (smooth * stiffness(len(texture))).astype(np.float32)
    by_texel = vstack([part.by_texel for part in parts], format="csr")
    back, names = by_texel.T, ("by_pose", "by_light", "residual")
    by_pose, by_light, residual = (torch.cat([getattr(part, name) for part in parts]) for name in names)
    poses = 3 * count + 3 if fixed else POSE * count  # unknowns before those of the texels

    def unknowns(pose: Tensor, texels: Array) -> Array:
        return np.concatenate([pose.reshape(-1).numpy(), texels])

    def pose_of(x: Array) -> Tensor:
        return torch.from_numpy(x[:poses]).reshape((-1,) if fixed else (count, POSE))

    def without_light(values: Tensor) -> Tensor:
        return values - (by_light.mT @ (by_light @ values[..., None]))[..., 0]

    def pulled(values: Tensor) -> Array:
        pose = (by_pose @ values[..., None])[..., 0].reshape(count, cameras, POSE).sum(1)
        return unknowns(_shared(pose, fixed), back @ values.reshape(-1).numpy())

    def applied(x: Array) -> Array:
        spread = _spread(pose_of(x), count, fixed).repeat_interleave(cameras, 0)
        values = (spread[:, None] @ by_pose)[:, 0] + torch.from_numpy(by_texel @ x[poses:]).reshape(residual.shape)
        force = pulled(without_light(values))
        force[poses:] += ties @ x[poses:]
        force += damping * x
        return force

    def preconditioned(x: Array) -> Array:
        return unknowns(solve_pose(pose_of(x)), precondition_map * x[poses:])

    lit = by_pose - (by_pose @ by_light.mT) @ by_light
    blocks = (lit @ lit.mT).reshape(count, cameras, POSE, POSE).sum(1)
    size = torch.tensor([LONGEST_SHARE] * 3 + [LONGEST_SHARE * radius_mm] * 3)
    damp = DAMPING * blocks.diagonal(dim1=1, dim2=2) + 1.0 / size.square()
    damp_map = np.full(ties.shape[0], 1e-3 * smooth, np.float32)
    damping = unknowns(_shared(damp, fixed), damp_map)
    precondition_map = (1.0 / (texel_sums(by_texel) + ties.diagonal() + damp_map)).astype(np.float32)
    solve_pose = _inverse_blocks(blocks, damp, fixed)
    right = pulled(without_light(residual))
    right[poses:] -= ties @ texture.reshape(-1).float().numpy()
    step = conjugate_gradients(applied, preconditioned, right, 1e-8, STEPS)
    return _spread(pose_of(step), count, fixed).double()


def _shared(pose: Tensor, fixed: bool) -> Tensor:
    """Sum common unknowns over instants: (N, 6), or (3 N + 3,) with one position for all."""
    return torch.cat([pose[:, :3].reshape(-1), pose[:, 3:].sum(0)]) if fixed else pose


def _spread(pose: Tensor, count: int, fixed: bool) -> Tensor:
    return torch.cat([pose[:-3].reshape(count, 3), pose[-3:].expand(count, 3)], dim=1) if fixed else pose


def _inverse_blocks(blocks: Tensor, damp: Tensor, fixed: bool) -> Callable[[Tensor], Tensor]:
    """Return the preconditioner of the poses, one block for each instant."""
    blocks = blocks + torch.diag_embed(damp)
    if not fixed:
        inverse = torch.linalg.inv(blocks.double()).float()
        return lambda pose: (inverse @ pose[..., None])[..., 0]
    turns = torch.linalg.inv(blocks[:, :3, :3].double()).float()
    move = torch.linalg.inv(blocks[:, 3:, 3:].sum(0).double()).float()
    return lambda pose: torch.cat([(turns @ pose[:-3].reshape(-1, 3, 1)).reshape(-1), move @ pose[-3:]])
