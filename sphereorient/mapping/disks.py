"""Locally normalised disks of the sphere with their slopes, to compare pictures before there is a map."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from sphereorient.cameras import R_cam_view
from sphereorient.mapping.crops import Crops
from sphereorient.mapping.settings import MapSettings
from sphereorient.search.normalisation import Blur, crop_disk, rim_share
from sphereorient.sphere.view import perspective_view

SHOWN_MIN = 0.99  # visible share of a disk's pixel below which it does not count
DEEPEST = 1e6  # radii: from there a perspective view is an orthographic one


@dataclass(frozen=True, kw_only=True, eq=False)
class Disks:
    """Normalised disks (S, S), limb at the edges, of N instants, C cameras; view: x right, y down, z to the sphere."""

    layers: Tensor  # (N, C, 3, S, S) float32: normalised grey, its slope to the right and down, per radius
    share: Tensor  # (S, S), weight of a pixel, 0 at the limb .. 1
    R_lab_view: Tensor  # (N, C, 3, 3) float32
    distance_radii: Tensor  # (N, C), of the camera from the centre
    seen: Tensor  # (N, C) bool
    shown: Tensor | None = None  # (N, C, S, S) float32, 0 where something hides the ball .. 1; None: nothing does

    def __len__(self) -> int:
        return len(self.layers)

    def where(self, rows: Tensor | slice, cameras: slice = slice(None)) -> "Disks":
        """Select instants and cameras."""
        shown = None if self.shown is None else self.shown[rows, cameras]
        names = ("layers", "R_lab_view", "distance_radii", "seen")
        return Disks(share=self.share, shown=shown, **{name: getattr(self, name)[rows, cameras] for name in names})

    def weight(self, rows: Tensor | slice, camera: int) -> Tensor:
        """Return pixel weights (R, S * S) of some disks: 0 where not seen or hidden."""
        counts = self.seen[rows, camera][:, None] * torch.ones(self.size_px**2)
        return counts if self.shown is None else counts * self.shown[rows, camera].flatten(1)

    def sampled(
        self, rows: Tensor | slice, camera: int, every: int = 1, slant_power: int = 1
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return each n-th (`every`) pixel of disks (R,): view directions (3, P), grey (R, P), weight (R, P).

        Weights are multiplied by the slant's cosine to the power `slant_power`.
        """
        far, size = self.distance_radii[:, camera].median(), self.size_px
        view = perspective_view(size, float(far))
        pixel = torch.nonzero(view.inside.reshape(-1))[:, 0]
        chosen = (pixel // size + pixel % size) % every == 0
        normal, share = view.normal_view.T.float()[:, chosen].contiguous(), self.share[view.inside][chosen]
        place, _, depth = disk_places(normal, far)
        at = ((place + 1) * (size / 2) - 0.5).round().long()
        cell = at[1] * size + at[0]
        grey = self.layers[rows, camera, 0].flatten(1)[:, cell]
        weight = (share * depth.clamp_min(0) ** slant_power)[None] * self.weight(rows, camera)[:, cell]
        return normal, grey, weight

    @property
    def size_px(self) -> int:
        """Side of the pictures, px."""
        return self.layers.shape[-1]


def disks_of(crops: Crops, frames: Tensor, settings: MapSettings) -> Disks:
    """Cut and normalise the disks of some frames (M,)."""
    size, count, cameras = settings.disk_px, len(frames), len(crops.views)
    pictures = torch.zeros(count, cameras, size, size)
    hidden = any(view.background.shown is not None for view in crops.views)
    shown = torch.ones(count, cameras, size, size) if hidden else None
    R, far = torch.empty(count, cameras, 3, 3).double(), torch.empty(count, cameras).double()
    X = crops.position_lab_mm[frames]
    for c, view in enumerate(crops.views):
        camera = view.camera
        in_camera = X @ camera.R_cam_lab.mT + camera.T_cam_lab_mm
        far[:, c] = in_camera.norm(dim=-1) / crops.radius_mm
        R[:, c] = camera.R_cam_lab.mT @ R_cam_view(in_camera)
        # The limb lies slightly before the great circle of `radius_px`.
        limb = view.radius_px(X, crops.radius_mm) / (1 - far[:, c] ** -2).clamp_min(1e-3).sqrt()
        middle = camera.project(X)
        for k, frame in enumerate(frames.tolist()):
            crop = crops.crops[c][frame]
            if crop is None or not bool(crops.seen[frame, c]):
                continue
            u, v, radius_px = float(middle[k, 0]), float(middle[k, 1]), float(limb[k])
            pictures[k, c] = torch.from_numpy(crop_disk(crop.grey, u - crop.left, v - crop.top, radius_px, size))
            if shown is not None and view.background.shown is not None:
                visible = crop_disk(view.background.shown.astype(np.uint8), u, v, radius_px, size)
                shown[k, c] = torch.from_numpy(visible) > SHOWN_MIN
    return normalised_disks(pictures, R, far, crops.seen[frames], settings, shown)


def normalised_disks(
    pictures: Tensor,
    R_lab_view: Tensor,
    distance_radii: Tensor,
    seen: Tensor,
    settings: MapSettings,
    shown: Tensor | None = None,
) -> Disks:
    """Return disks of pictures (N, C, S, S), any finite grey: difference from the local mean over the local deviation.

    R_lab_view (N, C, 3, 3), distance_radii (N, C) above 1, seen (N, C) bool, shown (N, C, S, S) 0 hidden .. 1, None: 1.
    """
    size = pictures.shape[-1]
    share = rim_share(size)
    fine, wide = Blur(size, settings.detail), Blur(size, settings.window)
    flat = pictures.reshape(-1, size, size).float()
    if shown is not None:  # fill what is hidden with the ball's mean grey
        part = shown.reshape(-1, size, size)
        inside = part * share
        usual = (flat * inside).sum((1, 2), keepdim=True) / inside.sum((1, 2), keepdim=True).clamp_min(1e-6)
        flat = usual + (flat - usual) * part
    rough = fine(flat) - wide(flat)
    whole = (rough.square() * share).sum((1, 2), keepdim=True) / share.sum()
    # Add half of the disk's deviation: in uniform texture the local one would amplify noise.
    local = (wide(rough.square()) + 0.25 * whole).sqrt().clamp_min(1e-12)
    even = (rough / local).clamp(-3.0, 3.0) * seen.reshape(-1, 1, 1)
    return Disks(
        layers=_with_slopes(even.reshape(pictures.shape)),
        share=share,
        R_lab_view=R_lab_view.float(),
        distance_radii=distance_radii.float().clamp(1.01, DEEPEST),
        seen=seen,
        shown=shown,
    )


def _with_slopes(grey: Tensor) -> Tensor:
    """Stack pictures (N, C, S, S) with their slopes to the right and down, per radius, (N, C, 3, S, S)."""
    size = grey.shape[-1]
    padded = F.pad(grey, (1, 1, 1, 1), mode="replicate")
    right = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) * (size / 4)
    down = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) * (size / 4)
    return torch.stack([grey, right, down], dim=2)


def reduced(disks: Disks, factor: int) -> Disks:
    """Return the disks with pictures reduced by a whole factor."""
    return replace(
        disks,
        layers=_with_slopes(F.avg_pool2d(disks.layers[:, :, 0], factor)),
        share=rim_share(disks.size_px // factor),
        shown=None if disks.shown is None else F.avg_pool2d(disks.shown, factor),
    )


def disk_places(normal_view: Tensor, distance_radii: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return places (..., 2, P), radii, of directions (..., 3, P), view, on a disk seen from a distance (...), radii.

    Return also their derivative by x and y (..., 1, P) and the slant's cosine (..., P), not positive where invisible.
    """
    D = distance_radii[..., None, None]
    x_y, z = normal_view[..., :2, :], normal_view[..., 2:, :]
    scale = (D.square() - 1).sqrt() / (D + z)
    # Visible if the normal points at the camera, D away along -z.
    depth = (-z - 1 / D) / (1 - 1 / D)
    return x_y * scale, scale, depth[..., 0, :]
