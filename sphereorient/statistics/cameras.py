"""Distance between the orientations by two cameras, each measured alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, zip_longest

import numpy as np

from sphereorient.statistics.bootstrap import Floats
from sphereorient.trajectory import Trajectory
from sphereorient.trajectory.rotations import distance_rad


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraDistance:
    """Distance between the orientations by two cameras."""

    cameras: tuple[str, str]
    distance_rad: Floats  # (K,), frames with both orientations
    edges_rad: Floats  # (B + 1,)
    pdf: Floats  # (B,), 1/rad
    uncorrected_rad: Floats | None  # (K',), the same without the correction of perspective, if given
    uncorrected_pdf: Floats | None  # (B,)


def camera_distances(
    tracks: Trajectory | Sequence[Trajectory], uncorrected: Sequence[Mapping[str, Floats] | None] = (), bins: int = 60
) -> list[CameraDistance]:
    """Return the distances for every pair of cameras, frames of all tracks together; empty for one camera.
    `uncorrected` holds for each track the orientations of its cameras by `cameras.without_perspective`; None: unknown.
    Source: the paper, section III, distance of the two cameras; the angle by docs/errata.md A3.
    """
    many = [tracks] if isinstance(tracks, Trajectory) else list(tracks)
    apart: dict[tuple[str, str], list[Floats]] = {}
    rough: dict[tuple[str, str], list[Floats]] = {}
    for track, other in zip_longest(many, uncorrected):
        own = {name: camera.orientation for name, camera in track.cameras.items()}
        for pair in combinations(sorted(own), 2):
            for parts, of in ((apart, own), (rough, other or {})):
                if set(pair) <= set(of):
                    apart_rad = distance_rad(*(of[name] for name in pair))
                    parts.setdefault(pair, []).append(apart_rad[np.isfinite(apart_rad)])  # frames with both
    return [_pooled(pair, np.concatenate(parts), rough.get(pair), bins) for pair, parts in apart.items()]


def _pooled(pair: tuple[str, str], apart: Floats, rough_parts: list[Floats] | None, bins: int) -> CameraDistance:
    rough = None if rough_parts is None else np.concatenate(rough_parts)
    top = max([float(x.max()) for x in (apart, rough) if x is not None and len(x)], default=np.pi)
    edges = np.linspace(0.0, max(top, 1e-9), bins + 1)
    own, other = _pdf(apart, edges), None if rough is None else _pdf(rough, edges)
    return CameraDistance(
        cameras=pair, distance_rad=apart, edges_rad=edges, pdf=own, uncorrected_rad=rough, uncorrected_pdf=other
    )


def _pdf(x: Floats, edges: Floats) -> Floats:
    counts, _ = np.histogram(x, edges)
    return np.asarray(counts / max(len(x), 1) / np.diff(edges))
