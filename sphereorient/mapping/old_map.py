"""A learnt map in the body frame of an old one, which fills what was never seen."""

from dataclasses import replace

import torch
from torch import Tensor

from sphereorient.mapping.compare import MapComparison, compare_maps, fit_levels, turned_map
from sphereorient.mapping.grid import texel_areas
from sphereorient.mapping.learn import LearntMap
from sphereorient.sphere.texture import map_directions, texture_coordinates


def corrected(learnt: LearntMap, old: Tensor) -> tuple[LearntMap, MapComparison, float]:
    """Express a learnt map in the frame of an old one (h, 2 h), used where unseen; raise PaintError on a mismatch.

    Return also the displacement against the old map, and the share of the sphere with the old map's texture.
    """
    comparison = compare_maps(learnt.texture, old)
    Q = comparison.R_other_reference
    height = max(len(old), len(learnt.texture))
    texture = turned_map(learnt.texture, Q, height)
    known = torch.isfinite(texture)
    before = old.to(texture) if len(old) == height else turned_map(old.to(texture), torch.eye(3), height)
    gain, offset = fit_levels(before, texture)
    new = replace(
        learnt,
        texture=torch.where(known, texture, (gain * before + offset).clamp(0, 1)),
        seen=torch.where(known, nearest_texels(learnt.seen, Q, height), 0),
        sigma=torch.where(known, nearest_texels(learnt.sigma, Q, height), torch.inf),
        R_lab_body=learnt.R_lab_body @ Q,
    )
    return new, comparison, float((texel_areas(height) * ~known).sum() / texel_areas(height).sum())


def nearest_texels(values: Tensor, R_map_new: Tensor, height: int) -> Tensor:
    """Return a map's values in another body frame by the nearest texel, (height, 2 height)."""
    rows = len(values)
    longitude, latitude = texture_coordinates(map_directions(height) @ R_map_new.double().mT)
    column = ((longitude / torch.pi + 1) * rows).long() % (2 * rows)
    row = ((0.5 - latitude / torch.pi) * rows).long().clamp(0, rows - 1)
    return values[row, column]
