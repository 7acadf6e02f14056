"""How far the orientations of two cameras, each by itself, lie apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sphereorient.trajectory import Trajectory

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraDistance:
    """Distance between the orientations of two cameras; made by `camera_distances`, drawn by the report."""

    cameras: tuple[str, str]
    distance_rad: Floats  # (K,), frames in which both have one
    edges_rad: Floats  # (B + 1,)
    pdf: Floats  # (B,), 1/rad
    uncorrected_rad: Floats | None  # (K',), the same without the correction of perspective, where it is given
    uncorrected_pdf: Floats | None  # (B,)

    @property
    def median_rad(self) -> float:
        """The middle distance; NaN where there is none."""
        return float(np.median(self.distance_rad)) if len(self.distance_rad) else float("nan")


def camera_distances(
    track: Trajectory, uncorrected: Mapping[str, Floats] | None = None, bins: int = 60
) -> list[CameraDistance]:
    """Return the distances for every pair of cameras; none with one camera.

    Args:
        track: each camera's own R_lab_body, in which perspective is corrected.
        uncorrected: (N, 3, 3) by camera, the same without this correction; None where it is not known.
        bins: of the PDF, from 0 to the largest distance or 180 degrees.

    Source: the paper, section III, distance of the two cameras; the angle by ERRATA A3.
    """
    found = []
    for pair in combinations(sorted(track.cameras), 2):
        apart = _distance(*(track.cameras[name].orientation for name in pair))
        rough = None
        if uncorrected is not None and all(name in uncorrected for name in pair):
            rough = _distance(*(uncorrected[name] for name in pair))
        top = max([float(x.max()) for x in (apart, rough) if x is not None and len(x)], default=np.pi)
        edges = np.linspace(0.0, max(top, 1e-9), bins + 1)
        found.append(
            CameraDistance(
                cameras=(pair[0], pair[1]),
                distance_rad=apart,
                edges_rad=edges,
                pdf=_pdf(apart, edges),
                uncorrected_rad=rough,
                uncorrected_pdf=None if rough is None else _pdf(rough, edges),
            )
        )
    return found


def _pdf(x: Floats, edges: Floats) -> Floats:
    counts, _ = np.histogram(x, edges)
    return np.asarray(counts / max(len(x), 1) / np.diff(edges))


def _distance(A: Floats, B: Floats) -> Floats:
    """Return the geodesic distances where both are known."""
    there = np.isfinite(A).all((1, 2)) & np.isfinite(B).all((1, 2))
    half = np.linalg.norm(A[there] - B[there], axis=(1, 2)) / np.sqrt(8)
    return np.asarray(2 * np.arcsin(np.minimum(half, 1.0)))
