"""Linearise pictures about map and poses, and solve for one joint Gauss-Newton step of all."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, vstack
from torch import Tensor

from sphereorient.mapping.grid import READS, SplineTable, stiffness
from sphereorient.pose.fit import grey_by_pose, residuals
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.model import SphereView
from sphereorient.pose.pixels import Pixels

DEPTH_MIN = 0.2  # cosine of the slant below which a pixel is not used for the map
POSE = 6  # unknowns of a pose
DAMPING = 1e-5  # of the diagonal: the body frame is free, the step along it zero
RIDGE = 1e-7
LONGEST_SHARE = 0.1  # typical length of a turn, rad, and of a move, radii
STEPS = 60  # of conjugate gradients
Array = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearisation:
    """L disks of P pixels, each linearised about one pose and the map."""

    view: SphereView
    reads: list[tuple[Tensor, Tensor]]  # of the inner and the outer pixels: texels and weights, (L, n * P', 16) each
    inner: int  # number of first pixels that `reads[0]` is of
    depth: Tensor  # (L, P), cosine of the slant
    step: Tensor  # (L, P), grey levels from black to white texture, the frame's own light and coverage included
    residual: Tensor  # (L, P), grey levels
    weight: Tensor  # (L, P), robust, 0 .. 1
    variance: Tensor  # (L, P), grey levels^2
    by_pose: Tensor  # (L, 6, P), grey levels per rad (delta) and per mm
    by_light: Tensor  # (L, K, P), by the coefficients of a frame's own light

    @property
    def precision(self) -> Tensor:
        """Weight over variance, (L, P), smaller towards the limb, where errors of the light grow."""
        slanted = torch.where(self.depth > DEPTH_MIN, self.depth.square(), 1.0)
        return self.weight / self.variance * slanted

    def by_texel(self, height: int) -> csr_matrix:
        """Return the derivative by the texels times the root of the precision, (L * P, T) float32."""
        factor = self.step * self.precision.sqrt() * (self.depth > DEPTH_MIN)
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
        return csr_matrix((entries.numpy(), columns.numpy(), start), shape=shape)


def linearise(
    fitter: Fitter, texture: Tensor, pixels: Pixels, position_lab_mm: Tensor, R_lab_body: Tensor, blur_px: float
) -> Linearisation:
    """Linearise B * C disks, adjacent cameras, about a map (H, 2 H) of their blur and poses (B, 3) mm, (B, 3, 3).

    The light of each frame is at its best; the fitter gives views and light, not the map.
    """
    table = SplineTable(texture, 0.0)
    model = replace(fitter.model(fitter.optics.fine), paint=table, blur_px=blur_px)
    at = residuals(pixels, position_lab_mm, R_lab_body, None, model, len(fitter.views))
    depth = (1 - at.view.across.square().sum(1)).clamp_min(0).sqrt()
    return Linearisation(
        view=at.view,
        reads=table.reads,
        inner=pixels.inner,
        depth=depth,
        step=at.lit,
        residual=at.residual,
        weight=at.weight,
        variance=at.variance,
        # Near the limb the map is not learnt; it must not move the pose there.
        by_pose=grey_by_pose(at.view, at.lit * (depth > DEPTH_MIN), at.over),
        by_light=at.design[:, POSE:],
    )


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
    # Orthonormal rows: the frame's own light is projected out along them.
    rows = (at.by_light * root[:, None]).double()
    size = rows.square().sum(-1, keepdim=True).clamp_min(1e-12).sqrt()
    rows = rows / size
    gram = rows @ rows.mT + RIDGE * torch.eye(rows.shape[1], dtype=rows.dtype)
    basis = torch.linalg.solve_triangular(torch.linalg.cholesky(gram), rows, upper=False).float()
    return LinearSystem(
        by_texel=at.by_texel(height),
        by_pose=at.by_pose * root[:, None],
        by_light=basis,
        residual=at.residual * root,
    )


def joint_step(
    parts: Sequence[LinearSystem], use: Tensor, texture: Tensor, smooth: float, radius_mm: float, fixed: bool
) -> Tensor:
    """Return the step of all poses (N, 6) float64, rad and mm, from one solution for poses and map together.

    The map (H, 2 H) has its squared slopes penalised by `smooth`; use is (N, C) bool; `fixed`: one shared position.

    Source: each frame's light projected out, Golub and Pereyra 1973; bundle adjustment, Agarwal et al. 2010.
    """
    count, cameras = use.shape
    height = len(texture)
    ties = (smooth * stiffness(height)).astype(np.float32)
    by_texel = vstack([part.by_texel for part in parts], format="csr")
    back = by_texel.T
    by_pose, by_light, residual = (
        torch.cat([getattr(part, name) for part in parts]) for name in ("by_pose", "by_light", "residual")
    )

    def without_light(values: Tensor) -> Tensor:
        along = by_light @ values[..., None]
        left: Tensor = values - (by_light.mT @ along)[..., 0]
        return left

    def pulled(values: Tensor) -> tuple[Tensor, Array]:
        pose = (by_pose @ values[..., None])[..., 0].reshape(count, cameras, POSE).sum(1)
        return _shared(pose, fixed), back @ values.reshape(-1).numpy()

    def applied(pose: Tensor, texels: Array) -> tuple[Tensor, Array]:
        spread = _spread(pose, count, fixed).repeat_interleave(cameras, 0)
        values = (spread[:, None] @ by_pose)[:, 0] + torch.from_numpy(by_texel @ texels).reshape(residual.shape)
        on_pose, on_map = pulled(without_light(values))
        return on_pose + damp_pose * pose, on_map + ties @ texels + damp_map * texels

    lit = by_pose - (by_pose @ by_light.mT) @ by_light
    blocks = (lit @ lit.mT).reshape(count, cameras, POSE, POSE).sum(1)
    size = torch.tensor([LONGEST_SHARE] * 3 + [LONGEST_SHARE * radius_mm] * 3)
    damp = DAMPING * blocks.diagonal(dim1=1, dim2=2) + 1.0 / size.square()
    damp_pose = _shared(damp, fixed)
    damp_map = np.float32(1e-3 * smooth) + np.zeros(1, np.float32)
    precondition_map = 1.0 / (np.asarray(by_texel.power(2).sum(0)).ravel() + ties.diagonal() + damp_map)
    solve_pose = _inverse_blocks(blocks, damp, fixed)
    r_pose, r_map = pulled(without_light(residual))
    r_map = r_map - ties @ texture.reshape(-1).float().numpy()
    pose, texels = torch.zeros_like(r_pose), np.zeros_like(r_map)
    z_pose, z_map = solve_pose(r_pose), precondition_map * r_map
    p_pose, p_map = z_pose.clone(), z_map.copy()
    rz = first = _dot(r_pose, z_pose, r_map, z_map)
    for _ in range(STEPS):
        if rz <= 1e-8 * first:
            break
        q_pose, q_map = applied(p_pose, p_map)
        alpha = rz / _dot(p_pose, q_pose, p_map, q_map)
        pose, texels = pose + alpha * p_pose, texels + alpha * p_map
        r_pose, r_map = r_pose - alpha * q_pose, r_map - alpha * q_map
        z_pose, z_map = solve_pose(r_pose), precondition_map * r_map
        rz, before = _dot(r_pose, z_pose, r_map, z_map), rz
        p_pose, p_map = z_pose + rz / before * p_pose, z_map + rz / before * p_map
    return _spread(pose, count, fixed).double()


def _dot(a_pose: Tensor, b_pose: Tensor, a_map: Array, b_map: Array) -> float:
    return float((a_pose.double() * b_pose.double()).sum()) + float(a_map.astype(np.float64) @ b_map)


def _shared(pose: Tensor, fixed: bool) -> Tensor:
    """Sum over instants what they share: (N, 6), or (3 N + 3,) with one position for all."""
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
    count = len(blocks)

    def solve(pose: Tensor) -> Tensor:
        turned = (turns @ pose[:-3].reshape(count, 3, 1)).reshape(-1)
        return torch.cat([turned, move @ pose[-3:]])

    return solve
