"""What covers the sphere (bubbles, specks, a rod, an unknown glint): connected residuals, whose pixels are not used."""

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.pose.model import SphereModel
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import PoseStart
from sphereorient.pose.residuals import noise_variance, residuals, robust_deviation

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

WINDOW_PX = 5  # over which squared residuals are averaged: noise of single pixels does not reach the limit
MOST_EACH = 25.0  # that one pixel counts, variances: a single outlier is no occluder, robust weights drop it
# Mean of a window, in variances of the disk's own scatter. Of paint whose light is learnt: 5 to 8 at most, along edges
# and the limb; of bubbles and specks, 16 to 25.
COVERED = 10.0
LEAST_OF_WINDOW = 0.5 * WINDOW_PX**2  # pixels
MARGIN_PX = 3  # about such windows' middles: the occluder's blurred border
MOST_HIDDEN = 0.4  # of a disk; where more differs, its pose or light is wrong, and all pixels count
# In half of the pictures: bubbles 0.03, a rod 0.07, a map warped by 3 degrees 0.22. Then the model is wrong in all.
USUALLY_HIDDEN = 0.15


def occluded(pixels: Pixels, expected: Tensor, noise: Tensor, counted: Tensor, most: float) -> Tensor:
    """Return the pixels that something before the sphere shows, (L, P) bool.

    Args:
        pixels: of L disks, all places of their stencil.
        expected: grey levels by the model, (L, P).
        noise: coefficients of the noise's variance, (L, 4); see `Light`.
        counted: (L, P) bool, pixels whose residuals tell something.
        most: share of a disk; where more of it differs, no pixel of it is returned.
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
    """Return the places of B * C disks that count, (B * C, P) bool, without those of occluders by the poses given."""
    at = residuals(pixels, begin.position_lab_mm.double(), begin.R_lab_body.double(), None, model)
    counted = at.inside & ~pixels.clipped
    hidden = occluded(pixels, at.model, model.light.noise.repeat(len(begin.use), 1), counted, most)
    return pixels.inside & ~hidden


def _covered(differs: Floats, counted: Floats, down: Indices, right: Indices) -> NDArray[np.bool_]:
    """Return which places (P,) of a disk lie near a window that differs."""
    grids = np.zeros((2, down.max() + 1, right.max() + 1), np.float32)
    grids[:, down, right] = differs, counted
    window = (WINDOW_PX, WINDOW_PX)
    sums = [cv2.boxFilter(grid, cv2.CV_32F, window, normalize=False, borderType=cv2.BORDER_CONSTANT) for grid in grids]
    # At the border of the stencil a few pixels are no window.
    seeds = sums[0] > COVERED * np.maximum(sums[1], LEAST_OF_WINDOW)
    about = np.ones((2 * MARGIN_PX + 1, 2 * MARGIN_PX + 1), np.uint8)
    covered: NDArray[np.bool_] = cv2.dilate(seeds.astype(np.uint8), about)[down, right] > 0
    return covered


def _array(part: Tensor) -> Floats:
    array: Floats = part.to(torch.float32).cpu().numpy()
    return array
