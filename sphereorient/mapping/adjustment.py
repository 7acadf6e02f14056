"""Bundle adjustment of position, rotations, light and paint of a ball in many pictures, from near values.

The paint of each map cell is eliminated as the weighted mean of the pictures there; residuals from this mean depend on
position and rotations only. Sources: bundle adjustment, Triggs et al. 2000; variable projection, Golub and Pereyra
1973.
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
from sphereorient.cameras import Camera, CoarserCamera, PinholeCamera, centre_lab_mm, perspective_centre_lab_mm
from sphereorient.errors import PaintError, refusal
from sphereorient.experiment.recording import UNKNOWN, TextureMap
from sphereorient.files.threads import Progress, counted, side_by_side, silent
from sphereorient.mapping.disks import Crops
from sphereorient.mapping.iterations import BLACK, WHITE, lowest
from sphereorient.mapping.paint_cells import BallView, PaintCells
from sphereorient.pose.camera_view import FIRST_BLUR_PX, CameraView
from sphereorient.sphere.texture import map_directions

LEVELS = 4.0, 2.0, 1.0  # pixels per cell at the disk's centre, in successive adjustments
MOST_STEPS, NEAR = 12, 0.02  # of each; the last step moves the paint by less, in cells
PAINT_PX = 0.5  # the same for the final map
MOST_CELLS = 320  # along each axis; pictures of larger balls are blurred
BLUR = 0.4  # cells, for pictures with smaller pixels
WITHIN = 0.98  # of the radius: pixels that are used
LIGHT_RADII = 0.08  # half side of the neighbourhood over which light is averaged, twice
LIGHT_ROUNDS, LIGHT_FRAMES = 2, 64  # rounds that estimate light from the paint, and their frames
BLACKEST = 1e-3  # of the brightest light, lower limit
ROBUST = 4.0  # deviations from the paint; beyond, a picture has less weight (occluders, glare)
PRIOR, SCATTER = 0.05, 0.02  # of the radius: initial error of all positions; scatter of those of a moving ball
HELD, FREE = 1e3, 1e-6  # of a rotation's precision: ridge for the first, which is fixed, and for all
FOCAL_STEP, FOCAL_STEPS = 0.4, 5  # of the logarithm of a focal length, and number to either side
FOCAL_FRAMES, FOCAL_BETTER = 60, 0.9  # frames; share of the residual with the given one that is clearly better
NEAREST = 2.0  # radii, of a camera from the ball's centre
FARTHEST = 0.1  # of the radius: longest step of a position
AT_ONCE = 4096  # cells
LEAST = 1e-6  # least weight

Singles = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Adjustment:
    """Position, rotations, light and paint common to the pictures of a ball."""

    crops: Crops  # as given, at the adjusted position
    R_lab_body: Tensor  # (N, 3, 3) float64; the first is as given
    cells: PaintCells  # of the adjustment; paint in shares of the light
    light: Sequence[Singles]  # of each camera, in the pixels of its crops
    left: float  # root mean square of the residuals from the paint
    moved_mm: Tensor  # (3,), mean change of the positions

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
    """Adjust all crops of a ball from near rotations (N, 3, 3) and a near position, coarse to fine, `levels` as
    `LEVELS`. A moving ball has a position per crop; the scatter of the given ones is learnt.
    """
    places = 1 if crops.fixed else len(R_lab_body)
    expected = crops.position_lab_mm[:places] / crops.radius_mm
    scatter = 0.0 if crops.fixed else SCATTER  # radii
    light = [_mean_light(crops, c) for c in range(len(crops.views))]
    found = Adjustment(
        crops=crops, R_lab_body=R_lab_body, cells=cells_of(crops), light=light, left=math.inf, moved_mm=torch.zeros(3)
    )
    for pixels in counted("adjustment", levels, len(levels), progress):
        found = replace(found, cells=cells_of(crops, pixels))
        spread = PRIOR**2 + scatter**2 * torch.eye(places, dtype=torch.float64)
        near = NEAR * math.sqrt(4 * math.pi) / found.cells.side  # radii
        for _ in range(MOST_STEPS):
            seen = [_seen(found, c) for c in range(len(crops.views))]
            found = replace(found, light=[_light(found, one, c) for c, one in enumerate(seen)])
            step, turn, left = _step(found, seen, expected, spread)  # radii, rad
            crops = replace(crops, position_lab_mm=crops.position_lab_mm + step * crops.radius_mm)
            found = replace(found, crops=crops, R_lab_body=found.R_lab_body @ so3.exp(turn), left=left)
            if _moved(step, found) < near and float(turn.norm(dim=1).median()) < near:
                break
        off = crops.position_lab_mm[:places] / crops.radius_mm - expected
        scatter = _moved(off - off.mean(0), found)
    return replace(found, moved_mm=crops.position_lab_mm[:places].mean(0) - expected.mean(0) * crops.radius_mm)


def focal_ratio(found: Adjustment) -> float:
    """Return the factor on the focal length of a single pinhole camera that fits best, within some per cent; 1 unless
    one of 1.5 times or its inverse is clearly better: from nearer, less of the sides is visible.
    """
    rows = torch.linspace(0, len(found.R_lab_body) - 1, min(FOCAL_FRAMES, len(found.R_lab_body))).long()
    begin = replace(found, crops=found.crops.where(rows), R_lab_body=found.R_lab_body[rows])

    def at(log: float, start: Adjustment) -> Adjustment:
        return adjusted(_with_focal(start.crops, math.exp(log)), start.R_lab_body, levels=LEVELS[:2])

    distance = float(sights(begin.crops)[:, 0].norm())  # radii
    logs = [k * FOCAL_STEP for k in range(-FOCAL_STEPS, FOCAL_STEPS + 1)]
    logs = [log for log in logs if log == 0.0 or distance * math.exp(log) > NEAREST]
    tried = {log: at(log, begin) for log in logs if abs(log) <= FOCAL_STEP}
    if min(tried, key=lambda log: tried[log].left) == 0.0:
        return 1.0
    tried |= {log: at(log, begin) for log in logs if log not in tried}
    log = min(tried, key=lambda log: tried[log].left)
    if tried[log].left > FOCAL_BETTER * tried[0.0].left:  # no effect for a distant ball
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
    """Return a ball of the same size in one pinhole camera of another focal length."""
    (view,) = crops.views
    coarse = view.camera if isinstance(view.camera, CoarserCamera) else None
    camera = view.camera if coarse is None else coarse.camera
    assert isinstance(camera, PinholeCamera)
    other: Camera = replace(camera, f_px=ratio * camera.f_px)
    other = other if coarse is None else replace(coarse, camera=other)
    X = ratio * (crops.position_lab_mm - (centre := centre_lab_mm(camera))) + centre
    return replace(crops, views=[CameraView.of(view.name, other, view.scene)], position_lab_mm=X)


def cells_of(place: Crops, pixels: float = 1.0) -> PaintCells:
    """Return an empty map of a ball at its usual position, with `pixels` per cell at a disk's centre."""
    radius_px = max(float(view.radius_px(place.usual, place.radius_mm)) for view in place.views)
    side = 16 * math.ceil(math.sqrt(4 * math.pi) * radius_px / pixels / 16)
    return PaintCells(min(side, MOST_CELLS), FIRST_BLUR_PX / radius_px)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Seen:
    """Values of all cells in one camera's N pictures."""

    grey: Tensor  # (N, cells) float32
    cosine: Tensor  # (N, cells), of the slant; 0: not visible
    pixel: Tensor  # (N, cells) int32, of the crop

    def where(self, rows: Tensor) -> "_Seen":
        return _Seen(grey=self.grey[rows], cosine=self.cosine[rows], pixel=self.pixel[rows])

    def paint(self, light: Singles) -> Tensor:
        """Return the grey in shares of the light."""
        shares: Tensor = self.grey / torch.from_numpy(light).reshape(-1)[self.pixel]
        return shares


def _seen(at: Adjustment, camera: int) -> _Seen:
    crops, view = at.crops, at.crops.views[camera]
    places = crops.position_lab_mm[:1] if crops.fixed else crops.position_lab_mm
    balls = [BallView.of(view.camera, X, crops.radius_mm) for X in places]
    counts = [torch.from_numpy(_within(crops, camera, k)) for k in range(len(places))]
    blur_px = BLUR * float(view.radius_px(crops.usual, crops.radius_mm)) * math.sqrt(4 * math.pi) / at.cells.side

    def one(k: int) -> tuple[Tensor, Tensor, Tensor]:
        crop = crops.crops[camera][k]
        if crop is None or not bool(crops.seen[k, camera]):
            none = torch.zeros(at.cells.side**2)
            return none, none, none.int()
        grey, place = crop.grey.astype(np.float32), 0 if crops.fixed else k
        if blur_px > 1.5 * BLUR:
            grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), blur_px), np.float32)
        corner = crop.left, crop.top
        return at.cells.see(balls[place], torch.from_numpy(grey), counts[place], corner, at.R_lab_body[k])

    grey, cosine, pixel = zip(*side_by_side(one, range(len(at.R_lab_body))), strict=True)
    return _Seen(grey=torch.stack(grey), cosine=torch.stack(cosine), pixel=torch.stack(pixel))


def _within(crops: Crops, camera: int, frame: int = 0) -> NDArray[np.bool_]:
    """Return which pixels of a camera's crop show the ball, (H, W); of another frame if this one is unseen."""
    crop = crops.crops[camera][frame] or next(crop for crop in crops.crops[camera] if crop is not None)
    there = tuple(slice(at, at + size) for at, size in zip((crop.top, crop.left), crop.grey.shape, strict=True))
    return within_limb(crops.views[camera], crops.position_lab_mm[frame], crops.radius_mm, there)


def within_limb(
    view: CameraView, position_lab_mm: Tensor, radius_mm: float, there: tuple[slice, ...]
) -> NDArray[np.bool_]:
    """Return which pixels of a part of the picture (rows, columns) are well within a ball at a position (3,)."""
    y, x = np.ogrid[there]
    u, v = view.camera.project(position_lab_mm).tolist()
    within: NDArray[np.bool_] = np.hypot(x - u, y - v) < WITHIN * float(view.radius_px(position_lab_mm, radius_mm))
    width, height = view.camera.image_size
    within &= (x >= 0) & (x < width) & (y >= 0) & (y < height)
    if view.background.shown is not None:
        within &= view.background.shown[y.clip(0, height - 1), x.clip(0, width - 1)]
    return within


def _smooth(crops: Crops, camera: int, total: Singles, share: Singles) -> Singles:
    """Return the local mean: sums over pixels, weighted by the share of each."""
    radius_px = float(crops.views[camera].radius_px(crops.usual, crops.radius_mm))
    side = (2 * int(LIGHT_RADII * radius_px) + 1,) * 2
    for _ in range(2):
        total, share = (
            np.asarray(cv2.boxFilter(one, -1, side, borderType=cv2.BORDER_CONSTANT), np.float32)
            for one in (total, share)
        )
    level = total / np.maximum(share, LEAST * (float(share.max()) or 1.0))
    return np.asarray(np.maximum(level, max(BLACKEST * float(level.max()), LEAST)), np.float32)


def _mean_light(crops: Crops, camera: int) -> Singles:
    """Return the local mean of all crops that show the ball: the light, if paint averages out."""
    total = share = np.zeros(_within(crops, camera).shape, np.float32)
    seen = [(k, crop) for k, crop in enumerate(crops.crops[camera]) if crop is not None and crops.seen[k, camera]]
    for k, crop in seen:
        counts = _within(crops, camera, 0 if crops.fixed else k)
        total, share = total + crop.grey * counts, share + counts
    count = np.float32(max(len(seen), 1))
    return _smooth(crops, camera, total / count, share / count)


def _light(at: Adjustment, seen: _Seen, camera: int) -> Singles:
    """Return the light that explains the pictures best with the common paint."""
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
    Overwrites `seen`, as these are the largest arrays.
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
    """Return the lines of sight from all cameras to a ball's N positions, (C, N, 3) float64, radii, lab."""
    X = place.position_lab_mm
    return torch.stack([X - perspective_centre_lab_mm(view.camera, X) for view in place.views]) / place.radius_mm


def place_metric(place: Crops) -> Tensor:
    """Return the metric (3, 3) of changes of position, by their effect in pictures, 1/radii^2 per camera: motion along
    a line of sight changes only the size.
    """
    sight = sights(place).nanmean(1)
    square = sight.square().sum(1)[:, None, None]
    ahead = sight[:, :, None] * sight[:, None] / square
    return (torch.eye(3) - ahead + ahead / square).sum(0)


def _moved(step: Tensor, at: Adjustment) -> float:
    """Return the rms motion in pictures of a step of positions (P, 3), radii."""
    return math.sqrt(float((step @ place_metric(at.crops) * step).sum(1).mean()))


def _step(at: Adjustment, seen: Sequence[_Seen], expected: Tensor, spread: Tensor) -> tuple[Tensor, Tensor, float]:
    """Return one Gauss-Newton step of positions (P, 3), radii, lab, and of rotations (N, 3), rad, body; and the rms
    residual. P: 1, or N for a moving ball. `expected` (P, 3), radii, and `spread` (P, P), radii^2: prior of positions.

    A rotation by t moves the paint in direction n by t x n; a motion d of the centre moves it by d minus the part along
    the line of sight w that leaves the sphere: d - w (n.d) / (n.w).
    """
    R, crops, count = at.R_lab_body, at.crops, len(at.R_lab_body)
    grey, weight = _together(at, seen)
    mean, total = _mean(grey, weight)
    off = grey.sub_(mean)
    left = float((weight * off.square()).sum() / weight.sum())
    at.cells.set(mean, total)
    slopes, normals = at.cells.table.rows[:, 1:], at.cells.normals
    sight = (sights(crops)[:, :, None] @ R)[:, :, 0].float()  # (C, N, 3), in the body
    places = 1 if crops.fixed else count
    size, turns = 3 * (count + places), 3 * count
    H, own = torch.zeros(size, size, dtype=torch.float64), torch.zeros(count, 6, 6, dtype=torch.float64)
    force = torch.zeros(size, dtype=torch.float64)
    for part in torch.split(torch.arange(len(mean)), AT_ONCE):
        s, n = slopes[part], normals[part]
        turned = torch.linalg.cross(n, s).mT
        rows = torch.zeros(size, len(part))
        for c, w in enumerate(weight[..., part]):
            along = (sight[c] @ s.mT) / (1 + sight[c] @ n.mT).clamp_max(-LEAST)
            moved = R.float() @ (s.mT - along[:, None] * n.mT)  # (N, 3, cells)
            both = torch.cat([turned.expand_as(moved), moved], dim=1)
            weighted = w[:, None] * both
            own += (weighted @ both.mT).double()
            pulled = (weighted @ off[c, :, part, None]).double()
            force[:turns] -= pulled[:, :3].reshape(-1)
            force[turns:] -= _of_places(pulled[:, 3:, 0], places)
            rows[:turns] += weighted[:, :3].reshape(turns, -1)
            rows[turns:] += _of_places(weighted[:, 3:], places)
        rows *= total[part].clamp_min(LEAST).rsqrt()
        H -= (rows @ rows.mT).double()
    by_turn, by_both, by_place = own[:, :3, :3], own[:, :3, 3:], own[:, 3:, 3:]
    k, place = torch.arange(count), torch.arange(count) * (places > 1)
    blocks = H.view(count + places, 3, count + places, 3)
    blocks[k, :, k] += by_turn
    blocks[k, :, count + place] += by_both
    blocks[count + place, :, k] += by_both.mT
    blocks[count:, :, count:].diagonal(dim1=0, dim2=2).add_(
        by_place.sum(0)[..., None] if places == 1 else by_place.permute(1, 2, 0)
    )
    metric = left * place_metric(crops)
    known = torch.linalg.inv(spread)
    away = crops.position_lab_mm[:places] / crops.radius_mm - expected
    H[turns:, turns:] += torch.kron(known.contiguous(), metric.contiguous())
    force[turns:] -= (known @ away @ metric).reshape(-1)
    diagonal = H.diagonal()
    usual = float(diagonal[:turns].mean())
    diagonal[:3] += HELD * usual
    diagonal[:turns] += FREE * usual + LEAST**2
    x = torch.linalg.solve(H, force)
    step = x[turns:].reshape(places, 3)
    step = step * (FARTHEST / max(_moved(step, at), FARTHEST))
    return step, x[:turns].reshape(count, 3), math.sqrt(left)


def _of_places(each: Tensor, places: int) -> Tensor:
    """Return values of N positions (N, 3, ...) for each, or summed for a common one, (3 P, ...)."""
    return each.sum(0) if places == 1 else each.flatten(0, 1)
