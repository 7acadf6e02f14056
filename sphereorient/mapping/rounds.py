"""Attitudes, light and map by turns, and then together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import vstack
from torch import Tensor

from sphereorient import so3
from sphereorient.mapping.chain import moved, spread
from sphereorient.mapping.footage import Footage
from sphereorient.mapping.grid import Gram, map_table, solve_map, stiffness, texel_areas
from sphereorient.mapping.joint import joint_step, part_of
from sphereorient.mapping.look import DEPTH_MIN, Look, look, look_ups
from sphereorient.mapping.record import Round
from sphereorient.mapping.settings import PaintSettings
from sphereorient.pose.fit import POSE_PARTS, FittedPoses
from sphereorient.pose.fitter import CameraView, Fitter, Optics, widest_px
from sphereorient.pose.learn_light import light_maps, light_sums, noise_curve
from sphereorient.pose.light import Light
from sphereorient.pose.pixels import Pixels

FIRST_ROUNDS = 2  # with each instant by itself: as long as the map is blurred, a joint step would believe it
LIGHT_ROUNDS = 8  # in which light, noise and blur are learnt anew
SMOOTHEST = 0.2  # as the setting `smooth`, of the first round: attitudes do not follow a map's noise
BLUR_FRAMES = 32
BLUR_RATIO = 1.25  # between neighbouring blurs that are tried
BLUR_PX = (0.25, 3.0)  # narrowest and widest
BATCH = 24  # instants at once
LONGEST_RAD = 0.05  # joint step
LONGEST_SHARE = 0.1  # the same of a move, in radii
STEPS = 60  # of conjugate gradients in it
BLACK, WHITE = 0.03, 0.97  # shares of the sphere that count as black and white paint
BEYOND = 0.2  # by how much the map may leave 0 .. 1 on the way
NOISE_EVERY = 4  # pixels from which the noise is learnt
MEASURED_STEPS = 2  # of each pose by itself, the map finished
HELD = 1e12  # 1/mm^2, of a place that is not to move
OUTLIER2 = 25.0  # squares of residuals, over the noise expected, count up to this


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """What rounds hand to each other: n instants of C cameras that the map is fitted to."""

    frames: Tensor  # (n,) int64
    pixels: Pixels  # of n * C disks
    use: Tensor  # (n, C) bool
    position_lab_mm: Tensor  # (n, 3)
    R_lab_body: Tensor  # (n, 3, 3)
    texture: Tensor  # (H, 2 H) float32, the map as the pictures blur it: coefficients of its spline
    blur_px: float
    fitter: Fitter  # its own map is none
    fixed: bool  # whether all instants share one place

    def map_fitter(self) -> Fitter:
        """Return what fits poses to the map as it is."""
        return replace(self.fitter, optics=optics_of(self.texture, self.fitter.views, self.blur_px))

    def batches(self) -> Iterator[tuple[Tensor, Pixels]]:
        """Yield rows of instants and their pixels, some at a time."""
        for rows in torch.split(torch.arange(len(self.use)), BATCH):
            yield rows, self.disks(rows)

    def disks(self, rows: Tensor) -> Pixels:
        """Return the pixels of some instants."""
        cameras = self.use.shape[1]
        return self.pixels.where((cameras * rows[:, None] + torch.arange(cameras)).reshape(-1))

    def looks(self) -> Iterator[Look]:
        """Yield how all disks compare with the map, some at a time; what is not seen weighs nothing."""
        for rows, pixels in self.batches():
            yield self.look(rows, pixels, self.blur_px)

    def look(self, rows: Tensor, pixels: Pixels, blur_px: float) -> Look:
        """Compare the disks of some instants with the map, taken to be blurred so much."""
        at = look(self.fitter, self.texture, pixels, self.position_lab_mm[rows], self.R_lab_body[rows], blur_px)
        return replace(at, weight=at.weight * self.use[rows].reshape(-1, 1))


def next_round(stage: Stage, settings: PaintSettings, k: int) -> tuple[Stage, Round]:
    """Improve attitudes, light and map once; k counts the rounds from 0."""
    before = stage.R_lab_body
    if k < FIRST_ROUNDS:
        stage, _ = fitted(stage, 3 if k == 0 else 2)
    if k < LIGHT_ROUNDS:
        stage = with_light(stage)
    smooth = smooth_of(settings, k)
    if k >= FIRST_ROUNDS:
        stage = together(stage, smooth)
    stage, misfit = with_map(stage, smooth)
    if k < LIGHT_ROUNDS:
        stage = rescaled(stage)
    if FIRST_ROUNDS <= k < LIGHT_ROUNDS and settings.blur_px is None:
        stage = replace(stage, blur_px=better_blur(stage))
    return stage, Round(moved_rad=moved(before, stage.R_lab_body), misfit=misfit, blur_px=stage.blur_px)


def smooth_of(settings: PaintSettings, k: int) -> float:
    """Return the weight that ties neighbouring texels in a round: from coarse to fine."""
    return max(settings.smooth, SMOOTHEST * 0.5**k)


def optics_of(blurred: Tensor, views: Sequence[CameraView], blur_px: float) -> Optics:
    """Return the optics of a map (H, 2 H) that is blurred as the pictures are."""
    widest = widest_px(views)
    return Optics(map_table(blurred, 2 * blur_px / widest), blur_px, widest)


def fitted(stage: Stage, steps: int) -> tuple[Stage, FittedPoses]:
    """Fit each instant's pose to the map as it is."""
    fitter = stage.map_fitter()
    fine = fitter.optics.fine
    parts = [
        fitter.fit(pixels, stage.position_lab_mm[rows], stage.R_lab_body[rows], stage.use[rows], fine, steps)
        for rows, pixels in stage.batches()
    ]
    fit = _joined(parts)
    X = fit.position_lab_mm
    X = X.median(0).values.expand(len(X), 3).clone() if stage.fixed else X
    return replace(stage, position_lab_mm=X, R_lab_body=fit.R_lab_body), fit


def _joined(parts: Sequence[FittedPoses]) -> FittedPoses:
    """Return the rows of all parts, one after the other."""
    return FittedPoses(**{name: torch.cat([getattr(part, name) for part in parts]) for name in POSE_PARTS})


def measured(footage: Footage, stage: Stage) -> tuple[Stage, FittedPoses]:
    """Fit each instant's pose to the map as it is, by all pixels: the map needs few of each picture, a pose all of its.

    Args:
        footage: with the pictures.
        stage: after the last round. A place that all instants share is left as it is.
    """
    fitter = stage.map_fitter()
    fine = fitter.optics.fine
    held = HELD * torch.eye(3, dtype=torch.float64) if stage.fixed else None
    parts = []
    for rows, _ in stage.batches():
        X, R, use = stage.position_lab_mm[rows], stage.R_lab_body[rows], stage.use[rows]
        pictures = footage.pictures(stage.frames[rows])
        known = None if held is None else held.expand(len(rows), 3, 3)
        parts.append(fitter.fit(fitter.pixels(pictures, X, fine), X, R, use, fine, MEASURED_STEPS, known))
    fit = _joined(parts)
    X = stage.position_lab_mm if stage.fixed else fit.position_lab_mm
    return replace(stage, position_lab_mm=X, R_lab_body=so3.nearest_rotation(fit.R_lab_body)), fit


def with_light(stage: Stage) -> Stage:
    """Learn light and noise from all frames."""
    cameras, basis = stage.use.shape[1], stage.fitter.light.difference.shape[-1]
    normal = torch.zeros(cameras, 2 * basis, 2 * basis, dtype=torch.float64)
    right = torch.zeros(cameras, 2 * basis, dtype=torch.float64)
    greys: list[tuple[Tensor, Tensor, Tensor]] = []
    some = slice(None, None, NOISE_EVERY)
    for (rows, pixels), at in zip(stage.batches(), stage.looks(), strict=True):
        more_normal, more_right = light_sums(at.view, pixels, at.precision)
        normal += more_normal.reshape(-1, cameras, *normal.shape[1:]).sum(0)
        right += more_right.reshape(-1, cameras, 2 * basis).sum(0)
        inside = pixels.inside & stage.use[rows].reshape(-1, 1)
        greys.append(((pixels.grey - at.residual)[:, some], at.residual[:, some], inside[:, some]))
    difference, black = light_maps(normal, right)
    model, residual, inside = (torch.cat(part) for part in zip(*greys, strict=True))
    curves = [noise_curve(model[c::cameras], residual[c::cameras], inside[c::cameras]) for c in range(cameras)]
    light = Light(difference=difference, black=black, noise=torch.stack(curves), known=True)
    return replace(stage, fitter=replace(stage.fitter, light=light))


def rescaled(stage: Stage) -> Stage:
    """Bring black and white paint to 0 and 1: pictures alone do not tell a dark light from dark paint."""
    values, order = stage.texture.reshape(-1).sort()
    share = texel_areas(len(stage.texture)).reshape(-1)[order].cumsum(0)
    low, high = (float(values[int((share < part * share[-1]).sum())]) for part in (BLACK, WHITE))
    step = max(high - low, 1e-3)
    light = stage.fitter.light
    if light.known:  # the light takes over what the paint loses, and no picture changes
        light = replace(light, difference=light.difference * step, black=light.black + light.difference * low)
    return replace(stage, texture=(stage.texture - low) / step, fitter=replace(stage.fitter, light=light))


def better_blur(stage: Stage) -> float:
    """Return the blur, of the present one and its neighbours, with which limb and slanted paint fit best, px."""
    rows = spread(torch.arange(len(stage.use)), BLUR_FRAMES)
    pixels = stage.disks(rows)
    tried = [stage.blur_px * BLUR_RATIO**k for k in (-1, 0, 1)]
    expected = stage.look(rows, pixels, stage.blur_px)
    left = []
    for blur_px in tried:
        at = stage.look(rows, pixels, blur_px)
        left.append(float((expected.weight * (at.residual.square() / expected.variance).clamp_max(OUTLIER2)).sum()))
    bend = left[0] - 2 * left[1] + left[2]
    shift = 0.5 * (left[0] - left[2]) / bend if bend > 0 else (1.0 if left[2] < left[0] else -1.0)
    best = float(stage.blur_px * BLUR_RATIO ** min(max(shift, -1.0), 1.0))
    return min(max(best, BLUR_PX[0]), BLUR_PX[1])


def together(stage: Stage, smooth: float) -> Stage:
    """Move all poses by one joint step, in which the map may give way; ties as in `joint_step`, by typical weights.

    The map itself is left to `with_map`, which is exact at any poses: moved along its slopes it would be damaged, and
    the next step would only repair it.
    """
    height = len(stage.texture)
    parts, weight = [], np.zeros(2 * height * height)
    for at in stage.looks():
        parts.append(part_of(at, height))
        weight += np.asarray(parts[-1].look_up.power(2).sum(0)).ravel()
    longest = (LONGEST_SHARE, LONGEST_SHARE * stage.fitter.radius_mm)
    tie = smooth * typical(weight)
    step = joint_step(parts, stage.use, stage.texture, tie, longest, STEPS, stage.fixed)
    shorter = (LONGEST_RAD / step.pose[:, :3].norm(dim=1).max().clamp_min(1e-9)).clamp_max(1.0)
    pose = step.pose * shorter
    return replace(
        stage,
        position_lab_mm=stage.position_lab_mm + pose[:, 3:],
        R_lab_body=so3.nearest_rotation(so3.exp(pose[:, :3]) @ stage.R_lab_body),
    )


def with_map(stage: Stage, smooth: float) -> tuple[Stage, float]:
    """Solve for the map at the poses as they are, ties as in `solve_map`, by typical weights; and tell the misfit."""
    height = len(stage.texture)
    texels = 2 * height * height
    parts, right = [], np.zeros(texels)
    tally = _Tally()
    for at in stage.looks():
        root = at.precision.sqrt()
        parts.append(look_ups(at, at.step * root * (at.depth > DEPTH_MIN), texels))
        right += parts[-1].T @ (at.residual * root).reshape(-1).numpy()
        tally.add(at)
    normal = Gram(vstack(parts, format="csr"))
    tie = smooth * typical(normal.diagonal())
    # The whole map is tied, not the correction alone: else noise would grow from round to round.
    right -= tie * (stiffness(height) @ stage.texture.double().numpy().ravel())
    texture = stage.texture + solve_map(normal, right, height, tie).float()
    return replace(stage, texture=texture.clamp(-BEYOND, 1 + BEYOND)), tally.misfit


def map_weight(stage: Stage) -> Tensor:
    """Sum of the weights with which pixels tell each texel, (H, 2 H) float64, one over paint squared."""
    height = len(stage.texture)
    total = np.zeros(2 * height * height)
    for at in stage.looks():
        factor = at.step * at.precision.sqrt() * (at.depth > DEPTH_MIN)
        total += np.asarray(look_ups(at, factor, len(total)).power(2).sum(0)).ravel()
    return torch.from_numpy(total.reshape(height, -1))


def typical(weight: NDArray[np.float64]) -> float:
    """The weight of a typical texel that is seen at all."""
    return float(np.median(weight[weight > 0])) if (weight > 0).any() else 1.0


class _Tally:
    """Mean square of the residuals over the noise expected."""

    def __init__(self) -> None:
        self._sum, self._count = 0.0, 0.0

    def add(self, at: Look) -> None:
        self._sum += float((at.precision * at.residual.square()).sum())
        self._count += float((at.precision * at.variance).sum())

    @property
    def misfit(self) -> float:
        return self._sum / max(self._count, 1e-9)
