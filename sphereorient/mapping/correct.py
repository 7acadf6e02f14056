"""A learnt map in the frame of an old one, which keeps what the movies did not show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sphereorient.mapping.compare import MapComparison, compare_maps, fit_levels, turned_map
from sphereorient.mapping.grid import texel_areas
from sphereorient.mapping.record import LearntMap
from sphereorient.sphere.texture import texture_coordinates
from sphereorient.synth.textures import map_directions


@dataclass(frozen=True, kw_only=True, eq=False)
class Correction:
    """What became of an old map; made by `corrected`."""

    learnt: LearntMap  # in the old map's body frame, the old paint, unseen, where the movies showed none
    comparison: MapComparison  # how far the paint lies from where the old map had it
    kept_share: float  # of the sphere that is the old map's still


def corrected(learnt: LearntMap, old: Tensor) -> Correction:
    """Bring a learnt map, and its attitudes, into the body frame of an old map that it corrects.

    The old map has no say in where paint is that the movies show: it gives the frame, and what was never seen.

    Args:
        learnt: from the movies alone.
        old: (h, 2 h), 0 black .. 1 white.

    Raises:
        PaintError: the old map is not one of this ball.
    """
    comparison = compare_maps(learnt.texture, old)
    Q = comparison.R_other_reference
    height = max(len(old), len(learnt.texture))
    texture = turned_map(learnt.texture, Q, height)
    known = torch.isfinite(texture)
    view = torch.eye(3, dtype=torch.float64)
    before = old.to(texture) if len(old) == height else turned_map(old.to(texture), view, height)
    gain, offset = fit_levels(before, texture)
    # Counts and sigmas of the texel that lies there: a mean of counts is none.
    seen = torch.where(known, nearest(learnt.seen, Q, height), 0)
    share = float((texel_areas(height) * ~known).sum() / texel_areas(height).sum())
    new = replace(
        learnt,
        texture=torch.where(known, texture, (gain * before + offset).clamp(0, 1)),
        seen=seen,
        sigma=torch.where(known, nearest(learnt.sigma, Q, height), torch.inf),
        R_lab_body=learnt.R_lab_body @ Q,
    )
    return Correction(learnt=new, comparison=comparison, kept_share=share)


def nearest(values: Tensor, R_map_new: Tensor, height: int) -> Tensor:
    """Return values of a map's texels in another body frame, those of the nearest texel, (height, 2 height)."""
    rows = len(values)
    longitude, latitude = texture_coordinates(map_directions(height) @ R_map_new.double().mT)
    column = ((longitude / torch.pi + 1) * rows).long() % (2 * rows)
    row = ((0.5 - latitude / torch.pi) * rows).long().clamp(0, rows - 1)
    return values[row, column]
