"""Place, turns, light and paint of a ball from many pictures at once, from near ones: a bundle adjustment.

The paint of each cell of the map is eliminated: it is the weighted mean of what the pictures show there. What a picture
shows less this mean depends on place and turns alone. Sources: bundle adjustment, Triggs et al. 2000; elimination of
what enters linearly, Golub and Pereyra 1973.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Camera, CoarserCamera, PinholeCamera, centre_lab_mm
from sphereorient.errors import PaintError, refusal
from sphereorient.experiment.recording import UNKNOWN, TextureMap
from sphereorient.files.threads import Progress, counted, side_by_side, silent
from sphereorient.mapping.disks import Crops
from sphereorient.mapping.iterations import BLACK, WHITE, lowest
from sphereorient.mapping.paint_cells import BallView, PaintCells
from sphereorient.pose.camera_view import FIRST_BLUR_PX, CameraView
from sphereorient.sphere.texture import map_directions

LEVELS = 4.0, 2.0, 1.0  # pixels in the disk's middle along a cell, of one adjustment after the other
MOST_STEPS, NEAR = 12, 0.02  # of each; a step that moves what is seen by less, in cells, is the last
PAINT_PX = 0.5  # the same of the map at the end
MOST_CELLS = 320  # along each axis: the pictures of larger balls are blurred for it
BLUR = 0.4  # cells, of pictures with smaller pixels
WITHIN = 0.98  # of the radius: pixels that count
LIGHT_RADII = 0.08  # half side of the neighbourhood over which light is averaged, twice
LIGHT_ROUNDS, LIGHT_FRAMES = 2, 64  # in each of which it follows from the paint, and of which frames
BLACKEST = 1e-3  # of the brightest light: the least
ROBUST = 4.0  # deviations from the paint from which a picture counts less: what hides the ball, glare
PRIOR = 0.05  # of the radius: error of the place at the start
HELD, FREE = 1e3, 1e-6  # of a turn's precision: what is added for the first, which is held, and for all
FOCAL_STEP, FOCAL_STEPS = 0.4, 5  # of the logarithm of a focal length, and how many to either side
FOCAL_FRAMES, FOCAL_BETTER = 60, 0.9  # and share of what is left with the given one
NEAREST = 2.0  # radii, of a camera from the ball's centre
FARTHEST = 0.1  # of the radius, of a step: a place is near
AT_ONCE = 4096  # cells
LEAST = 1e-6  # of a weight

Picture = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Adjustment:
    """What the pictures of a ball in its place have in common."""

    crops: Crops  # as given, at the place found
    R_lab_body: Tensor  # (N, 3, 3) float64; the first is as given
    cells: PaintCells  # in which it was found, of paint in shares of the light
    light: Sequence[Picture]  # of each camera, in the pixels of its crops
    left: float  # root mean square of what the pictures differ from the paint

    def texture(self) -> TextureMap:
        """Return the map, 0 black .. 1 white."""
        fine = replace(self, cells=cells_of(self.crops, PAINT_PX))
        fine.cells.set(*_mean(*_together(fine, (_seen(fine, c) for c in range(len(self.crops.views))))))
        grey, unseen = fine.cells.sample(map_directions(fine.cells.side))
        if bool(unseen.all()):
            raise PaintError(refusal("movies", expected="a ball", got="no picture of it", do="check the movies"))
        low, high = (float(grey[~unseen].quantile(share)) for share in (BLACK, WHITE))
        grey = (BLACK + (WHITE - BLACK) * (grey - low) / max(high - low, LEAST)).clamp(0.0, 1.0)
        return TextureMap(grey=grey.masked_fill(unseen, UNKNOWN), unseen=unseen if bool(unseen.any()) else None)


def adjusted(
    crops: Crops, R_lab_body: Tensor, progress: Progress = silent, levels: Sequence[float] = LEVELS
) -> Adjustment:
    """Return what all crops of a ball that stays in its place have in common, from near turns (N, 3, 3) and a near
    place: coarse to fine, `levels` as `LEVELS`.
    """
    light = [_mean_light(crops, c) for c in range(len(crops.views))]
    found = Adjustment(crops=crops, R_lab_body=R_lab_body, cells=cells_of(crops), light=light, left=math.inf)
    for pixels in counted("adjustment", levels, len(levels), progress):
        found = replace(found, cells=cells_of(crops, pixels))
        near = NEAR * math.sqrt(4 * math.pi) / found.cells.side  # radii
        for _ in range(MOST_STEPS):
            seen = [_seen(found, c) for c in range(len(crops.views))]
            found = replace(found, light=[_light(found, one, c) for c, one in enumerate(seen)])
            step, turn, left = _step(found, seen)  # radii, rad
            crops = replace(crops, position_lab_mm=crops.position_lab_mm + step * crops.radius_mm)
            found = replace(found, crops=crops, R_lab_body=found.R_lab_body @ so3.exp(turn), left=left)
            if _moved(step, found) < near and float(turn.norm(dim=1).median()) < near:
                break
    return found


def focal_ratio(found: Adjustment) -> float:
    """Return by which factor the focal length of an only pinhole camera explains the pictures best, to some per cent; 1
    where none that is 1.5 times longer or shorter does clearly: seen from nearer, more of the sides turns away.
    """
    rows = torch.linspace(0, len(found.R_lab_body) - 1, min(FOCAL_FRAMES, len(found.R_lab_body))).long()
    begin = replace(found, crops=found.crops.where(rows), R_lab_body=found.R_lab_body[rows])

    def at(log: float, start: Adjustment) -> Adjustment:
        return adjusted(_with_focal(start.crops, math.exp(log)), start.R_lab_body, levels=LEVELS[:2])

    distance = float(sights(begin.crops).norm())  # radii
    logs = [k * FOCAL_STEP for k in range(-FOCAL_STEPS, FOCAL_STEPS + 1)]
    logs = [log for log in logs if log == 0.0 or distance * math.exp(log) > NEAREST]
    tried = {log: at(log, begin) for log in logs if abs(log) <= FOCAL_STEP}
    if min(tried, key=lambda log: tried[log].left) == 0.0:
        return 1.0
    tried |= {log: at(log, begin) for log in logs if log not in tried}
    log = min(tried, key=lambda log: tried[log].left)
    if tried[log].left > FOCAL_BETTER * tried[0.0].left:  # a ball far away looks alike
        return 1.0
    here, step = tried[log], FOCAL_STEP / 4
    for _ in range(FOCAL_STEPS):
        before, after = at(-step, here), at(step, here)
        best = min(before, here, after, key=lambda one: one.left)
        if best is here:
            break
        here, log = best, log + (step if best is after else -step)
    return math.exp(log + step * lowest(*(one.left**2 for one in (before, here, after))))


def _with_focal(crops: Crops, ratio: float) -> Crops:
    """Return a ball that one pinhole camera sees of the same size, but with another focal length."""
    (view,) = crops.views
    coarse = view.camera if isinstance(view.camera, CoarserCamera) else None
    camera = view.camera if coarse is None else coarse.camera
    assert isinstance(camera, PinholeCamera)
    other: Camera = replace(camera, f_px=ratio * camera.f_px)
    other = other if coarse is None else replace(coarse, camera=other)
    X = ratio * (crops.position_lab_mm - (centre := centre_lab_mm(camera))) + centre
    return replace(crops, views=[CameraView.of(view.name, other, view.scene)], position_lab_mm=X)


def cells_of(place: Crops, pixels: float = 1.0) -> PaintCells:
    """Return an empty map of a ball at its first position, with `pixels` in a disk's middle along a cell."""
    radius_px = max(float(view.radius_px(place.position_lab_mm[0], place.radius_mm)) for view in place.views)
    side = 16 * math.ceil(math.sqrt(4 * math.pi) * radius_px / pixels / 16)
    return PaintCells(min(side, MOST_CELLS), FIRST_BLUR_PX / radius_px)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Seen:
    """What one camera's N pictures show of all cells."""

    grey: Tensor  # (N, cells) float32
    cosine: Tensor  # (N, cells), of the slant; 0: does not show it
    pixel: Tensor  # (N, cells) int32, of the crop

    def where(self, rows: Tensor) -> "_Seen":
        return _Seen(grey=self.grey[rows], cosine=self.cosine[rows], pixel=self.pixel[rows])

    def paint(self, light: Picture) -> Tensor:
        """Return the grey in shares of the light."""
        shares: Tensor = self.grey / torch.from_numpy(light).reshape(-1)[self.pixel]
        return shares


def _seen(at: Adjustment, camera: int) -> _Seen:
    crops, view = at.crops, at.crops.views[camera]
    ball = BallView.of(view.camera, crops.position_lab_mm[0], crops.radius_mm)
    counts = torch.from_numpy(_within(crops, camera))
    blur_px = BLUR * _radius_px(crops, camera) * math.sqrt(4 * math.pi) / at.cells.side

    def one(k: int) -> tuple[Tensor, Tensor, Tensor]:
        crop = crops.crops[camera][k]
        if crop is None or not bool(crops.seen[k, camera]):
            none = torch.zeros(at.cells.side**2)
            return none, none, none.int()
        grey = torch.from_numpy(_blurred(crop.grey.astype(np.float32), blur_px))
        return at.cells.see(ball, grey, counts, (crop.left, crop.top), at.R_lab_body[k])

    grey, cosine, pixel = zip(*side_by_side(one, range(len(at.R_lab_body))), strict=True)
    return _Seen(grey=torch.stack(grey), cosine=torch.stack(cosine), pixel=torch.stack(pixel))


def _blurred(grey: Picture, blur_px: float) -> Picture:
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), blur_px), np.float32) if blur_px > 1.5 * BLUR else grey


def _radius_px(crops: Crops, camera: int) -> float:
    return float(crops.views[camera].radius_px(crops.position_lab_mm[0], crops.radius_mm))


def _within(crops: Crops, camera: int) -> NDArray[np.bool_]:
    """Return which pixels of a camera's crops show the ball, (H, W)."""
    crop = next(crop for crop in crops.crops[camera] if crop is not None)
    there = tuple(slice(at, at + size) for at, size in zip((crop.top, crop.left), crop.grey.shape, strict=True))
    return within_limb(crops.views[camera], crops.position_lab_mm[0], crops.radius_mm, there)


def within_limb(
    view: CameraView, position_lab_mm: Tensor, radius_mm: float, there: tuple[slice, ...]
) -> NDArray[np.bool_]:
    """Return which pixels of a part of the picture, rows and columns, show a ball at a position (3,) well."""
    y, x = np.mgrid[there]
    u, v = view.camera.project(position_lab_mm).tolist()
    within: NDArray[np.bool_] = np.hypot(x - u, y - v) < WITHIN * float(view.radius_px(position_lab_mm, radius_mm))
    if view.background.shown is not None:
        within &= view.background.shown[there]
    return within


def _smooth(crops: Crops, camera: int, total: Picture, share: Picture) -> Picture:
    """Return the local mean of what counts: sums over pixels, by the share that each has."""
    side = (2 * int(LIGHT_RADII * _radius_px(crops, camera)) + 1,) * 2
    for _ in range(2):
        total, share = (
            np.asarray(cv2.boxFilter(one, -1, side, borderType=cv2.BORDER_CONSTANT), np.float32)
            for one in (total, share)
        )
    level = total / np.maximum(share, LEAST * float(share.max()))
    return np.asarray(np.maximum(level, max(BLACKEST * float(level.max()), LEAST)), np.float32)


def _mean_light(crops: Crops, camera: int) -> Picture:
    """Return the local mean of all crops: the light, as far as paint averages out."""
    counts = _within(crops, camera).astype(np.float32)
    mean = np.mean([crop.grey for crop in crops.crops[camera] if crop is not None], axis=0, dtype=np.float32)
    return _smooth(crops, camera, mean * counts, counts)


def _light(at: Adjustment, seen: _Seen, camera: int) -> Picture:
    """Return the light under which the paint that all pictures have in common looks like them."""
    light, count = at.light[camera], len(seen.grey)
    some = seen.where(torch.linspace(0, count - 1, min(LIGHT_FRAMES, count)).long())
    weight, where = some.cosine.square(), some.pixel.reshape(-1)
    for _ in range(LIGHT_ROUNDS):
        paint = torch.where(some.cosine > 0, _mean(some.paint(light), weight)[0], 0.0)
        sums = (torch.bincount(where, part.reshape(-1), light.size) for part in (some.grey * paint, paint.square()))
        light = _smooth(at.crops, camera, *(part.float().reshape(light.shape).numpy() for part in sums))
    return light


def _mean(grey: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return means over all but the cells, (..., cells) to (cells), and their weights."""
    total = weight.flatten(0, -2).sum(0)
    return (weight * grey).flatten(0, -2).sum(0) / total.clamp_min(LEAST), total


def _together(at: Adjustment, seen: Iterable[_Seen]) -> tuple[Tensor, Tensor]:
    """Return grey, in shares of light and of each picture's brightness, and weights of all cameras, (C, N, cells).
    What was seen is used up: these are the largest arrays.
    """
    each = [(one.paint(light), one.cosine.square_()) for one, light in zip(seen, at.light, strict=True)]
    grey, weight = (part[0][None] if len(part) == 1 else torch.stack(part) for part in zip(*each, strict=True))
    mean, _ = _mean(grey, weight)
    bright = (weight * grey) @ mean / (weight @ mean.square()).clamp_min(LEAST)
    grey /= torch.where(bright > 0, bright, 1.0)[..., None]
    mean, _ = _mean(grey, weight)
    squares = (grey - mean).square_()
    usual = float((weight * squares).sum() / weight.sum())
    return grey, weight.div_(squares.div_(max(ROBUST**2 * usual, LEAST**2)).add_(1.0))


def sights(place: Crops) -> Tensor:
    """Return the lines of sight from all cameras to a ball's first position, (C, 3) float64, radii, lab."""
    centres = torch.stack([centre_lab_mm(view.camera) for view in place.views])
    return (place.position_lab_mm[0] - centres) / place.radius_mm


def place_metric(place: Crops) -> Tensor:
    """Return the metric (3, 3) of moves of a ball's place, by what they move in pictures, 1/radii^2 of each camera:
    along a line of sight a ball but grows.
    """
    sight = sights(place)
    square = sight.square().sum(1)[:, None, None]
    ahead = sight[:, :, None] * sight[:, None] / square
    return (torch.eye(3) - ahead + ahead / square).sum(0)


def _moved(step: Tensor, at: Adjustment) -> float:
    """Return how far a step of the place moves what is seen, radii."""
    return math.sqrt(float(step @ place_metric(at.crops) @ step))


def _step(at: Adjustment, seen: Sequence[_Seen]) -> tuple[Tensor, Tensor, float]:
    """Return one Gauss-Newton step of the place (3,), radii, and of turns (N, 3), rad, in the body; and what is left.

    A turn by t moves what is seen in direction n by t x n; a place that moves by d moves it by d less the part of d
    along the line of sight w that leaves the sphere: d - w (n.d) / (n.w).
    """
    R, count = at.R_lab_body, len(at.R_lab_body)
    grey, weight = _together(at, seen)
    mean, total = _mean(grey, weight)
    off = grey.sub_(mean)
    left = float((weight * off.square()).sum() / weight.sum())
    at.cells.set(mean, total)
    slopes, normals = at.cells.table.rows[:, 1:], at.cells.normals
    sight = (sights(at.crops)[:, None, None] @ R)[:, :, 0].float()  # (C, N, 3), in the body
    by_turn = torch.zeros(3, count, 3, count, dtype=torch.float64)
    by_both, by_place = torch.zeros(count, 3, 3, dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64)
    force, force_place = torch.zeros(count, 3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    for part in torch.split(torch.arange(len(mean)), AT_ONCE):
        s, n = slopes[part], normals[part]
        q, w, e, whole = torch.linalg.cross(n, s), weight[..., part], off[..., part], total[part].clamp_min(LEAST)
        along = (sight @ s.mT) / (1 + sight @ n.mT).clamp_max(-LEAST)  # a place's: s less n times it, in the body
        once, square, twice = w.sum(0), (w * along.square()).sum(0), (w * along).sum(0)
        rotations = R.float().flatten(1)
        s_lab, n_lab = ((one.mT @ rotations).reshape(-1, 3, 3) for one in (once, twice))
        p = ((s_lab @ s[..., None]) - (n_lab @ n[..., None]))[..., 0] / whole[:, None]  # the mean over the pictures
        scaled = once * whole.rsqrt()
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            product = q[:, i] * q[:, j]
            by_turn[i, :, j] += torch.diag(once @ product).double() - ((scaled * product) @ scaled.mT).double()
        own = once @ _outer(q, s) - twice @ _outer(q, n)
        by_both += own.reshape(count, 3, 3).double() @ R.mT - (once @ _outer(q, p)).reshape(count, 3, 3).double()
        squares = once @ _outer(s, s) + square @ _outer(n, n) - twice @ (_outer(s, n) + _outer(n, s))
        by_place += (R @ squares.reshape(count, 3, 3).double() @ R.mT).sum(0) - ((whole * p.mT) @ p).double()
        force -= ((w * e).sum(0) @ q).double()
        moved = (w * e).sum(0) @ s - (w * e * along).sum(0) @ n
        force_place -= (R @ moved[..., None].double()).sum(0)[:, 0]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        by_turn[j, :, i] = by_turn[i, :, j].mT
    H = torch.zeros(3 * count + 3, 3 * count + 3, dtype=torch.float64)
    H[:-3, :-3] = by_turn.permute(1, 0, 3, 2).reshape(3 * count, -1)
    H[:-3, -3:] = by_both.reshape(-1, 3)
    H[-3:, :-3] = H[:-3, -3:].mT
    H[-3:, -3:] = by_place + left / PRIOR**2 * place_metric(at.crops)
    diagonal = H.diagonal()
    usual = float(diagonal[:-3].mean())
    diagonal[:3] += HELD * usual
    diagonal[:-3] += FREE * usual + LEAST**2
    x = torch.linalg.solve(H, torch.cat([force.reshape(-1), force_place]))
    step = x[-3:] * (FARTHEST / max(_moved(x[-3:], at), FARTHEST))
    return step, x[:-3].reshape(count, 3), math.sqrt(left)


def _outer(a: Tensor, b: Tensor) -> Tensor:
    """Return outer products of rows, (M, 9)."""
    return (a[:, :, None] * b[:, None]).flatten(1)
