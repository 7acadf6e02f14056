"""What a fit needs of each camera, and the texture map blurred as in its pictures."""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from sphereorient.cameras import Camera, holds_disk, perspective_centre_lab_mm, sphere_radius_px
from sphereorient.experiment.recording import Shown
from sphereorient.files.picture import OnDemand
from sphereorient.locate import Background, CameraScene
from sphereorient.locate.background import Picture
from sphereorient.pose.pixels import LinesOfSight, Pixels, Stencil, cut_pixels, disk_stencil, stacked, window_of
from sphereorient.sphere.texture_table import BASE_RAD, SIDE, TextureTable, texture_table

RIM = 2.5  # standard deviations of the blur: pixels this far beyond the limb are fitted
SIZES = 1.06  # ratio of neighbouring stencil sizes
FINEST_PX = 0.4  # least blur of any picture, px; that of the pixel alone is 0.29
COARSE, MIDDLE = 0.07, 0.03  # blur added to a picture before a coarse fit, in radii of the disk
SOFT, SOFT_PX = 0.06, 1.5  # radii, px: templates are blurred too if the pictures have more blur than both
FINER_SIDES = 2  # of the usual table, for disks above 100 px; 16 MB
FIRST_BLUR_PX = 0.625  # assumed at first: pixel width and a good lens


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraView(CameraScene):
    """One calibrated camera and its movie's empty scene."""

    name: str
    camera: Camera
    sight: LinesOfSight

    @classmethod
    def of(cls, name: str, camera: Camera, scene: CameraScene) -> "CameraView":
        """Return the view of a camera whose scene is known."""
        sight, background = LinesOfSight(camera), scene.background
        if not sight.sees.all():
            shown = sight.sees if background.shown is None else sight.sees & background.shown
            scene = replace(scene, background=replace(background, shown=shown))
        return cls(name=name, camera=camera, sight=sight, **vars(scene))

    @property
    def scene(self) -> CameraScene:
        """Background, response and masks of the camera's movie."""
        return CameraScene(**{part.name: getattr(self, part.name) for part in fields(CameraScene)})

    @cached_property
    def behind(self) -> Background:
        """The light of the scene without the sphere."""
        if self.response is None:
            return self.background
        mean = self.response.light(self.background.mean, self.background.full_scale)
        return replace(self.background, mean=mean)

    @cached_property
    def plain(self) -> bool:
        """Whether grey levels are proportional to light and the camera is not a fisheye."""
        return (self.response is None or self.response.linear) and not self.sight.wide

    def light(self, picture: Picture, window: tuple[int, int, int, int]) -> Picture:
        """Return the light of a picture (H, W) within left, top, right and bottom, included, px; 0 elsewhere."""
        if self.response is None or self.response.linear:
            return picture
        left, top, right, bottom = window
        there = np.s_[top : bottom + 1, left : right + 1]
        light = np.zeros(picture.shape, np.float32)
        light[there] = self.response.light(picture[there], self.background.full_scale)
        return light

    def radius_px(self, position_lab_mm: Tensor, radius_mm: float) -> Tensor:
        """Return the radius (...), px, of the sphere's picture at positions (..., 3), mm, along the camera's x."""
        return sphere_radius_px(self.camera, position_lab_mm, radius_mm)

    def smear_px(self, position_lab_mm: Tensor, moved: Tensor, radius_mm: float) -> Tensor:
        """Return the motion (B,), px, of the disk's middle during the exposure, of spheres at (B, 3), mm.
        `moved` (B, 6): rotation (rad) and displacement (mm) during the exposure.
        """
        centre = perspective_centre_lab_mm(self.camera, position_lab_mm)
        sight = torch.nn.functional.normalize(position_lab_mm - centre, dim=-1)
        front = moved[:, 3:] + torch.linalg.cross(moved[:, :3], -radius_mm * sight)
        across = front - (front * sight).sum(-1, keepdim=True) * sight
        smear: Tensor = across.norm(dim=-1) * self.radius_px(position_lab_mm, radius_mm) / radius_mm
        return smear

    def shows_whole(self, centre_px: Tensor, radius_px: Tensor) -> Tensor:
        """Return whether the whole disk lies in the picture, (...) bool, for centres (..., 2) and radii (...), px."""
        return holds_disk(self.camera, centre_px, radius_px)


def widest_px(views: Sequence[CameraView]) -> float:
    """Return the largest expected diameter of the sphere in any camera, px."""
    return max(view.diameter_px for view in views)


@dataclass(frozen=True, kw_only=True, eq=False)
class PyramidLevel:
    """One level of detail: the blur added to the picture, the pixels fitted, the blurred texture map."""

    extra_px: float
    blur_px: float  # of the limb
    paint: TextureTable

    def stencil(self, radius_px: float) -> Stencil:
        """Return the stencil of a disk of a given radius."""
        return disk_stencil(radius_px + RIM * self.blur_px, max(1, round(self.extra_px)), self.blur_px)


Steps = Sequence[tuple[PyramidLevel, int, int]]  # of a fit: level, every n-th pixel, iterations


class Optics:
    """Texture tables at the blur levels of the fits: paint of blur `blur_px` on disks of `diameter_px`, px, and the
    limb's blur (None: the same). An unsharp map and disks of different sizes blur the paint alone.
    """

    def __init__(
        self, base: TextureTable, blur_px: float, diameter_px: float, limb_blur_px: float | None = None
    ) -> None:
        self.blur_px = blur_px
        self._radius_px = diameter_px / 2
        self.fine = level_of(base, blur_px, 0.0, self._radius_px, limb_blur_px)

    # Each is blurred from the previous one: a wider blur allows a smaller table.
    @cached_property
    def middle(self) -> PyramidLevel:
        """The level of a fit from poses that are right to a few degrees."""
        return self._blurred(self.fine.paint, MIDDLE)

    @cached_property
    def coarse(self) -> PyramidLevel:
        """The level of a fit from a candidate."""
        return self._blurred(self.middle.paint, COARSE)

    def _blurred(self, paint: TextureTable, extra: float) -> PyramidLevel:
        return level_of(paint, self.blur_px, extra * self._radius_px, self._radius_px, self.limb_blur_px)

    @property
    def limb_blur_px(self) -> float:
        """The standard deviation of the limb's blur, px."""
        return self.fine.blur_px

    def with_limb_blur(self, blur_px: float) -> "Optics":
        """Return the same with another blur of the limb, px."""
        other = copy(self)
        other.fine = replace(self.fine, blur_px=blur_px)
        for name in ("middle", "coarse"):
            vars(other).pop(name, None)
        return other

    @property
    def steps(self) -> Steps:
        """The steps of a fit from roughly right poses to full detail."""
        return (self.coarse, 1, 4), (self.middle, 1, 3), (self.fine, 1, 4)

    def to(self, device: torch.device) -> "Optics":
        """Return the same with its tables on another device."""
        moved = copy(self)
        for name in ("fine", "middle", "coarse"):
            level: PyramidLevel = getattr(self, name)
            setattr(moved, name, replace(level, paint=level.paint.to(device)))
        return moved


def level_of(
    base: TextureTable, blur_px: float, extra_px: float, radius_px: float, limb_blur_px: float | None = None
) -> PyramidLevel:
    """Return the level with `extra_px` of blur added to pictures of blur `blur_px`; limb as in `Optics`."""
    limb_px = math.hypot(blur_px if limb_blur_px is None else limb_blur_px, extra_px)
    paint = base.blurred(math.hypot(blur_px, extra_px) / radius_px)
    return PyramidLevel(extra_px=extra_px, blur_px=limb_px, paint=paint)


def base_table(texture: Tensor, diameter_px: float, unseen: Tensor | None = None) -> TextureTable:
    """Return the finest table of a map that disks of this diameter resolve; all others are blurred from it.
    `unseen` (H, 2 H) bool: texels without known paint.
    """
    blur_rad = max(FINEST_PX * 2 / diameter_px, BASE_RAD / FINER_SIDES)
    finer = 1 << max(0, math.ceil(math.log2(BASE_RAD / blur_rad)))  # large disks resolve smaller cells
    return texture_table(texture, blur_rad, finer * SIDE, unseen)


def size_steps(ratio: float) -> int:
    """Return how many steps of `SIZES` a ratio of stencil sizes needs."""
    return math.ceil(math.log(ratio) / math.log(SIZES))


def defocus_radii(blur_px: float, diameter_px: float) -> float:
    """Return the blur of pictures in radii, for the search: 0 unless they are defocused."""
    blur = 2 * blur_px / diameter_px
    return blur if blur > SOFT and blur_px > SOFT_PX else 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameDisks:
    """The disks of B spheres in the frames of C cameras; made by `FrameDisks.of`."""

    views: Sequence[CameraView]  # C
    frames: Sequence[Sequence[Picture]]  # B of C, light; decoded at least at the disks
    middle_px: Tensor  # (C, B, 2)
    stencil: Stencil
    hidden: Tensor | None  # (B * C, P) bool, places not used; None: all are used

    @classmethod
    def of(
        cls,
        views: Sequence[CameraView],
        pictures: Sequence[Sequence[Shown]],
        middle_px: Tensor,
        stencil: Stencil,
        hidden: Tensor | None = None,
        blur_px: float = 0.0,
    ) -> "FrameDisks":
        """Decode the pixels that disks about `middle_px`, with an added blur, read."""
        middles = middle_px.nan_to_num().tolist()

        def window(b: int, c: int) -> tuple[int, int, int, int]:
            return window_of(middles[c][b], stencil, blur_px, views[c].sight.size)

        for b, row in enumerate(pictures):
            for c, frame in enumerate(row):
                if isinstance(frame, OnDemand):  # request all before waiting for the first
                    frame.ask(*window(b, c))
        frames = []
        for b, row in enumerate(pictures):
            windows = [window(b, c) for c in range(len(row))]
            shown = zip(views, row, windows, strict=True)
            frames.append(
                [view.light(one.part(*at) if isinstance(one, OnDemand) else one, at) for view, one, at in shown]
            )
        return cls(views=views, frames=frames, middle_px=middle_px, stencil=stencil, hidden=hidden)

    def pixels(self, blur_px: float = 0.0) -> Pixels:
        """Return the pixels of the B * C disks, with a blur added to the frames."""
        middles = self.middle_px.nan_to_num().tolist()
        pixels = stacked(
            [
                cut_pixels(frame, view.behind, view.sight, middles[c][b], self.stencil, blur_px)
                for b, frames in enumerate(self.frames)
                for c, (view, frame) in enumerate(zip(self.views, frames, strict=True))
            ]
        )
        return pixels if self.hidden is None else replace(pixels, inside=pixels.inside & ~self.hidden)
