"""Maps that show one paint, put into one body frame: an old map and a new one; those of balls that look alike."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sphereorient.errors import PaintError
from sphereorient.files.threads import Progress
from sphereorient.mapping.compare import MapComparison, compare_maps, fit_levels, turned_map
from sphereorient.mapping.grid import texel_areas
from sphereorient.mapping.learn import LearntMap
from sphereorient.sphere.texture import map_directions, texture_coordinates


@dataclass(frozen=True, kw_only=True, eq=False)
class SharedMap:
    """The map of a ball, and the ball whose body frame it is in; that is another one where both wear one paint."""

    learnt: LearntMap
    first: str
    correlation: float  # with the map of `first`; 1 for itself


def shared_maps(learnt: Mapping[str, LearntMap], progress: Progress) -> dict[str, SharedMap]:
    """Return the maps of balls, by name; those that show one paint are joined into one, in the frame of the first."""
    found: dict[str, SharedMap] = {}
    for name, one in learnt.items():
        found[name] = SharedMap(learnt=one, first=name, correlation=1.0)
        for first in [other for other in found if found[other].first == other != name]:
            progress("balls of one paint", len(found), len(learnt))
            try:
                compared = compare_maps(one.texture, learnt[first].texture)
            except PaintError:
                continue
            R = compared.R_other_reference
            joined = _joined(found[first].learnt, one, R)
            own = replace(one, R_lab_body=one.R_lab_body @ R)
            found[name] = SharedMap(learnt=own, first=first, correlation=compared.correlation)
            for same, its in found.items():
                if its.first == first:
                    own = replace(its.learnt, texture=joined.texture, seen=joined.seen, sigma=joined.sigma)
                    found[same] = replace(its, learnt=own)
            break
    return found


def _joined(first: LearntMap, other: LearntMap, R_other_first: Tensor) -> LearntMap:
    """Return the first map with what the other one shows: means by weight, 1 / sigma^2."""
    known = torch.where(torch.isfinite(other.sigma), other.sigma.double(), torch.nan)
    parts = (other.texture.double(), known, other.seen.double())
    grey, sigma, seen = (turned_map(part, R_other_first, len(first.texture)) for part in parts)
    gain, offset = fit_levels(grey, first.texture.double())
    own, added = first.sigma.double().square().reciprocal(), (gain * sigma).square().reciprocal().nan_to_num()
    sums = own * first.texture.nan_to_num() + added * (gain * grey + offset).nan_to_num()
    texture, count = (sums / (own + added)).float(), first.seen + seen.nan_to_num().round().long()
    return replace(first, texture=texture, sigma=(own + added).rsqrt().float(), seen=count)


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
