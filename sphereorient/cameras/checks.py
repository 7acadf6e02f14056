from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from sphereorient.errors import CameraError, ShapeError, SphereOrientError, check_tail, refusal
from sphereorient.files.hdf5 import names_a_group
from sphereorient.files.yaml_file import refuse_unknown, short

ROTATION_TOLERANCE = 1e-5  # of |R R^T - I|: moves a point at the rim of a 1000 px picture by less than 0.01 px
WRITE_R = "write R_cam_lab row by row with at least 7 digits, x right, y down, z forward"
LARGEST = 1e30  # of any parameter: results must stay finite
MAX_SIDE_PX = 65_536  # of a picture: twice what any camera has


def as_parameter(name: str, value: Tensor | float | Sequence[float], *shape: int) -> Tensor:
    """Return a parameter as float64 tensor, still in its graph; refuse other shapes and numbers beyond LARGEST."""
    # as_tensor alone rounds plain numbers to float32.
    tensor = value.to(torch.float64) if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
    if tuple(tensor.shape) != shape:
        raise camera_error(name, f"shape {shape}", f"shape {tuple(tensor.shape)}")
    if not bool((tensor.detach().abs() <= LARGEST).all()):
        raise camera_error(name, "finite numbers", str(tensor.detach().tolist()))
    return tensor


def check_positive(name: str, value: Tensor) -> None:
    """Refuse numbers that are zero or negative (CameraError)."""
    if not bool((value.detach() > 0).all()):
        raise camera_error(name, "above zero", str(value.detach().tolist()))


def check_image_size(name: str, size: Sequence[int]) -> None:
    """Refuse a picture size that is not two positive whole numbers of at most MAX_SIDE_PX (CameraError)."""
    do = "write width and height in pixels"
    if len(size) != 2 or not all(isinstance(n, int) and not isinstance(n, bool) and n > 0 for n in size):
        raise camera_error(name, "two whole numbers above zero", short(tuple(size)), do)
    if max(size) > MAX_SIDE_PX:
        raise camera_error(name, f"at most {MAX_SIDE_PX} px a side", short(tuple(size)), do)


def check_rotation(name: str, R: Tensor, most: float = ROTATION_TOLERANCE, do: str = WRITE_R) -> None:
    """Refuse a (3, 3) matrix that is not orthonormal, to `most`, or a reflection (CameraError)."""
    R = R.detach()
    error = float((R @ R.mT - torch.eye(3, dtype=R.dtype, device=R.device)).abs().max())
    det = float(torch.linalg.det(R))
    if error > most or det < 0:
        expected = f"a rotation, |R R^T - I| below {most:g} and det 1"
        raise camera_error(name, expected, f"|R R^T - I| = {error:.2g}, det = {det:.6g}", do)


def check_camera_names(names: Iterable[str], where: str) -> None:
    """Refuse names that cannot be names of groups in track.h5: empty ones, '.', and names with '/' (CameraError)."""
    for name in (one for one in names if not names_a_group(one)):
        raise camera_error(where, "names without '/'", short(name), "give each camera a name, such as cam1")


def check_points(name: str, points: Tensor, size: int) -> None:
    """Refuse points that are not (..., size) floating-point numbers (ShapeError)."""
    check_tail(name, points, size)
    if not points.is_floating_point():
        do = "convert it with .double() or .float()"
        raise ShapeError(refusal(name, expected="a floating-point tensor", got=str(points.dtype), do=do))


@contextmanager
def named(where: str) -> Iterator[None]:
    """Put the location in front of the message of a CameraError."""
    try:
        yield
    except CameraError as error:
        raise CameraError(f"{where}, {error}") from None


def check_known(
    names: Iterable[str], known: Collection[str], where: str, error: type[SphereOrientError] = CameraError
) -> None:
    """Refuse names that are not among the known ones."""
    for name in names:
        if name not in known:
            raise error(refuse_unknown(name, known, where))


def camera_error(name: str, expected: str, got: str, do: str = "correct the camera") -> CameraError:
    """Return a CameraError worded by `refusal`."""
    return CameraError(refusal(name, expected=expected, got=got, do=do))
