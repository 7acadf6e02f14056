"""What calibration.yaml says of the plate, read into a record."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sphereorient.cameras.calibration.plate import DotPlate
from sphereorient.cameras.calibration.targets import CharucoBoard, Chessboard, CircleGrid
from sphereorient.errors import CameraError, refusal

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
        expected, got = f"a mapping with `type` one of {', '.join(KEYS)}", repr(kind if kind is not None else entry)
        raise CameraError(refusal(name, expected=expected, got=got, do="write what the plate is"))
    made, keys = KEYS[kind]
    known = {key.rstrip("?"): field for key, field in keys.items()}
    missing = [key for key in keys if not key.endswith("?") and key not in entry]
    unknown = [str(key) for key in entry if key != "type" and key not in known]
    if missing or unknown:
        got = "; ".join(
            f"{what} {', '.join(which)}" for what, which in (("no", missing), ("unknown", unknown)) if which
        )
        raise CameraError(refusal(name, expected=f"the keys {', '.join(known)}", got=got, do="correct the plate"))
    return made(**{known[key]: _value(name, key, value) for key, value in entry.items() if key != "type"})


def _value(name: str, key: str, value: Any) -> Any:
    if key == "dots":
        if value not in ("dark", "bright"):
            do = "say which the dots are"
            raise CameraError(refusal(f"{name}, dots", expected="dark or bright", got=repr(value), do=do))
        return value == "dark"
    if key in FLAGS and not isinstance(value, bool):
        raise CameraError(refusal(f"{name}, {key}", expected="true or false", got=repr(value), do="correct the plate"))
    if key == "fiducials" and isinstance(value, list):
        return tuple(tuple(at) if isinstance(at, list) else at for at in value)
    return value
