"""Photographs of a ball cut to disks: found without the empty scene, made grey by the ball's own colour."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.errors import PaintError, refusal
from sphereorient.search import crop_disk

Photograph = NDArray[Any]

FINER = 4  # times: the outline is followed on a lattice finer than the pixels
CORNER = 0.08  # of the shorter side: squares in the corners that show what is behind the ball
RIM = (0.85, 0.95)  # of the radius: of this the outline is half as bright
SPECK = 3  # px, median that takes noise off before the outline is followed
RADIUS_MIN_PX = 6.0  # below this a disk shows next to no paint
ROUND_SHARE = 0.6  # of the outline's points must lie on the circle, to 6 % of its radius
ON_CIRCLE = 0.06
STEPS = 12  # of the circle's robust fit


@dataclass(frozen=True, kw_only=True)
class BallOutline:
    """Where the ball is in one photograph; made by `find_ball`."""

    u_px: float
    v_px: float
    radius_px: float


def find_ball(picture: Photograph, name: str = "photograph") -> BallOutline:
    """Find the one ball that a photograph shows before a scene unlike it, whole or cut by the picture's border.

    Args:
        picture: (H, W) or (H, W, 3), any grey or colour levels; at least one corner shows the scene.
        name: for the message.

    Raises:
        PaintError: nothing round stands out.
    """
    levels = _channels(picture, name)
    difference = np.asarray(cv2.medianBlur(_unlike_corners(levels), SPECK), np.float32)
    inside = difference > _otsu(difference)
    if not inside.any():
        raise _nothing(name, "nothing that stands out")
    fine = np.asarray(cv2.resize(difference, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_LINEAR), np.float32)
    rough = _outlined(fine, 0.5 * float(np.median(difference[inside])))
    # A lit ball is dimmer at its rim than in its middle: the border lies at half of what is just inside it.
    row, column = np.ogrid[: fine.shape[0], : fine.shape[1]]
    away = np.hypot(row - rough[1], column - rough[0]) / max(rough[2], 1.0)
    rim = fine[(away > RIM[0]) & (away < RIM[1])]
    u, v, radius, share = _outlined(fine, 0.5 * float(np.median(rim))) if len(rim) else rough
    radius = (radius + 0.5) / FINER  # the outline runs through the outermost cells' middles
    if not radius >= RADIUS_MIN_PX or share < ROUND_SHARE or radius > max(picture.shape[:2]):
        raise _nothing(name, "nothing round that stands out")
    return BallOutline(u_px=(u + 0.5) / FINER - 0.5, v_px=(v + 0.5) / FINER - 0.5, radius_px=radius)


def own_grey(picture: Photograph, ball: BallOutline, name: str = "photograph") -> NDArray[np.float32]:
    """Return a photograph (H, W, 3) as grey levels (H, W): how much of the ball's own mean colour each pixel has.

    Dark paint is dark in it and white paint bright whatever the ball's colour, and the channel that shows most of the
    ball counts most, so that noise is low.
    """
    levels = _channels(picture, name)
    row, column = np.ogrid[: levels.shape[0], : levels.shape[1]]
    inside = np.hypot(row - ball.v_px, column - ball.u_px) < ball.radius_px
    colour = levels[inside].mean(0) if inside.any() else np.ones(levels.shape[2], np.float32)
    grey: NDArray[np.float32] = (levels @ (colour / max(float(np.linalg.norm(colour)), 1e-6))).astype(np.float32)
    return grey


def cut_disks(
    pictures: Sequence[Photograph], size_px: int, balls: Sequence[BallOutline] | None = None
) -> tuple[Tensor, tuple[BallOutline, ...]]:
    """Find the ball in each photograph and resample its disk.

    Args:
        pictures: F of (H, W) or (H, W, 3), sizes may differ.
        size_px: side S of the disks.
        balls: F, where they are; None: they are looked for.

    Returns:
        (F, S, S) float32, and where the balls were.

    Raises:
        PaintError: a photograph without a ball, or that is no picture.
    """
    names = [f"photograph {k}" for k in range(len(pictures))]
    found = tuple(find_ball(*each) for each in zip(pictures, names, strict=True)) if balls is None else tuple(balls)
    disks = [
        crop_disk(own_grey(picture, ball, name), ball.u_px, ball.v_px, ball.radius_px, size_px)
        for picture, ball, name in zip(pictures, found, names, strict=True)
    ]
    return torch.from_numpy(np.stack(disks)) if disks else torch.zeros(0, size_px, size_px), found


def _channels(picture: Photograph, name: str) -> NDArray[np.float32]:
    """Levels (H, W, C) float32."""
    if picture.ndim not in (2, 3) or min(picture.shape[:2]) < 2 * RADIUS_MIN_PX or picture.shape[2:] not in ((), (3,)):
        expected, do = "(H, W) or (H, W, 3), 12 px at least", "pass pictures as arrays, colours in the last axis"
        raise PaintError(refusal(name, expected=expected, got=str(picture.shape), do=do))
    levels = picture.astype(np.float32)
    return levels[..., None] if picture.ndim == 2 else levels


def _unlike_corners(levels: NDArray[np.float32]) -> NDArray[np.float32]:
    """How unlike each pixel is to what the corners show, (H, W); a ball that fills a corner or two is outvoted."""
    side = max(2, round(CORNER * min(levels.shape[:2])))
    corners = [levels[rows, columns] for rows in _ends(side) for columns in _ends(side)]
    means = np.stack([corner.reshape(-1, levels.shape[2]).mean(0) for corner in corners])
    behind = np.median(means, axis=0)
    away: NDArray[np.float32] = np.linalg.norm(levels - behind, axis=-1).astype(np.float32)
    return away


def _ends(side: int) -> tuple[slice, slice]:
    return slice(None, side), slice(-side, None)


def _otsu(values: NDArray[np.float32]) -> float:
    top = max(float(values.max()), 1e-6)
    threshold, _ = cv2.threshold((values * (255 / top)).astype(np.uint8), 0, 255, cv2.THRESH_OTSU)
    return float(threshold) * top / 255


def _outlined(fine: NDArray[np.float32], level: float) -> tuple[float, float, float, float]:
    """Circle about the largest region above a level, by those points of its border that the picture does not cut."""
    outlines, _ = cv2.findContours((fine > level).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        return math.nan, math.nan, math.nan, 0.0
    outline = max(outlines, key=cv2.contourArea)[:, 0].astype(np.float64)
    height, width = fine.shape
    free = (outline > FINER).all(1) & (outline < np.array([width, height]) - 1 - FINER).all(1)
    return _circle(outline[free])


def _circle(points: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Fit a circle to points (K, 2), most of which lie on one: centre, radius, share of points on it.

    Source: the algebraic fit of Kasa 1976, repeated with weights of Geman and McClure 1987.
    """
    if len(points) < 8:
        return math.nan, math.nan, math.nan, 0.0
    columns = np.column_stack([2 * points, np.ones(len(points))])
    square = (points**2).sum(1)
    weight, u, v, radius = np.ones(len(points)), 0.0, 0.0, math.nan
    for step in range(STEPS):
        root = np.sqrt(weight)
        solved = np.linalg.lstsq(columns * root[:, None], square * root, rcond=None)[0]
        u, v = float(solved[0]), float(solved[1])
        radius = math.sqrt(max(float(solved[2]) + u * u + v * v, 0.0))
        off = np.hypot(points[:, 0] - u, points[:, 1] - v) - radius
        scale = ON_CIRCLE * max(radius, 1.0) * max(1.0, 4.0 - step)  # loose at first: the first circle is pulled
        weight = 1 / (1 + (off / (0.5 * scale)) ** 2) ** 2
    return u, v, radius, float((np.abs(off) < ON_CIRCLE * radius).mean())


def _nothing(name: str, got: str) -> PaintError:
    do = "cut the picture about the ball so that a corner shows the scene, or pass balls="
    return PaintError(refusal(name, expected="one ball before a scene unlike it", got=got, do=do))
