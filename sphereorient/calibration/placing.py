"""Lattices moved on a plate: turned by quarters and shifted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from sphereorient.calibration.plate import Floats, Ints
from sphereorient.calibration.view import PlateView


class Plate(Protocol):
    """A target whose points are told by grid indices."""

    def points(self, index: Ints) -> Floats:
        """Return the points (n, 3), plate frame, mm, of grid indices (n, 2)."""

    def diameters(self, index: Ints) -> Floats:
        """Return the diameters (n,), mm, of the dots with grid indices (n, 2); 0 for corners."""


def turned(index: Ints, quarters: int) -> Ints:
    """Return grid indices (n, 2) after that many quarter turns, each of which takes (i, j) to (-j, i)."""
    for _ in range(quarters % 4):
        index = np.stack([-index[:, 1], index[:, 0]], axis=1)
    return index


def placed(view: PlateView, plate: Plate, placement: Ints | Sequence[int]) -> PlateView:
    """Return a floating view with one of its placements chosen, now `tied`.

    Args:
        view: as of `see_plate`; its `index` is read as before any placement.
        plate: the target.
        placement: (3,), a row of `view.placements`: turn by quarters, shift along columns and along rows.

    Returns:
        PlateView, tied, without placements.
    """
    quarters, shift_i, shift_j = (int(p) for p in placement)
    index = turned(view.index, quarters) + np.array([shift_i, shift_j])
    return replace(
        view,
        index=index,
        points_plate_mm=plate.points(index),
        diameter_mm=plate.diameters(index),
        state="tied",
        reason="",
        placements=np.zeros((0, 3), dtype=np.int64),
    )
