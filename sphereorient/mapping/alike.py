"""Balls whose maps show one paint: they share one map, in one body frame."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sphereorient.errors import PaintError
from sphereorient.mapping.compare import compare_maps, fit_levels, turned_map
from sphereorient.mapping.learn import LearntMap


@dataclass(frozen=True, kw_only=True, eq=False)
class SharedMap:
    """The map of a ball, and the ball whose body frame it is in; that is another one where both wear one paint."""

    learnt: LearntMap
    first: str
    correlation: float  # with the map of `first`; 1 for itself


def shared_maps(learnt: Mapping[str, LearntMap]) -> dict[str, SharedMap]:
    """Return the maps of balls, by name; those that show one paint are joined into one, in the frame of the first."""
    found: dict[str, SharedMap] = {}
    for name, one in learnt.items():
        found[name] = SharedMap(learnt=one, first=name, correlation=1.0)
        for first in [other for other in found if found[other].first == other != name]:
            try:
                compared = compare_maps(one.texture, learnt[first].texture)
            except PaintError:
                continue
            R = compared.R_other_reference
            joined = _joined(found[first].learnt, one, R)
            found[name] = SharedMap(
                learnt=replace(one, R_lab_body=one.R_lab_body @ R), first=first, correlation=compared.correlation
            )
            for same in [other for other in found if found[other].first == first]:
                found[same] = replace(found[same], learnt=_with_map_of(found[same].learnt, joined))
            break
    return found


def _with_map_of(own: LearntMap, other: LearntMap) -> LearntMap:
    return replace(own, texture=other.texture, seen=other.seen, sigma=other.sigma)


def _joined(first: LearntMap, other: LearntMap, R_other_first: Tensor) -> LearntMap:
    """Return the first map with what the other one shows: means by weight, 1 / sigma^2."""
    height = len(first.texture)
    grey, sigma, seen = (
        turned_map(part, R_other_first, height)
        for part in (
            other.texture.double(),
            torch.where(torch.isfinite(other.sigma), other.sigma.double(), torch.nan),
            other.seen.double(),
        )
    )
    gain, offset = fit_levels(grey, first.texture.double())
    own, added = first.sigma.double().square().reciprocal(), (gain * sigma).square().reciprocal().nan_to_num()
    sums = own * first.texture.nan_to_num() + added * (gain * grey + offset).nan_to_num()
    return replace(
        first,
        texture=(sums / (own + added)).float(),
        sigma=(own + added).rsqrt().float(),
        seen=first.seen + seen.nan_to_num().round().long(),
    )
