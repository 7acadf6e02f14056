"""From a rough orientation to the best one nearby: Gauss-Newton on grey values, the light solved inside."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.orient.evening import Blur, rim_share
from sphereorient.orient.light import polynomials
from sphereorient.sphere import DiskView
from sphereorient.sphere.paint_table import PaintTable

WHITE_ORDER, BLACK_ORDER = 2, 1  # of the light's polynomials over the disk: on the paint, and without it
STEP_RAD = 0.14  # longest step: beyond it the paint's slope says nothing any more
RIDGE = 1e-4  # of the diagonal: keeps the light solvable where the disk shows one paint
GAIN_MIN = 0.1  # of the mean one: a place darker than that still turns the paint the right way
PIXEL = 0.5  # standard deviation of a pixel and its resampling, px


@dataclass(frozen=True, kw_only=True, eq=False)
class Level:
    """One width of detail, and the pixels that are looked at there; P of them."""

    blur: Blur
    paint: PaintTable
    place: Tensor  # (P,) int64, in the flattened picture
    normal: Tensor  # (3, P), view frame
    weight: Tensor  # (P,)
    white: Tensor  # (6, P), polynomials of the light on the paint
    black: Tensor  # (3, P)


def climb_level(view: DiskView, paint: PaintTable, detail: float, every: int) -> Level:
    """Prepare a level.

    Args:
        view: of the pictures.
        paint: as fine as `detail` at least.
        detail: standard deviation of the Gaussian on the sphere, rad, and on the picture, radii.
        every: 1: all pixels, 2: like the white fields of a chess board.
    """
    size = view.size_px
    normal = view.normal_view.T.float()
    place = torch.nonzero(view.inside.reshape(-1))[:, 0]
    chosen = (place // size + place % size) % every == 0
    place, normal = place[chosen], normal[:, chosen].contiguous()
    share = rim_share(size).reshape(-1)[place]
    terms = polynomials(normal[:2], WHITE_ORDER)
    return Level(
        blur=Blur(size, math.sqrt(max(detail**2 - (2 * PIXEL / size) ** 2, 1e-6))),
        paint=paint.blurred(detail),
        place=place,
        normal=normal,
        weight=normal[2].square() * share,  # an error of the outline turns far near the limb
        white=terms,
        black=terms[: (BLACK_ORDER + 1) * (BLACK_ORDER + 2) // 2],
    )


def level_picture(level: Level, disk: Tensor) -> Tensor:
    """Return the level's pixels of a disk (S, S), in units of their deviation from the smoothest light, (P,)."""
    seen = level.blur(disk[None])[0].reshape(-1)[level.place]
    seen = seen - (seen * level.weight).sum() / level.weight.sum()
    seen = seen / seen.abs().amax().clamp_min(1e-12)  # whatever the camera's units: single precision has few digits
    smooth = _solved(level.white[None], seen, level.weight)[0] @ level.white
    return seen / ((seen - smooth).square() * level.weight).sum().div(level.weight.sum()).sqrt().clamp_min(1e-12)


def climb(level: Level, picture: Tensor, R_view_body: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Turn orientations towards the best fit nearby.

    Args:
        level: of detail.
        picture: (P,), of `level_picture`.
        R_view_body: (Q, 3, 3) float32, starts.
        steps: Gauss-Newton steps.

    Returns:
        R_view_body (Q, 3, 3), and the score (Q,): the share of the picture's deviation from smooth light that paint
        explains, 1 at most, 0 and below where it explains nothing.

    Source: variable projection, Golub and Pereyra 1973; robust weights, Geman and McClure 1987.
    """
    R = R_view_body
    gain = torch.ones(len(R), 1)
    weight = level.weight.expand(len(R), -1)
    whites = len(level.white)
    for _ in range(steps):
        normal_body = R.mT @ level.normal
        value, slope = level.paint.look(normal_body)
        light = _light_columns(level, value)
        # Turning the body by epsilon, R exp(epsilon), changes the paint by epsilon . (slope x normal).
        columns = torch.cat([light, _cross(slope, normal_body) * gain[:, None]], dim=1)
        found = _solved(columns, picture, weight)
        mean_gain = found[:, :1].clamp_min(GAIN_MIN)
        # The first step knows no map of the gain yet, and has its mean in the turn.
        turn = found[:, -3:] / (mean_gain if gain.shape[1] == 1 else 1.0)
        turn = turn * (STEP_RAD / turn.norm(dim=1, keepdim=True).clamp_min(1e-9)).clamp_max(1.0)
        R = R @ so3.exp(turn)
        gain = torch.maximum(found[:, :whites] @ level.white, GAIN_MIN * mean_gain)
        weight = level.weight * _trust(picture - (found[:, None] @ columns)[:, 0])
    return R, _score(level, picture, R, weight)


def _score(level: Level, picture: Tensor, R: Tensor, weight: Tensor) -> Tensor:
    light = _light_columns(level, level.paint.look(R.mT @ level.normal)[0])
    found = _solved(light, picture, weight)
    left = picture - (found[:, None] @ light)[:, 0]
    # Bounded as the weights are, so that a reflection costs every orientation the same.
    cost = (left.square() * _trust(left).sqrt() * level.weight).sum(1)
    smooth = picture - _solved(level.white[None], picture, level.weight)[0] @ level.white
    worst = (smooth.square() * _trust(smooth).sqrt() * level.weight).sum()
    # Paint that would have to be lit by less than nothing is the negative of a map.
    return torch.where(found[:, 0] > 0, 1.0 - cost / worst.clamp_min(1e-12), -torch.ones_like(cost))


def _light_columns(level: Level, value: Tensor) -> Tensor:
    """What the light's coefficients multiply, (Q, 9, P)."""
    return torch.cat([value[:, None] * level.white, level.black.expand(len(value), -1, -1)], dim=1)


def _trust(residual: Tensor) -> Tensor:
    """Weight of a pixel, 1 .. 0, by its residual in deviations of the picture."""
    return (1.0 + residual.square()).square().reciprocal()


def _solved(columns: Tensor, picture: Tensor, weight: Tensor) -> Tensor:
    """Weighted least squares, (Q, C) float32, of columns (Q, C, P)."""
    weighted = columns * weight.expand(len(columns), -1)[:, None]
    normal = (weighted @ columns.mT).double()
    right = (weighted @ picture[:, None]).double()
    ridge = RIDGE * normal.diagonal(dim1=1, dim2=2).clamp_min(1e-9)
    return torch.linalg.solve(normal + torch.diag_embed(ridge), right)[..., 0].float()


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Return a x b of (Q, 3, P)."""
    (ax, ay, az), (bx, by, bz) = a.unbind(1), b.unbind(1)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], dim=1)
