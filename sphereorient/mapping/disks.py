"""The ball's disks freed of light, with their slopes: what pictures are compared by as long as there is no map."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from sphereorient.search.normalisation import Blur, rim_share
from sphereorient.sphere.view import disk_offsets, perspective_view

DEEPEST = 1e6  # radii: from there a perspective view is an orthographic one


@dataclass(frozen=True, kw_only=True, eq=False)
class Disks:
    """Evened disks of N instants and C cameras; made by `even_disks`, read by the comparison of pairs.

    A disk's picture is (S, S), the limb touching its edges; its view frame is x right, y down, z to the ball.
    """

    layers: Tensor  # (N, C, 3, S, S) float32: normalised grey, its slope to the right and down, per radius
    share: Tensor  # (S, S), 0 at the limb .. 1
    R_lab_view: Tensor  # (N, C, 3, 3) float32
    distance_radii: Tensor  # (N, C), of the camera from the centre
    seen: Tensor  # (N, C) bool, disks that there are
    shown: Tensor | None = None  # (N, C, S, S) float32, 0 where something hides the ball .. 1; None: nowhere

    def __len__(self) -> int:
        """Return the number of instants."""
        return len(self.layers)

    def where(self, rows: Tensor) -> Disks:
        """Return some of the instants."""
        shown = None if self.shown is None else self.shown[rows]
        names = ("layers", "R_lab_view", "distance_radii", "seen")
        return Disks(share=self.share, shown=shown, **{name: getattr(self, name)[rows] for name in names})

    def told(self, rows: Tensor, camera: int) -> Tensor:
        """Return how much each place of some disks counts, (R, S * S)."""
        counts = self.seen[rows, camera][:, None] * torch.ones(self.size_px**2)
        return counts if self.shown is None else counts * self.shown[rows, camera].flatten(1)

    @property
    def size_px(self) -> int:
        """Side of the pictures, px."""
        return self.layers.shape[-1]


def even_disks(
    pictures: Tensor,
    R_lab_view: Tensor,
    distance_radii: Tensor,
    seen: Tensor,
    detail: float,
    window: float,
    shown: Tensor | None = None,
) -> Disks:
    """Even the disks of a movie.

    Args:
        pictures: (N, C, S, S), grey levels of any scale; what is not seen may hold anything finite.
        R_lab_view: (N, C, 3, 3).
        distance_radii: (N, C), above 1.
        seen: (N, C) bool.
        detail: standard deviation of the Gaussian laid over the pictures first, radii.
        window: standard deviation of the neighbourhood over which light is taken to be even, radii.
        shown: (N, C, S, S), 0 where something hides the ball .. 1; None: nowhere.

    Returns:
        The disks: each place's difference from its neighbourhood over that neighbourhood's own deviation, so that
        what is lit dimly counts like what is lit well.
    """
    size = pictures.shape[-1]
    share = rim_share(size)
    fine, wide = Blur(size, detail), Blur(size, window)
    flat = pictures.reshape(-1, size, size).float()
    if shown is not None:  # what hides the ball is taken to be as bright as the ball is on the whole
        part = shown.reshape(-1, size, size)
        inside = part * share
        usual = (flat * inside).sum((1, 2), keepdim=True) / inside.sum((1, 2), keepdim=True).clamp_min(1e-6)
        flat = usual + (flat - usual) * part
    rough = fine(flat) - wide(flat)
    whole = (rough.square() * share).sum((1, 2), keepdim=True) / share.sum()
    # A neighbourhood of one paint has no deviation of its own: half of the disk's keeps its noise small.
    local = (wide(rough.square()) + 0.25 * whole).sqrt().clamp_min(1e-12)
    even = (rough / local).clamp(-3.0, 3.0) * seen.reshape(-1, 1, 1)
    padded = F.pad(even[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    right = (padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]) * (size / 4)
    down = (padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]) * (size / 4)
    layers = torch.stack([even, right, down], dim=1).reshape(*pictures.shape[:2], 3, size, size)
    return Disks(
        layers=layers,
        share=share,
        R_lab_view=R_lab_view.float(),
        distance_radii=distance_radii.float().clamp(1.01, DEEPEST),
        seen=seen,
        shown=shown,
    )


def reduced(disks: Disks, factor: int) -> Disks:
    """Return the same with pictures smaller by a whole factor."""
    size = disks.size_px // factor
    even = F.avg_pool2d(disks.layers[:, :, 0], factor)
    padded = F.pad(even, (1, 1, 1, 1), mode="replicate")
    right = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) * (size / 4)
    down = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) * (size / 4)
    return Disks(
        layers=torch.stack([even, right, down], dim=2),
        share=rim_share(size),
        R_lab_view=disks.R_lab_view,
        distance_radii=disks.distance_radii,
        seen=disks.seen,
        shown=None if disks.shown is None else F.avg_pool2d(disks.shown, factor),
    )


def view_normals(size_px: int, distance_radii: float, every: int = 1) -> tuple[Tensor, Tensor]:
    """Return the normals (3, P) float32, view frame, and shares (P,) of a disk's pixels, every so-many-th of them."""
    view = perspective_view(size_px, distance_radii)
    normal, share = view.normal_view.T.float(), rim_share(size_px)[view.inside]
    place = torch.nonzero(view.inside.reshape(-1))[:, 0]
    chosen = (place // size_px + place % size_px) % every == 0
    return normal[:, chosen].contiguous(), share[chosen]


def disk_places(normal_view: Tensor, distance_radii: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Project directions onto a disk.

    Args:
        normal_view: (..., 3, P) unit, view frame.
        distance_radii: (...).

    Returns:
        Places (..., 2, P) in radii of the disk, their derivative by the direction as its factors (..., 1, P) for x and
        y alike and by z (..., 2, P), all to be used with `depth` > 0; and the cosine `depth` (..., P) under which the
        camera sees the place, not positive where it does not.
    """
    D = distance_radii[..., None, None]
    x_y, z = normal_view[..., :2, :], normal_view[..., 2:, :]
    scale = (D.square() - 1).sqrt() / (D + z)
    place = x_y * scale
    # Seen where the outward normal looks at the camera, which is D away along -z.
    depth = (-z - 1 / D) / (1 - 1 / D)
    return place, scale, depth[..., 0, :]


def offsets(size_px: int) -> Tensor:
    """Places of the pixels in radii, (S, S, 2) as (right, down)."""
    return disk_offsets(size_px)
