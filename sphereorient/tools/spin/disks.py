"""Photographs without a background picture: files, and disks of the ball, grey relative to its colour."""

import csv
import io
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from sphereorient.errors import PaintError, error_words, refusal
from sphereorient.files.whole_file import TABLE_BYTES, read_text, read_whole
from sphereorient.search import crop_disk
from sphereorient.sphere import load_texture
from sphereorient.sphere.texture import PICTURE_BYTES
from sphereorient.sphere.view import fitted_circle
from sphereorient.tools.spin.dots import DotTable

Photograph = NDArray[Any]

MOST_PIXELS = 50_000_000  # of a photograph
ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
MOST_PHOTOGRAPHS = 1000  # all in memory
FINER = 4  # lattice of the outline, times finer than pixels
CORNER = 0.08  # of the shorter side: squares in the corners, for the scene
RIM = (0.85, 0.95)  # of the radius: the outline has half the brightness of this ring
SPECK = 3  # px, median filter against noise
RADIUS_MIN_PX = 6.0  # a smaller disk shows hardly any texture
ROUND_SHARE = 0.6  # of the outline's points that must lie on the circle
ON_CIRCLE = 0.06  # largest distance of these from the circle, of its radius
STEPS = 12  # of the circle's robust fit
PICTURES_MIN = 3  # any spin fits two
NO_CIRCLE = math.nan, math.nan, math.nan, 0.0


@dataclass(frozen=True, kw_only=True)
class BallOutline:
    """Outline of the ball in one photograph."""

    u_px: float
    v_px: float
    radius_px: float


def find_disk(picture: Photograph, name: str = "photograph") -> BallOutline:
    """Find the ball, whole or cut, in a photograph (H, W) or (H, W, 3) with a free corner; else raise PaintError."""
    levels = _channels(picture, name)
    # Each pixel's distance from the corners' median colour, as the ball may fill a corner.
    side = max(2, round(CORNER * min(levels.shape[:2])))
    ends = (slice(None, side), slice(-side, None))
    corners = [levels[rows, columns].reshape(-1, levels.shape[2]).mean(0) for rows in ends for columns in ends]
    away = np.linalg.norm(levels - np.median(corners, axis=0), axis=-1).astype(np.float32)
    difference = np.asarray(cv2.medianBlur(away, SPECK), np.float32)
    scale = 255 / max(float(difference.max()), 1e-6)
    inside = difference > cv2.threshold((difference * scale).astype(np.uint8), 0, 255, cv2.THRESH_OTSU)[0] / scale
    if not inside.any():
        raise _nothing(name, "nothing unlike the scene")
    fine = np.asarray(cv2.resize(difference, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_LINEAR), np.float32)
    rough = _outlined(fine, 0.5 * float(np.median(difference[inside])))
    # A lit ball is dimmer at its rim: the border is at half of the level just inside.
    row, column = np.ogrid[: fine.shape[0], : fine.shape[1]]
    away = np.hypot(row - rough[1], column - rough[0]) / max(rough[2], 1.0)
    rim = fine[(away > RIM[0]) & (away < RIM[1])]
    u, v, radius, share = _outlined(fine, 0.5 * float(np.median(rim))) if len(rim) else rough
    radius = (radius + 0.5) / FINER  # the outline runs through the outermost cells' middles
    if not radius >= RADIUS_MIN_PX or share < ROUND_SHARE or radius > max(picture.shape[:2]):
        raise _nothing(name, "nothing round unlike the scene")
    return BallOutline(u_px=(u + 0.5) / FINER - 0.5, v_px=(v + 0.5) / FINER - 0.5, radius_px=radius)


@dataclass(frozen=True, kw_only=True, eq=False)
class Photographs:
    """F photographs of one flight; raises PaintError for fewer than three, or times that do not match."""

    pictures: Sequence[Photograph]  # (H, W) or (H, W, 3) each, sizes may differ
    time_s: Tensor  # (F,) float64, from any origin, all different
    names: Sequence[str] = ()  # for messages
    balls: Sequence[BallOutline] | None = None  # outlines; None: to be found

    def __post_init__(self) -> None:
        count, finite = len(self.pictures), bool(self.time_s.isfinite().all())
        do = "give one time in seconds for each photograph"
        if count < PICTURES_MIN:
            expected = f"at least {PICTURES_MIN} photographs"
            raise PaintError(refusal("spin", expected=expected, got=str(count), do="add pictures of the same flight"))
        if self.time_s.shape != (count,) or not finite:
            got = f"{tuple(self.time_s.shape)} times" if finite else "a time that is no number"
            raise PaintError(refusal("times", expected=f"{count} times", got=got, do=do))
        if bool((self.time_s.sort().values.diff() <= 0).any()):
            raise PaintError(refusal("times", expected="different times", got="one of them twice", do=do))

    def disks(self, size_px: int) -> tuple[Tensor, tuple[BallOutline, ...]]:
        """Find the balls; return grey disks (F, S, S) float32 and outlines, or raise PaintError."""
        names = self.names or [f"photograph {k}" for k in range(len(self.pictures))]
        found = tuple(self.balls or [find_disk(*each) for each in zip(self.pictures, names, strict=True)])
        disks = [
            crop_disk(_own_grey(_channels(picture, name), ball), ball.u_px, ball.v_px, ball.radius_px, size_px)
            for picture, name, ball in zip(self.pictures, names, found, strict=True)
        ]
        return torch.from_numpy(np.stack(disks)), found


def _own_grey(levels: NDArray[np.float32], ball: BallOutline) -> NDArray[np.float32]:
    """Return the share of the ball's mean colour in each pixel (H, W): white is bright for any colour of the ball."""
    row, column = np.ogrid[: levels.shape[0], : levels.shape[1]]
    inside = np.hypot(row - ball.v_px, column - ball.u_px) < ball.radius_px
    colour = levels[inside].mean(0) if inside.any() else np.ones(levels.shape[2], np.float32)
    return np.asarray(levels @ (colour / max(float(np.linalg.norm(colour)), 1e-6)), np.float32)


def _channels(picture: Photograph, name: str) -> NDArray[np.float32]:
    if picture.ndim not in (2, 3) or min(picture.shape[:2]) < 2 * RADIUS_MIN_PX or picture.shape[2:] not in ((), (3,)):
        expected, do = "(H, W) or (H, W, 3), at least 12 px", "pass pictures as arrays, colours in the last axis"
        raise PaintError(refusal(name, expected=expected, got=str(picture.shape), do=do))
    levels = picture.astype(np.float32)
    return levels[..., None] if picture.ndim == 2 else levels


def _outlined(fine: NDArray[np.float32], level: float) -> tuple[float, float, float, float]:
    """Fit a circle to the border of the largest region above a level, without parts cut by the picture."""
    outlines, _ = cv2.findContours((fine > level).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        return NO_CIRCLE
    outline = max(outlines, key=cv2.contourArea)[:, 0].astype(np.float64)
    height, width = fine.shape
    free = (outline > FINER).all(1) & (outline < np.array([width, height]) - 1 - FINER).all(1)
    return _circle(outline[free])


def _circle(points: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Fit a circle to points (K, 2): centre, radius, share on it (weights of Geman and McClure 1987)."""
    if len(points) < 8:
        return NO_CIRCLE
    weight, u, v, radius = np.ones(len(points)), 0.0, 0.0, math.nan
    for step in range(STEPS):
        u, v, radius = fitted_circle(points, weight)
        off = np.hypot(points[:, 0] - u, points[:, 1] - v) - radius
        scale = ON_CIRCLE * max(radius, 1.0) * max(1.0, 4.0 - step)  # loose at first: outliers pull the first circle
        weight = 1 / (1 + (off / (0.5 * scale)) ** 2) ** 2
    return u, v, radius, float((np.abs(off) < ON_CIRCLE * radius).mean())


def _nothing(name: str, got: str) -> PaintError:
    do = "crop the picture to the ball and a corner of scene, or give the outline (balls=)"
    return PaintError(refusal(name, expected="one ball before an unlike scene", got=got, do=do))


def load_photographs(paths: Sequence[Path], times: str) -> Photographs:
    """Read photographs: files in order of time, or one folder by name.
    `times`: a table .csv with the columns file and t_s, s, or pictures per second at equal intervals. Raise PaintError
    for missing or unreadable files, too many of them, or times that do not match.
    """
    files = list(paths)
    if len(files) == 1 and files[0].is_dir():
        files = sorted(path for path in files[0].iterdir() if path.suffix.lower() in ENDINGS)
    if len(files) > MOST_PHOTOGRAPHS:
        expected, do = f"at most {MOST_PHOTOGRAPHS}", "name fewer, or measure a movie with `sphereorient track`"
        raise PaintError(refusal("photographs", expected=expected, got=str(len(files)), do=do))
    time_s = _times(times, files)
    return Photographs(pictures=[_picture(path) for path in files], time_s=time_s, names=[str(path) for path in files])


def load_ball(path: Path, dot_radius_deg: float | None) -> Tensor | DotTable:
    """Read a texture map, or a table .csv of dots: x, y, z of a direction in each line, no header.
    Raise PaintError for a missing table or lines that are no directions, TextureError for a missing or unreadable map.
    """
    if path.suffix.lower() not in (".csv", ".txt"):
        return load_texture(path)
    text = read_text(path, TABLE_BYTES, "a table of dots", PaintError, "name a file that exists")
    do = "write x,y,z of one dot per line, without a header"
    try:
        with warnings.catch_warnings(action="ignore"):  # of an empty table, refused below
            rows = np.loadtxt(io.StringIO(text), delimiter=",", ndmin=2)
    except ValueError as error:
        raise PaintError(refusal(str(path), expected="a table of numbers", got=error_words(error), do=do)) from None
    if rows.size and rows.shape[1] != 3:
        raise PaintError(refusal(str(path), expected="three columns", got=str(rows.shape[1]), do=do))
    table = DotTable(direction_body=torch.from_numpy(rows.reshape(-1, 3)))
    return table if dot_radius_deg is None else replace(table, radius_deg=dot_radius_deg)


def _times(times: str, files: Sequence[Path]) -> Tensor:
    try:
        rate_hz = float(times)
    except ValueError:
        return _table_times(Path(times), files)
    if not 0 < rate_hz < math.inf:
        do = "give the number of pictures per second"
        raise PaintError(refusal("--times", expected="a rate above 0", got=times, do=do))
    return torch.arange(len(files), dtype=torch.float64) / rate_hz


def _table_times(path: Path, files: Sequence[Path]) -> Tensor:
    text = read_text(path, TABLE_BYTES, "a table of times", PaintError, "name a file that exists")
    table = csv.DictReader(io.StringIO(text))
    if not {"file", "t_s"} <= set(table.fieldnames or ()):
        got, do = ", ".join(table.fieldnames or ()) or "nothing", "write a header with file,t_s"
        raise PaintError(refusal(str(path), expected="the columns file and t_s", got=got, do=do))
    found = {str(row["file"]): str(row["t_s"]) for row in table}
    missing = [file.name for file in files if file.name not in found]
    if missing:
        do = "add a line for each photograph"
        raise PaintError(refusal(str(path), expected=f"a time of {missing[0]}", got="none", do=do))
    try:
        return torch.tensor([float(found[file.name]) for file in files], dtype=torch.float64)
    except ValueError as error:
        do = "correct t_s"
        raise PaintError(refusal(str(path), expected="times in seconds", got=error_words(error), do=do)) from None


def _picture(path: Path) -> Photograph:
    content = read_whole(path, PICTURE_BYTES, "a picture file", PaintError, "name a file that exists")
    do = "export it again as PNG"
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(content)) as picture:
            if picture.width * picture.height > MOST_PIXELS:
                got, do = f"{picture.width} x {picture.height}", "crop it to the ball"
                expected = f"a picture of at most {MOST_PIXELS / 1e6:g} million pixels"
                raise PaintError(refusal(str(path), expected=expected, got=got, do=do))
            return np.asarray(picture if picture.mode[0] in "IF" else picture.convert("RGB"))  # 16 bit as they are
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        expected = "a picture that can be decoded"
        raise PaintError(refusal(str(path), expected=expected, got=error_words(error), do=do)) from None
