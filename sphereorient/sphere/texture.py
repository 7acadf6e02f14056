import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional as F

from sphereorient.errors import ShapeError, TextureError, check_tail, refusal, tensor_of
from sphereorient.files.picture import claimed_pixels, decoded_grey
from sphereorient.files.whole_file import read_whole

PICTURE_BYTES = 100_000_000  # of a picture file
MOST_PIXELS = 2**25  # 8192 x 4096: enough for a disk of 2600 px
SPLINE_TEXELS = 2  # reach of a cubic spline beyond the map's edges
OVERSHOOT = 2.0  # largest value of a map: learnt maps exceed white a little; grey levels are far above
WHITE = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}  # grey level of white paint


def load_texture(path: Path | str) -> Tensor:
    """Read an 8 or 16 bit equirectangular map (docs/conventions.md), (H, 2 H) float32, 0 black .. 1 white.

    Raises:
        TextureError: missing, not a picture, not 2:1, smaller than 16 x 8, or of one grey.
    """
    path = Path(path)
    name, do = f"texture {path}", "learn it with `sphereorient map`, or correct the path"
    content = read_whole(path, PICTURE_BYTES, "a picture file", TextureError, do)

    def refused(expected: str, got: str, do: str) -> TextureError:
        return TextureError(refusal(name, expected=expected, got=got, do=do))

    claimed = claimed_pixels(content)
    if claimed is not None and claimed > MOST_PIXELS:
        expected = f"a picture of at most {MOST_PIXELS / 1e6:.3g} million pixels"
        raise refused(expected, f"{claimed / 1e6:.3g} million", "export it smaller, as 8192 x 4096")
    picture = None if claimed is None else decoded_grey(content)
    if picture is None:
        raise refused("a PNG, TIFF or JPEG picture", "a file that does not decode", "export it again")
    height, width = picture.shape
    if width != 2 * height or height < 8:
        expected = "an equirectangular map, twice as wide as high, at least 16 x 8"
        do = "export the whole sphere, longitude -180..180 across and latitude 90..-90 down"
        raise refused(expected, f"{width} x {height}", do)
    white = WHITE.get(picture.dtype)
    if white is None:
        raise refused("8 or 16 bit grey", str(picture.dtype), "export it as 8 bit")
    if int(picture.min()) == int(picture.max()):
        raise refused("a pattern of paint", "one single grey", "check that the map was saved")
    return torch.from_numpy(picture.astype(np.float32) / white)


def seen_path(texture: Path) -> Path:
    """Return the path of the counts of a texture map: texture_seen.png beside texture.png."""
    return texture.with_name(f"{texture.stem}_seen.png")


def read_seen(path: Path) -> Tensor | None:
    """Read the counts beside a texture map, (H, 2 H); None without a file. TextureError for another format."""
    if not path.is_file():
        return None
    do = "take the one that `sphereorient map` wrote, or move it away"
    content = read_whole(path, PICTURE_BYTES, "a picture file", TextureError, do)
    counts = decoded_grey(content) if (claimed_pixels(content) or math.inf) <= MOST_PIXELS else None
    if counts is None or counts.dtype != np.uint8 or counts.shape[1] != 2 * counts.shape[0]:
        got = "no picture" if counts is None else f"{counts.shape[1]} x {counts.shape[0]} of {counts.dtype}"
        raise TextureError(refusal(str(path), expected="8-bit counts, twice as wide as high", got=got, do=do))
    return torch.from_numpy(counts.astype(np.int64))


def load_unseen(texture: Path) -> Tensor | None:
    """Return the texels (H, 2 H) of a map read by `load_texture` that are no paint: in no picture (0 in the counts
    beside it, see `seen_path`) or transparent. None: all are paint. Raise TextureError for counts of another size.
    """
    with Image.open(texture) as picture:
        size = picture.height, picture.width
        # A transparent grey level or index.
        shown = picture.convert("RGBA") if "transparency" in picture.info else picture
        alpha = np.asarray(shown.getchannel("A")) if "A" in shown.getbands() else np.full(size, 255)
    # Texels with alpha below this (of 255) are no paint.
    unseen, counts = torch.from_numpy(alpha < 128), read_seen(seen_path(texture))
    if counts is not None and counts.shape != unseen.shape:
        expected, got = (f"{shape[1]} x {shape[0]}" for shape in (size, counts.shape))
        do = f"take the one that was written with {texture.name}, or move it away"
        raise TextureError(refusal(str(seen_path(texture)), expected=expected, got=got, do=do))
    unseen |= counts == 0 if counts is not None else False
    if bool(unseen.all()):
        do = "learn the map anew, or correct its alpha channel"
        raise TextureError(refusal(f"texture {texture}", expected="paint that some picture shows", got="none", do=do))
    return unseen if bool(unseen.any()) else None


def load_known(texture: Path) -> Tensor:
    """Read a map as `load_texture`, (H, 2 H) float32, with the texels of `load_unseen` as NaN."""
    grey, unseen = load_texture(texture), load_unseen(texture)
    return grey if unseen is None else grey.masked_fill(unseen, math.nan)


def map_directions(height: int) -> Tensor:
    """Return the body direction of every texel, (H, 2 H, 3) float64 (docs/conventions.md)."""
    latitude = math.pi / 2 - math.pi * (torch.arange(height, dtype=torch.float64) + 0.5) / height
    longitude = math.pi * (torch.arange(2 * height, dtype=torch.float64) + 0.5) / height - math.pi
    lat, lon = torch.meshgrid(latitude, longitude, indexing="ij")
    return torch.stack([lat.cos() * lon.cos(), lat.cos() * lon.sin(), lat.sin()], dim=-1)


def unseen_share(unseen: Tensor) -> float:
    """Return the share of the sphere covered by texels (H, 2 H) bool."""
    latitude = (torch.arange(len(unseen)) + 0.5) * (math.pi / len(unseen))
    return float((unseen.double().mean(1) * latitude.sin()).sum() / latitude.sin().sum())


def reduced_texture(texture: Tensor, diameter_px: float) -> Tensor:
    """Average a map (H, 2 H) by an integer factor to the resolution of a disk `diameter_px` wide, without aliasing."""
    circumference_px = math.pi * diameter_px
    factor = max(1, int(texture.shape[-1] / circumference_px))
    while texture.shape[-2] % factor:
        factor -= 1
    return F.avg_pool2d(texture[None, None], factor)[0, 0]


def texture_coordinates(direction_body: Tensor) -> tuple[Tensor, Tensor]:
    """Return longitude -pi .. pi and latitude -pi/2 .. pi/2, rad, of directions (..., 3); finite gradients at poles."""
    check_tail("direction_body", direction_body, 3)
    x, y, z = direction_body.unbind(-1)
    x, y = x.contiguous(), y.contiguous()  # strided atan2 is slower, and differs in the last digit
    if direction_body.requires_grad:
        # The gradient of the longitude is infinite at the poles: replace x by a constant nudge and detach y.
        nudge = torch.finfo(direction_body.dtype).eps
        polar = (x.abs() < nudge) & (y.abs() < nudge)
        x, y = torch.where(polar, x.detach() + nudge, x), torch.where(polar, y.detach(), y)
    return torch.atan2(y, x), torch.atan2(z, torch.sqrt(x * x + y * y))


def sample_texture(texture: Tensor, direction_body: Tensor) -> Tensor:
    """Return the bilinear grey (...) of a map (H, 2 H) at body directions (..., 3) of any length but zero.
    Differentiable, continuous over the date line and the poles; map and directions share dtype and device.
    Source: docs/conventions.md (texture map); kornia's remap needs align_corners=True for pixel coordinates.
    """
    check_texture_shape(texture)
    return sample_closed(closed_texture(texture), direction_body)


def closed_texture(texture: Tensor) -> Tensor:
    """Return a map (H, 2 H) continued by a texel over its edges, (H + 2, 2 H + 2), for `sample_closed`."""
    return _continued(texture, 1)


def sample_closed(closed: Tensor, direction_body: Tensor) -> Tensor:
    """Return the grey of `sample_texture` for a map sampled more than once."""
    return sample_at(closed[None], *texel_coordinates(direction_body, len(closed) - 2))[0]


def sample_at(closed: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """Return the grey (n, ...) of n closed maps (n, H + 2, 2 H + 2) at `texel_coordinates` (...)."""
    from kornia.geometry.transform import remap  # late: half a second, not needed with cached tables

    grey = remap(closed[None], (column + 1).reshape(1, 1, -1), (row + 1).reshape(1, 1, -1), align_corners=True)
    return grey.reshape(len(closed), *column.shape)


def sample_spline(texture: Tensor, direction_body: Tensor) -> Tensor:
    """Return the cubic B-spline grey (...) at body directions (..., 3); twice differentiable, except at the poles.
    Source: Unser 1999, Splines, a perfect fit, eq. 3; the texels are the coefficients: a blur of 0.58 texels.
    """
    check_texture_shape(texture)
    height, width = texture.shape
    column, row = texel_coordinates(direction_body, height)
    closed = _continued(texture, SPLINE_TEXELS)
    first_column, columns = spline_weights(column)
    first_row, rows = spline_weights(row)
    # A longitude of pi may round to one column beyond the edge.
    first_column = first_column.clamp(-SPLINE_TEXELS, width + SPLINE_TEXELS - 4) + SPLINE_TEXELS
    first_row = first_row.clamp(-SPLINE_TEXELS, height + SPLINE_TEXELS - 4) + SPLINE_TEXELS
    steps = torch.arange(4, device=texture.device)
    at = (first_row[..., None, None] + steps[:, None]) * closed.shape[1] + first_column[..., None, None] + steps
    texels = closed.reshape(-1)[at]
    return ((texels * columns[..., None, :]).sum(-1) * rows).sum(-1)


def known_paint(texture: Any) -> tuple[Tensor, Tensor | None]:
    """Return a map (H, 2 H), 0 black .. 1 white, an array or a tensor, as a tensor, with unknown paint (NaN) as grey;
    and the unknown texels, (H, 2 H) bool, None if there are none. Refuse other maps (ShapeError).
    """
    values = tensor_of("texture", texture)
    check_texture_shape(values)
    top = float(values.detach().nan_to_num().amax())
    if not values.is_floating_point() or top > OVERSHOOT:
        got = f"{str(values.dtype).removeprefix('torch.')} up to {top:g}"
        do = "convert it to float and divide it by the level of white, as load_texture does"
        raise ShapeError(refusal("texture", expected="floating-point numbers, 0 black .. 1 white", got=got, do=do))
    hidden = values.detach().isnan()
    return (torch.where(hidden, 0.5, values), hidden) if bool(hidden.any()) else (values, None)


def check_texture_shape(texture: Tensor) -> None:
    """Raise ShapeError unless the tensor is one map (H, 2 H), H at least 2."""
    if texture.ndim != 2 or texture.shape[1] != 2 * texture.shape[0] or len(texture) < SPLINE_TEXELS:
        expected = f"(H, 2 H), H at least {SPLINE_TEXELS}"
        raise ShapeError(refusal("texture", expected=expected, got=str(tuple(texture.shape)), do="pass one map"))


def texel_coordinates(direction_body: Tensor, height: int) -> tuple[Tensor, Tensor]:
    """Return column and row (...) of body directions (..., 3) in a map (H, 2 H); integers are texel centres."""
    longitude, latitude = texture_coordinates(direction_body)
    return (longitude + math.pi) * (height / math.pi) - 0.5, (math.pi / 2 - latitude) * (height / math.pi) - 0.5


def texel_areas(height: int) -> Tensor:
    """Return the solid angle of every texel, (H, 2 H) float64, sr; the sum is 4 pi."""
    edge = math.pi / 2 - math.pi * torch.arange(height + 1, dtype=torch.float64) / height
    band = (edge[:-1].sin() - edge[1:].sin()) * (math.pi / height)
    return band[:, None].expand(height, 2 * height)


def _continued(texture: Tensor, texels: int) -> Tensor:
    """Pad the map across the poles (opposite meridian) and the date line."""
    beyond = texture.roll(texture.shape[1] // 2, 1)
    tall = torch.cat([beyond[:texels].flip(0), texture, beyond[-texels:].flip(0)])
    return torch.cat([tall[:, -texels:], tall, tall[:, :texels]], dim=1)


def spline_weights(place: Tensor) -> tuple[Tensor, Tensor]:
    """Return the first of four texels (...) int64 and the weights (..., 4), sum 1."""
    below = place.detach().floor()
    t = place - below
    s = 1.0 - t
    weights = [s**3, 4.0 - 3.0 * t * t * (1.0 + s), 4.0 - 3.0 * s * s * (1.0 + t), t**3]
    return below.long() - 1, torch.stack(weights, dim=-1) / 6.0


def fibonacci_directions(count: int) -> Tensor:
    """Return evenly spread directions, (count, 3) float64, without the poles (Swinbank and Purser 2006)."""
    k = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * k / count
    angle = math.pi * (1 + math.sqrt(5.0)) * k
    level = (1 - z * z).sqrt()
    return torch.stack([level * angle.cos(), level * angle.sin(), z], dim=-1)


def random_directions(count: int, rng: torch.Generator) -> Tensor:
    """Draw uniform unit directions, (count, 3) float64."""
    draw = torch.randn(count, 3, generator=rng, dtype=torch.float64)
    return torch.nn.functional.normalize(draw, dim=-1)


def blobs(height: int, rng: torch.Generator) -> Tensor:
    """Draw smooth blobs, half of the sphere white."""
    wave = random_directions(60, rng) * (5 + 5 * torch.rand(60, 1, generator=rng, dtype=torch.float64))
    phase = 2 * math.pi * torch.rand(60, generator=rng, dtype=torch.float64)
    rows = torch.split(map_directions(height), 2)  # all at once need 250 MB
    value = torch.cat([torch.cos(body @ wave.T + phase).sum(-1) for body in rows])
    return _edge(value - value.median(), 0.25)


def polygons(height: int, rng: torch.Generator) -> Tensor:
    """Draw black and white regions nearest to random points."""
    points = random_directions(60, rng)
    owner = (map_directions(height) @ points.T).argmax(-1)
    return (owner % 2).float()


def dots(height: int, rng: torch.Generator) -> Tensor:
    """Draw black dots of 8 to 14 degrees radius on white."""
    points = random_directions(34, rng)
    radius = torch.deg2rad(8 + 6 * torch.rand(34, generator=rng, dtype=torch.float64))
    outside = (torch.acos((map_directions(height) @ points.T).clamp(-1, 1)) - radius).amin(-1)
    return _edge(outside, math.pi / height)


def _edge(value: Tensor, width: float) -> Tensor:
    return (0.5 + value / width).clamp(0, 1).float()


KINDS = {"blobs": blobs, "patches": polygons, "dots": dots}


def random_texture(kind: str, seed: int, height: int = 512) -> Tensor:
    """Draw a texture map of a kind in `KINDS`, (H, 2 H) float32, 0 black .. 1 white; equal seeds give equal maps."""
    return KINDS[kind](height, torch.Generator().manual_seed(seed))
