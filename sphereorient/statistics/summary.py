"""Everything that section IV of the paper shows, of one or many tracks, in one record."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sphereorient.errors import TrackError
from sphereorient.statistics.attitude import EulerDensity, Uniformity, euler_densities, uniformity
from sphereorient.statistics.bootstrap import FEWEST
from sphereorient.statistics.correlation import Correlation, correlation
from sphereorient.statistics.density import Density, density
from sphereorient.statistics.durations import Durations, durations
from sphereorient.statistics.flow import Comparison, FlowScales, comparisons, flow_scales
from sphereorient.statistics.increments import Increments, increment_density, increments
from sphereorient.statistics.isotropy import FrameOfRow, Isotropy, frame_of_omega, isotropy
from sphereorient.statistics.lift import Lift, lift
from sphereorient.statistics.moments import Moments, table_of_moments
from sphereorient.statistics.noise import RATES, MultiLag, NoiseWarning, multi_lag, noise_warnings
from sphereorient.statistics.segments import UNITS, Ensemble, ensemble_of
from sphereorient.statistics.settings import StatisticsSettings
from sphereorient.statistics.widths import WidthCurve, width_curve
from sphereorient.trajectory import Trajectory

CORRELATED = ("velocity", "acceleration", "omega_lab", "alpha_lab")
SHOWN_LAGS = 5  # increments whose densities are shown, from one frame to the integral time
STEPS = 10  # of the progress

Progress = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """What a track does not say of itself: the sphere's size and its flow; all of it may be unknown."""

    diameter_mm: float | None = None
    viscosity_m2_s: float | None = None
    dissipation_w_kg: float | None = None
    u_rms_m_s: float | None = None
    integral_length_m: float | None = None

    @property
    def flow(self) -> FlowScales | None:
        """The flow's own scales; None where viscosity or dissipation is not known."""
        if self.viscosity_m2_s is None or self.dissipation_w_kg is None:
            return None
        return flow_scales(self.viscosity_m2_s, self.dissipation_w_kg)


@dataclass(frozen=True, kw_only=True, eq=False)
class Distributions:
    """What needs two segments or more, since its error bars come from them; a part of `Summary`."""

    densities: Mapping[str, tuple[Density, ...]]  # by quantity: x, y, z
    increments: Increments  # of omega_lab
    increment_densities: Mapping[int, Density]  # by lag in frames, x component
    correlations: Mapping[str, Correlation]  # by quantity, CORRELATED
    durations: Durations | None  # None where only pieces of one segment are there
    angles: Sequence[EulerDensity]
    uniformity: Uniformity
    isotropies: Mapping[str, Isotropy]  # by quantity
    rows: Mapping[str, FrameOfRow]  # omega_lab, omega_body: in which frame they are written
    lift: Lift
    multi_lag: Mapping[str, MultiLag]  # acceleration, alpha_lab; without a quantity that cannot be fitted
    widths: Mapping[str, WidthCurve]  # velocity, acceleration, alpha_lab


@dataclass(frozen=True, kw_only=True, eq=False)
class Summary:
    """All numbers of a report; made by `summarise`, read by figures, tables and the page."""

    settings: StatisticsSettings  # with the integral time that was used
    surroundings: Surroundings
    ensemble: Ensemble
    table: Mapping[str, Moments]  # Table I; of one segment without intervals
    warnings: Sequence[NoiseWarning]
    comparisons: Sequence[Comparison]
    distributions: Distributions | None  # None with fewer than two segments

    @property
    def integral_time_s(self) -> float:
        """Integral time of the velocity that was given or measured; NaN where neither."""
        return self.settings.integral_time_s or float("nan")


def summarise(
    tracks: Trajectory | Sequence[Trajectory],
    settings: StatisticsSettings | None = None,
    surroundings: Surroundings | None = None,
    progress: Progress = lambda done, total: None,
    name: str = "tracks",
) -> Summary:
    """Compute all statistics of tracks.

    Where no integral time of the velocity is given, it is measured on all segments that have enough frames; the short
    ones are then left out. Of a single segment only the table is given, without intervals: nothing says how much
    another one would differ.

    Args:
        tracks: one or many, of one kind of method.
        settings: which segments count, and the bootstrap.
        surroundings: the sphere's diameter and the flow, for the comparisons.
        progress: called with steps done and all steps.
        name: what the tracks are called in a message.

    Returns:
        The summary.

    Raises:
        TrackError: no usable frame, or tracks of kinds that do not go together.

    Source: the paper, section IV, with ERRATA A5, E6, E7.
    """
    many = [tracks] if isinstance(tracks, Trajectory) else list(tracks)
    settings = settings or StatisticsSettings()
    around = surroundings or Surroundings()
    ensemble = ensemble_of(many, settings, name, fewest=1)
    progress(1, STEPS)
    if ensemble.segments >= FEWEST and settings.integral_time_s is None:
        ensemble, settings = _long_enough(ensemble, settings)
    table = dict(table_of_moments(ensemble, settings))
    progress(2, STEPS)
    more = None
    if ensemble.segments >= FEWEST:
        more = _distributions(many, ensemble, settings, lambda done: progress(2 + done, STEPS))
    progress(STEPS, STEPS)
    return Summary(
        settings=settings,
        surroundings=around,
        ensemble=ensemble,
        table=table,
        warnings=noise_warnings(table, ensemble.error),
        comparisons=_comparisons(table, around),
        distributions=more,
    )


def _long_enough(ensemble: Ensemble, settings: StatisticsSettings) -> tuple[Ensemble, StatisticsSettings]:
    """Leave out segments that are short against the integral time that all of them show."""
    measured = float(correlation(ensemble, "velocity", settings=settings).integral_time_s.value[3])
    if not measured > 0:
        return ensemble, settings
    settings = settings.model_copy(update={"integral_time_s": measured})
    kept = ensemble.span_s >= settings.min_integral_times * measured
    return (ensemble.at(kept) if kept.sum() >= FEWEST else ensemble), settings


def _distributions(
    tracks: Sequence[Trajectory], ensemble: Ensemble, settings: StatisticsSettings, progress: Callable[[int], None]
) -> Distributions:
    densities = {
        quantity: tuple(density(ensemble, quantity, i, settings=settings) for i in range(3)) for quantity in UNITS
    }
    progress(2)
    curves = {quantity: correlation(ensemble, quantity, settings=settings) for quantity in CORRELATED}
    progress(3)
    longest_s = float(curves["omega_lab"].integral_time_s.value[3])
    steps = increments(ensemble, integral_time_s=longest_s if longest_s > 0 else None, settings=settings)
    chosen = np.unique(np.linspace(0, len(steps.lag_frames) - 1, SHOWN_LAGS).round().astype(int))
    shown = [int(lag) for lag in steps.lag_frames[chosen]]
    lagged = {lag: increment_density(ensemble, lag, settings=settings) for lag in shown}
    progress(4)
    angles = euler_densities(ensemble, settings=settings)
    uniform = uniformity(ensemble.R_lab_body, ensemble.segment)
    progress(5)
    isotropies = {quantity: isotropy(ensemble, quantity, settings) for quantity in UNITS}
    rows = {name: frame_of_omega(ensemble, ensemble.values[name]) for name in ("omega_lab", "omega_body")}
    progress(6)
    widths = {q: width_curve(tracks, q, settings=settings) for q in ("velocity", "acceleration", "alpha_lab")}
    progress(7)
    return Distributions(
        densities=densities,
        increments=steps,
        increment_densities=lagged,
        correlations=curves,
        durations=_durations(tracks, ensemble, settings),
        angles=angles,
        uniformity=uniform,
        isotropies=isotropies,
        rows=rows,
        lift=lift(ensemble, settings),
        multi_lag=_multi_lag(tracks, settings),
        widths=widths,
    )


def _durations(tracks: Sequence[Trajectory], ensemble: Ensemble, settings: StatisticsSettings) -> Durations | None:
    """Return the histogram beyond what was left out: by number of frames or by integral times."""
    whole = ensemble
    if settings.max_duration_s is not None:
        whole = ensemble_of(tracks, settings.model_copy(update={"max_duration_s": None}), fewest=1)
    if whole.segments < FEWEST:
        return None
    least_s = max(settings.min_frames * whole.step_s, settings.min_integral_times * (settings.integral_time_s or 0.0))
    return durations(whole.span_s, min(least_s, float(whole.span_s.min())), level=settings.level)


def _multi_lag(tracks: Sequence[Trajectory], settings: StatisticsSettings) -> dict[str, MultiLag]:
    found = {}
    for quantity in RATES:
        try:
            found[quantity] = multi_lag(list(tracks), quantity, settings=settings)
        except TrackError:  # too few neighbouring frames: it is left out, and the page says so
            continue
    return found


def _comparisons(table: dict[str, Moments], around: Surroundings) -> list[Comparison]:
    if around.diameter_mm is None:
        return []
    return comparisons(
        table,
        around.diameter_mm,
        around.flow,
        u_rms_m_s=around.u_rms_m_s,
        integral_length_m=around.integral_length_m,
    )
