"""What every camera model asks of its parameters before it is a camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from sphereorient.errors import CameraError, ShapeError, check_tail, refusal
from sphereorient.files.yaml_file import short

ROTATION_TOLERANCE = 1e-5  # of |R R^T - I|: moves a point at the rim of a 1000 px picture by less than 0.01 px
LARGEST = 1e30  # of any parameter: no camera has such numbers, and what is computed of them must stay finite
MAX_SIDE_PX = 65_536  # of a picture: twice what any camera has
RIM_STEPS = 33  # points per side of the picture where the distortion is tried; both corners are among them


def as_parameter(name: str, value: Tensor | float | Sequence[float], *shape: int) -> Tensor:
    """Return a camera parameter as float64 tensor, still part of its graph.

    Raises:
        CameraError: another shape, or a number that is not finite or beyond LARGEST.
    """
    # Not as_tensor alone: it would round plain numbers to float32 first.
    tensor = value.to(torch.float64) if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
    if tuple(tensor.shape) != shape:
        expected, got = f"shape {shape}", f"shape {tuple(tensor.shape)}"
        raise CameraError(refusal(name, expected=expected, got=got, do="correct the camera"))
    if not bool((tensor.detach().abs() <= LARGEST).all()):
        got = str(tensor.detach().tolist())
        raise CameraError(refusal(name, expected="finite numbers", got=got, do="correct the camera"))
    return tensor


def check_positive(name: str, value: Tensor) -> None:
    """Refuse parameters that are not above zero.

    Raises:
        CameraError: one of the numbers is zero or negative.
    """
    if not bool((value.detach() > 0).all()):
        raise CameraError(
            refusal(name, expected="above zero", got=str(value.detach().tolist()), do="correct the camera")
        )


def check_image_size(name: str, size: Sequence[int]) -> None:
    """Refuse a picture size that is not two positive whole numbers, or larger than pictures are.

    Raises:
        CameraError: it is not.
    """
    if len(size) != 2 or not all(isinstance(n, int) and not isinstance(n, bool) and n > 0 for n in size):
        do = "write width and height in pixels"
        raise CameraError(refusal(name, expected="two whole numbers above zero", got=short(tuple(size)), do=do))
    if max(size) > MAX_SIDE_PX:
        expected, do = f"at most {MAX_SIDE_PX} px a side", "write width and height in pixels"
        raise CameraError(refusal(name, expected=expected, got=short(tuple(size)), do=do))


def check_rotation(name: str, R: Tensor) -> None:
    """Refuse a (3, 3) matrix that is no rotation, and say by how much.

    Raises:
        CameraError: rows not orthonormal to ROTATION_TOLERANCE, or a mirror image.
    """
    R = R.detach()
    error = float((R @ R.mT - torch.eye(3, dtype=R.dtype, device=R.device)).abs().max())
    det = float(torch.linalg.det(R))
    if error > ROTATION_TOLERANCE or det < 0:
        expected = f"a rotation, |R R^T - I| below {ROTATION_TOLERANCE:g} and det 1"
        do = "write R_cam_lab row by row with at least 7 digits, x right, y down, z forward"
        raise CameraError(refusal(name, expected=expected, got=f"|R R^T - I| = {error:.2g}, det = {det:.6g}", do=do))


class Distorting(Protocol):
    """What `check_unfolded` asks of a camera."""

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the picture, px."""

    def undistort(self, uv_px: Tensor) -> Tensor:
        """Return NaN where the distortion cannot be undone."""


def check_unfolded(name: str, camera: Distorting) -> None:
    """Refuse a distortion that folds over inside the picture.

    Raises:
        CameraError: somewhere on the picture's rim the distortion cannot be undone. Inside the rim it then can.
    """
    width, height = camera.image_size
    across = torch.linspace(-0.5, width - 0.5, RIM_STEPS, dtype=torch.float64)
    down = torch.linspace(-0.5, height - 0.5, RIM_STEPS, dtype=torch.float64)
    sides = [torch.stack([across, torch.full_like(across, v)], dim=-1) for v in (-0.5, height - 0.5)]
    sides += [torch.stack([torch.full_like(down, u), down], dim=-1) for u in (-0.5, width - 0.5)]
    rim_px = torch.cat(sides)
    lost = torch.isnan(camera.undistort(rim_px).detach()).any(-1)
    if bool(lost.any()):
        u, v = rim_px[lost][0].tolist()
        expected, got = "a distortion that can be undone in the whole picture", f"one that folds before ({u:g}, {v:g})"
        raise CameraError(refusal(name, expected=expected, got=got, do="correct the camera or calibrate again"))


def check_points(name: str, points: Tensor, size: int) -> None:
    """Refuse points that are not (..., size) numbers with a fraction.

    Raises:
        ShapeError: another last axis, or whole numbers, to whose type the camera would have to be rounded.
    """
    check_tail(name, points, size)
    if not points.is_floating_point():
        do = "convert it with .double() or .float()"
        raise ShapeError(refusal(name, expected="a floating-point tensor", got=str(points.dtype), do=do))
