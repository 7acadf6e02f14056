"""What one picture shows of a calibration target: points of the plate and their pixels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sphereorient.calibration.plate import Floats, Ints

State = Literal["tied", "floating", "refused"]


@dataclass(frozen=True, kw_only=True, eq=False)
class PlateView:
    """Points of the plate and where they appear in one picture; made by `see_plate`, read by the fit of cameras.

    `floating`: the lattice is seen, but not which of its points these are; each row of `placements` is one reading,
    and `points_plate_mm` is that of the first row. `refused`: nothing is usable, all arrays are empty.
    """

    points_plate_mm: Floats  # (n, 3), plate frame
    uv_px: Floats  # (n, 2)
    sigma_px: Floats  # (n,), standard deviation of each of u and v
    diameter_mm: Floats  # (n,), of the dot whose centroid was measured; 0 for corners, which have no perspective bias
    index: Ints  # (n, 2), grid indices
    state: State = "tied"
    reason: str = ""  # one line, why the state is not `tied`
    placements: Ints = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))  # (m, 3): see `placed`

    def __post_init__(self) -> None:
        """Refuse records of unequal lengths: our own mistake."""
        n = len(self.index)
        shapes = (self.points_plate_mm.shape, self.uv_px.shape, self.sigma_px.shape, self.diameter_mm.shape)
        assert shapes == ((n, 3), (n, 2), (n,), (n,)), shapes

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.index)


def nothing_seen(reason: str) -> PlateView:
    """Return the view of a picture that is of no use, with the reason in one line."""
    return PlateView(
        points_plate_mm=np.zeros((0, 3)),
        uv_px=np.zeros((0, 2)),
        sigma_px=np.zeros(0),
        diameter_mm=np.zeros(0),
        index=np.zeros((0, 2), dtype=np.int64),
        state="refused",
        reason=reason,
    )
