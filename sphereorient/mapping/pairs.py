"""How the ball turned between two instants, from their pictures alone: disks warped over the sphere, no map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.mapping.disks import Disks, disk_places, view_normals

STEP_RAD = 0.15  # longest step of the climb
RIDGE = 1e-3
BATCH = 64  # pairs compared at once
LOOKS = 1 << 21  # look-ups at once, at most, in a search
SCALE = 0.7  # residual, in deviations of an normalised picture, that counts half
OVERLAP_MIN = 0.2  # share of a disk that both pictures of a pair show, below which they tell nothing


@dataclass(frozen=True, kw_only=True, eq=False)
class Turns:
    """Relative rotations of E pairs of instants; made by `climb_pairs`, read by the graph."""

    first: Tensor  # (E,) int64, i
    second: Tensor  # (E,) int64, j
    R_ji: Tensor  # (E, 3, 3) float64: R_lab_body(j) R_lab_body(i)^T
    information: Tensor  # (E, 3, 3) float64, 1/rad^2, of delta in exp([delta]x) R_ji
    score: Tensor  # (E,), correlation of what both show, -1 .. 1
    overlap: Tensor  # (E,), in disks

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.score)

    def where(self, chosen: Tensor) -> Turns:
        """Return some of the pairs."""
        return Turns(**{name: getattr(self, name)[chosen] for name in self.__dataclass_fields__})


def joined(parts: list[Turns]) -> Turns:
    """Return the pairs of all parts."""
    return Turns(**{name: torch.cat([getattr(part, name) for part in parts]) for name in Turns.__dataclass_fields__})


@dataclass(frozen=True, kw_only=True, eq=False)
class _Warp:
    """One disk laid over another, for E rotations."""

    grey: Tensor  # (E, P), of the second disk at the first one's places
    by_turn: Tensor  # (E, 3, P), its derivative by delta, lab
    weight: Tensor  # (E, P)


def _warped(disks: Disks, second: Tensor, camera: int, normal_lab: Tensor, slopes: bool) -> _Warp:
    """Look up the disks of `second` (E,) in directions (E, 3, P) that the lab sees at that instant."""
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
    near = disks.share.reshape(-1)[cell]
    weight = depth.clamp_min(0) * near * disks.told(second, camera).gather(1, cell)
    if not slopes:
        return _Warp(grey=found[:, 0], by_turn=found[:, :0], weight=weight)
    # d place = scale (d xy - place / sqrt(D^2 - 1) d z), d n = delta x n, view frame.
    gx, gy = found[:, 1] * scale[:, 0], found[:, 2] * scale[:, 0]
    D = disks.distance_radii[second, camera][:, None]
    gz = -(gx * place[:, 0] + gy * place[:, 1]) / (D.square() - 1).sqrt()
    x, y, z = normal.unbind(1)
    turned = torch.stack([y * gz - z * gy, z * gx - x * gz, x * gy - y * gx], dim=1)
    return _Warp(grey=found[:, 0], by_turn=R @ turned, weight=weight)


def _first_views(disks: Disks, first: Tensor, every: int) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Return directions in the lab (E, 3, P), grey (E, P) and weight (E, P) of the first disks, camera by camera."""
    views = []
    for camera in range(disks.layers.shape[1]):
        normal, grey, weight = _sampled(disks, first, camera, every)
        views.append((disks.R_lab_view[first, camera] @ normal, grey, weight))
    return views


def _sampled(disks: Disks, rows: Tensor, camera: int, every: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return directions in the view frame (3, P), grey (R, P) and weight (R, P) of one camera's disks."""
    normal, share = view_normals(disks.size_px, float(disks.distance_radii[:, camera].median()), every)
    place, _, depth = disk_places(normal, disks.distance_radii[:, camera].median())
    at = ((place + 1) * (disks.size_px / 2) - 0.5).round().long()
    cell = at[1] * disks.size_px + at[0]
    grey = disks.layers[rows, camera, 0].flatten(1)[:, cell]
    return normal, grey, (share * depth.clamp_min(0))[None] * disks.told(rows, camera)[:, cell]


def climb_pairs(disks: Disks, first: Tensor, second: Tensor, R_ji: Tensor, steps: int, every: int = 1) -> Turns:
    """Bring rough relative rotations to the best fit nearby, all cameras of both instants against each other.

    Args:
        disks: of the movie.
        first: (E,) int64.
        second: (E,) int64.
        R_ji: (E, 3, 3), starts.
        steps: Gauss-Newton steps.
        every: which share of the pixels is looked at.

    Source: direct alignment, Lucas and Kanade 1981; robust weights, Geman and McClure 1987.
    """
    parts = []
    for rows in torch.split(torch.arange(len(first)), BATCH):
        i, j, R = first[rows], second[rows], R_ji[rows].float()
        views = _first_views(disks, i, every)
        for _ in range(steps):
            normal, right, _, _ = _normal_equations(disks, j, R, views, slopes=True)
            ridge = RIDGE * normal.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None] * torch.eye(3) + 1e-6 * torch.eye(3)
            turn = torch.linalg.solve((normal + ridge).double(), right.double()[..., None])[..., 0].float()
            turn = turn * (STEP_RAD / turn.norm(dim=-1, keepdim=True).clamp_min(1e-9)).clamp_max(1.0)
            R = so3.exp(turn) @ R
        normal, _, score, overlap = _normal_equations(disks, j, R, views, slopes=True)
        parts.append(
            Turns(
                first=i,
                second=j,
                R_ji=so3.nearest_rotation(R.double()),
                information=normal.double(),
                score=score.double(),
                overlap=overlap.double(),
            )
        )
    return joined(parts)


def _normal_equations(
    disks: Disks, second: Tensor, R: Tensor, views: list[tuple[Tensor, Tensor, Tensor]], slopes: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Sum over all pairs of cameras: normal matrix (E, 3, 3), right side (E, 3), correlation and overlap (E,)."""
    count = len(R)
    normal, right = torch.zeros(count, 3, 3), torch.zeros(count, 3)
    sums = torch.zeros(count, 6)
    disk_weight = 0.0
    for normal_lab, grey, own in views:
        turned = R @ normal_lab
        disk_weight += float(own.sum(1).max()) if count else 0.0
        for camera in range(disks.layers.shape[1]):
            warp = _warped(disks, second, camera, turned, slopes)
            weight = own * warp.weight
            left = grey - warp.grey
            if slopes:
                trusted = weight / (1 + (left / SCALE).square()).square()
                scaled = warp.by_turn * trusted[:, None]
                normal += scaled @ warp.by_turn.mT
                right += (scaled @ left[..., None])[..., 0]
            a, b = grey, warp.grey
            sums += torch.stack(
                [
                    weight.sum(1),
                    (weight * a).sum(1),
                    (weight * b).sum(1),
                    (weight * a * a).sum(1),
                    (weight * b * b).sum(1),
                    (weight * a * b).sum(1),
                ],
                dim=1,
            )
    score, w = _correlation(*sums.unbind(1))
    return normal, right, score, w / max(disk_weight / len(views), 1e-9)


def _correlation(w: Tensor, a: Tensor, b: Tensor, aa: Tensor, bb: Tensor, ab: Tensor) -> tuple[Tensor, Tensor]:
    """Return correlations (...), and weights above 0, from sums of weights, weighted values, squares and products."""
    w = w.clamp_min(1e-9)
    covariance = ab / w - a * b / w.square()
    deviation = ((aa / w - (a / w).square()) * (bb / w - (b / w).square())).clamp_min(1e-12).sqrt()
    return torch.where(w > 1e-6, covariance / deviation, torch.zeros(())), w


def search_pairs(disks: Disks, first: Tensor, second: Tensor, about: Tensor, grid: Tensor, every: int = 1) -> Tensor:
    """Return the best of all rotations grid[m] @ about[e], (E, 3, 3), for pairs of instants.

    Args:
        disks: small ones: detail that is finer than the grid only hides the right place.
        first: (E,) int64.
        second: (E,) int64.
        about: (E, 3, 3), R_ji about which is searched.
        grid: (M, 3, 3).
        every: which share of the pixels is looked at.
    """
    best = []
    grid = grid.float()
    places = math.pi / 4 * disks.size_px**2 / every
    chunk = max(1, int(LOOKS / places))
    for i, j, R in zip(first, second, about.float(), strict=True):
        scores = []
        for some in torch.split(grid, chunk):
            tried = some @ R
            views = _first_views(disks, i.expand(len(tried)), every)
            _, _, score, overlap = _normal_equations(disks, j.expand(len(tried)), tried, views, slopes=False)
            # Little that both show says little: shrunk towards nothing as a correlation of few places is.
            scores.append(score * (overlap / (overlap + OVERLAP_MIN)))
        best.append(grid[int(torch.cat(scores).argmax())] @ R)
    return torch.stack(best).double()


def search_views(disks: Disks, cameras: tuple[int, int], second: int, grid: Tensor, every: int) -> Tensor:
    """Compare one disk with all first ones of a camera, for all rotations of a grid, (N, M).

    A disk that is turned is looked up once for all that it is compared with; the rest are products of matrices.

    Args:
        disks: N, small ones, as in `search_pairs`.
        cameras: of the first disks and of the second one.
        second: instant of the second one.
        grid: (M, 3, 3), from the first disk's view frame to the second one's.
        every: which share of the pixels is looked at.

    Returns:
        Correlations, shrunk as in `search_pairs`.
    """
    camera, other = cameras
    normal, grey, own = _sampled(disks, torch.arange(len(disks)), camera, every)
    left = torch.stack([own, own * grey, own * grey.square()])
    full = float(own.sum(1).max())
    parts = []
    for some in torch.split(grid.float(), max(1, LOOKS // normal.shape[1])):
        rows = torch.full((len(some),), second)
        warp = _warped(disks, rows, other, disks.R_lab_view[second, other] @ some @ normal, slopes=False)
        right = torch.stack([warp.weight, warp.weight * warp.grey, warp.weight * warp.grey.square()])
        sums = torch.einsum("anp,bmp->abnm", left, right)
        w, a, aa = sums[0, 0], sums[1, 0], sums[2, 0]
        score, w = _correlation(w, a, sums[0, 1], aa, sums[0, 2], sums[1, 1])
        overlap = w / max(full, 1e-9)
        parts.append(score * (overlap / (overlap + OVERLAP_MIN)))
    return torch.cat(parts, dim=1)
