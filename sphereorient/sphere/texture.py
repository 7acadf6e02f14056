"""The painted sphere's map: loading, reducing, and looking up by direction."""

from __future__ import annotations

import math
from pathlib import Path

import kornia.geometry.transform as kornia_transform
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from sphereorient.errors import ShapeError, TextureError, check_tail, refusal
from sphereorient.files.picture import claimed_pixels, decoded_grey
from sphereorient.files.whole_file import read_whole

PICTURE_BYTES = 100_000_000
MOST_PIXELS = 2**25  # 8192 x 4096: finer than a ball of 2600 px shows it
WHITE = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}  # grey level of white paint by type of picture


def load_texture(path: Path) -> Tensor:
    """Read an equirectangular grey map of the paint.

    Args:
        path: picture of 8 or 16 bit, W = 2 H (docs/conventions.md: where north and east are).

    Returns:
        (H, W) float32, 0 black paint .. 1 white paint.

    Raises:
        TextureError: the file is missing, no picture, not 2:1, smaller than 16 x 8, or of one grey only.
    """
    name, do = f"texture {path}", "correct sphere.texture in the experiment"
    content = read_whole(path, PICTURE_BYTES, "a picture file", TextureError, do)
    claimed = claimed_pixels(content)
    if claimed is not None and claimed > MOST_PIXELS:
        expected, do = (
            f"a picture of at most {MOST_PIXELS / 1e6:.3g} million pixels",
            "export it smaller, as 8192 x 4096",
        )
        raise TextureError(refusal(name, expected=expected, got=f"{claimed / 1e6:.3g} million", do=do))
    picture = None if claimed is None else decoded_grey(content)
    if picture is None:
        raise TextureError(
            refusal(
                name, expected="a PNG, TIFF or JPEG picture", got="a file that does not decode", do="export it again"
            )
        )
    height, width = picture.shape
    if width != 2 * height or height < 8:
        raise TextureError(
            refusal(
                name,
                expected="an equirectangular map, twice as wide as high, at least 16 x 8",
                got=f"{width} x {height}",
                do="export the whole sphere, longitude -180..180 across and latitude 90..-90 down",
            )
        )
    white = WHITE.get(picture.dtype)
    if white is None:
        raise TextureError(refusal(name, expected="8 or 16 bit grey", got=str(picture.dtype), do="export it as 8 bit"))
    if int(picture.min()) == int(picture.max()):
        raise TextureError(
            refusal(name, expected="a pattern of paint", got="one single grey", do="check that the map was saved")
        )
    return torch.from_numpy(picture.astype(np.float32) / white)


def reduced_texture(texture: Tensor, diameter_px: float) -> Tensor:
    """Average a map down to the resolution that a disk of some diameter shows, against aliasing.

    Args:
        texture: (H, W), W = 2 H.
        diameter_px: diameter of the disk that will be rendered, px.

    Returns:
        (h, 2 h): by whole factors, at least as fine as one disk pixel at the disk's centre.
    """
    circumference_px = math.pi * diameter_px
    factor = max(1, int(texture.shape[-1] / circumference_px))
    while texture.shape[-2] % factor:
        factor -= 1
    return F.avg_pool2d(texture[None, None], factor)[0, 0]


def texture_coordinates(direction_body: Tensor) -> tuple[Tensor, Tensor]:
    """Return longitude and latitude of body directions, with finite gradients at the poles.

    Args:
        direction_body: (..., 3), body frame, any length but zero.

    Returns:
        Longitude -pi .. pi and latitude -pi/2 .. pi/2, each (...), rad.
    """
    check_tail("direction_body", direction_body, 3)
    x, y, z = direction_body.unbind(-1)
    # At the poles longitude is undefined and its gradient infinite; a direction nudged off the axis has a longitude,
    # and without the gradients of x and y it has none of 1 / nudge, which would drown those of all other directions.
    nudge = torch.finfo(direction_body.dtype).eps
    polar = (x.abs() < nudge) & (y.abs() < nudge)
    x, y = torch.where(polar, x.detach() + nudge, x), torch.where(polar, y.detach(), y)
    return torch.atan2(y, x), torch.atan2(z, torch.sqrt(x * x + y * y))


def sample_texture(texture: Tensor, direction_body: Tensor) -> Tensor:
    """Look up the paint at body directions, bilinear, closed over the date line and the poles.

    Args:
        texture: (H, W), W = 2 H, dtype and device of the directions; differentiable.
        direction_body: (..., 3), body frame; differentiable.

    Returns:
        (...), the map's grey at each direction.

    Source: docs/conventions.md (texture map); kornia's remap with align_corners=True, its default being wrong for
    pixel coordinates.
    """
    check_tail("direction_body", direction_body, 3)
    if texture.ndim != 2 or texture.shape[1] != 2 * texture.shape[0]:
        raise ShapeError(refusal("texture", expected="(H, 2 H)", got=str(tuple(texture.shape)), do="pass one map"))
    height, width = texture.shape
    longitude, latitude = texture_coordinates(direction_body)
    column = (longitude + math.pi) * (width / (2 * math.pi)) - 0.5
    row = (math.pi / 2 - latitude) * (height / math.pi) - 0.5
    # One more row beyond each pole (the meridian goes on at the other side) and one column beyond the date line.
    beyond = texture.roll(width // 2, 1)
    closed = torch.cat([beyond[:1], texture, beyond[-1:]])
    closed = torch.cat([closed[:, -1:], closed, closed[:, :1]], dim=1)
    shape = column.shape
    grey = kornia_transform.remap(
        closed[None, None], (column + 1).reshape(1, 1, -1), (row + 1).reshape(1, 1, -1), align_corners=True
    )
    return grey.reshape(shape)
