"""The measured sphere in a camera's picture: outline, axes, trail, and the re-rendered picture."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera
from sphereorient.errors import TextureError, refusal
from sphereorient.movies import Grey
from sphereorient.preflight.cameras import expected_outline_px
from sphereorient.sphere import see_sphere
from sphereorient.trajectory import Trajectory

Floats = NDArray[np.float64]
MARGIN = 1.3  # half the side of a crop, in radii of the sphere
SLANT = 0.3  # cosine of the angle of sight below which the paint is too foreshortened for the light's fit
FINE = 2  # samples along each side of a pixel


@dataclass(frozen=True, kw_only=True, eq=False)
class Path3D:
    """Position and orientation of N frames, from the smoother where the frame's own is missing; made by `path_of`."""

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
    """A square of a camera's picture; made by `window`, sampled by `crop` and `Model`."""

    centre_px: Floats  # (2,)
    half_px: float
    side: int  # samples along each side

    @property
    def known(self) -> bool:
        """Whether centre and size are."""
        return bool(np.isfinite(self.centre_px).all() and np.isfinite(self.half_px))

    def grid_px(self, fine: int = 1) -> Floats:
        """Return the sampling positions (u, v), (fine side, fine side, 2), px."""
        count = fine * self.side
        at = ((np.arange(count) + 0.5) * (2 / count) - 1) * self.half_px
        u, v = np.meshgrid(self.centre_px[0] + at, self.centre_px[1] + at)
        return np.stack([u, v], axis=-1)


def crop(picture: Grey, window: CropWindow) -> NDArray[np.float32]:
    """Return a picture within a window, (side, side) grey levels; NaN outside the picture."""
    at = window.grid_px().astype(np.float32)
    u, v, nan = at[..., 0], at[..., 1], float("nan")
    grey = picture.astype(np.float32)
    found = cv2.remap(grey, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=nan)
    return np.asarray(found, np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenDisk:
    """Texture and basis of the light in a window, (side, side, ...); made by `Model.look`."""

    paint: NDArray[np.float32]  # 0 black .. 1 white; NaN outside the sphere
    basis: NDArray[np.float32]  # (side, side, 4): 1, normal's right and down, cosine of the angle of sight


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A camera, the texture map and the poses; renders the expected picture."""

    camera: Camera
    texture: Tensor | None  # (H, 2 H), as fine as the window shows it; None: nothing can be rendered
    path: Path3D

    def look(self, k: int, window: CropWindow) -> SeenDisk:
        """Return texture and basis of the light in a window of frame k, the mean of finer samples, ports included."""
        if self.texture is None:
            do = "draw the track of an experiment with a texture"
            raise TextureError(refusal("model", expected="a map of the paint", got="none", do=do))
        uv = torch.from_numpy(window.grid_px(FINE))
        rays = self.camera.rays(uv)
        centre, R = torch.from_numpy(self.path.position_mm[k]), torch.from_numpy(self.path.R_lab_body[k])
        seen = see_sphere(rays, centre, R, self.texture, self.path.radius_mm)
        across = seen.normal @ self.camera.R_cam_lab.mT
        sight = -(seen.normal * rays.direction_lab).sum(-1, keepdim=True)
        parts = torch.cat([seen.paint[..., None], torch.ones_like(sight), across[..., :2], sight], dim=-1)
        parts = torch.where(seen.depth2[..., None] > 0, parts, torch.full_like(parts, torch.nan))
        side = window.side
        mean = parts.reshape(side, FINE, side, FINE, 5).mean((1, 3)).numpy().astype(np.float32)
        return SeenDisk(paint=mean[..., 0], basis=mean[..., 1:])

    def window(self, k: int, half_px: float, side: int) -> CropWindow:
        """Return the window around the sphere in frame k."""
        centre = self.camera.project(torch.from_numpy(self.path.position_mm[k])).numpy()
        return CropWindow(centre_px=centre, half_px=half_px, side=side)


@dataclass(frozen=True, kw_only=True, eq=False)
class LightFit:
    """Grey levels of white and black paint over the disk, one for a whole movie; made by `fit_light`."""

    gain: Floats  # (4,), coefficients of the basis: white minus black
    offset: Floats  # (4,), black

    @property
    def contrast(self) -> float:
        """White minus black paint in the middle of the disk, grey levels."""
        return float(max(self.gain[0] + self.gain[3], 1e-6))

    def picture(self, seen: SeenDisk, filmed: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
        """Return model grey levels (side, side), NaN outside, scaled by 0.5 .. 2 to the brightness of `filmed`."""
        grey = (seen.basis @ self.gain) * seen.paint + seen.basis @ self.offset
        if filmed is not None:
            good = np.isfinite(grey) & np.isfinite(filmed)
            # Ratio of sums: least squares would darken a sphere with a wrong orientation.
            grey = grey * np.clip(filmed[good].sum() / max(float(grey[good].sum()), 1e-9), 0.5, 2.0)
        return np.asarray(grey, np.float32)


def fit_light(pairs: Sequence[tuple[SeenDisk, NDArray[np.float32]]]) -> LightFit | None:
    """Fit one light to all given frames (model, crop in grey levels); None if no pixel can be compared."""
    # One light for all frames: a fit of each frame would hide a part of a wrong orientation.
    rows, greys = [np.zeros((0, 8))], [np.zeros(0)]
    for seen, grey in pairs:
        with np.errstate(invalid="ignore"):
            good = np.isfinite(grey) & (seen.basis[..., 3] > SLANT)
        basis = seen.basis[good].astype(np.float64)
        rows.append(np.concatenate([basis * seen.paint[good][:, None], basis], axis=1))
        greys.append(grey[good].astype(np.float64))
    design, target = np.concatenate(rows), np.concatenate(greys)
    if len(target) < 8:
        return None
    # A small ridge keeps coefficients finite where the visible paint has one grey level.
    ridge = 1e-3 * np.sqrt(len(target)) * np.eye(8)
    solved = np.linalg.lstsq(np.concatenate([design, ridge]), np.concatenate([target, np.zeros(8)]), rcond=None)[0]
    return LightFit(gain=solved[:4], offset=solved[4:])
