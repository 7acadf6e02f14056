"""Pose to hundredths of a degree: Gauss-Newton on rotation and position of all cameras at once, light eliminated.
Pixels of occluders (bubbles, specks, a rod, an unknown glint) are found as connected large residuals and not used.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import sphere_disk_px
from sphereorient.pose.camera_view import CameraView, FrameDisks
from sphereorient.pose.model import SphereModel, by_pose
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses, PoseStart, moved_to
from sphereorient.pose.residuals import (
    EDGE_PX,
    Residuals,
    disk_sums,
    loss_of,
    noise_variance,
    residuals,
    robust_deviation,
    scores_of,
    tile_scores,
)
from sphereorient.so3 import inverse_damped, solve_damped

Singles = NDArray[np.float32]
Indices = NDArray[np.int64]

WINDOW_PX = 5  # over which squared residuals are averaged: noise of single pixels stays below the limit
MOST_EACH = 25.0  # limit of one pixel's square, variances: a single outlier is no occluder; robust weights remove it
# Mean of a window, in variances of the disk's residuals: at most 5 to 8 for paint with learnt light, along edges and
# the limb; 16 to 25 for bubbles and specks.
COVERED = 10.0
LEAST_OF_WINDOW = 0.5 * WINDOW_PX**2  # pixels
MARGIN_PX = 3  # around the middles of such windows: the occluder's blurred border
MOST_HIDDEN = 0.5  # of a disk; if more differs, pose or light is wrong, and all pixels are used
# Share in half of the pictures: bubbles 0.03, a rod 0.07, a map warped by 3 degrees 0.22. Above: the model is wrong.
USUALLY_HIDDEN = 0.15
# Longest steps of a settled fit: rad; blurs at the disk's middle; blurs below NARROW_PX. With so narrow a blur edges
# fall between pixels: robust weights drop what is off by a pixel, and steps are too short.
NEAR_RAD, NEAR_BLURS, NEAR_NARROW, NARROW_PX = 0.006, 0.4, 0.15, 0.5
FIRST_EVERY = 4  # the first step of a fit uses every fourth pixel
MORE = 2, 3  # further iterations after a long step: with some pixels, with all
AGAIN = 3  # repetitions of a fit whose last step is long
HOPELESS = 0.2  # score below which a fit is not repeated: far from any pose


def occluded(pixels: Pixels, expected: Tensor, noise: Tensor, counted: Tensor, most: float) -> Tensor:
    """Return the pixels that show something in front of the sphere, (L, P) bool.

    Args:
        pixels: of L disks, all places of their stencil.
        expected: grey levels by the model, (L, P).
        noise: coefficients of the noise's variance, (L, 4); see `Light`.
        counted: (L, P) bool, pixels with valid residuals.
        most: share of a disk; if more of it differs, none of its pixels is returned.
    """
    residual = pixels.grey - expected
    variance = noise_variance(expected, noise)
    own = variance * robust_deviation(residual, variance, counted).clamp_min(1.0)[:, None].square()
    differs = (residual.square() / own).clamp_max(MOST_EACH) * counted
    right, down = (pixels.place - pixels.place.amin(1, keepdim=True)).cpu().numpy()
    disks = zip(_array(differs), _array(counted), strict=True)
    covered = np.array([_covered(*disk, down, right) for disk in disks], bool).reshape(differs.shape)
    hidden = torch.from_numpy(covered).to(counted.device)
    share = (hidden & counted).sum(-1) / counted.sum(-1).clamp_min(1)
    return hidden & (share <= most)[:, None]


def kept(pixels: Pixels, begin: PoseStart, model: SphereModel, most: float) -> Tensor:
    """Return the used places of B * C disks, (B * C, P) bool, without occluders at the given poses."""
    at = residuals(pixels, begin.position_lab_mm.double(), begin.R_lab_body.double(), None, model)
    counted = at.inside & ~pixels.clipped
    hidden = occluded(pixels, at.model, model.light.noise.repeat(len(begin.use), 1), counted, most)
    return pixels.inside & ~hidden


def _covered(differs: Singles, counted: Singles, down: Indices, right: Indices) -> NDArray[np.bool_]:
    """Return which places (P,) of a disk lie near a window that differs."""
    grids = np.zeros((2, down.max() + 1, right.max() + 1), np.float32)
    grids[:, down, right] = differs, counted
    window = (WINDOW_PX, WINDOW_PX)
    sums = [cv2.boxFilter(grid, cv2.CV_32F, window, normalize=False, borderType=cv2.BORDER_CONSTANT) for grid in grids]
    # Windows at the stencil's border have too few pixels.
    seeds = sums[0] > COVERED * np.maximum(sums[1], LEAST_OF_WINDOW)
    about = np.ones((2 * MARGIN_PX + 1, 2 * MARGIN_PX + 1), np.uint8)
    covered: NDArray[np.bool_] = cv2.dilate(seeds.astype(np.uint8), about)[down, right] > 0
    return covered


def _array(part: Tensor) -> Singles:
    array: Singles = part.to(torch.float32).cpu().numpy()
    return array


@dataclass(frozen=True, kw_only=True, eq=False)
class _Last:
    """The last step of a fit of B poses in C cameras."""

    step: Tensor  # (B, 6)
    whole: Tensor  # (B, 6, 6), information by all cameras in use and the prior position
    information: Tensor  # (B, C, 6, 6)
    pull: Tensor  # (B, C, 6)
    shared: Tensor  # (B, C, 6, 6), from the scores of tiles
    to_centre: Tensor  # (B, C, 3), mm, from the camera, after the step
    paint_step: Tensor  # (B, C), median grey levels from black to white paint


def refine(
    pixels: Pixels, begin: PoseStart, model: SphereModel, iterations: int = 4, most_hidden: float = 0.0
) -> FittedPoses:
    """Fit poses to pictures: robust Gauss-Newton, the light's coefficients eliminated in every step.
    `pixels` holds B * C disks, the cameras of a pose side by side; `iterations` is at least 1. Pixels of occluders at
    the first pose are not used; `most_hidden`: share of a disk, see `occluded`. The covariance is robust, with errors
    shared within tiles. All results but the pose belong to the pose before the last step.
    Source: variable projection, Golub and Pereyra 1973; covariance from clustered scores, Liang and Zeger 1986.
    """
    cameras, seen = begin.use.shape[1], begin.use.double()
    start, R = begin.position_lab_mm.double(), begin.R_lab_body.double()
    X = start
    if most_hidden > 0:
        pixels = replace(pixels, inside=kept(pixels, begin, model, most_hidden))
    origin = by_pose(pixels.origin[..., 0].double(), cameras)
    state: tuple[Tensor, Tensor] | None = None
    for _ in range(iterations):
        at = residuals(pixels, X, R, state, model)
        state = at.model, at.weight
        *sums, mixed = disk_sums(at)
        information, pull = (by_pose(part, cameras) for part in sums)
        whole = (information * seen[..., None, None]).sum(1)
        force = (pull * seen[..., None]).sum(1)
        if begin.place_precision is not None:
            whole[:, 3:, 3:] += begin.place_precision
            force[:, 3:] -= (begin.place_precision @ (X - start)[..., None])[..., 0]
        step = _bounded(solve_damped(whole, force), X[:, None] - origin, seen, model.radius_mm)
        R = so3.exp(step[:, :3]) @ R
        X = X + step[:, 3:]
    tiles = tile_scores(at, mixed, pixels.tile)  # errors of neighbouring pixels are correlated
    # Residuals are smaller than errors: correction for few clusters (Cameron and Miller 2015, CR1).
    few = tiles.shape[2] / max(tiles.shape[2] - 6 - sum(model.shading.counts), 1)
    last = _Last(
        step=step,
        whole=whole,
        information=information,
        pull=pull,
        shared=by_pose(few * (tiles @ tiles.mT), cameras),
        to_centre=X[:, None] - origin,
        paint_step=by_pose(at.lit[:, : pixels.inner].double().median(-1).values, cameras),
    )
    return FittedPoses(
        position_lab_mm=X,
        R_lab_body=R,
        covariance=_covariance(last, pixels, begin, model),
        **_by_each(last, model.radius_mm),
        limb_coverage=by_pose(_limb_coverage(at, pixels, last.to_centre.flatten(0, 1), model), cameras),
        score=by_pose(scores_of(at, pixels).double(), cameras),
        nll=(by_pose(loss_of(at, pixels.inside), cameras) * seen).sum(1),
        step=step,
    )


def _by_each(last: _Last, radius_mm: float) -> dict[str, Tensor]:
    """Return the estimates by each camera alone; see `FittedPoses`."""
    information, pull, step, shared = last.information, last.pull, last.step, last.shared
    by_move = (information[..., :3, 3:] @ step[:, None, 3:, None])[..., 0]
    turn = solve_damped(information[..., :3, :3], pull[..., :3] - by_move) - step[:, None, :3]
    freely = inverse_damped(information)
    freed = ((freely @ pull[..., None])[..., 0] - step[:, None]).flatten(0, 1)
    alone = _bounded(freed, last.to_centre.flatten(0, 1)[:, None], freed.new_ones(len(freed), 1), radius_mm)
    own_bread = inverse_damped(information[..., :3, :3])
    own_covariance = own_bread @ shared[..., :3, :3] @ own_bread
    sight = torch.nn.functional.normalize(last.to_centre, dim=-1)[..., None]
    place = (freely @ shared @ freely)[..., 3:, 3:]
    across = so3.trace(place) - (sight.mT @ place @ sight)[..., 0, 0]
    return {
        "own_turn": turn,
        "own_move": by_pose(alone[:, 3:], shared.shape[1]),
        "own_covariance": own_covariance,
        "own_sigma_mm": (across.clamp_min(0) / 2).sqrt(),
        "excess": (so3.trace(own_covariance) / so3.trace(own_bread).clamp_min(1e-30)).sqrt(),
    }


def _covariance(last: _Last, pixels: Pixels, begin: PoseStart, model: SphereModel) -> Tensor:
    """Return the covariance of the poses, (B, 6, 6), from the scores of tiles, the limb's position, and stray light."""
    cameras, seen, to_centre = begin.use.shape[1], begin.use.double(), last.to_centre
    meat = (last.shared * seen[..., None, None]).sum(1)
    if begin.place_precision is not None:  # the prior position has its own error
        meat[:, 3:, 3:] += begin.place_precision
    bread = inverse_damped(last.whole)
    # An edge that is off by a pixel moves the sphere along each line of sight.
    distance = to_centre.flatten(0, 1).norm(dim=-1, keepdim=True)
    px_mm = by_pose(pixels.pitch_mm[:, None] + pixels.pitch_rad[:, None] * distance, cameras)
    edge = to_centre * (px_mm / model.radius_mm) * seen[..., None]
    lured = (bread[:, None] @ last.information[..., 3:] @ edge[..., None])[..., 0]
    covariance = bread @ meat @ bread + EDGE_PX**2 * lured.mT @ lured
    if model.limb_px is not None:
        found = (model.limb_px[:, None].to(lured) * lured).sum(1)[..., None]
        covariance = covariance + found @ found.mT
    finest_mm = px_mm[..., 0].masked_fill(~begin.use, math.inf).amin(1).nan_to_num(0.0, 0.0, 0.0)
    # The limb's shift if stray light were neglected: stray light is hardly known better.
    stray = model.light.stray.double()
    share = stray.square() @ stray.new_tensor([1.0] + [0.5] * (stray.shape[1] - 1))  # mean square over the angle
    aside_px = (model.blur_px * share.sqrt() / last.paint_step.clamp_min(1.0) * seen).amax(1)
    aside_mm = (aside_px * finest_mm)[:, None].expand(-1, 3)
    covariance = covariance + torch.diag_embed(torch.cat([aside_mm / model.radius_mm, aside_mm], dim=1).square())
    any_seen = (last.whole.diagonal(dim1=-2, dim2=-1) > 0).all(-1)  # without any picture the inverse is huge
    return torch.where(any_seen[:, None, None], 0.5 * (covariance + covariance.mT), bread)


def _bounded(step: Tensor, to_centre: Tensor, seen: Tensor, radius_mm: float) -> Tensor:
    """Shorten steps (B, 6) to 0.1 radii in the picture, or the same share of the distance along the line of sight."""
    distance = to_centre.norm(dim=-1, keepdim=True).clamp_min(radius_mm)
    move, sight = step[:, None, 3:], to_centre / distance
    along = (move * sight).sum(-1, keepdim=True)
    across = (move - along * sight).norm(dim=-1) / radius_mm
    seen_change = torch.hypot(across, (along / distance)[..., 0]) * seen
    size = torch.maximum(step[:, :3].norm(dim=-1), seen_change.amax(1))
    return step * (0.1 / size.clamp_min(0.1))[:, None]


def _limb_coverage(at: Residuals, pixels: Pixels, to_centre: Tensor, model: SphereModel) -> Tensor:
    """Return the share of the limb of L disks whose pixels are used, (L,): picture border, masks, occluders, shadow and
    unknown paint reduce it. `to_centre` (L, 3), mm.
    """
    limb = (at.view.coverage_by_position.norm(dim=1) * (at.weight > 0)).double().sum(-1)  # 1/mm
    distance = to_centre.norm(dim=-1)
    px_mm = pixels.pitch_mm + pixels.pitch_rad * distance
    place_px2 = (
        math.pi * float(pixels.place[:, -1].square().sum()) / pixels.place.shape[1]
    )  # area that one pixel represents
    # That of a whole disk on the camera's axis: the picture of a near ball is larger than its angle.
    whole = 2 * math.pi * model.radius_mm / px_mm.square() / (1 - (model.radius_mm / distance).square()).square()
    share: Tensor = (place_px2 * limb / whole).clamp_max(1.0)
    return share


def disks(views: Sequence[CameraView], position_lab_mm: Tensor, radius_mm: float) -> tuple[Tensor, Tensor]:
    """Return middles (C, B, 2) and radii (C, B), px, of the disks of spheres at (B, 3), mm, in C views."""
    each = [sphere_disk_px(view.camera, position_lab_mm, radius_mm) for view in views]
    middles, radii = zip(*each, strict=True)
    return torch.stack(middles), torch.stack(radii)


def settle(
    disks: FrameDisks, begin: PoseStart, model: SphereModel, instants: int, most_hidden: float, first: bool
) -> tuple[FittedPoses, Tensor]:
    """Fit B poses to their disks; `first`: with every `FIRST_EVERY`-th pixel before.
    Return also which poses moved far, (B,) bool: they are not fitted further; cut their disks out anew.
    """
    pixels = moved_to(begin.R_lab_body.device, disks.pixels().exposed(begin.moved, instants))
    some, more = further_steps(model)
    if not first:
        fit, far = _step(pixels, begin, model, more, most_hidden)
        return fit, torch.zeros_like(far)
    near, far = _step(pixels.thinned(FIRST_EVERY), begin, model, some)
    return near.where(far, _step(pixels, begin.after(near), model, more, most_hidden)[0]), far


def longest_near_rad(blur_px: float, radius_px: float) -> float:
    """Return the longest step, rad, after which a fit to a disk of this radius and blur, px, counts as settled."""
    share = NEAR_BLURS if blur_px > NARROW_PX else NEAR_NARROW
    return min(NEAR_RAD, share * blur_px / max(radius_px, 1.0))


def further_steps(model: SphereModel) -> tuple[int, int]:
    """Return the numbers of further iterations after a long step, with some pixels and with all."""
    some, more = (math.ceil(count * max(1.0, NEAR_RAD / model.near_rad)) for count in MORE)
    return some, more


def _step(
    pixels: Pixels, begin: PoseStart, model: SphereModel, more: int, most_hidden: float = 0.0
) -> tuple[FittedPoses, Tensor]:
    """Take one step, and `more` where it was long; return also where it was long, (B,) bool."""
    use = begin.use
    if begin.place_precision is not None and not begin.held:
        # Two cameras determine the position; for one alone the prior distance is better.
        precision = torch.where(use.all(1)[:, None, None], 0.0, begin.place_precision)
        begin = replace(begin, place_precision=precision)
    fit = refine(pixels, begin, model, 1, most_hidden)
    turn, move = fit.step[:, :3].norm(dim=-1), fit.step[:, 3:].norm(dim=-1)
    # Distances by one camera scatter; a real change of its picture also changes the rotation.
    far = (turn > model.near_rad) | ((use.sum(1) > 1) & (move > model.near_rad * model.radius_mm))
    if bool(far.any()):
        fit = refine(pixels, begin.after(fit), model, more, most_hidden).where(far, fit)
    return fit, far
