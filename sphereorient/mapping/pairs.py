"""Relative rotations of pairs of instants from pictures alone, and orientations from them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve
from torch import Tensor

from sphereorient import so3
from sphereorient.files.threads import side_by_side
from sphereorient.mapping.disks import Disks, disk_places
from sphereorient.so3 import cross_first_axis

STEP_RAD = 0.15  # longest step of a refinement
RIDGE = 1e-3  # of the trace, for pairs without slopes
BATCH = 64  # pairs compared at once
LOOKS = 1 << 21  # most look-ups at once in a search
SCALE = 0.7  # residual of half weight, in deviations of a normalised picture
OVERLAP_MIN = 0.2  # share of a disk visible in both pictures at which a correlation has half weight
ARRIVED_RAD = 1e-6  # largest last step of the graph
Sampled = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True, kw_only=True, eq=False)
class RelativeRotations:
    """Relative rotations of E pairs of instants."""

    first: Tensor  # (E,) int64, i
    second: Tensor  # (E,) int64, j
    R_ji: Tensor  # (E, 3, 3) float64: R_lab_body(j) R_lab_body(i)^T
    information: Tensor  # (E, 3, 3) float64, 1/rad^2, of delta in exp([delta]x) R_ji
    score: Tensor  # (E,), correlation of common parts, -1 .. 1
    overlap: Tensor  # (E,), in disks

    def __len__(self) -> int:
        return len(self.score)

    def where(self, chosen: Tensor) -> "RelativeRotations":
        """Return some of the pairs."""
        return RelativeRotations(**{name: part[chosen] for name, part in vars(self).items()})

    @classmethod
    def joined(cls, parts: Sequence["RelativeRotations"]) -> "RelativeRotations":
        """Join several records of pairs."""
        return cls(**{name: torch.cat([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__})

    def residual(self, R_lab_body: Tensor) -> Tensor:
        """Return delta (E, 3), rad, between the pairs and orientations (N, 3, 3): R_ji = exp([delta]x) R(j) R(i)^T."""
        return so3.log(self.R_ji @ (R_lab_body[self.second] @ R_lab_body[self.first].mT).mT)


@dataclass(frozen=True, kw_only=True, eq=False)
class Closure:
    """The effect of closing the loops; angles in rad."""

    pairs: int  # of neighbouring instants
    loops: int  # tried
    closed: int  # accepted and kept by the graph
    drift_before_rad: float  # rms error of the closed loops in the chain
    drift_after_rad: float  # and afterwards
    moved_rad: float  # rms change of the orientations, without a common rotation of the body frame

    @classmethod
    def of(cls, closed: RelativeRotations, before: Tensor, after: Tensor, *, pairs: int, loops: int) -> "Closure":
        """Compare orientations (N, 3, 3) before and after the loops `closed`."""
        drift, left = (_rms(closed.residual(R)) for R in (before, after))
        moved = attitude_change_rad(before, after)
        counts = {"pairs": pairs, "loops": loops, "closed": len(closed)}
        return cls(**counts, drift_before_rad=drift, drift_after_rad=left, moved_rad=moved)


def attitude_change_rad(before: Tensor, after: Tensor) -> float:
    """Return the rms angle, rad, between orientations (N, 3, 3) without a common rotation of the body frame."""
    Q = so3.nearest_rotation((before.mT @ after).sum(0))
    return _rms(so3.log(after @ (before @ Q).mT))


def _rms(vectors: Tensor) -> float:
    return float(vectors.square().sum(-1).mean().sqrt()) if len(vectors) else 0.0


def _warped(disks: Disks, second: Tensor, camera: int, normal_lab: Tensor, slopes: bool) -> Sampled:
    """Sample disks `second` (E,) at (E, 3, P), lab: grey (E, P), derivative by delta (E, 3 or 0, P), weight (E, P)."""
    R = disks.R_lab_view[second, camera]
    normal = R.mT @ normal_lab
    place, scale, depth = disk_places(normal, disks.distance_radii[second, camera])
    size = disks.size_px
    at = ((place + 1) * (size / 2) - 0.5).clamp(0, size - 1.001)
    column, row = at[:, 0].int(), at[:, 1].int()
    tx, ty = at[:, 0] - column, at[:, 1] - row
    cell = (row * size + column).long()
    flat = disks.layers[second, camera].flatten(2)
    layers = flat if slopes else flat[:, :1]

    def corner(offset: int) -> Tensor:
        return layers.gather(2, (cell + offset)[:, None].expand(-1, layers.shape[1], -1))

    upper = corner(0) * (1 - tx)[:, None] + corner(1) * tx[:, None]
    lower = corner(size) * (1 - tx)[:, None] + corner(size + 1) * tx[:, None]
    found = upper * (1 - ty)[:, None] + lower * ty[:, None]
    weight = depth.clamp_min(0) * disks.share.reshape(-1)[cell] * disks.weight(second, camera).gather(1, cell)
    if not slopes:
        return found[:, 0], found[:, :0], weight
    # d place = scale (d xy - place / sqrt(D^2 - 1) d z), d n = delta x n, view frame.
    gx, gy = found[:, 1] * scale[:, 0], found[:, 2] * scale[:, 0]
    D = disks.distance_radii[second, camera][:, None]
    gz = -(gx * place[:, 0] + gy * place[:, 1]) / (D.square() - 1).sqrt()
    return found[:, 0], R @ cross_first_axis(normal, torch.stack([gx, gy, gz], dim=1)), weight


def _first_views(disks: Disks, first: Tensor, every: int) -> list[Sampled]:
    """Return directions in the lab (E, 3, P), grey (E, P) and weight (E, P) of the first disks, camera by camera."""
    sampled = [disks.sampled(first, camera, every) for camera in range(disks.layers.shape[1])]
    return [(disks.R_lab_view[first, c] @ normal, grey, weight) for c, (normal, grey, weight) in enumerate(sampled)]


def refine_pairs(
    disks: Disks, first: Tensor, second: Tensor, R_ji: Tensor, iterations: int, every: int = 1
) -> RelativeRotations:
    """Refine R_ji (E, 3, 3) on each n-th pixel (Lucas and Kanade 1981; weights: Geman and McClure 1987)."""

    def refined(rows: Tensor) -> RelativeRotations:
        i, j, R = first[rows], second[rows], R_ji[rows].float()
        views = _first_views(disks, i, every)
        for _ in range(iterations):
            normal, right, _, _ = _normal_equations(disks, j, R, views, slopes=True)
            ridge = RIDGE * normal.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None] * torch.eye(3) + 1e-6 * torch.eye(3)
            turn = torch.linalg.solve((normal + ridge).double(), right.double()[..., None])[..., 0].float()
            turn = turn * (STEP_RAD / turn.norm(dim=-1, keepdim=True).clamp_min(1e-9)).clamp_max(1.0)
            R = so3.exp(turn) @ R
        normal, _, score, overlap = _normal_equations(disks, j, R, views, slopes=True)
        R, normal, score, overlap = so3.nearest_rotation(R.double()), normal.double(), score.double(), overlap.double()
        return RelativeRotations(first=i, second=j, R_ji=R, information=normal, score=score, overlap=overlap)

    return RelativeRotations.joined(list(side_by_side(refined, torch.split(torch.arange(len(first)), BATCH))))


def _normal_equations(
    disks: Disks, second: Tensor, R: Tensor, views: list[Sampled], slopes: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Sum over all pairs of cameras: normal matrix (E, 3, 3), right side (E, 3), correlation and overlap (E,)."""
    count = len(R)
    normal, right = torch.zeros(count, 3, 3), torch.zeros(count, 3)
    sums = torch.zeros(count, 6)
    disk_weight = 0.0
    for normal_lab, a, own in views:
        turned = R @ normal_lab
        disk_weight += float(own.sum(1).max()) if count else 0.0
        for camera in range(disks.layers.shape[1]):
            b, by_turn, other = _warped(disks, second, camera, turned, slopes)
            weight = own * other
            residual = a - b
            if slopes:
                robust = weight / (1 + (residual / SCALE).square()).square()
                scaled = by_turn * robust[:, None]
                normal += scaled @ by_turn.mT
                right += (scaled @ residual[..., None])[..., 0]
            products = (weight, weight * a, weight * b, weight * a * a, weight * b * b, weight * a * b)
            sums += torch.stack([product.sum(1) for product in products], dim=1)
    score, w = _correlation(*sums.unbind(1))
    return normal, right, score, w / max(disk_weight / len(views), 1e-9)


def _correlation(w: Tensor, a: Tensor, b: Tensor, aa: Tensor, bb: Tensor, ab: Tensor) -> tuple[Tensor, Tensor]:
    """Return correlations (...), and weights above 0, from sums of weights, weighted values, squares and products."""
    w = w.clamp_min(1e-9)
    covariance = ab / w - a * b / w.square()
    deviation = ((aa / w - (a / w).square()) * (bb / w - (b / w).square())).clamp_min(1e-12).sqrt()
    return torch.where(w > 1e-6, covariance / deviation, torch.zeros(())), w


def search_pairs(disks: Disks, first: Tensor, second: Tensor, about: Tensor, grid: Tensor, every: int = 1) -> Tensor:
    """Return the best of all rotations grid[m] @ about[e], (E, 3, 3), for pairs (E,); the disks should be small."""
    grid = grid.float()
    places = math.pi / 4 * disks.size_px**2 / every
    chunk = max(1, int(LOOKS / places))

    def best(pair: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        i, j, R = pair
        scores = []
        for some in torch.split(grid, chunk):
            tried = some @ R
            views = _first_views(disks, i.expand(len(tried)), every)
            _, _, score, overlap = _normal_equations(disks, j.expand(len(tried)), tried, views, slopes=False)
            # A correlation over a small overlap is weak evidence.
            scores.append(score * (overlap / (overlap + OVERLAP_MIN)))
        return grid[int(torch.cat(scores).argmax())] @ R

    return torch.stack(list(side_by_side(best, zip(first, second, about.float(), strict=True)))).double()


def search_views(disks: Disks, cameras: tuple[int, int], second: int, grid: Tensor, every: int = 1) -> Tensor:
    """Return correlations (N, M) of all first disks of a camera with one disk, `second`, at rotations (M, 3, 3).
    `cameras`: of the first disks and of the second; the rotations take the first view frame to the second.
    """
    camera, other = cameras
    normal, grey, own = disks.sampled(torch.arange(len(disks)), camera, every)
    left = torch.stack([own, own * grey, own * grey.square()])
    full = float(own.sum(1).max())
    parts = []
    for some in torch.split(grid.float(), max(1, LOOKS // normal.shape[1])):
        rows = torch.full((len(some),), second)
        b, _, weight = _warped(disks, rows, other, disks.R_lab_view[second, other] @ some @ normal, slopes=False)
        right = torch.stack([weight, weight * b, weight * b.square()])
        sums = torch.einsum("anp,bmp->abnm", left, right)
        w, a, aa = sums[0, 0], sums[1, 0], sums[2, 0]
        score, w = _correlation(w, a, sums[0, 1], aa, sums[0, 2], sums[1, 1])
        overlap = w / max(full, 1e-9)
        parts.append(score * (overlap / (overlap + OVERLAP_MIN)))
    return torch.cat(parts, dim=1)


def solve_graph(R_lab_body: Tensor, pairs: RelativeRotations, scale_rad: float) -> tuple[Tensor, Tensor]:
    """Fit orientations (N, 3, 3) float64, the first fixed, to relative rotations; return also residuals (E, 3), rad.
    Source: weights at `scale_rad`, Geman and McClure 1987, graduated non-convexity (Yang et al. 2020).
    """
    R = R_lab_body.clone()
    shape = pairs.information / pairs.information.diagonal(dim1=1, dim2=2).mean().clamp_min(1e-12)
    for k in range(20):
        wide = scale_rad * max(1.0, 16.0 * 0.6**k)
        residual = pairs.residual(R)
        weight = 1 / (1 + (residual.norm(dim=-1) / wide).square()).square()
        step = _graph_step(R, pairs, residual, shape * weight[:, None, None])
        R = so3.exp(step) @ R
        if wide == scale_rad and float(step.norm(dim=-1).max()) < ARRIVED_RAD:
            break
    R = so3.nearest_rotation(R @ (R[0].mT @ R_lab_body[0]))
    return R, pairs.residual(R)


def _graph_step(R: Tensor, pairs: RelativeRotations, residual: Tensor, weight: Tensor) -> Tensor:
    """Solve residual = delta_j - R_ji delta_i for all pairs, (N, 3)."""
    count, i, j = len(R), pairs.first, pairs.second
    carry, axes = R[j] @ R[i].mT, torch.arange(3)
    left = carry.mT @ weight
    blocks = torch.cat([left @ carry, -left, -weight @ carry, weight])
    rows = (3 * torch.cat([i, i, j, j])[:, None, None] + axes[:, None]).expand_as(blocks)
    columns = (3 * torch.cat([i, j, i, j])[:, None, None] + axes).expand_as(blocks)
    pulled = (weight @ residual[..., None])[..., 0]
    right = torch.zeros(count, 3, dtype=R.dtype).index_add(0, j, pulled)
    right = right.index_add(0, i, -(carry.mT @ pulled[..., None])[..., 0])
    # The first orientation is fixed; unconnected ones do not change.
    diagonal = torch.full((3 * count,), 1e-9, dtype=R.dtype)
    diagonal[:3] = 1e9
    every = torch.arange(3 * count)
    parts = (blocks, diagonal), (rows, every), (columns, every)
    entries, at, to = (torch.cat([part.reshape(-1), own]).numpy() for part, own in parts)
    matrix = coo_matrix((entries, (at, to)), shape=(3 * count, 3 * count)).tocsc()
    return torch.from_numpy(np.asarray(spsolve(matrix, right.reshape(-1).numpy())).reshape(count, 3))
