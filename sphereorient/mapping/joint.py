"""Gauss-Newton of all poses and the map together: what one camera calls a turn another may call other paint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, vstack
from torch import Tensor

from sphereorient.mapping.grid import stiffness
from sphereorient.mapping.look import DEPTH_MIN, Look, look_ups

POSE = 6
DAMPING = 1e-5  # of the diagonal: the body frame is free, and the step along it nought
RIDGE = 1e-7
Array = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """The linear problem of some disks; made by `part_of`, read by `joint_step`. All is float32, times root weight."""

    look_up: csr_matrix  # (L * P, T): what each pixel changes by the map
    by_pose: Tensor  # (L, 6, P)
    by_light: Tensor  # (L, K, P), orthonormal rows
    residual: Tensor  # (L, P)


def part_of(at: Look, height: int) -> Part:
    """Take the linear problem out of a comparison.

    Args:
        at: of L disks.
        height: H of the map.
    """
    root = at.precision.sqrt()
    told = at.depth > DEPTH_MIN
    reads = look_ups(at, at.step * root * told, 2 * height * height)
    # Rows of the light made orthonormal: what is along them, a frame's own light takes.
    rows = (at.by_light * root[:, None]).double()
    size = rows.square().sum(-1, keepdim=True).clamp_min(1e-12).sqrt()
    rows = rows / size
    gram = rows @ rows.mT + RIDGE * torch.eye(rows.shape[1], dtype=rows.dtype)
    basis = torch.linalg.solve_triangular(torch.linalg.cholesky(gram), rows, upper=False).float()
    return Part(look_up=reads, by_pose=at.by_pose * root[:, None], by_light=basis, residual=at.residual * root)


def _without_light(part: Part, values: Tensor) -> Tensor:
    """Take out of values (L, P) what the frames' own light explains."""
    along = part.by_light @ values[..., None]
    left: Tensor = values - (part.by_light.mT @ along)[..., 0]
    return left


@dataclass(frozen=True, kw_only=True, eq=False)
class Step:
    """What a joint step changes; made by `joint_step`."""

    pose: Tensor  # (N, 6) float64: delta (rad) and place (mm)
    map: Tensor  # (H, 2 H) float64
    left: float  # of the linear problem, share of its gradient


def joint_step(
    parts: Sequence[Part],
    use: Tensor,
    texture: Tensor,
    smooth: float,
    scale: tuple[float, float],
    iterations: int,
    fixed: bool = False,
) -> Step:
    """Solve for a step of all poses and the map.

    Args:
        parts: of N instants with C cameras each, in order.
        use: (N, C) bool.
        texture: (H, 2 H), the map, whose slopes are held small.
        smooth: weight of the integral of its squared slope.
        scale: typical lengths of a turn and a move, rad and mm: the longest that are plausible at all.
        iterations: of the conjugate gradients.
        fixed: whether all instants share one place.

    Source: Gauss-Newton by preconditioned conjugate gradients, the light of each frame projected out (Golub and
    Pereyra 1973); bundle adjustment in the large, Agarwal et al. 2010.
    """
    count, cameras = use.shape
    height = len(texture)
    ties = (smooth * stiffness(height)).astype(np.float32)
    looks = vstack([part.look_up for part in parts], format="csr")
    back = looks.T
    by_pose = torch.cat([part.by_pose for part in parts])
    by_light = torch.cat([part.by_light for part in parts])
    whole = Part(look_up=looks, by_pose=by_pose, by_light=by_light, residual=torch.cat([p.residual for p in parts]))
    shape = whole.residual.shape

    def pulled(values: Tensor) -> tuple[Tensor, Array]:
        pose = (by_pose @ values[..., None])[..., 0].reshape(count, cameras, POSE).sum(1)
        return _shared(pose, fixed), back @ values.reshape(-1).numpy()

    def applied(pose: Tensor, paint: Array) -> tuple[Tensor, Array]:
        spread = _spread(pose, count, fixed).repeat_interleave(cameras, 0)
        values = (spread[:, None] @ by_pose)[:, 0] + torch.from_numpy(looks @ paint).reshape(shape)
        turned, painted = pulled(_without_light(whole, values))
        return turned + damp_pose * pose, painted + ties @ paint + damp_map * paint

    lit = by_pose - (by_pose @ by_light.mT) @ by_light
    blocks = (lit @ lit.mT).reshape(count, cameras, POSE, POSE).sum(1)
    size = torch.tensor([scale[0]] * 3 + [scale[1]] * 3)
    damp = DAMPING * blocks.diagonal(dim1=1, dim2=2) + 1.0 / size.square()
    damp_pose = _shared(damp, fixed)
    own_map = np.asarray(looks.power(2).sum(0)).ravel()
    damp_map = np.float32(1e-3 * smooth) + np.zeros(1, np.float32)
    precondition_map = 1.0 / (own_map + ties.diagonal() + damp_map)
    solve_pose = _inverse_blocks(blocks, damp, fixed)
    right = pulled(_without_light(whole, whole.residual))
    r_pose, r_map = right[0], right[1] - ties @ texture.reshape(-1).float().numpy()
    pose, paint = torch.zeros_like(r_pose), np.zeros_like(r_map)
    z_pose, z_map = solve_pose(r_pose), precondition_map * r_map
    p_pose, p_map = z_pose.clone(), z_map.copy()
    rz = first = _dot(r_pose, z_pose, r_map, z_map)
    for _ in range(iterations):
        if rz <= 1e-8 * first:
            break
        q_pose, q_map = applied(p_pose, p_map)
        alpha = rz / _dot(p_pose, q_pose, p_map, q_map)
        pose, paint = pose + alpha * p_pose, paint + alpha * p_map
        r_pose, r_map = r_pose - alpha * q_pose, r_map - alpha * q_map
        z_pose, z_map = solve_pose(r_pose), precondition_map * r_map
        rz, before = _dot(r_pose, z_pose, r_map, z_map), rz
        p_pose, p_map = z_pose + rz / before * p_pose, z_map + rz / before * p_map
    return Step(
        pose=_spread(pose, count, fixed).double(),
        map=torch.from_numpy(paint.astype(np.float64)).reshape(height, -1),
        left=(rz / max(first, 1e-30)) ** 0.5,
    )


def _dot(a_pose: Tensor, b_pose: Tensor, a_map: Array, b_map: Array) -> float:
    return float((a_pose.double() * b_pose.double()).sum()) + float(a_map.astype(np.float64) @ b_map)


def _shared(pose: Tensor, fixed: bool) -> Tensor:
    """Sum up what all instants share: (N, 6), or (3 N + 3,) with one place for all."""
    return torch.cat([pose[:, :3].reshape(-1), pose[:, 3:].sum(0)]) if fixed else pose


def _spread(pose: Tensor, count: int, fixed: bool) -> Tensor:
    """Return (N, 6) of what `_shared` made."""
    return torch.cat([pose[:-3].reshape(count, 3), pose[-3:].expand(count, 3)], dim=1) if fixed else pose


def _inverse_blocks(blocks: Tensor, damp: Tensor, fixed: bool) -> Callable[[Tensor], Tensor]:
    """Return the preconditioner of the poses: each instant by itself."""
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
