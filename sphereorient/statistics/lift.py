"""Does the sphere's spin push it sideways: correlation of omega x v with the acceleration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.statistics.bootstrap import Interval, bootstrap, per_segment
from sphereorient.statistics.segments import Ensemble
from sphereorient.statistics.settings import BootstrapSettings

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Lift:
    """Correlation of omega x v with a, lab; made by `lift`. Columns: x, y, z, and the vectors' (their sum)."""

    correlation: Interval  # (4,), cosine: <a . l> / sqrt(<a^2> <l^2>) with l = omega x v
    coefficient: Interval  # (4,), least squares of a = C omega x v


def lift(ensemble: Ensemble, settings: BootstrapSettings | None = None) -> Lift:
    """Return how far the acceleration follows omega x v, the direction of Magnus's force.

    The velocity is the sphere's in the lab, as in the paper: the liquid's own is not known.

    Args:
        ensemble: the samples.
        settings: of the bootstrap.

    Source: the paper, section IV, lift.
    """
    v, a = (ensemble.values[q] - ensemble.values[q].mean(0) for q in ("velocity", "acceleration"))
    pushed = np.cross(ensemble.values["omega_lab"], v)
    products = np.stack([a * pushed, a * a, pushed * pushed], axis=-1)
    found = bootstrap(per_segment(products, ensemble.segment, ensemble.segments), _statistics, settings)
    return Lift(correlation=found.part(0), coefficient=found.part(1))


def _statistics(totals: Floats) -> Floats:
    """Return correlation and coefficient, (..., 2, 4), of sums (..., 3, 3)."""
    whole = np.concatenate([totals, totals.sum(-2, keepdims=True)], axis=-2)
    both, a2, l2 = np.moveaxis(whole, -1, 0)
    return np.stack([both / np.sqrt(a2 * l2), both / l2], axis=-2)
