from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from sphereorient.calibration.targets import CalibrationTarget, Floats, Ints
from sphereorient.errors import refusal


@dataclass(frozen=True, kw_only=True, eq=False)
class PlateView:
    """Points of the plate and their pixels in one picture.
    `tied`: every point is identified. `floating`: each row of `placements` is a possible place on the plate;
    `points_plate_mm` are those before any. `refused`: unusable, all arrays are empty.
    """

    points_plate_mm: Floats  # (n, 3), plate frame
    uv_px: Floats  # (n, 2)
    sigma_px: Floats  # (n,), standard deviation of each of u and v
    diameter_mm: Floats  # (n,), of the dot whose centroid was measured; 0 for corners, which have no perspective bias
    index: Ints  # (n, 2), grid indices
    state: Literal["tied", "floating", "refused"] = "tied"
    reason: str = ""  # one line, why the state is not `tied`
    placements: Ints = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))  # (m, 3): see `placed`

    def __post_init__(self) -> None:
        n = len(self.index)
        shapes = (self.points_plate_mm.shape, self.uv_px.shape, self.sigma_px.shape, self.diameter_mm.shape)
        assert shapes == ((n, 3), (n, 2), (n,), (n,)), shapes

    def __len__(self) -> int:
        return len(self.index)


def refused_view(name: str, *, expected: str, got: str, do: str) -> PlateView:
    """Return a `refused` view with the reason worded by `refusal`."""
    return PlateView(
        points_plate_mm=np.zeros((0, 3)),
        uv_px=np.zeros((0, 2)),
        sigma_px=np.zeros(0),
        diameter_mm=np.zeros(0),
        index=np.zeros((0, 2), dtype=np.int64),
        state="refused",
        reason=refusal(name, expected=expected, got=got, do=do),
    )


def quarter_turned(index: Ints, quarters: int) -> Ints:
    """Rotate grid indices (n, 2) by quarter turns; each takes (i, j) to (-j, i)."""
    for _ in range(quarters % 4):
        index = np.stack([-index[:, 1], index[:, 0]], axis=1)
    return index


def placed(view: PlateView, plate: CalibrationTarget, placement: Ints | Sequence[int]) -> PlateView:
    """Return a floating view as `tied` by a placement (3,): quarter turns, shift along columns, shift along rows."""
    quarters, shift_i, shift_j = (int(p) for p in placement)
    index = quarter_turned(view.index, quarters) + np.array([shift_i, shift_j])
    return replace(
        view,
        index=index,
        points_plate_mm=plate.points(index),
        diameter_mm=plate.diameters(index),
        state="tied",
        reason="",
        placements=np.zeros((0, 3), dtype=np.int64),
    )
