"""A map cut into gores: strips from pole to pole that lie flat on paper and wrap a ball of a diameter.

On the sheet x grows to the right and y upwards, mm; the strips touch along the equator, which is pi D long, the first
one at longitude -180 degrees. North is up and east is right, as seen from outside. Parallels and the middle meridian
of each strip have their true lengths (the sinusoidal projection, strip by strip).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.errors import PaintError, check_tail, refusal
from sphereorient.sphere import sample_texture

GORES = (4, 48)
DIAMETERS_MM = (2.0, 500.0)
STEP_MM = 0.1  # of the lattice on which borders are followed, at most
STEP_RAD = math.radians(0.5)  # and on the ball


@dataclass(frozen=True, kw_only=True)
class Gores:
    """Strips for a ball.

    Raises:
        PaintError: a number of strips or a diameter that cannot be cut.
    """

    count: int
    diameter_mm: float

    def __post_init__(self) -> None:
        """Refuse what cannot be cut."""
        for name, value, (low, high), unit in (
            ("gores", self.count, GORES, ""),
            ("diameter", self.diameter_mm, DIAMETERS_MM, " mm"),
        ):
            if not low <= value <= high:
                do = "give what paper and scissors allow"
                raise PaintError(refusal(name, expected=f"{low:g} .. {high:g}{unit}", got=f"{value:g}{unit}", do=do))

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width (the equator) and height (from pole to pole) of the sheet."""
        return math.pi * self.diameter_mm, math.pi * self.diameter_mm / 2

    def place_mm(self, direction_body: Tensor) -> Tensor:
        """Return where directions (..., 3) lie on the sheet, (..., 2), mm; (0, 0) is its middle.

        On the border of two strips the eastern one has it.
        """
        check_tail("direction_body", direction_body, 3)
        x, y, z = direction_body.unbind(-1)
        longitude, latitude = torch.atan2(y, x), torch.atan2(z, torch.hypot(x, y))
        middle = self._middle(longitude)
        across = middle + (longitude - middle) * latitude.cos()
        return 0.5 * self.diameter_mm * torch.stack([across, latitude], -1)

    def direction_body(self, place_mm: Tensor) -> tuple[Tensor, Tensor]:
        """Return which directions places (..., 2) of the sheet show, (..., 3), and whether they lie on a strip (...).

        Beside the strips a direction is that of the nearest strip, continued.
        """
        check_tail("place_mm", place_mm, 2)
        across, latitude = (2 / self.diameter_mm * place_mm).unbind(-1)
        middle = self._middle(across)
        room = latitude.cos()
        offset = (across - middle) / room.clamp_min(1e-9)
        on = (latitude.abs() < math.pi / 2) & (offset.abs() <= math.pi / self.count) & (across.abs() <= math.pi)
        longitude = middle + offset
        direction = torch.stack([room * longitude.cos(), room * longitude.sin(), latitude.sin()], -1)
        return direction, on

    def outline_mm(self, points: int = 181) -> list[NDArray[np.float64]]:
        """Return the closed outline of each strip, (2 points, 2), mm, where scissors go."""
        latitude = np.linspace(-math.pi / 2, math.pi / 2, points)
        half = math.pi / self.count * np.cos(latitude)
        edges = [np.column_stack([side * half, latitude]) for side in (-1, 1)]
        loop = np.concatenate([edges[1], edges[0][::-1]])
        return [0.5 * self.diameter_mm * (loop + np.array([middle, 0.0])) for middle in self.middles_rad()]

    def middles_rad(self) -> list[float]:
        """Longitudes of the strips' middles, rad, from west to east."""
        return [-math.pi + 2 * math.pi * (k + 0.5) / self.count for k in range(self.count)]

    def _middle(self, longitude: Tensor) -> Tensor:
        """Longitude of the middle of the strip that a longitude lies on."""
        width = 2 * math.pi / self.count
        strip = ((longitude + math.pi) / width).floor().clamp(0, self.count - 1)
        return -math.pi + (strip + 0.5) * width


def painted_gore(gores: Gores, texture: Tensor, strip: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the paint of one strip on a lattice.

    Args:
        gores: of the ball.
        texture: (H, 2 H), the map.
        strip: from west to east.

    Returns:
        x (columns) and y (rows), mm, on the sheet, and the paint (rows, columns), 0 black .. 1 white; beyond the
        outline it goes on, so that borders run up to it.
    """
    step = min(STEP_MM, 0.5 * gores.diameter_mm * STEP_RAD)
    width, height = gores.size_mm
    middle = 0.5 * gores.diameter_mm * gores.middles_rad()[strip]
    half = 0.5 * width / gores.count
    x = middle + torch.linspace(-half, half, math.ceil(2 * half / step) + 1, dtype=torch.float64)
    y = torch.linspace(-height / 2, height / 2, math.ceil(height / step) + 1, dtype=torch.float64)
    latitude = 2 / gores.diameter_mm * y
    # On the strip's own middle meridian whatever the rounding: the lattice reaches both borders.
    longitude = gores.middles_rad()[strip] + (2 / gores.diameter_mm) * (x - middle) / latitude.cos()[:, None].clamp_min(
        1e-3
    )
    room = latitude.cos()[:, None]
    direction = torch.stack(
        [room * longitude.cos(), room * longitude.sin(), latitude.sin()[:, None].expand_as(longitude)], -1
    )
    return x, y, sample_texture(texture.double(), direction)
