"""What calibration.yaml says of the plate, read into a record."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sphereorient.calibration.plate import DotPlate
from sphereorient.calibration.targets import CharucoBoard, Chessboard, CircleGrid
from sphereorient.errors import CameraError, refusal
from sphereorient.files.yaml_file import short

Target = DotPlate | Chessboard | CharucoBoard | CircleGrid

# Keys of calibration.yaml -> fields; optional ones end in "?".
KEYS: Mapping[str, tuple[type[Target], Mapping[str, str]]] = {
    "dots": (
        DotPlate,
        {
            "columns": "columns",
            "rows": "rows",
            "pitch": "pitch_mm",
            "dot_diameter": "dot_diameter_mm",
            "fiducial_diameter": "fiducial_diameter_mm",
            "fiducials": "fiducials",
            "dots?": "dark",
        },
    ),
    "chessboard": (Chessboard, {"columns": "columns", "rows": "rows", "pitch": "pitch_mm"}),
    "charuco": (
        CharucoBoard,
        {
            "columns": "columns",
            "rows": "rows",
            "pitch": "pitch_mm",
            "marker": "marker_mm",
            "dictionary?": "dictionary",
            "legacy_pattern?": "legacy_pattern",
        },
    ),
    "circles": (
        CircleGrid,
        {
            "columns": "columns",
            "rows": "rows",
            "pitch": "pitch_mm",
            "dot_diameter": "dot_diameter_mm",
            "asymmetric?": "asymmetric",
            "dots?": "dark",
        },
    ),
}
FLAGS = ("asymmetric", "legacy_pattern")
COUNTS = ("columns", "rows")
LENGTHS = ("pitch", "dot_diameter", "fiducial_diameter", "marker")
MOST = 1000  # columns or rows: arrays of all points are made, and no camera tells more apart
LONGEST_MM = 1e5


def plate_from_entry(entry: Any, name: str = "calibration.yaml, plate") -> Target:
    """Read the `plate` of calibration.yaml (DESIGN section 2).

    Args:
        entry: as YAML gives it.
        name: file and key, for the message.

    Raises:
        CameraError: no mapping, an unknown type or key, one missing, or a value that no plate has.
    """
    kind = entry.get("type") if isinstance(entry, Mapping) else None
    if not isinstance(kind, str) or kind not in KEYS:
        expected, got = f"a mapping with `type` one of {', '.join(KEYS)}", short(kind if kind is not None else entry)
        raise CameraError(refusal(name, expected=expected, got=got, do="write what the plate is"))
    made, keys = KEYS[kind]
    known = {key.rstrip("?"): field for key, field in keys.items()}
    missing = [key for key in keys if not key.endswith("?") and key not in entry]
    unknown = [str(key)[:40] for key in entry if key != "type" and key not in known][:5]
    if missing or unknown:
        got = "; ".join(
            f"{what} {', '.join(which)}" for what, which in (("no", missing), ("unknown", unknown)) if which
        )
        raise CameraError(refusal(name, expected=f"the keys {', '.join(known)}", got=got, do="correct the plate"))
    values = {known[key]: _value(name, key, value) for key, value in entry.items() if key != "type"}
    try:
        return made(**values)
    except CameraError as error:
        raise CameraError(f"{name.removesuffix('plate')}{error}") from None


def _value(name: str, key: str, value: Any) -> Any:
    """Return a value of the kind that its key wants; whether it is a plate's is up to the record."""
    expected, do = "", "correct the plate"
    if key == "dots":
        expected, do = ("" if value in ("dark", "bright") else "dark or bright"), "say which the dots are"
    elif key in FLAGS:
        expected = "" if isinstance(value, bool) else "true or false"
    elif key in COUNTS:
        whole = _is_whole(value) and 2 <= value <= MOST
        expected, do = ("" if whole else f"a whole number, 2 or more, at most {MOST}"), "count them on the plate"
    elif key in LENGTHS:
        length = isinstance(value, int | float) and not isinstance(value, bool) and 0 < value <= LONGEST_MM
        expected, do = ("" if length else f"a length above zero, mm, at most {LONGEST_MM:g}"), "measure the plate"
    elif key == "fiducials":
        expected = "" if _are_indices(value) else "three grid indices of this plate: [0, 0], one on +x, one on +y"
        do = "count columns and rows from the origin dot"
    elif not isinstance(value, str):
        expected = "a name"
    if expected:
        raise CameraError(refusal(f"{name}, {key}", expected=expected, got=short(value), do=do))
    if key == "fiducials":
        return tuple(tuple(at) for at in value)
    return value == "dark" if key == "dots" else value


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _are_indices(value: Any) -> bool:
    """Tell whether a value is a list of three pairs of whole numbers that a plate can have."""
    pairs = isinstance(value, list | tuple) and all(isinstance(at, list | tuple) and len(at) == 2 for at in value)
    return pairs and len(value) == 3 and all(_is_whole(i) and abs(i) <= MOST for at in value for i in at)
