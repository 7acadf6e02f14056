"""The walk of an animal on a ball that rotates under it: heading, path, and speeds ahead, sideways and of turning."""

from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sphereorient.trajectory.datasets import runs_of
from sphereorient.trajectory.rotations import Floats, rotation_vectors

# The columns of FicTrac's table, in order, with their numbers of values. Source: FicTrac's doc/data_header.txt.
WIDTHS = {"frame": 1, "turn_cam": 3, "error": 1, "turn_lab": 3, "rotation_cam": 3, "rotation_lab": 3}
WIDTHS |= {"path": 2, "heading": 1, "direction": 1, "speed": 1, "sums": 2, "time_ms": 1, "sequence": 1}
WIDTHS |= {"step_ms": 1, "clock_ms": 1}
FICTRAC = {name: slice(end - WIDTHS[name], end) for name, end in zip(WIDTHS, accumulate(WIDTHS.values()), strict=True)}


@dataclass(frozen=True, kw_only=True, eq=False)
class Walk:
    """Motion of an animal that stands still on a ball, lab axes x ahead, y to the right, z down. Lengths are in radii
    of the ball. A segment begins at 0, since motion in a gap is unknown.
    """

    turn_rad: Floats  # (N, 3), rotation of the ball since the previous frame, lab; NaN in the first frame of a segment
    heading_rad: Floats  # (N,), direction that the animal faces, 0 .. 2 pi, from x towards y
    path: Floats  # (N, 2), position on the plane on which it walks
    forward_rad_s: Floats  # (N,), radii a second ahead
    side_rad_s: Floats  # (N,), to the right
    turn_rad_s: Floats  # (N,), rate of the heading, positive to the right
    start: NDArray[np.bool_]  # (N,), first frame of a segment


def walk_of(time_s: Floats, R_lab_body: Floats) -> Walk:
    """Integrate the motion of a ball (N, 3, 3), NaN if not measured, over times (N,), s.
    Between two frames the ball rotates at a constant rate: the path is an arc.
    Source: FicTrac, Moore et al. 2014, columns 15 to 21 of its table.
    """
    known = np.asarray(np.isfinite(R_lab_body).all(axis=(1, 2)))
    linked = known & np.concatenate([[False], known[:-1]])
    turn = np.full((len(R_lab_body), 3), np.nan)
    turn[1:] = rotation_vectors(R_lab_body[1:] @ R_lab_body[:-1].transpose(0, 2, 1))
    ahead, right, about, across = arcs(turn)
    heading, path = np.full(len(turn), np.nan), np.full((len(turn), 2), np.nan)
    for first, last in runs_of(known):
        some = slice(first + 1, last)
        heading[first:last] = np.concatenate([[0.0], np.cumsum(about[some])])
        steps = turned(across[some], heading[first : last - 1])
        path[first:last] = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    step_s = np.concatenate([[np.nan], np.diff(time_s)])
    return Walk(
        turn_rad=turn,
        heading_rad=np.mod(heading, 2 * np.pi),
        path=path,
        forward_rad_s=ahead / step_s,
        side_rad_s=right / step_s,
        turn_rad_s=about / step_s,
        start=known & ~linked,
    )


def arcs(turn_rad: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the walk for rotations (N, 3) of the ball, rad, lab: ahead and to the right (N,), radii, change of the
    heading (N,), rad, and the step (N, 2) in the animal's previous axes, the chord of an arc.
    """
    ahead, right, about = turn_rad[:, 1], -turn_rad[:, 0], -turn_rad[:, 2]
    half = np.nan_to_num(about) / 2
    chord = np.sinc(half / np.pi)
    return ahead, right, about, chord[:, None] * turned(np.stack([ahead, right], axis=1), half)


def turned(steps: Floats, heading_rad: Floats) -> Floats:
    """Return steps (N, 2) of an animal with headings (N,) on the plane."""
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    x, y = steps[:, 0], steps[:, 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class FicTracAxes:
    """Axes of FicTrac's table, its "lab" and its "camera": of an experiment, or of FicTrac itself."""

    R_own_lab: Floats  # (3, 3), from the experiment's lab to the table's
    R_cam_own: Floats  # (3, 3), from the table's lab to its camera

    @classmethod
    def of_lab(cls, R_cam_lab: Floats) -> "FicTracAxes":
        """Return the axes of the experiment: its lab is the animal's frame, x ahead, y to the right, z down."""
        return cls(R_own_lab=np.eye(3), R_cam_own=R_cam_lab)


def fictrac_rows(
    R_cam_lab: Floats, R_from_first: Floats, ahead: Floats, right: Floats, start: NDArray[np.bool_], **own: ArrayLike
) -> Floats:
    """Return FicTrac's columns, (N, 25), from rotations since the start of a stretch, (N, 3, 3), and steps (N,), radii,
    in the table's lab; at the `start` (N,) of a stretch there is no motion. `own`: other columns, by names in
    `FICTRAC`.
    """
    # FicTrac's absolute rotations are since its first frame, in the lab multiplied by the camera's pose.
    R_cam = R_cam_lab @ R_from_first @ R_cam_lab.T
    in_cam, in_lab = np.split(rotation_vectors(np.concatenate([R_cam, R_cam_lab.T @ R_cam])), 2)
    own |= {
        "turn_cam": np.asarray(own["turn_lab"]) @ R_cam_lab.T,
        "rotation_cam": in_cam,
        "rotation_lab": in_lab,
        "direction": np.mod(np.arctan2(right, ahead), 2 * np.pi),
        "speed": np.hypot(ahead, right),
        "clock_ms": own["time_ms"],
    }
    rows = np.column_stack([np.asarray(own[name], np.float64) for name in FICTRAC])
    for name in ("turn_cam", "turn_lab", "direction", "speed"):
        rows[start, FICTRAC[name]] = 0.0
    return rows
