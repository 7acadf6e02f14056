"""The two views of the paint that are most easily taken for each other."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.preflight.finding import Finding, Severity
from sphereorient.search.normalisation import LocalNormalisation
from sphereorient.search.refine_rotation import detail_level, level_reference, refine_rotation
from sphereorient.search.settings import GreySearchSettings
from sphereorient.sphere import orthographic_view
from sphereorient.sphere.texture_table import texture_table

STEP_DEG = 15.0  # of the grid of rotations with which views are compared
VIEWS = 300  # sides from which the ball is looked at, 8 degrees apart; turning the picture makes no other view
APART_DEG = 20.0  # nearer rotations show the same view, a little turned
CLIMBS = 40  # pairs that are turned to their best likeness
BATCH = 64  # views that are normalised at once
ALIKE, SAME = 0.85, 0.97  # share of one view that the other explains, from which on single frames are doubtful, useless


@dataclass(frozen=True, kw_only=True, eq=False)
class Alike:
    """Two views and how alike they are; made by `most_alike`, drawn by the figure."""

    score: float  # share of the one's paint that the other explains under any smooth light, as the search scores
    angle_rad: float  # between the two orientations
    pictures: Tensor  # (2, S, S), 0 black .. 1 white, NaN beyond the disk
    R_view_body: Tensor  # (2, 3, 3)


def most_alike(texture: Tensor, settings: GreySearchSettings) -> Alike:
    """Find the pair of views, far from each other, of which one explains most of the other.

    Args:
        texture: (H, 2 H), the map, 0 black .. 1 white.
        settings: of the search for orientations, whose views are used.
    """
    size = settings.size_px
    view = orthographic_view(size)
    normal = view.normal_view.T.contiguous()
    paint = texture_table(texture, min(2.0 / size, settings.detail), 192)

    def pictures(R: Tensor) -> Tensor:
        return view.picture(paint.sample(R.mT @ normal)[0])

    normalisation = LocalNormalisation(size, detail=settings.detail, window=settings.window, clip=settings.clip)

    def normalised(R: Tensor) -> Tensor:
        return torch.cat([normalisation(pictures(some)) for some in torch.split(R, BATCH)])

    seen = towards(spread_directions(VIEWS)).float()
    grid = so3.lattman_grid(math.radians(STEP_DEG)).float()
    likeness = normalised(seen) @ normalised(grid).T
    near = _cosine(seen, grid) > math.cos(math.radians(APART_DEG))
    best = likeness.masked_fill(near, -1.0).max(1)
    rough, fine = detail_level(view, paint, settings.detail, 2), detail_level(view, paint, 2.0 / size, 1)
    found = Alike(score=0.0, angle_rad=math.pi, pictures=pictures(seen[:1]).expand(2, -1, -1), R_view_body=seen[:2])
    for k in best.values.argsort(descending=True)[:CLIMBS].tolist():
        disk = pictures(seen[k : k + 1])[0]
        R, _ = refine_rotation(rough, level_reference(rough, disk), grid[best.indices[k]][None], settings.rough_steps)
        R, score = refine_rotation(fine, level_reference(fine, disk), R, settings.fine_steps)
        angle = float(so3.geodesic_distance(seen[k].double(), R[0].double()))
        if float(score) > found.score and angle > math.radians(APART_DEG):
            pair = torch.stack([seen[k], R[0]])
            shown = view.picture(paint.sample(pair.mT @ normal)[0], math.nan)
            found = Alike(score=float(score), angle_rad=angle, pictures=shown, R_view_body=pair)
    return found


def spread_directions(count: int) -> Tensor:
    """Return directions spread evenly over the sphere, (count, 3) float64.

    Source: the golden spiral (textbook).
    """
    k = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * k / count
    longitude = k * (math.pi * (1 + math.sqrt(5)))
    across = (1 - z.square()).sqrt()
    return torch.stack([across * longitude.cos(), across * longitude.sin(), z], dim=-1)


def towards(direction_body: Tensor) -> Tensor:
    """Return orientations R_view_body, (n, 3, 3), that turn body directions (n, 3) to the viewer, against z of V."""
    back = -direction_body
    helper = torch.eye(3, dtype=back.dtype)[back.abs().argmin(-1)]
    right = torch.nn.functional.normalize(torch.linalg.cross(helper, back), dim=-1)
    return torch.stack([right, torch.linalg.cross(back, right), back], dim=-2)


def _cosine(A: Tensor, B: Tensor) -> Tensor:
    """Cosine of the angle between rotations (n, 3, 3) and (m, 3, 3), (n, m)."""
    return (A.reshape(-1, 9) @ B.reshape(-1, 9).T - 1) / 2


def look_alikes(pair: Alike) -> Finding:
    """Judge the most confusable pair of views."""
    title = "views that look alike"
    measured = (
        f"the worst pair, {math.degrees(pair.angle_rad):.0f} degrees apart: "
        f"one explains {100 * pair.score:.0f} % of the other"
    )
    if pair.score >= SAME:
        advice = "break the paint's symmetry: add a patch that is found once only; these two views cannot be told apart"
        return Finding(title=title, severity=Severity.FAULT, measured=measured, advice=advice)
    if pair.score >= ALIKE:
        advice = "add a patch where the two views are alike: single frames are doubtful there, only their history tells"
        return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)
    return Finding(title=title, severity=Severity.OK, measured=measured + ": single frames can be told")
