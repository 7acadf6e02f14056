"""The measured sphere in a camera's picture: outline, axes, and the re-rendered picture with the light of `pose`."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera, sphere_disk_px
from sphereorient.experiment.recording import Shown
from sphereorient.files.picture import OnDemand
from sphereorient.pose.lights.disk import DiskLight, light_basis, solved_light
from sphereorient.pose.worn import LIMB
from sphereorient.preflight.cameras import expected_outline_px
from sphereorient.sphere import see_sphere
from sphereorient.trajectory import Trajectory

Floats = NDArray[np.float64]
MARGIN = 1.3  # half the side of a crop, in radii of the sphere
FINE = 2  # samples along each side of a pixel
NEAR = 1.1  # radii about the disk's centre that contain the sphere, even with distortion


@dataclass(frozen=True, kw_only=True, eq=False)
class Path3D:
    """Position and orientation of N frames; the smoother's where the measured one is missing; made by `path_of`."""

    position_mm: Floats  # (N, 3), lab
    R_lab_body: Floats  # (N, 3, 3)
    smoothed: NDArray[np.bool_]  # (N,), whether either is the smoother's
    radius_mm: float  # of the sphere; 1 where lengths are in radii

    @property
    def whole(self) -> NDArray[np.bool_]:
        """Frames with both, (N,)."""
        return finite_rows(self.position_mm) & finite_rows(self.R_lab_body)


def finite_rows(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which rows (N, ...) hold no NaN, (N,)."""
    return np.asarray(np.isfinite(values).all(tuple(range(1, values.ndim))), np.bool_)


def path_of(track: Trajectory, radius_mm: float) -> Path3D:
    """Return the poses of all frames of a track; the radius is in mm, or 1 where lengths are in radii."""
    no_position, no_orientation = ~finite_rows(track.position), ~finite_rows(track.orientation)
    position = np.where(no_position[:, None], track.position_smooth, track.position)
    orientation = np.where(no_orientation[:, None, None], track.orientation_smooth, track.orientation)
    smoothed = (no_position | no_orientation) & finite_rows(position) & finite_rows(orientation)
    return Path3D(position_mm=position, R_lab_body=orientation, smoothed=smoothed, radius_mm=radius_mm)


def outline_px(camera: Camera, path: Path3D, k: int) -> Floats:
    """Return the closed outline of the sphere in frame k, (n, 2) px; NaN without a position."""
    around = expected_outline_px(camera, torch.from_numpy(path.position_mm[k]), path.radius_mm).numpy()
    return np.concatenate([around, around[:1]])


def axes_px(camera: Camera, path: Path3D, k: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the tips of the body axes on the sphere in frame k, (3, 2) px, and whether each faces the camera."""
    centre, R = torch.from_numpy(path.position_mm[k]), torch.from_numpy(path.R_lab_body[k])
    sight = camera.rays(camera.project(centre)).direction_lab
    tips = camera.project(centre + path.radius_mm * R.mT)  # rows: the columns of R are the axes
    return tips.numpy(), (R.mT @ sight < 0).numpy()


@dataclass(frozen=True, kw_only=True, eq=False)
class CropWindow:
    """A square of a camera's picture; made by `window`, sampled by `crop` and `OverlayModel`."""

    centre_px: Floats  # (2,)
    half_px: float
    side: int  # samples along each side

    @property
    def known(self) -> bool:
        """Whether centre and size are known."""
        return bool(np.isfinite(self.centre_px).all() and np.isfinite(self.half_px))

    def grid_px(self, fine: int = 1) -> Floats:
        """Return the sampling positions (u, v), (fine side, fine side, 2), px."""
        count = fine * self.side
        at = ((np.arange(count) + 0.5) * (2 / count) - 1) * self.half_px
        u, v = np.meshgrid(self.centre_px[0] + at, self.centre_px[1] + at)
        return np.stack([u, v], axis=-1)


def crop(picture: Shown, window: CropWindow) -> NDArray[np.float32]:
    """Return a picture within a window, (side, side) grey levels; NaN outside the picture."""
    grid, last = window.grid_px(), np.array(picture.shape[::-1]) - 1
    low, high = np.clip([np.floor(grid[0, 0] - 1), np.ceil(grid[-1, -1] + 1)], 0, last).astype(int)
    whole = picture.part(*low.tolist(), *high.tolist()) if isinstance(picture, OnDemand) else picture
    grey = whole[low[1] : high[1] + 1, low[0] : high[0] + 1].astype(np.float32)
    u, v = (grid - low).astype(np.float32).transpose(2, 0, 1)
    return np.asarray(cv2.remap(grey, u, v, cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, np.nan), np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenDisk:
    """Paint and place on the disk in a window, (side, side, ...); made by `OverlayModel.look`."""

    paint: NDArray[np.float32]  # 0 black .. 1 white; NaN outside the sphere
    across: NDArray[np.float32]  # (side, side, 2), place on the disk along the camera's x and y, radii

    def basis(self, chosen: NDArray[np.bool_]) -> Tensor:
        """Return the basis of light maps at chosen pixels (side, side), (K, n)."""
        return light_basis(torch.from_numpy(self.across[chosen].T.astype(np.float64)))


@dataclass(frozen=True, kw_only=True, eq=False)
class OverlayModel:
    """A camera, the texture map and the poses; renders the expected picture."""

    camera: Camera
    texture: Tensor | None  # (H, 2 H), at the window's resolution; None: no rendering
    path: Path3D

    def look(self, k: int, window: CropWindow) -> SeenDisk:
        """Return paint and places in a window of frame k, the mean of finer samples, ports included."""
        assert self.texture is not None  # without a map there is no light and no rendering
        centre, R = torch.from_numpy(self.path.position_mm[k]), torch.from_numpy(self.path.R_lab_body[k])
        middle_px, radius_px = sphere_disk_px(self.camera, centre, self.path.radius_mm)
        grid_px = torch.from_numpy(window.grid_px(FINE)).reshape(window.side, FINE, window.side, FINE, 2)
        grid_px = grid_px.transpose(1, 2).flatten(2, 3)
        near = ~((grid_px.mean(2) - middle_px).norm(dim=-1) > NEAR * radius_px + 1)  # only near the sphere
        seen = see_sphere(rays := self.camera.rays(grid_px[near]), centre, R, self.texture, self.path.radius_mm)
        along = (seen.normal * rays.direction_lab).sum(-1, keepdim=True)
        across = (seen.normal - along * rays.direction_lab) @ self.camera.R_cam_lab[:2].mT
        parts = torch.cat([seen.paint[..., None], across], dim=-1)
        mean = torch.full((window.side, window.side, 3), torch.nan, dtype=parts.dtype)
        mean[near] = torch.where(seen.depth2[..., None] > 0, parts, torch.nan).mean(1)
        shown = mean.numpy().astype(np.float32)
        return SeenDisk(paint=shown[..., 0], across=shown[..., 1:])

    def window(self, k: int, half_px: float, side: int) -> CropWindow:
        """Return the window around the sphere in frame k."""
        centre = self.camera.project(torch.from_numpy(self.path.position_mm[k])).numpy()
        return CropWindow(centre_px=centre, half_px=half_px, side=side)


def contrast(light: DiskLight) -> float:
    """Return white minus black paint at the centre of the disk of one camera, grey levels."""
    middle = light_basis(torch.zeros(1, 2, 1))[0, :, 0]
    return max(float(light.difference[0] @ middle), 1e-6)


def lit_picture(light: DiskLight, seen: SeenDisk, filmed: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """Return model grey levels (side, side), NaN outside, scaled by 0.5 .. 2 to the brightness of `filmed`."""
    there = np.isfinite(seen.paint)
    difference, black = (light_map[0].double() @ seen.basis(there) for light_map in (light.difference, light.black))
    grey = np.full(there.shape, np.nan)
    grey[there] = difference.numpy() * seen.paint[there] + black.numpy()
    if filmed is not None:
        good = there & np.isfinite(filmed)
        # Ratio of sums, as least squares darkens a sphere with a wrong orientation.
        grey = grey * np.clip(filmed[good].sum() / max(float(grey[good].sum()), 1e-9), 0.5, 2.0)
    return np.asarray(grey, np.float32)


def fit_light(pairs: Iterable[tuple[SeenDisk, NDArray[np.float32]]]) -> DiskLight | None:
    """Fit one light to all frames of one camera (model, crop in grey levels); None if too few pixels are known."""
    # One light for all frames: a light per frame would partly hide a wrong orientation.
    light, count = DiskLight.unknown(1, torch.zeros(1, 4)), 0
    unknowns = 2 * light.difference.shape[1]
    normal, right = torch.zeros(unknowns, unknowns, dtype=torch.float64), torch.zeros(unknowns, dtype=torch.float64)
    for seen, grey in pairs:
        good = np.isfinite(grey) & (np.hypot(*np.moveaxis(seen.across, -1, 0)) < LIMB)
        basis, target = seen.basis(good), torch.from_numpy(grey[good].astype(np.float64))
        columns = torch.cat([basis * torch.from_numpy(seen.paint[good].astype(np.float64)), basis])
        normal, right, count = normal + columns @ columns.mT, right + columns @ target, count + len(target)
    if count < unknowns:
        return None
    difference, black = solved_light(normal, right)[None].chunk(2, dim=-1)
    return replace(light, difference=difference, black=black, known=True)
