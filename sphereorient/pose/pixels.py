"""The pixels of a sphere in a frame, each with its own line of sight: the data of the fit."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera, R_cam_view, in_air
from sphereorient.cameras.fisheye import FisheyeCamera
from sphereorient.locate import Background

VECTOR = 32  # most numbers that a vectorised loop takes in one step
# Parts of `Pixels` whose last axis is the places.
ALONG_PLACES = ("grey", "behind", "inside", "clipped", "direction")
OF_DISKS = (*ALONG_PLACES, "origin", "axes", "pitch_rad", "pitch_mm", "moved")  # and parts with an entry per disk
# Side of a tile: least, px; in standard deviations of the blur (for 3 px, errors over sigma are 1.0 with 14 px, 1.4
# with 6); least number across half a disk.
TILE_PX, TILE_BLURS, FEWEST_TILES = 6, 10.0, 3
BACKWARD = -0.17  # least cosine of a line of sight to the axis: beyond it a disk is twice as wide as high
INNER = 0.67  # of a stencil's radius: nearer places are well inside the limb, also of a smaller disk


@dataclass(frozen=True, kw_only=True, eq=False)
class Pixels:
    """Pixels of L disks (one camera's view of one frame each) with P places each.
    Grey levels and geometry are float32: a line of sight is right to 3e-5 mm half a metre away.
    """

    grey: Tensor  # (L, P), grey levels
    behind: Tensor  # (L, P), grey levels of the scene without the sphere
    inside: Tensor  # (L, P) bool, in the picture and not masked
    clipped: Tensor  # (L, P) bool, saturated: the true grey level is this or higher
    direction: Tensor  # (L, 3, P), unit lines of sight, lab
    origin: Tensor  # (L, 3, 1) or (L, 3, P), where they start, lab, mm
    axes: Tensor  # (L, 2, 3), the camera's x and y in the lab
    pitch_rad: Tensor  # (L,), angle between neighbouring lines of sight at the disk's middle
    pitch_mm: Tensor  # (L,), distance of their origins; not 0 behind a port and in parallel projection
    moved: Tensor  # (L, 6) float64, rotation (rad) and displacement (mm), lab, during the exposure
    tile: Tensor  # (P,) int64, square tile of the disk, for correlated errors
    place: Tensor  # (2, P) int64, px to the right of and below the middle pixel
    inner: int = 0  # number of first places well within the limb
    instants: int = 1  # rendered in an exposure; 1: the sphere at rest

    def __len__(self) -> int:
        """Return the number of disks."""
        return len(self.grey)

    def where(self, chosen: Tensor) -> "Pixels":
        """Return some of the disks, by mask (L,) or by index."""
        return self._with(OF_DISKS, lambda part: part[chosen])

    def thinned(self, step: int) -> "Pixels":
        """Return every `step`-th place of all disks."""
        if step == 1:
            return self
        kept = thinned_places(self.grey.shape[1], step)
        own = ("origin",) if self.origin.shape[-1] > 1 else ()
        some = self._with((*ALONG_PLACES, *own, "tile", "place"), lambda part: part[..., kept])
        return replace(some, inner=min(len(range(0, self.inner, step)), some.grey.shape[1]))

    def exposed(self, moved: Tensor | None, instants: int) -> "Pixels":
        """Return the pixels of B * C disks with the sphere's motion (B, 6) during the exposure; None: at rest."""
        if moved is None or instants == 1:
            return self
        return replace(self, moved=moved.repeat_interleave(len(self) // len(moved), 0), instants=instants)

    def _with(self, names: Iterable[str], change: Callable[[Tensor], Tensor]) -> "Pixels":
        parts: dict[str, Any] = {name: change(getattr(self, name)) for name in names}
        return replace(self, **parts)


def whole_vectors(count: int) -> int:
    """Return the largest number up to `count` that fills the processor's vectors.
    The remainder runs other code with other last bits, so that a disk would depend on its batch.
    """
    return max(count // VECTOR, 1) * VECTOR


def thinned_places(count: int, step: int) -> slice:
    """Return which of `count` places `Pixels.thinned` keeps, as a slice."""
    return slice(None, step * whole_vectors(len(range(0, count, step))), step)


class LinesOfSight:
    """The lines of sight of all pixels of a camera, computed once for all frames."""

    def __init__(self, camera: Camera) -> None:
        width, height = camera.image_size
        v, u = torch.meshgrid(
            torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
        )
        rays = camera.rays(torch.stack([u, v], dim=-1))
        ahead = rays.direction_lab @ camera.R_cam_lab[2]
        self.sees = (ahead > BACKWARD).numpy()  # (H, W) bool; False also without a line of sight
        self.direction = rays.direction_lab.nan_to_num().float().movedim(-1, 0).contiguous()  # (3, H, W)
        origin = rays.origin_lab_mm.nan_to_num()
        self.one_origin = bool((origin == origin[0, 0]).all())
        self.origin = origin.float().movedim(-1, 0)[:, :1, :1] if self.one_origin else origin.float().movedim(-1, 0)
        self.R_cam_lab = camera.R_cam_lab.float()
        self.axes = self.R_cam_lab[:2]
        self.wide = isinstance(in_air(camera), FisheyeCamera)
        self.size = width, height
        self.pitch_rad = _to_next_pixel(self.direction)
        apart = not self.one_origin
        self.pitch_mm = _to_next_pixel(self.origin, self.direction) if apart else torch.zeros(1, 1)

    def pitch(self, u: int, v: int) -> tuple[Tensor, Tensor]:
        """Return the change of the line of sight to the next pixel: angle, rad, and origin, mm; each (1,)."""
        there = self.pitch_mm.shape[0] > 1
        return self.pitch_rad[v, u : u + 1], self.pitch_mm[v * there, u * there : u * there + 1]

    def axes_at(self, middle_px: Tensor) -> Tensor:
        """Return x and y of disks about B places (B, 2), px, in the lab, (B, 2, 3): the camera's. For a fisheye camera
        they are rotated to the line of sight, which may lie along its x.
        """
        if not self.wide:
            return self.axes.expand(len(middle_px), 2, 3)
        u, v = middle_px.nan_to_num().round().long().clamp_min(0).minimum(torch.tensor(self.size) - 1).unbind(-1)
        turned = R_cam_view(self.direction[:, v, u].mT @ self.R_cam_lab.mT)
        return (self.R_cam_lab.mT @ turned.nan_to_num()).mT[:, :2]

    def about(self, middle_px: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Return the lines of sight nearest to B places (B, 2), px: direction and origin (B, 3), and `pitch` (B,)."""
        u, v = np.rint(middle_px).astype(np.int64).clip(0, np.array(self.size) - 2).T
        parts = self.direction, self.origin, self.pitch_rad, self.pitch_mm
        direction, origin, rad, mm = (part.numpy() for part in parts)
        starts = origin[:, 0, 0] if self.one_origin else origin[:, v, u].T
        pitch_mm = mm[v, u] if len(mm) > 1 else mm[0, 0]
        found = direction[:, v, u].T, starts, rad[v, u], pitch_mm
        shapes = (len(u), 3), (len(u), 3), (len(u),), (len(u),)
        return tuple(np.broadcast_to(part, shape).astype(np.float64) for part, shape in zip(found, shapes, strict=True))

    def of_size(self, middle_px: NDArray[np.float64], mm_px: float) -> tuple[NDArray[np.float64], ...]:
        """Return the lines of sight nearest to B places (B, 2), px: direction (B, 3), the point (B, 3), lab, mm, where
        a pixel is `mm_px` wide, and its distance (B,), mm, from the origin; the origin if lines are parallel.
        """
        direction, origin, pitch_rad, pitch_mm = self.about(middle_px)
        distance = np.divide(mm_px - pitch_mm, pitch_rad, out=np.zeros_like(pitch_rad), where=pitch_rad > 0)
        return direction, origin + distance[:, None] * direction, distance

    def places(self, middle_px: NDArray[np.float64], stencil: "Stencil") -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the pixels of B disks about (B, 2), px, as indices of the flattened picture (places outside get the
        nearest pixel of its border), and which places are inside, (B, P) each.
        """
        (width, height), (u, v) = self.size, np.rint(middle_px).astype(np.int64).T[..., None]
        columns, rows = u + stencil.right, v + stencil.down
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        return rows.clip(0, height - 1) * width + columns.clip(0, width - 1), inside

    def of(self, middle_px: NDArray[np.float64], stencil: "Stencil") -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the lines of sight of these places: direction (B, 3, P), and origin (B or 1, 3, P or 1)."""
        at, _ = self.places(middle_px, stencil)
        direction, origin = (part.numpy().reshape(3, -1) for part in (self.direction, self.origin))
        starts = origin[:, None] if self.one_origin else origin.take(at, axis=1)
        return direction.take(at, axis=1).swapaxes(0, 1), starts.swapaxes(0, 1)


def _to_next_pixel(field: Tensor, sight: Tensor | None = None) -> Tensor:
    """Return the mean length of a field's (3, H, W) change to the right and below, (H - 1, W - 1); only of the change
    across lines of sight (3, H, W) if these are given.
    """
    here = (slice(None), slice(None, -1), slice(None, -1))
    lengths = []
    for axis in (1, 2):
        change = field.diff(dim=axis)[:, : field.shape[1] - 1, : field.shape[2] - 1]
        if sight is not None:
            change = change - (change * sight[here]).sum(0) * sight[here]
        lengths.append(change.square().sum(0).sqrt())
    return (lengths[0] + lengths[1]) / 2


@dataclass(frozen=True, kw_only=True, eq=False)
class Stencil:
    """Places of a disk about its middle pixel, in order of distance."""

    right: NDArray[np.int64]  # (P,), px
    down: NDArray[np.int64]
    tile: Tensor  # (P,) int64
    place: Tensor  # (2, P) int64, right and down
    reach: int  # px
    inner: int  # number of first places well within the limb


@lru_cache(maxsize=64)
def disk_stencil(radius_px: float, step_px: int = 1, blur_px: float = 0.0) -> Stencil:
    """Return all places within a radius, `step_px` apart, with several tiles, by the blur, on every disk."""
    tile_px = max(round(min(TILE_BLURS * blur_px, radius_px / FEWEST_TILES)), TILE_PX, step_px)
    reach = math.ceil(radius_px)
    at = np.arange(-reach, reach + 1)
    at = at[at % step_px == 0]
    down, right = (grid.reshape(-1) for grid in np.meshgrid(at, at, indexing="ij"))
    distance2 = right**2 + down**2
    # Random order at equal distance: in row order every second place could be the disk's left half.
    order = np.lexsort((np.random.default_rng(0).random(len(distance2)), distance2))
    order = order[: whole_vectors(int((distance2 <= radius_px**2).sum()))]
    right, down = right[order], down[order]
    across = 2 * reach // tile_px + 1
    tile = (down + reach) // tile_px * across + (right + reach) // tile_px
    _, tile = np.unique(tile, return_inverse=True)
    inner = int((right**2 + down**2 < (INNER * radius_px) ** 2).sum())
    place = torch.from_numpy(np.stack([right, down]))
    return Stencil(right=right, down=down, tile=torch.from_numpy(tile), place=place, reach=reach, inner=inner)


@lru_cache(maxsize=64)
def thinned_stencil(stencil: Stencil, step: int) -> Stencil:
    """Return every `step`-th place, as `Pixels.thinned`."""
    some = thinned_places(len(stencil.right), step)
    right, down, tile = stencil.right[some], stencil.down[some], stencil.tile[some].contiguous()
    place, inner = torch.from_numpy(np.stack([right, down])), min(len(range(0, stencil.inner, step)), len(right))
    return Stencil(right=right, down=down, tile=tile, place=place, reach=stencil.reach, inner=inner)


def window_of(
    middle_px: tuple[float, float], stencil: Stencil, blur_px: float, size: tuple[int, int]
) -> tuple[int, int, int, int]:
    """Return the region `cut_pixels` reads of a frame of `size` (W, H): left, top, right, bottom, included, px."""
    reach = stencil.reach + math.ceil(3 * blur_px)
    (left, right), (top, bottom) = (
        [min(max(round(middle) + side, 0), count - 1) for side in (-reach, reach)]
        for middle, count in zip(middle_px, size, strict=True)
    )
    return left, top, right, bottom


def cut_pixels(
    frame: NDArray[Any],
    background: Background,
    sight: LinesOfSight,
    middle_px: tuple[float, float],
    stencil: Stencil,
    blur_px: float = 0.0,
) -> Pixels:
    """Return a disk's pixels about middle_px (u, v) without resampling, so that the noise of neighbours is independent.
    For coarse fits a Gaussian blur of blur_px is applied to the frame (H, W) and the background's mean.
    """
    width, height = sight.size
    u, v = round(middle_px[0]), round(middle_px[1])
    ((place,), (inside,)) = sight.places(np.array([[u, v]]), stencil)
    if background.shown is not None:
        inside = inside & background.shown.take(place)
    grey, behind = frame.take(place), background.mean.take(place)
    clipped = grey >= background.full_scale
    if blur_px > 0:
        left, top, last_right, last_down = window_of(middle_px, stencil, blur_px, sight.size)
        around = np.s_[top : last_down + 1, left : last_right + 1]
        pictures = frame[around].astype(np.float32), background.mean[around]
        soft = [np.asarray(cv2.GaussianBlur(picture, (0, 0), blur_px), np.float32) for picture in pictures]
        down, right = (
            at.clip(0, size - 1)
            for at, size in zip((place // width - top, place % width - left), soft[0].shape, strict=True)
        )
        grey, behind = (picture[down, right] for picture in soft)
    at = torch.from_numpy(place)
    flat = sight.direction.reshape(3, -1)
    pitch_rad, pitch_mm = sight.pitch(min(max(u, 0), width - 2), min(max(v, 0), height - 2))
    return Pixels(
        grey=torch.from_numpy(grey.astype(np.float32))[None],
        behind=torch.from_numpy(behind)[None],
        inside=torch.from_numpy(inside)[None],
        clipped=torch.from_numpy(clipped)[None],
        direction=flat.index_select(1, at)[None],
        origin=(sight.origin.reshape(3, 1) if sight.one_origin else sight.origin.reshape(3, -1)[:, at])[None],
        axes=sight.axes_at(torch.tensor([[u, v]])),
        pitch_rad=pitch_rad,
        pitch_mm=pitch_mm,
        moved=torch.zeros(1, 6, dtype=torch.float64),
        tile=stencil.tile,
        place=stencil.place,
        inner=stencil.inner,
    )


def stacked(parts: list[Pixels]) -> Pixels:
    """Return the disks of all parts, which share one stencil, in one record."""
    widest = max(part.origin.shape[-1] for part in parts)
    if any(part.origin.shape[-1] < widest for part in parts):
        parts = [replace(part, origin=part.origin.expand(-1, -1, widest)) for part in parts]
    whole: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts]) for name in OF_DISKS}
    return replace(parts[0], **whole)
