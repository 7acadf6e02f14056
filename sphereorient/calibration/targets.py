"""Calibration targets (dot plates, chessboards, ChArUco boards, circle grids), and the view of one in a picture."""

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.cameras.checks import camera_error
from sphereorient.errors import CameraError, refusal
from sphereorient.files.yaml_file import short

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
MOST = 1000  # columns or rows; no camera resolves more
LONGEST_MM = 1e5  # of any length of a plate: 100 m
FIDUCIALS = ("origin", "+x", "+y")  # their names, in the order of `DotPlate.fiducials`


@dataclass(frozen=True, kw_only=True)
class CalibrationTarget:
    """A plane target whose points have grid indices: x along columns, y along rows, z towards the viewer."""

    columns: int
    rows: int
    pitch_mm: float

    def __post_init__(self) -> None:
        for one in fields(self):
            name, value = f"plate, {_key(one.name)}", getattr(self, one.name)
            if one.type is int and not (_is_whole(value) and 2 <= value <= MOST):
                raise _refused(name, f"a whole number, 2 or more, at most {MOST}", value, "count them on the plate")
            if one.type is float and not ((_is_whole(value) or isinstance(value, float)) and 0 < value <= LONGEST_MM):
                raise _refused(name, f"a length above zero, mm, at most {LONGEST_MM:g}", value, "measure the plate")
            if one.type is bool and not isinstance(value, bool):
                raise _refused(name, "true or false", value)

    @property
    def extent(self) -> tuple[int, int]:
        """The largest grid indices."""
        return self.columns - 1, self.rows - 1

    def points(self, index: Ints) -> Floats:
        """Return the points (n, 3), plate frame, mm, with grid indices (n, 2)."""
        flat = index.astype(np.float64) * self.pitch_mm
        return np.column_stack([flat, np.zeros(len(flat))])

    def diameters(self, index: Ints) -> Floats:
        """Return the diameters (n,), mm, of the dots with grid indices (n, 2); 0 for corners."""
        return np.zeros(len(index))


@dataclass(frozen=True, kw_only=True)
class DotPlate(CalibrationTarget):
    """A square lattice of dots; three larger ones, the fiducials, define the axes.
    Grid index (0, 0) is the origin dot, in the middle of the grid (with an even number: the first after the middle).
    """

    dot_diameter_mm: float
    fiducial_diameter_mm: float
    fiducials: tuple[tuple[int, int], ...]  # grid indices, in the order of FIDUCIALS
    dark: bool = True  # dark dots on a bright plate; False: bright dots on a dark plate

    def __post_init__(self) -> None:
        super().__post_init__()
        largest = 2 * self.pitch_mm - self.dot_diameter_mm
        got = f"dots of {self.dot_diameter_mm:g} and {self.fiducial_diameter_mm:g} mm at pitch {self.pitch_mm:g}"
        if not self.dot_diameter_mm < self.pitch_mm or not self.fiducial_diameter_mm < largest:
            raise camera_error("plate", "dots that do not touch", got, "measure the plate")
        if self.fiducial_diameter_mm < 1.15 * self.dot_diameter_mm:
            raise camera_error("plate", "fiducials larger than the dots by 15 % or more", got, "measure the plate")
        marks = self.fiducials
        pairs = isinstance(marks, list | tuple) and all(isinstance(at, list | tuple) and len(at) == 2 for at in marks)
        axes = pairs and len(marks) == 3 and all(_is_whole(i) and abs(i) <= MOST for at in marks for i in at)
        if axes:
            origin, on_x, on_y = (tuple(at) for at in marks)
            axes = origin == (0, 0) and on_x[0] > 0 and on_x[1] == 0 and on_y[0] == 0 and on_y[1] > 0
            object.__setattr__(self, "fiducials", (origin, on_x, on_y))
        if not axes or not self.holds(np.array(marks)).all():
            expected = "three grid indices of this plate: [0, 0], one on +x, one on +y"
            raise _refused("plate, fiducials", expected, marks, "count columns and rows from the origin dot")

    @property
    def first(self) -> tuple[int, int]:
        """The smallest grid indices."""
        return -(self.columns // 2), -(self.rows // 2)

    @property
    def last(self) -> tuple[int, int]:
        """The largest grid indices."""
        return self.first[0] + self.columns - 1, self.first[1] + self.rows - 1

    @property
    def indices(self) -> Ints:
        """(columns * rows, 2), all grid indices, row after row."""
        return indices(self.first, self.last)

    def holds(self, index: Ints) -> NDArray[np.bool_]:
        """Return (n,), whether grid indices (n, 2) are on the plate."""
        return np.asarray(((index >= self.first) & (index <= self.last)).all(axis=1))

    def is_fiducial(self, index: Ints) -> NDArray[np.bool_]:
        """Return (n,), whether grid indices (n, 2) are fiducials."""
        return np.asarray((index[:, None] == np.array(self.fiducials)).all(axis=2).any(axis=1))

    def diameters(self, index: Ints) -> Floats:
        """Return the diameters (n,), mm, of the dots with grid indices (n, 2)."""
        return np.where(self.is_fiducial(index), self.fiducial_diameter_mm, self.dot_diameter_mm)


@dataclass(frozen=True, kw_only=True)
class Chessboard(CalibrationTarget):
    """A chessboard of columns x rows inner corners; the pitch is the side of a square; floating if it has a symmetry.
    Index (0, 0) is the lower left corner; the square to its lower left is dark.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.columns, self.rows) < 3:
            got, do = f"{self.columns} x {self.rows}", "count the corners between squares, without the border"
            raise camera_error("plate", "3 x 3 inner corners or more", got, do)


@dataclass(frozen=True, kw_only=True)
class CharucoBoard(CalibrationTarget):
    """A chessboard of columns x rows squares with markers; a part is enough; (0, 0): OpenCV's lower left corner."""

    marker_mm: float  # side of a marker
    dictionary: str = "DICT_4X4_50"  # OpenCV's name
    legacy_pattern: bool = False  # pattern of OpenCV before 4.6

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.marker_mm >= self.pitch_mm:
            got, do = f"{self.marker_mm:g} mm in {self.pitch_mm:g} mm", "measure the board"
            raise camera_error("plate, marker", "smaller than its square", got, do)
        name, do = self.dictionary, "look up the dictionary that the board was drawn with"
        if not isinstance(name, str) or not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
            raise _refused("plate, dictionary", "a name of OpenCV's, such as DICT_4X4_50", name, do)
        held, least = len(self._markers().bytesList), self.columns * self.rows // 2
        if held < least:
            raise camera_error("plate, dictionary", f"{least} markers or more", f"{held} in {name}", do)

    def _markers(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))

    def opencv(self) -> cv2.aruco.CharucoBoard:
        """Return OpenCV's board."""
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.pitch_mm, self.marker_mm, self._markers())
        board.setLegacyPattern(self.legacy_pattern)
        return board


@dataclass(frozen=True, kw_only=True)
class CircleGrid(CalibrationTarget):
    """Equal circles, in a square lattice or (asymmetric) with every other row shifted by half a step.
    Index (0, 0) is the lower left circle. Asymmetric, as OpenCV draws it: `pitch_mm` between rows and twice that in a
    row; from the top every second row is shifted to the right. Views of a grid with a symmetry are floating.
    """

    dot_diameter_mm: float
    asymmetric: bool = False
    dark: bool = True  # dark circles on a bright plate

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.asymmetric and self.rows % 2 == 0:  # symmetric upside down, and not found by OpenCV
            raise camera_error("plate, rows", "an odd number", f"{self.rows}", "count the rows, or cover one of them")
        nearest = self.pitch_mm * (np.sqrt(2) if self.asymmetric else 1)
        if self.dot_diameter_mm >= nearest:
            got, do = f"{self.dot_diameter_mm:g} mm, {nearest:g} mm apart", "measure the plate"
            raise camera_error("plate, dot_diameter", "circles that do not touch", got, do)

    @property
    def extent(self) -> tuple[int, int]:
        """The largest grid indices."""
        return (2 * self.columns - 1 if self.asymmetric else self.columns - 1), self.rows - 1

    def diameters(self, index: Ints) -> Floats:
        """Return the diameters (n,), mm."""
        return np.full(len(index), self.dot_diameter_mm)


_Kind = type[CalibrationTarget]
KINDS: dict[str, _Kind] = {"dots": DotPlate, "chessboard": Chessboard, "charuco": CharucoBoard, "circles": CircleGrid}


def target_keys(kind: _Kind) -> dict[str, tuple[str, bool]]:
    """Return the field of each key of calibration.yaml, and whether the key is required."""
    return {_key(one.name): (one.name, one.default is MISSING) for one in fields(kind)}


def _kind_of(entry: Any) -> _Kind | None:
    kind = entry.get("type") if isinstance(entry, Mapping) else None
    return KINDS.get(kind) if isinstance(kind, str) else None


def missing_keys(entry: Any) -> list[str]:
    """Return the keys missing in the parsed `plate` of calibration.yaml; none for an unknown type."""
    keys = target_keys(kind) if (kind := _kind_of(entry)) else {}
    return [key for key, (_, needed) in keys.items() if needed and key not in entry]


def plate_from_entry(entry: Any, name: str = "calibration.yaml, plate") -> CalibrationTarget:
    """Build the target from the parsed `plate` of calibration.yaml; CameraError, naming the key, if impossible."""
    kind = _kind_of(entry)
    if kind is None:
        expected = f"a mapping with `type` one of {', '.join(KINDS)}"
        got = entry["type"] if isinstance(entry, Mapping) and "type" in entry else entry
        raise _refused(name, expected, got, "write the type of the plate")
    keys, missing = target_keys(kind), missing_keys(entry)
    unknown = [str(key)[:40] for key in entry if key != "type" and key not in keys][:5]
    if missing or unknown:
        faults = {"no": missing, "unknown": unknown}
        got = "; ".join(f"{what} {', '.join(which)}" for what, which in faults.items() if which)
        raise camera_error(name, f"the keys {', '.join(keys)}", got, "correct the plate")
    values = {keys[key][0]: value for key, value in entry.items() if key != "type"}
    if "dots" in entry:
        if entry["dots"] not in ("dark", "bright"):
            raise _refused(f"{name}, dots", "dark or bright", entry["dots"], "write the brightness of the dots")
        values["dark"] = entry["dots"] == "dark"
    try:
        return kind(**values)
    except CameraError as error:
        raise CameraError(f"{name.removesuffix('plate')}{error}") from None


@dataclass(frozen=True, eq=False)
class PlateView:
    """Points of the plate and their pixels in one picture.
    `tied`: every point is identified. `floating`: each row of `placements` is a possible placement on the plate;
    `points_plate_mm` are without placement. `refused`: unusable, all arrays are empty.
    """

    points_plate_mm: Floats  # (n, 3), plate frame
    uv_px: Floats  # (n, 2)
    sigma_px: Floats  # (n,), standard deviation of each of u and v
    diameter_mm: Floats  # (n,), of the dot whose centroid was measured; 0 for corners, which have no perspective bias
    index: Ints  # (n, 2), grid indices
    state: Literal["tied", "floating", "refused"] = "tied"
    reason: str = ""  # one line, why the state is not `tied`
    placements: Ints = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))  # (m, 3): see `placed`

    def __len__(self) -> int:
        return len(self.index)

    def settled(self, plate: CalibrationTarget, placements: Ints, reason: str) -> "PlateView":
        """Return the view as `tied` if there is one placement (m, 3), or `floating` for this reason."""
        if len(placements) == 1:
            return placed(self, plate, placements[0])
        return replace(self, state="floating", reason=reason, placements=placements)


def seen(plate: CalibrationTarget, index: Ints, uv_px: Floats, sigma_px: Floats) -> PlateView:
    """Return the view of the points with grid indices (n, 2) at pixels (n, 2), each with a sigma (n,)."""
    points, diameters = plate.points(index), plate.diameters(index)
    return PlateView(points_plate_mm=points, uv_px=uv_px, sigma_px=sigma_px, diameter_mm=diameters, index=index)


def refused_view(name: str, expected: str, got: str, do: str) -> PlateView:
    """Return a `refused` view with the reason worded by `refusal`."""
    none, index = np.zeros(0), np.zeros((0, 2), dtype=np.int64)
    reason = refusal(name, expected=expected, got=got, do=do)
    return PlateView(np.zeros((0, 3)), np.zeros((0, 2)), none, none, index, "refused", reason)


def quarter_turned(index: Ints, quarters: int) -> Ints:
    """Rotate grid indices (n, 2) by quarter turns; each takes (i, j) to (-j, i)."""
    for _ in range(quarters % 4):
        index = np.stack([-index[:, 1], index[:, 0]], axis=1)
    return index


def placed(view: PlateView, plate: CalibrationTarget, placement: Ints | Sequence[int]) -> PlateView:
    """Return a floating view as `tied` by a placement (3,): quarter turns, shift along columns, shift along rows."""
    quarters, *shift = (int(p) for p in placement)
    return seen(plate, quarter_turned(view.index, quarters) + np.array(shift), view.uv_px, view.sigma_px)


def indices(first: Sequence[int] | Ints, last: Sequence[int] | Ints) -> Ints:
    """Return the grid indices (n, 2) from the first to the last ones, row after row."""
    i, j = np.meshgrid(np.arange(first[0], last[0] + 1), np.arange(first[1], last[1] + 1))
    return np.stack([i.ravel(), j.ravel()], axis=1).astype(np.int64)


def _key(field: str) -> str:
    return "dots" if field == "dark" else field.removesuffix("_mm")


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _refused(name: str, expected: str, got: object, do: str = "correct the plate") -> CameraError:
    return camera_error(name, expected, short(got), do)
