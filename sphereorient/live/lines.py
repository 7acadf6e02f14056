"""A measured pose as a line of FicTrac's table or JSON, and as named numbers."""

import json
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from sphereorient.errors import Flag
from sphereorient.files.provenance import without_nan
from sphereorient.live.live import Floats, Measured
from sphereorient.motion.forward import UNKNOWN, ForwardRate, Rate
from sphereorient.trajectory import quaternions_wxyz
from sphereorient.trajectory.rotations import rotation_vectors
from sphereorient.trajectory.walk import FicTracAxes, arcs, fictrac_rows, turned

AXES = {3: ("_x", "_y", "_z"), 4: ("_w", "_x", "_y", "_z")}  # by their number


class FicTracLines:
    """FicTrac's 25 columns per frame, as of `export --to fictrac`; NaN without a pose, then a new stretch begins."""

    def __init__(self, axes: FicTracAxes) -> None:
        self._axes = axes
        self._before: tuple[float, Floats] | None = None  # time, s, and R_lab_body (3, 3) of the frame before
        self._first = np.eye(3)  # R_lab_body at the start of this stretch
        self._sequence = -1
        self._heading, self._path, self._sums = 0.0, np.zeros((1, 2)), np.zeros((1, 2))

    def columns(self, number: int, time_s: float, R_lab_body: Floats, error_rad: float) -> Floats:
        """Return the columns (25,) of the next frame, R_lab_body (3, 3), NaN without a pose, and its stated error."""
        R_lab_body = self._axes.R_own_lab @ R_lab_body  # from here on the table's lab
        before, self._before = self._before, (time_s, R_lab_body)
        valid = math.isfinite(R_lab_body[0, 0])
        start = valid and (before is None or not math.isfinite(before[1][0, 0]))
        if start:
            self._first, self._sequence = R_lab_body, -1
            self._heading, self._path, self._sums = 0.0, np.zeros((1, 2)), np.zeros((1, 2))
        R_before = R_lab_body if before is None or start else before[1]
        turn = rotation_vectors((R_lab_body @ R_before.T)[None])
        ahead, right, about, step = arcs(turn)
        self._sequence += 1
        if valid:
            self._path = self._path + turned(step, np.array([self._heading]))
            self._heading = (self._heading + float(about[0])) % (2 * math.pi)
            self._sums = self._sums + np.column_stack([ahead, right])
        nothing = 0.0 if valid else np.nan
        rows = fictrac_rows(
            self._axes.R_cam_own,
            (R_lab_body @ self._first.T)[None],
            ahead,
            right,
            np.array([start]),
            frame=number,
            turn_lab=turn,
            error=error_rad,
            path=self._path + nothing,
            heading=self._heading + nothing,
            sums=self._sums + nothing,
            time_ms=1e3 * time_s,
            sequence=self._sequence,
            step_ms=math.nan if before is None else 1e3 * (time_s - before[0]),
        )
        return rows.ravel()


class Quantities:
    """Named quantities of each frame, with units; lengths in mm or radii (`length_unit`); `ball`: name of one of
    several. Angular velocity, and velocity unless the ball is `fixed`, use this and earlier frames; they restart after
    a search, and are NaN without stated errors (relative orientations).
    """

    def __init__(self, fixed: bool, length_unit: str = "mm", ball: str = "") -> None:
        self._unit, self._ball = length_unit, {"ball": ball} if ball else {}
        self._turning, self._moving = ForwardRate(), None if fixed else ForwardRate()
        self._before: Measured | None = None

    def of(self, now: Measured) -> dict[str, Any]:
        """Return those of the next frame: numbers, or lists of a number per axis; NaN: unknown."""
        unit = self._unit
        sigma = np.sqrt(np.diag(now.covariance + now.lasting))
        omega, velocity = self._rates(now)
        return self._ball | {
            "frame": now.number,
            "time_s": now.time_s,
            "valid": now.valid,
            "position_lab_mm" if unit == "mm" else f"position_{unit}": now.position_lab_mm.tolist(),
            "quaternion_wxyz": quaternions_wxyz(now.R_lab_body[None])[0].tolist(),
            "omega_rad_s": omega.value.tolist(),
            f"velocity_{unit}_s": velocity.value.tolist(),
            "sigma_rad": sigma[:3].tolist(),
            f"sigma_{unit}": sigma[3:].tolist(),
            "sigma_omega_rad_s": omega.sigma.tolist(),
            f"sigma_velocity_{unit}_s": velocity.sigma.tolist(),
            "map": now.map_number,
            "flags": now.flags,
            "found": now.found,
            "dropped": now.dropped,
            "latency_ms": 1e3 * now.latency_s,
        }

    def _rates(self, now: Measured) -> tuple[Rate, Rate]:
        before, self._before = self._before, now if _states_errors(now) else None
        if not _states_errors(now):
            return UNKNOWN, UNKNOWN
        if before is None or now.found or before.map_number != now.map_number:
            for one in (self._turning, self._moving):
                if one is not None:
                    one.restart()
            before = now
        step_s, turn = now.time_s - before.time_s, now.R_lab_body @ before.R_lab_body.T
        rotvec = np.asarray(cv2.Rodrigues(turn)[0][:, 0], np.float64)
        omega = self._turning.measured(step_s, rotvec, now.covariance[:3, :3], turn)
        if self._moving is None:
            return omega, UNKNOWN
        moved = now.position_lab_mm - before.position_lab_mm
        return omega, self._moving.measured(step_s, moved, now.covariance[3:, 3:])


def _states_errors(now: Measured) -> bool:
    return bool(np.isfinite(now.covariance).all())


@dataclass(frozen=True, eq=False)
class Forms:
    """A frame in the forms of the outputs, each computed on demand."""

    now: Measured
    table: FicTracLines
    known: Quantities

    @cached_property
    def columns(self) -> Floats:
        """FicTrac's columns (25,)."""
        now = self.now
        return self.table.columns(now.number, now.time_s, now.R_lab_body, now.error_rad)

    @cached_property
    def fictrac(self) -> str:
        """A line of FicTrac's file."""
        return ", ".join(f"{value:.14g}" for value in self.columns.tolist())

    @property
    def marked(self) -> str:
        """A line of FicTrac's socket."""
        return f"FT, {self.fictrac}"

    @property
    def short(self) -> str:
        """Number of the frame and rotation vector of R_lab_body, rad; NaN without a pose."""
        x, y, z = rotation_vectors(self.now.R_lab_body[None])[0].tolist()
        return f"{self.now.number},{x:.5f},{y:.5f},{z:.5f}"

    @cached_property
    def quantities(self) -> dict[str, Any]:
        """Named quantities, see `Quantities.of`."""
        return self.known.of(self.now)

    @cached_property
    def numbers(self) -> dict[str, float]:
        """The same as single numbers, with the axis at the end of the name."""
        found: dict[str, float] = {}
        for name, value in self.quantities.items():
            parts = zip(AXES[len(value)], value, strict=True) if isinstance(value, list) else [("", value)]
            found |= {f"{name.removesuffix('_wxyz')}{axis}": part for axis, part in parts}
        return found

    @cached_property
    def json(self) -> str:
        """A line of JSON: null for unknown values, flags and reasons by name."""
        words = {"flags": [flag.name for flag in Flag(self.now.flags)], "reason": [str(why) for why in self.now.reason]}
        return json.dumps(without_nan(self.quantities | words), allow_nan=False)
