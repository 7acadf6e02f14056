"""What a calibration target is: its points in its own frame, as calibration.yaml says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import CameraError, refusal

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def check_lattice(name: str, columns: int, rows: int, pitch_mm: float) -> None:
    """Refuse fewer than 2 columns or rows, and a pitch that is no length.

    Raises:
        CameraError: one of them is impossible.
    """
    for what, count in (("columns", columns), ("rows", rows)):
        if isinstance(count, bool) or not isinstance(count, int) or count < 2:
            expected, do = "a whole number, 2 or more", "count them on the plate"
            raise CameraError(refusal(f"{name}, {what}", expected=expected, got=f"{count}", do=do))
    check_length(f"{name}, pitch", pitch_mm)


def check_length(name: str, length_mm: float) -> None:
    """Refuse what is no length above zero, mm.

    Raises:
        CameraError: it is none.
    """
    if not (isinstance(length_mm, int | float) and not isinstance(length_mm, bool) and 0 < length_mm < np.inf):
        raise CameraError(refusal(name, expected="a length above zero, mm", got=f"{length_mm}", do="measure the plate"))


def lattice_points(index: Ints, pitch_mm: float) -> Floats:
    """Return the points (n, 3), plate frame, mm, of grid indices (n, 2): x along columns, y along rows, z = 0."""
    flat = index.astype(np.float64) * pitch_mm
    return np.column_stack([flat, np.zeros(len(flat))])


@dataclass(frozen=True, kw_only=True)
class DotPlate:
    """A square lattice of dots, three of which are larger and tell the axes.

    Grid index (0, 0) is the origin dot, in the middle of the grid (with an even number: the first after the middle);
    x along columns, y along rows, z towards the viewer (DESIGN section 2, calibration.yaml).
    """

    columns: int
    rows: int
    pitch_mm: float
    dot_diameter_mm: float
    fiducial_diameter_mm: float
    fiducials: tuple[tuple[int, int], ...]  # grid indices: origin, on +x, on +y
    dark: bool = True  # dark dots on a bright plate; False: bright dots on a dark plate

    def __post_init__(self) -> None:
        """Refuse a plate that nobody can have made, or whose axes could not be told."""
        check_lattice("plate", self.columns, self.rows, self.pitch_mm)
        check_length("plate, dot_diameter", self.dot_diameter_mm)
        check_length("plate, fiducial_diameter", self.fiducial_diameter_mm)
        self._check_sizes()
        self._check_fiducials()

    def _check_sizes(self) -> None:
        largest = 2 * self.pitch_mm - self.dot_diameter_mm
        if not self.dot_diameter_mm < self.pitch_mm or not self.fiducial_diameter_mm < largest:
            got = f"diameters {self.dot_diameter_mm:g} and {self.fiducial_diameter_mm:g} at pitch {self.pitch_mm:g}"
            raise CameraError(refusal("plate", expected="dots that do not touch", got=got, do="measure the plate"))
        if self.fiducial_diameter_mm < 1.15 * self.dot_diameter_mm:
            got = f"fiducials {self.fiducial_diameter_mm:g} mm, dots {self.dot_diameter_mm:g} mm"
            expected = "fiducials larger than the dots by 15 % or more"
            raise CameraError(refusal("plate", expected=expected, got=got, do="measure the plate"))

    def _check_fiducials(self) -> None:
        marks = self.fiducials
        try:
            origin, on_x, on_y = ((int(i), int(j)) for i, j in marks)
        except (TypeError, ValueError):
            origin, on_x, on_y = (1, 1), (0, 0), (0, 0)
        axes_told = origin == (0, 0) and on_x[0] > 0 and on_x[1] == 0 and on_y[0] == 0 and on_y[1] > 0
        if not axes_told or not self.holds(np.array([on_x, on_y])).all():
            expected = "three grid indices of this plate: [0, 0], one on +x, one on +y"
            do = "count columns and rows from the origin dot"
            raise CameraError(refusal("plate, fiducials", expected=expected, got=f"{marks}", do=do))
        object.__setattr__(self, "fiducials", (origin, on_x, on_y))

    @property
    def first(self) -> tuple[int, int]:
        """The smallest grid index along columns and along rows."""
        return -(self.columns // 2), -(self.rows // 2)

    @property
    def last(self) -> tuple[int, int]:
        """The largest grid index along columns and along rows."""
        return self.first[0] + self.columns - 1, self.first[1] + self.rows - 1

    @property
    def indices(self) -> Ints:
        """(columns * rows, 2), all grid indices, row after row."""
        (i0, j0), (i1, j1) = self.first, self.last
        i, j = np.meshgrid(np.arange(i0, i1 + 1), np.arange(j0, j1 + 1))
        return np.stack([i.ravel(), j.ravel()], axis=1).astype(np.int64)

    def holds(self, index: Ints) -> NDArray[np.bool_]:
        """Return (n,), whether grid indices (n, 2) lie on the plate."""
        inside = (index >= np.array(self.first)) & (index <= np.array(self.last))
        return np.asarray(inside.all(axis=1), dtype=np.bool_)

    def is_fiducial(self, index: Ints) -> NDArray[np.bool_]:
        """Return (n,), whether grid indices (n, 2) are those of fiducials."""
        same = (index[:, None, :] == np.array(self.fiducials)[None]).all(axis=2)
        return np.asarray(same.any(axis=1), dtype=np.bool_)

    def points(self, index: Ints) -> Floats:
        """Return the centres (n, 3), plate frame, mm, of the dots with grid indices (n, 2)."""
        return lattice_points(index, self.pitch_mm)

    def diameters(self, index: Ints) -> Floats:
        """Return the diameters (n,), mm, of the dots with grid indices (n, 2)."""
        return np.where(self.is_fiducial(index), self.fiducial_diameter_mm, self.dot_diameter_mm)
