"""Refinement at three widths of detail, and what it needs of each camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera
from sphereorient.locate import Background
from sphereorient.orient.light import Light
from sphereorient.orient.pixels import LinesOfSight, Pixels, Stencil, cut_pixels, disk_stencil, stacked
from sphereorient.orient.refine import FIRST, LATER, Fit, Shading, refine
from sphereorient.sphere.paint_table import BASE_RAD, PaintTable, paint_table

Picture = NDArray[np.generic]

RIM = 1.06  # of the radius: pixels that the ball's blurred limb touches
COARSE, MIDDLE = 0.07, 0.03  # blur laid over a picture before a coarse fit, in radii of the disk


@dataclass(frozen=True, kw_only=True, eq=False)
class Eye:
    """One calibrated camera and its movie's empty scene; made by the pipeline, read by the fits."""

    name: str
    camera: Camera
    background: Background
    diameter_px: float  # of the ball in the middle of the volume
    sight: LinesOfSight


@dataclass(frozen=True, kw_only=True, eq=False)
class Level:
    """One width of detail: what is laid over the picture, which pixels are looked at, the paint as blurred."""

    extra_px: float
    blur_px: float
    stencil: Stencil
    paint: PaintTable


class Optics:
    """The paint at the widths of detail that fits go through, for one blur of the pictures.

    Args:
        base: finest table of the paint.
        blur_px: of optics, pixel and exposure together, px.
        diameter_px: largest typical diameter of the disk, px.
        reach: largest disk expected over the typical one.
    """

    def __init__(self, base: PaintTable, blur_px: float, diameter_px: float, reach: float) -> None:
        radius_px = diameter_px / 2
        self.blur_px = blur_px
        self.coarse, self.middle, self.fine = (
            self._level(base, extra, radius_px, reach) for extra in (COARSE * radius_px, MIDDLE * radius_px, 0.0)
        )

    def _level(self, base: PaintTable, extra_px: float, radius_px: float, reach: float) -> Level:
        blur_px = math.hypot(self.blur_px, extra_px)
        step = max(1, round(extra_px))
        stencil = disk_stencil(RIM * radius_px * reach + 2 * blur_px, step, tile_px=max(6, step))
        return Level(
            extra_px=extra_px, blur_px=blur_px, stencil=stencil, paint=base.blurred(max(blur_px / radius_px, BASE_RAD))
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitter:
    """Fits poses to the pictures of all eyes; made by the pipeline once blur and light are known."""

    eyes: Sequence[Eye]
    radius_mm: float
    optics: Optics
    light: Light

    @property
    def shading(self) -> Shading:
        """Orders of each frame's own light: high while nothing is learnt."""
        return LATER if self.light.known else FIRST

    def pixels(self, pictures: Sequence[Sequence[Picture]], position_lab_mm: Tensor, level: Level) -> Pixels:
        """Cut the disks of B poses out of the pictures of C eyes.

        Args:
            pictures: B times C frames.
            position_lab_mm: (B, 3), where the ball is, to a few pixels.
            level: of detail.
        """
        middles = [torch.nan_to_num(eye.camera.project(position_lab_mm)).tolist() for eye in self.eyes]
        return stacked(
            [
                cut_pixels(frame, eye.background.mean, eye.sight, tuple(middles[c][b]), level.stencil, level.extra_px)
                for b, frames in enumerate(pictures)
                for c, (eye, frame) in enumerate(zip(self.eyes, frames, strict=True))
            ]
        )

    def fit(
        self,
        pixels: Pixels,
        position_lab_mm: Tensor,
        R_lab_body: Tensor,
        use: Tensor,
        level: Level,
        iterations: int,
        place_precision: Tensor | None = None,
    ) -> Fit:
        """Refine B poses at one level; see `refine`."""
        return refine(
            pixels,
            position_lab_mm,
            R_lab_body,
            use,
            radius_mm=self.radius_mm,
            paint=level.paint,
            blur_px=level.blur_px,
            light=self.light,
            shading=self.shading if level.extra_px == 0 else LATER,
            iterations=iterations,
            place_precision=place_precision,
        )


def base_table(texture: Tensor) -> PaintTable:
    """Return the finest table of a map, from which all others are blurred."""
    return paint_table(texture, BASE_RAD)
