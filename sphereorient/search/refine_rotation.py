"""From a rough orientation to the best one nearby: Gauss-Newton on grey values, the light eliminated."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.search.normalisation import Blur, rim_share
from sphereorient.so3 import cross_first_axis
from sphereorient.sphere import DiskView
from sphereorient.sphere.texture_table import TextureTable
from sphereorient.sphere.view import polynomials

WHITE_ORDER, BLACK_ORDER = 2, 1  # of the light's polynomials over the disk: times the paint, and without it
STEP_RAD = 0.14  # longest step for which the paint's slope holds
RIDGE = 1e-4  # of the diagonal: keeps the light solvable for disks of one paint
GAIN_MIN = 0.1  # least white minus black paint, deviations, to keep the right sign
PIXEL = 0.5  # standard deviation of a pixel and its resampling, px


@dataclass(frozen=True, kw_only=True, eq=False)
class DetailLevel:
    """One pyramid level and its P pixels."""

    blur: Blur
    paint: TextureTable
    place: Tensor  # (P,) int64, in the flattened picture
    normal: Tensor  # (3, P), view frame
    weight: Tensor  # (P,)
    white: Tensor  # (6, P), polynomials of the light on the paint
    black: Tensor  # (3, P)


def detail_level(view: DiskView, paint: TextureTable, detail: float, every: int, blur: float = 0.0) -> DetailLevel:
    """Prepare a pyramid level: `detail` (rad or radii) and the pictures' `blur` (radii); `every` 2: half the pixels."""
    size = view.size_px
    normal = view.normal_view.T.float()
    place = torch.nonzero(view.inside.reshape(-1))[:, 0]
    chosen = (place // size + place % size) % every == 0
    place, normal = place[chosen], normal[:, chosen].contiguous()
    share = rim_share(size).reshape(-1)[place]
    terms = polynomials(normal[:2], WHITE_ORDER)
    return DetailLevel(
        blur=Blur(size, math.sqrt(max(detail**2 - (2 * PIXEL / size) ** 2, 1e-6))),
        paint=paint.blurred(math.hypot(detail, blur)),
        place=place,
        normal=normal,
        weight=normal[2].square() * share,  # an error of the outline is a large rotation near the limb
        white=terms,
        black=terms[: (BLACK_ORDER + 1) * (BLACK_ORDER + 2) // 2],
    )


def refine_rotation(level: DetailLevel, disk: Tensor, R_view_body: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Fit rough orientations R_view_body (Q, 3, 3) float32 of a disk (S, S) by Gauss-Newton steps; return also scores
    (Q,): the share of the disk's deviation from smooth light that paint explains, at most 1.
    Source: variable projection, Golub and Pereyra 1973; robust weights, Geman and McClure 1987.
    """
    grey = level.blur(disk[None])[0].reshape(-1)[level.place]
    grey = grey - (grey * level.weight).sum() / level.weight.sum()
    grey = grey / grey.abs().amax().clamp_min(1e-12)
    rough = grey - (_solved(level.white[None], grey, level.weight) @ level.white)[0]
    deviation = (rough.square() * level.weight).sum().div(level.weight.sum()).sqrt().clamp_min(1e-12)
    grey, unexplained = grey / deviation, _cost(level, rough / deviation)
    R, weight, whites = R_view_body, level.weight.expand(len(R_view_body), -1), len(level.white)
    for _ in range(steps):
        normal_body = R.mT @ level.normal
        value, slope = level.paint.sample(normal_body)
        light = _light_columns(level, value)
        found = _solved(light, grey, weight)
        left = grey - (found[:, None] @ light)[:, 0]
        weight = level.weight * _trust(left)
        gain = (found[:, None, :whites] @ level.white)[:, 0].clamp_min(GAIN_MIN)
        # Rotating the body by epsilon, R exp(epsilon), changes the paint by epsilon . (slope x normal).
        turned = cross_first_axis(slope, normal_body) * gain[:, None]
        turn = _solved(torch.cat([light, turned], dim=1), left, weight)[:, -3:]
        R = R @ cayley(turn * (STEP_RAD / turn.norm(dim=1, keepdim=True).clamp_min(1e-9)).clamp_max(1.0))
    light = _light_columns(level, level.paint.sample(R.mT @ level.normal)[0])
    found = _solved(light, grey, weight)
    cost = _cost(level, grey - (found[:, None] @ light)[:, 0])
    # A negative gain is the negative of the map.
    return R, torch.where(found[:, 0] > 0, 1.0 - cost / unexplained.clamp_min(1e-12), -1.0)


def cayley(turn: Tensor) -> Tensor:
    """Return rotations (Q, 3, 3) by Cayley's formula, as `so3.exp` up to terms of third order, much faster."""
    H = so3.hat(turn)
    return torch.eye(3) + (H + 0.5 * H @ H) / (1.0 + 0.25 * turn.square().sum(-1))[:, None, None]


def _cost(level: DetailLevel, residual: Tensor) -> Tensor:
    """Sum over the pixels (..., P), bounded as the weights: a reflection costs the same for every orientation."""
    return (residual.square() * _trust(residual).sqrt() * level.weight).sum(-1)


def _light_columns(level: DetailLevel, value: Tensor) -> Tensor:
    return torch.cat([value[:, None] * level.white, level.black.expand(len(value), -1, -1)], dim=1)


def _trust(residual: Tensor) -> Tensor:
    """Return the weight of a pixel, 1 .. 0, by its residual in deviations of the picture."""
    return 1.0 / (1.0 + residual.square()).square()


def _solved(columns: Tensor, grey: Tensor, weight: Tensor) -> Tensor:
    weighted = columns * weight.expand(len(columns), -1)[:, None]
    normal = (weighted @ columns.mT).double()
    right = (weighted @ grey[..., None]).double()
    ridge = RIDGE * normal.diagonal(dim1=1, dim2=2).clamp_min(1e-9)
    solution: Tensor = torch.linalg.solve(normal + torch.diag_embed(ridge), right)
    return solution[..., 0].float()
