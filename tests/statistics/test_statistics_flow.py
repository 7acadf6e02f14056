import numpy as np
import pytest
from statistics_examples import ensemble, holds

from sphereorient.statistics.flow import FlowScales, Surroundings, dimensionless_numbers, lift
from sphereorient.statistics.moments import table_of_moments
from sphereorient.statistics.settings import BootstrapSettings

FEW = BootstrapSettings(resamples=200)


@pytest.mark.parametrize(
    ("viscosity", "dissipation", "eta_um", "tau_ms"), [(1e-6, 1.0, 31.6, 1.0), (8e-6, 1.7, 131.7, 2.17)]
)
def test_kolmogorovs_scales_of_water_and_of_the_mix(viscosity, dissipation, eta_um, tau_ms):  # docs/errata.md A5
    found = FlowScales(viscosity_m2_s=viscosity, dissipation_w_kg=dissipation)
    assert found.eta_m * 1e6 == pytest.approx(eta_um, rel=1e-3)
    assert found.tau_eta_s * 1e3 == pytest.approx(tau_ms, rel=2e-3)


def test_dimensionless_numbers_that_a_person_works_out_by_hand():
    rng = np.random.default_rng(3)
    values = {
        name: scale * rng.choice([-1.0, 1.0], (1000, 3)) for name, scale in (("velocity", 0.36), ("omega_lab", 8.0))
    }
    table = table_of_moments(ensemble([100] * 10, **values), FEW)
    flow = {"viscosity_m2_s": 8e-6, "dissipation_w_kg": 1.7, "u_rms_m_s": 0.6, "integral_length_m": 0.03}
    found = {row.formula: row.value for row in dimensionless_numbers(table, Surroundings(diameter_mm=18.0, **flow))}
    assert found["u_rms / D"] == pytest.approx(33.333, rel=1e-3)
    assert found["omega_rms D / u_rms"] == pytest.approx(0.24, rel=1e-2)
    assert found["D / eta"] == pytest.approx(136.7, rel=1e-2)
    assert found["D / L"] == pytest.approx(0.6)
    assert "u_rms / D" not in {row.formula for row in dimensionless_numbers(table, Surroundings(diameter_mm=18.0))}


def test_a_planted_lift_is_found_with_its_coefficient():
    rng = np.random.default_rng(4)
    v, omega = rng.standard_normal((2, 20_000, 3))
    a = 0.7 * np.cross(omega, v) + rng.standard_normal((20_000, 3))
    found = lift(ensemble([100] * 200, velocity=v, omega_lab=omega, acceleration=a), FEW)
    assert holds(found.coefficient, 0.7).sum() >= 3
    expected = 0.7 * np.sqrt(2) / np.sqrt(0.49 * 2 + 1)
    assert found.correlation.value[3] == pytest.approx(expected, abs=0.02)


def test_without_lift_there_is_no_correlation():
    found = lift(ensemble([100] * 200), FEW)
    assert (np.abs(found.correlation.value) < 4 * found.correlation.error).all()
    assert found.correlation.error[3] == pytest.approx(1 / np.sqrt(60_000), rel=0.3)
