"""Targets that OpenCV finds: chessboards, ChArUco boards, plain circle grids."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sphereorient.calibration.plate import Floats, Ints, check_lattice, check_length, lattice_points
from sphereorient.errors import CameraError, refusal


@dataclass(frozen=True, kw_only=True)
class Chessboard:
    """A chessboard; its points are the corners between squares.

    Grid index (0, 0) is the corner at the lower left, whose own lower left square is dark; x runs to the right along
    columns, y upwards along rows, z towards the viewer. Where the board looks the same after a turn, the view floats.
    """

    columns: int  # of inner corners
    rows: int
    pitch_mm: float  # side of a square

    def __post_init__(self) -> None:
        """Refuse a board that nobody can have made."""
        check_lattice("plate", self.columns, self.rows, self.pitch_mm)
        if min(self.columns, self.rows) < 3:
            got, do = f"{self.columns} x {self.rows}", "count the corners between squares, without the border"
            raise CameraError(refusal("plate", expected="3 x 3 inner corners or more", got=got, do=do))

    @property
    def extent(self) -> tuple[int, int]:
        """The largest grid indices."""
        return self.columns - 1, self.rows - 1

    def points(self, index: Ints) -> Floats:
        """Return the corners (n, 3), plate frame, mm, with grid indices (n, 2)."""
        return lattice_points(index, self.pitch_mm)

    def diameters(self, index: Ints) -> Floats:
        """Return zeros (n,): a corner has no perspective bias."""
        return np.zeros(len(index))


@dataclass(frozen=True, kw_only=True)
class CharucoBoard:
    """A chessboard with markers in its bright squares, so that parts of it can be told.

    Grid index (0, 0) is the inner corner at the lower left of the board as OpenCV draws it; x to the right, y upwards,
    z towards the viewer.
    """

    columns: int  # of squares
    rows: int
    pitch_mm: float  # side of a square
    marker_mm: float  # side of a marker
    dictionary: str = "DICT_4X4_50"  # OpenCV's name
    legacy_pattern: bool = False  # drawn by OpenCV before 4.6, or by a program that follows it

    def __post_init__(self) -> None:
        """Refuse a board that nobody can have made."""
        check_lattice("plate", self.columns, self.rows, self.pitch_mm)
        check_length("plate, marker", self.marker_mm)
        if self.marker_mm >= self.pitch_mm:
            got, do = f"{self.marker_mm:g} mm in {self.pitch_mm:g} mm", "measure the board"
            raise CameraError(refusal("plate, marker", expected="smaller than its square", got=got, do=do))
        if not self.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, self.dictionary):
            expected, do = "a name of OpenCV's, such as DICT_4X4_50", "look up what the board was drawn with"
            raise CameraError(refusal("plate, dictionary", expected=expected, got=self.dictionary, do=do))
        held = len(self._markers().bytesList)
        if held < self.columns * self.rows // 2:
            expected, got = f"{self.columns * self.rows // 2} markers or more", f"{held} in {self.dictionary}"
            do = "look up what the board was drawn with"
            raise CameraError(refusal("plate, dictionary", expected=expected, got=got, do=do))

    def _markers(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))

    def opencv(self) -> cv2.aruco.CharucoBoard:
        """Return OpenCV's board."""
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.pitch_mm, self.marker_mm, self._markers())
        board.setLegacyPattern(self.legacy_pattern)
        return board

    def points(self, index: Ints) -> Floats:
        """Return the corners (n, 3), plate frame, mm, with grid indices (n, 2)."""
        return lattice_points(index, self.pitch_mm)

    def diameters(self, index: Ints) -> Floats:
        """Return zeros (n,): a corner has no perspective bias."""
        return np.zeros(len(index))


@dataclass(frozen=True, kw_only=True)
class CircleGrid:
    """Equal circles, in a square lattice or (asymmetric) in one whose every other row is shifted by half a step.

    Grid index (0, 0) is the circle at the lower left; x to the right, y upwards, z towards the viewer. Asymmetric:
    `pitch_mm` is the distance of rows, circles of one row are two of it apart, the highest row is not shifted, and the
    one below it is, to the right (as OpenCV draws it). Where the grid looks the same after a turn, the view floats.
    """

    columns: int  # circles in a row
    rows: int
    pitch_mm: float
    dot_diameter_mm: float
    asymmetric: bool = False
    dark: bool = True  # dark circles on a bright plate

    def __post_init__(self) -> None:
        """Refuse a grid that nobody can have made."""
        check_lattice("plate", self.columns, self.rows, self.pitch_mm)
        check_length("plate, dot_diameter", self.dot_diameter_mm)
        if self.asymmetric and self.rows % 2 == 0:
            # Such a grid looks the same upside down, and OpenCV does not find it.
            do = "count the rows, or cover one of them"
            raise CameraError(refusal("plate, rows", expected="an odd number", got=f"{self.rows}", do=do))
        nearest = self.pitch_mm * (np.sqrt(2) if self.asymmetric else 1)
        if self.dot_diameter_mm >= nearest:
            got, do = f"{self.dot_diameter_mm:g} mm, {nearest:g} mm apart", "measure the plate"
            raise CameraError(refusal("plate, dot_diameter", expected="circles that do not touch", got=got, do=do))

    @property
    def extent(self) -> tuple[int, int]:
        """The largest grid indices."""
        return (2 * self.columns - 1 if self.asymmetric else self.columns - 1), self.rows - 1

    def points(self, index: Ints) -> Floats:
        """Return the centres (n, 3), plate frame, mm, with grid indices (n, 2)."""
        return lattice_points(index, self.pitch_mm)

    def diameters(self, index: Ints) -> Floats:
        """Return the diameters (n,), mm."""
        return np.full(len(index), self.dot_diameter_mm)
