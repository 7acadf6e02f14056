"""From footage to what is compared: normalised disks without a map, pixels with one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from sphereorient.cameras import R_cam_view
from sphereorient.mapping.disks import Disks, even_disks
from sphereorient.mapping.footage import Footage
from sphereorient.mapping.settings import PaintSettings
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.pixels import Pixels, stacked
from sphereorient.search.crop import crop_disk

SHOWN_MIN = 0.99  # share of a disk's pixel that nothing hides, below which it does not count
FAR_RADII = 50.0  # of a camera that does not see the ball: any distance does


def disks_of(footage: Footage, frames: Tensor, settings: PaintSettings) -> Disks:
    """Cut the normalised disks of some frames (M,) out of the footage."""
    size, count, cameras = settings.disk_px, len(frames), len(footage.views)
    pictures = torch.zeros(count, cameras, size, size)
    hidden = any(view.background.shown is not None for view in footage.views)
    shown = torch.ones(count, cameras, size, size) if hidden else None
    R = torch.eye(3, dtype=torch.float64).repeat(count, cameras, 1, 1)
    far = torch.full((count, cameras), FAR_RADII, dtype=torch.float64)
    X = footage.position_lab_mm[frames]
    for c, view in enumerate(footage.views):
        camera = view.camera
        in_camera = X @ camera.R_cam_lab.mT + camera.T_cam_lab_mm
        far[:, c] = in_camera.norm(dim=-1) / footage.radius_mm
        R[:, c] = camera.R_cam_lab.mT @ R_cam_view(in_camera)
        # The limb lies a little before the great circle that `radius_px` measures.
        limb = view.radius_px(X, footage.radius_mm) / (1 - far[:, c] ** -2).clamp_min(1e-3).sqrt()
        middle = camera.project(X)
        for k, frame in enumerate(frames.tolist()):
            window = footage.windows[c][frame]
            if window is not None and bool(footage.seen[frame, c]):
                u, v = float(middle[k, 0]) - window.left, float(middle[k, 1]) - window.top
                pictures[k, c] = torch.from_numpy(crop_disk(window.grey, u, v, float(limb[k]), size))
                if shown is not None and view.background.shown is not None:
                    whole = view.background.shown.astype(np.uint8)
                    told = crop_disk(whole, float(middle[k, 0]), float(middle[k, 1]), float(limb[k]), size)
                    shown[k, c] = torch.from_numpy(told) > SHOWN_MIN
    return even_disks(pictures, R, far, footage.seen[frames], settings.detail, settings.window, shown)


def pixels_of(footage: Footage, fitter: Fitter, frames: Tensor, wanted: int, extra_px: float = 0.0) -> Pixels:
    """Cut the disks' pixels out, frame by frame, of each disk about as many as wanted, the picture blurred first."""
    level = replace(fitter.optics.fine, extra_px=extra_px)
    X = footage.position_lab_mm[frames]
    radius_px = float(fitter.largest_px(X).max())
    parts = []
    for k in range(len(frames)):
        whole = fitter.pixels(footage.pictures(frames[k : k + 1]), X[k : k + 1], level, radius_px)
        parts.append(whole.thinned(max(1, round(whole.grey.shape[1] / wanted))))
    return stacked(parts)
