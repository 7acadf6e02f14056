"""What a smooth motion makes likely: densities of orientations on SO(3), as ratios to the uniform one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# The sweep is sequential, each step a hundred operations on few numbers: numpy's cost a quarter of torch's.
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

TURNS_RAD3 = 8 * math.pi**2  # volume of SO(3) in rotation vectors' rad^3
VARIANCE_MAX = 1.0  # rad^2; a wider density has wrapped around SO(3) and is as good as uniform
REST_SHARE = 0.5  # of spheres seen for the first time: as slow as omega's changes; the others turn anyhow
SMALL = 1e-12


@dataclass(frozen=True, kw_only=True)
class Motion:
    """How omega changes; made by second_order, read by the sweep."""

    acceleration_rad_s2: float  # scale per axis
    tail: float  # degrees of freedom
    frame_s: float  # usual time between frames

    def log_ratio(self, angle: Floats, variance: Floats) -> Floats:
        """Return the log of Student's t in three dimensions over the uniform density 1/TURNS_RAD3.

        Args:
            angle: (...), rad, how far an orientation is from where it is expected.
            variance: (...), rad^2, scale per axis.

        Source: textbook; three-dimensional t of shape variance * identity.
        """
        within = np.minimum(variance, VARIANCE_MAX)
        peak = math.lgamma((self.tail + 3) / 2) - math.lgamma(self.tail / 2) - 1.5 * math.log(self.tail * math.pi)
        fall = (self.tail + 3) / 2 * np.log1p(angle**2 / (self.tail * within))
        return math.log(TURNS_RAD3) + peak - 1.5 * np.log(within) - fall

    def predicted_variance(
        self, dt_s: Floats, span_s: Floats, before: Floats, here: Floats, after: Floats | float
    ) -> Floats:
        """Return how far off the orientation is that omega's mean over a span predicts, rad^2 per axis.

        Omega's mean changes by acceleration times the time between the midpoints of span and step; the errors of both
        ends of the span are carried on by the step.

        Args:
            dt_s: (...), step from the span's end to the predicted orientation.
            span_s: (...), time over which omega was measured.
            before: (...), rad^2 per axis, of the span's first orientation.
            here: (...), of its last.
            after: (...), of the one compared with the prediction.
        """
        ratio = dt_s / span_s
        drift = self.acceleration_rad_s2 * (span_s + dt_s) / 2 * dt_s
        return drift**2 + after + (1 + ratio) ** 2 * here + ratio**2 * before

    def rest_variance(self, dt_s: Floats, here: Floats, after: Floats | float) -> Floats:
        """Return the same of a sphere that is as good as still, rad^2 per axis.

        As wide as `predicted_variance` of even steps: else a sphere at rest and a stuck candidate would differ in it.
        """
        return (self.acceleration_rad_s2 * dt_s**2) ** 2 + 3 * (here + after)

    def zones(self, dt_s: Floats) -> Ints:
        """Return in how many ways a turn may have taken place: below half a turn in each frame interval."""
        return np.maximum(np.rint(dt_s / self.frame_s).astype(np.int64), 1)


def turn_between(R_from: Floats, R_to: Floats) -> tuple[Floats, Floats]:
    """Return angle (...), rad in 0 .. pi, and lab axis (..., 3) of the shortest turn; the axis is 0 where it is none.

    Args:
        R_from: (..., 3, 3), rotations.
        R_to: (..., 3, 3), broadcasts against R_from.
    """
    turn = R_to @ np.swapaxes(R_from, -1, -2)
    twice = np.stack(
        [turn[..., 2, 1] - turn[..., 1, 2], turn[..., 0, 2] - turn[..., 2, 0], turn[..., 1, 0] - turn[..., 0, 1]], -1
    )
    sine = np.sqrt((twice**2).sum(-1)) / 2
    cosine = (turn[..., 0, 0] + turn[..., 1, 1] + turn[..., 2, 2] - 1) / 2
    return np.arctan2(sine, cosine), twice / np.maximum(2 * sine, SMALL)[..., None]


def turned(R: Floats, rotvec: Floats) -> Floats:
    """Return (..., 3, 3), orientations (..., 3, 3) after lab turns (..., 3), rad.

    Source: Rodrigues' formula.
    """
    angle = np.sqrt((rotvec**2).sum(-1))[..., None]
    axis = rotvec / np.maximum(angle, SMALL)
    along = (axis[..., None, :] @ R)[..., 0, :]  # axis . column, of the three columns
    x, y, z = (axis[..., i, None] for i in range(3))
    a, b, c = R[..., 0, :], R[..., 1, :], R[..., 2, :]
    across = np.stack([y * c - z * b, z * a - x * c, x * b - y * a], -2)
    cosine, sine = np.cos(angle)[..., None], np.sin(angle)[..., None]
    result: Floats = R * cosine + across * sine + axis[..., None] * along[..., None, :] * (1 - cosine)
    return result
