"""Two ways to add up paths: the cheapest one, and all of them. Costs are negative logarithms, nats."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from sphereorient.errors import SettingsError, refusal

# Arriving totals with an axis of origins -> the total without it, and which origin made it (None: all of them did).
SumOverOrigins = Callable[[Tensor, int], tuple[Tensor, Tensor | None]]


@dataclass(frozen=True, kw_only=True)
class Semiring:
    """What `trellis.sweep` does with costs; product is what follows on the way, sum what meets in one place."""

    sum: SumOverOrigins
    product: Callable[[Tensor, Tensor], Tensor] = torch.add
    zero: float = math.inf  # of the sum: there is no way
    one: float = 0.0  # of the product: the way costs nothing
    levelled: bool  # take each step's least total off: totals that only differ keep their digits in long movies


def _least(arriving: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """The cheapest total and its origin; of equals the lowest index."""
    # Not min(): it wakes all threads for the smallest tensor, on busy cores the sweep then takes ten times as long.
    origin = arriving.argmin(axis)
    return arriving.gather(axis, origin.unsqueeze(axis)).squeeze(axis), origin


def _softly(arriving: Tensor, axis: int, temperature: float) -> tuple[Tensor, None]:
    """-T log of the sum of exp(-total / T); inf where nothing arrives."""
    if temperature == 1.0:
        return -torch.logsumexp(-arriving, axis), None
    return -temperature * torch.logsumexp(arriving / -temperature, axis), None


MIN_PLUS = Semiring(sum=_least, levelled=False)  # plain sums: what is equally cheap stays so


def log_sum_exp(temperature: float = 1.0) -> Semiring:
    """Return the semiring of all paths, each of weight exp(-cost / temperature).

    Args:
        temperature: above 0, unit of the costs; towards 0 the sum is that of `MIN_PLUS`.

    Raises:
        SettingsError: a temperature that is not above 0.
    """
    if not 0 < temperature < math.inf:
        do = "for temperature 0 take the shortest path"
        raise SettingsError(refusal("temperature", expected="a number above 0", got=str(temperature), do=do))
    return Semiring(sum=partial(_softly, temperature=temperature), levelled=True)
