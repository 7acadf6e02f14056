"""A map that grows with every picture: the paint of a ball in cells of directions."""

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from sphereorient.cameras import Camera, R_cam_view, perspective_centre_lab_mm
from sphereorient.files.compiled import compiled, record
from sphereorient.sphere.texture_table import TextureTable, octahedral_cells, octahedral_directions, tangents

SOURCE = Path(__file__).with_suffix("")
Growing = record(SOURCE, "Growing")
LEAST_COSINE = 0.25  # of the slant at which a picture counts
LEAST_WEIGHT = 0.05  # sum of squared cosines; with less a cell is unseen
ASIDE = 1.3  # cells to the neighbours that give the slope
SAMPLES = 9  # along each axis of a disk, for a view's polynomial


@dataclass(frozen=True, kw_only=True, eq=False)
class BallView:
    """A camera's view of a ball at one position: a polynomial from lines of sight to pixels."""

    R_view_lab: Tensor  # (3, 3) float64; view: right, down, towards the camera
    distance_radii: float  # of the camera
    place_px: Tensor  # (2, 10) float64, in the slopes of a line of sight times the distance

    @classmethod
    def of(cls, camera: Camera, position_lab_mm: Tensor, radius_mm: float) -> "BallView":
        """Return the view of a ball at a position (3,), mm."""
        X = position_lab_mm.double()
        in_camera = (X - perspective_centre_lab_mm(camera, X)) @ camera.R_cam_lab.mT
        D = float(in_camera.norm()) / radius_mm
        R = R_cam_view(in_camera).mT @ camera.R_cam_lab
        R[2] *= -1
        at = torch.linspace(-1.0, 1.0, SAMPLES, dtype=torch.float64)
        a, b = (part.reshape(-1) for part in torch.meshgrid(at, at, indexing="ij"))
        points = X + radius_mm * (torch.stack([a, b, torch.zeros_like(a)], dim=-1) @ R)
        # The default driver, gelsy, reads memory that torch does not set: its last bits, even its rank, vary.
        found = torch.linalg.lstsq(_terms(a, b), camera.project(points), driver="gels").solution.mT
        return cls(R_view_lab=R, distance_radii=D, place_px=found.contiguous())


def _terms(a: Tensor, b: Tensor) -> Tensor:
    """Return the terms of polynomials of third order, (..., 10)."""
    return torch.stack([a**0, a, b, a * a, a * b, b * b, a * a * a, a * a * b, a * b * b, b * b * b], dim=-1)


@cache
def _cells(side: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return directions (3, cells), the four cells beside each, and slopes by their differences (cells, 4, 3)."""
    centre = octahedral_directions(side)
    step = ASIDE * math.sqrt(4 * math.pi) / side
    along = tangents(centre)
    near = [centre + sign * step * tangent for tangent in along for sign in (1.0, -1.0)]
    beside = torch.stack([octahedral_cells(one[:, 0], one[:, 1], one[:, 2], side) for one in near], dim=1)
    away = centre[beside] - centre[:, None]
    across = torch.stack([(away * tangent[:, None]).sum(-1) for tangent in along], dim=-1)  # (cells, 4, 2)
    by = torch.linalg.pinv(across, rtol=0.1).mT @ torch.stack(along, dim=1)
    return centre.mT.float().contiguous(), beside.int().contiguous(), by.float().contiguous()


class PaintCells:
    """Mean grey of pictures in cells of directions, and its table for fits. `side`: cells per axis; `blur_rad`: blur of
    the pictures and of the table.
    """

    def __init__(self, side: int, blur_rad: float) -> None:
        self.side = side
        self.weight, self.mean = torch.zeros(side * side), torch.zeros(side * side)
        self._shown = torch.zeros(side * side, dtype=torch.int32)
        self._unseen = TextureTable(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(side * side, 1), blur_rad)
        self.table = TextureTable(torch.zeros(side * side, 4), blur_rad, self._unseen)

    def add(self, view: BallView, grey: Tensor, counts: Tensor, corner: tuple[int, int], R_lab_body: Tensor) -> None:
        """Add a part (H, W) float32 of a picture; `corner`: left, top of its first pixel; `counts` (H, W) bool."""
        turn, place = _seen_from(view, corner, R_lab_body)
        if (code := compiled(SOURCE, Growing)) is None:
            grown, cosine, _ = self._see(view, grey, counts, place, turn)
            shown, weight = cosine > 0, cosine.square()
            self.weight += weight
            self.mean += torch.where(shown, weight / self.weight * (grown - self.mean), 0.0)
            self._write(shown & (self.weight >= LEAST_WEIGHT))
            return
        parts = *_cells(self.side), grey.contiguous(), counts.contiguous(), turn, place
        sums = self.weight, self.mean, self.table.rows, self._unseen.rows, self._shown
        code.grow(ctypes.byref(_growing(view, parts, sums, ())))

    def see(
        self, view: BallView, grey: Tensor, counts: Tensor, corner: tuple[int, int], R_lab_body: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return grey, cosine of the slant (0: not visible) and pixel number of all cells in a part of a picture;
        arguments as of `add`.
        """
        turn, place = _seen_from(view, corner, R_lab_body)
        if (code := compiled(SOURCE, Growing)) is None:
            return self._see(view, grey, counts, place, turn)
        parts = *_cells(self.side), grey.contiguous(), counts.contiguous(), turn, place
        here, cosine = torch.empty(2, self.side**2)
        pixel = torch.empty(self.side**2, dtype=torch.int32)
        code.see(ctypes.byref(_growing(view, parts, (None,) * 5, (here, cosine, pixel))))
        return here, cosine, pixel

    def set(self, mean: Tensor, weight: Tensor) -> None:
        """Replace mean grey and weight of each cell."""
        self.mean, self.weight = mean.clone(), weight.clone()
        self._unseen.rows[:, 0] = 1.0
        self._write(weight >= LEAST_WEIGHT)

    @property
    def normals(self) -> Tensor:
        """Directions of the cells, (cells, 3)."""
        return _cells(self.side)[0].mT

    def sample(self, direction_body: Tensor) -> tuple[Tensor, Tensor]:
        """Return the grey at directions (H, W, 3), and where it is unseen, (H, W) bool."""
        at, shape = direction_body.reshape(-1, 3).float().mT[None], direction_body.shape[:-1]
        grey, unseen = (table.sample(at)[0].reshape(shape) for table in (self.table, self._unseen))
        return grey, unseen > 0.5

    def _write(self, changed: Tensor) -> None:
        """Update the tables in some cells (cells,) bool."""
        _, beside, slope_by = _cells(self.side)
        known = self.weight >= LEAST_WEIGHT
        differs = torch.where(known[beside], self.mean[beside] - self.mean[:, None], 0.0)
        rows = torch.cat([self.mean[:, None], (differs[..., None] * slope_by).sum(1)], dim=1)
        self.table.rows[changed] = rows[changed]
        self._unseen.rows[changed, 0] = 0.0

    def _see(
        self, view: BallView, grey: Tensor, counts: Tensor, place_px: Tensor, turn: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Reference of the compiled code."""
        D, (height, width) = view.distance_radii, grey.shape
        x, y, z = turn @ _cells(self.side)[0]
        cosine = (D * z - 1) / (D * D + 1 - 2 * D * z).sqrt()
        u, v = place_px @ _terms(x * D / (D - z), y * D / (D - z)).mT
        shown = (cosine > LEAST_COSINE) & (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
        column, row = (torch.where(shown, part, 0.0).long() for part in (u, v))
        shown &= counts[row, column] & counts[row, column + 1] & counts[row + 1, column] & counts[row + 1, column + 1]
        right, down = u - column, v - row
        upper, lower = (grey[at, column] + right * (grey[at, column + 1] - grey[at, column]) for at in (row, row + 1))
        pixel = (v + 0.5).long() * width + (u + 0.5).long()
        found = upper + down * (lower - upper), cosine, pixel.int()
        here, cosine, pixel = (torch.where(shown, part, 0) for part in found)
        return here, cosine, pixel


def _seen_from(view: BallView, corner: tuple[int, int], R_lab_body: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rotation from the body to the view (3, 3), and the view's polynomial in a part of the picture."""
    place = view.place_px.clone()
    place[:, 0] -= torch.tensor(corner)
    return (view.R_view_lab @ R_lab_body).float().contiguous(), place.float()


def _growing(
    view: BallView, parts: Sequence[Tensor], sums: Sequence[Tensor | None], seen: Sequence[Tensor]
) -> ctypes.Structure:
    directions, _, _, grey, *_ = parts
    sizes, numbers = (directions.shape[1], *grey.shape[::-1]), (view.distance_radii, LEAST_COSINE, LEAST_WEIGHT)
    addresses = [None if part is None else part.data_ptr() for part in (*parts, *sums, *seen)]
    return Growing(*sizes, *addresses[: len(parts)], *numbers, *addresses[len(parts) :])
