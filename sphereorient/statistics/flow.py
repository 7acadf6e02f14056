"""The flow around the sphere: its scales, dimensionless numbers, and the lift of a spinning sphere."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sphereorient.motion.measure import M_PER_MM
from sphereorient.statistics.bootstrap import Floats, Interval, bootstrap, segment_sums
from sphereorient.statistics.moments import Moments
from sphereorient.statistics.segments import Ensemble
from sphereorient.statistics.settings import BootstrapSettings


@dataclass(frozen=True, kw_only=True)
class FlowScales:
    """Scales of the liquid, such as water-glycerol. Source: Kolmogorov 1941; docs/errata.md A5 (water)."""

    viscosity_m2_s: float  # kinematic
    dissipation_w_kg: float  # energy dissipated per mass

    @property
    def eta_m(self) -> float:
        """Kolmogorov's length, (nu^3 / epsilon)^(1/4), m."""
        return float((self.viscosity_m2_s**3 / self.dissipation_w_kg) ** 0.25)

    @property
    def tau_eta_s(self) -> float:
        """Kolmogorov's time, (nu / epsilon)^(1/2), s."""
        return float((self.viscosity_m2_s / self.dissipation_w_kg) ** 0.5)


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """Properties of the sphere and its flow that are not in a track; None if unknown."""

    diameter_mm: float | None = None
    viscosity_m2_s: float | None = None
    dissipation_w_kg: float | None = None
    u_rms_m_s: float | None = None
    integral_length_m: float | None = None
    integral_time_s: float | None = None

    @property
    def flow(self) -> FlowScales | None:
        """Scales of the flow; None if viscosity or dissipation is unknown."""
        if self.viscosity_m2_s is None or self.dissipation_w_kg is None:
            return None
        return FlowScales(viscosity_m2_s=self.viscosity_m2_s, dissipation_w_kg=self.dissipation_w_kg)


@dataclass(frozen=True, kw_only=True)
class DimensionlessNumber:
    """One dimensionless number, in words and symbols."""

    name: str
    formula: str
    value: float


def dimensionless_numbers(table: Mapping[str, Moments], around: Surroundings) -> list[DimensionlessNumber]:
    """Return the dimensionless numbers for the known surroundings, from the moments by quantity.
    Rms values are of one component, the sphere's corrected for noise. Needs a diameter and a moving centre.
    Source: the paper, section IV: omega_rms against u_rms / D; docs/errata.md A5.
    """
    if around.diameter_mm is None or "velocity" not in table:
        return []
    diameter_m, u_rms_m_s = around.diameter_mm * M_PER_MM, around.u_rms_m_s
    v, a, omega, alpha = (_component_rms(table[q]) for q in ("velocity", "acceleration", "omega_lab", "alpha_lab"))
    rows = [
        ("sphere's rate of shear, rad/s", "v_rms / D", v / diameter_m),
        ("rotation against translation", "omega_rms D / v_rms", omega * diameter_m / v),
        ("angular against linear acceleration", "alpha_rms D / a_rms", alpha * diameter_m / a),
    ]
    if u_rms_m_s:
        rows += [
            ("flow's rate of shear, rad/s", "u_rms / D", u_rms_m_s / diameter_m),
            ("rotation against the flow", "omega_rms D / u_rms", omega * diameter_m / u_rms_m_s),
            ("velocity against the flow", "v_rms / u_rms", v / u_rms_m_s),
        ]
    if around.integral_length_m:
        rows.append(("size against the integral length", "D / L", diameter_m / around.integral_length_m))
    if flow := around.flow:
        acceleration = (flow.dissipation_w_kg**3 / flow.viscosity_m2_s) ** 0.25
        rows += [
            ("size against Kolmogorov's length", "D / eta", diameter_m / flow.eta_m),
            ("rotation at Kolmogorov's rate", "omega_rms tau_eta", omega * flow.tau_eta_s),
            ("acceleration in Kolmogorov's units", "a_rms / (epsilon^3 / nu)^(1/4)", a / acceleration),
        ]
    return [DimensionlessNumber(name=name, formula=formula, value=float(value)) for name, formula, value in rows]


def _component_rms(moments: Moments) -> float:
    """Return the rms over the three components; as measured if the noise is unknown."""
    corrected = moments.corrected_rms.value[:3]
    rms = corrected if np.isfinite(corrected).all() else moments.rms.value[:3]
    return float(np.sqrt((rms**2).mean()))


@dataclass(frozen=True, kw_only=True, eq=False)
class Lift:
    """Correlation of omega x v with a, lab. Columns: x, y, z, and the whole vectors (their sum)."""

    about: ClassVar[str] = "a against omega x v"
    correlation: Interval  # (4,), cosine: <a . l> / sqrt(<a^2> <l^2>) with l = omega x v
    coefficient: Interval  # (4,), least squares of a = C omega x v

    def columns(self) -> dict[str, Any]:
        """Return the columns of its table in a report."""
        return {"component": ("x", "y", "z", "vector"), **vars(self)}


def lift(ensemble: Ensemble, settings: BootstrapSettings | None = None) -> Lift:
    """Return the correlation of a with omega x v of the sphere, lab (Magnus force). Source: the paper, section IV."""
    v, a = (ensemble.values[q] - ensemble.values[q].mean(0) for q in ("velocity", "acceleration"))
    force = np.cross(ensemble.values["omega_lab"], v)
    products = np.stack([a * force, a * a, force * force], axis=-1)
    found = bootstrap(segment_sums(products, ensemble.segment, ensemble.segments), _lift_statistics, settings)
    return Lift(correlation=found.part(0), coefficient=found.part(1))


def _lift_statistics(totals: Floats) -> Floats:
    """Return correlation and coefficient, (..., 2, 4), of sums (..., 3, 3)."""
    whole = np.concatenate([totals, totals.sum(-2, keepdims=True)], axis=-2)
    both, a2, l2 = np.moveaxis(whole, -1, 0)
    return np.stack([both / np.sqrt(a2 * l2), both / l2], axis=-2)
