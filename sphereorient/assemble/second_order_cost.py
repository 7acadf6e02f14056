"""The second-order path cost in nats: pictures, motion, misses and breaks; for beam.py (numpy) and layer.py (torch).

Densities of orientations are ratios to the uniform density on SO(3).
"""

import math
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.assemble.settings import PathSettings
from sphereorient.errors import SettingsError, refusal

Floats = NDArray[np.float64]
Values = TypeVar("Values", Floats, Tensor)

TURNS_RAD3 = 8 * math.pi**2  # volume of SO(3) in rotation vectors' rad^3
VARIANCE_MAX = 1.0  # rad^2; a wider density is practically uniform on SO(3)


@dataclass(frozen=True, kw_only=True)
class SecondOrderCost:
    """The parameters of the cost: floats, or 0-dimensional tensors if learnt. See PathSettings."""

    acceleration_rad_s2: float | Tensor
    tail: float | Tensor
    miss_probability: float | Tensor
    miss_again_probability: float | Tensor
    break_probability: float | Tensor
    stuck_probability: float | Tensor
    follow_probability: float | Tensor
    evidence_doubt: float | Tensor
    evidence_scale: float | Tensor
    sigma_scale: float | Tensor

    @classmethod
    def of(cls, settings: PathSettings) -> "SecondOrderCost":
        """Take the parameters from settings with a number for the acceleration."""
        if settings.acceleration_rad_s2 is None:
            do = "set it; only `track` estimates it"
            raise SettingsError(refusal("path.acceleration_rad_s2", expected="a number", got="null", do=do))
        return cls(**{name: getattr(settings, name) for name in PARAMETERS})

    def picture_log_weight(self, nll: Tensor, mask: Tensor) -> Tensor:
        """Return the log probability (..., C) of each candidate of a frame by the pictures alone; 0 where masked."""
        claimed = torch.where(mask, -self.evidence_scale * nll, -torch.inf)
        # A frame without candidates: zeros, as the gradient of inf - inf is NaN.
        weight = torch.softmax(torch.where(mask.any(-1, keepdim=True), claimed, 0.0), -1)
        count = mask.sum(-1)[..., None].clamp_min(1)
        weight = (1 - self.evidence_doubt) * weight + self.evidence_doubt / count
        return torch.where(mask, weight, 1.0).log()

    def presence(self) -> tuple[list[Any], list[Any]]:
        """Return the costs that a candidate is right, and that none is; index 1: one was right in the last frame."""
        each = self.miss_again_probability, self.miss_probability
        return [-_library(p).log1p(-p) for p in each], [-_library(p).log(p) for p in each]

    def log_ratio(self, misfit: Values, variance: Values) -> Values:
        """Return the log density of Student's t in three dimensions, over the uniform one.
        `misfit`, rad^2, is angle^2 or (2 sin(angle / 2))^2 to the expected rotation; `variance`, rad^2, is per axis.
        """
        lib, tail = _library(variance), self.tail
        own: Any = torch if isinstance(tail, Tensor) else math
        peak = own.lgamma((tail + 3) / 2) - own.lgamma(tail / 2) - 1.5 * own.log(tail * math.pi)
        within = lib.minimum(variance, lib.asarray(VARIANCE_MAX))
        fall = (tail + 3) / 2 * lib.log1p(misfit / (tail * within))
        result: Values = math.log(TURNS_RAD3) + peak - 1.5 * lib.log(within) - fall
        return result

    def predicted_variance(
        self, dt_s: Values, span_s: Values, before: Values, here: Values, after: Values | float
    ) -> Values:
        """Return the variance per axis, rad^2, of an orientation about the prediction by the mean omega of a span.
        dt_s is the step after the span, span_s its length; before, here and after are the variances per axis, rad^2, of
        the span's first and last orientation and of the predicted one.
        """
        ratio = dt_s / span_s
        drift = self.acceleration_rad_s2 * (span_s + dt_s) / 2 * dt_s
        result: Values = drift**2 + after + (1 + ratio) ** 2 * here + ratio**2 * before
        return result

    def rest_variance(self, dt_s: Values, here: Values, after: Values) -> Values:
        """Return the variance for a sphere at rest, as wide as `predicted_variance` of even steps, for comparison."""
        result: Values = (self.acceleration_rad_s2 * dt_s**2) ** 2 + 3 * (here + after)
        return result

    def candidate(self, log_ratio: Values, still: Values) -> Values:
        """Return the cost of a candidate: its log density if false, less that if right. A false candidate is anywhere,
        or stays (`still`, -inf without a previous frame), or follows the motion (`log_ratio`). Staying never explains a
        candidate better than the motion does: otherwise noise would lose a sphere at rest.
        """
        lib = _library(still)
        shares = 1 - self.stuck_probability - self.follow_probability, self.stuck_probability, self.follow_probability
        anywhere, stuck, follow = (_log(share, still) for share in shares)
        false = lib.logaddexp(lib.logaddexp(anywhere, stuck + lib.minimum(still, log_ratio)), follow + log_ratio)
        result: Values = false - log_ratio
        return result


# The keys of `PathSettings` in the cost; `PathLayer` learns them.
PARAMETERS = tuple(entry.name for entry in fields(SecondOrderCost))


def _library(values: Floats | Tensor | float) -> Any:
    return torch if isinstance(values, Tensor) else np


def _log(number: float | Tensor, like: Floats | Tensor) -> Any:
    if isinstance(like, Tensor):
        return torch.as_tensor(number, dtype=like.dtype, device=like.device).log()
    return np.log(number)
