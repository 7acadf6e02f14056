"""All statistics of the paper's section IV; a new one needs a field of `Distributions` and a call in `_distributions`.
A record with `about` and `columns` has a table with the field's name in a report.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np

from sphereorient.errors import TrackError
from sphereorient.statistics import density, isotropy, lags, noise
from sphereorient.statistics.bootstrap import FEWEST
from sphereorient.statistics.flow import DimensionlessNumber, Lift, Surroundings, dimensionless_numbers, lift
from sphereorient.statistics.moments import Moments, table_of_moments
from sphereorient.statistics.segments import UNITS, Durations, Ensemble, durations, ensemble_of
from sphereorient.statistics.settings import StatisticsSettings
from sphereorient.trajectory import Trajectory

CORRELATED = ("velocity", "acceleration", "omega_lab", "alpha_lab")
SHOWN_LAGS = 5  # increments with a density, from one frame to the integral time
WIDTHS_OF = ("velocity", "acceleration", "alpha_lab")
STEPS = 10  # of the progress

Advance = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Distributions:
    """The statistics of two segments or more; a part of `Summary`."""

    densities: Mapping[str, tuple[density.Density, ...]]  # by quantity: x, y, z
    increments: lags.Increments  # of omega_lab
    increment_densities: Mapping[int, density.Density]  # by lag in frames, x component
    correlations: Mapping[str, lags.Correlation]  # by quantity, CORRELATED
    durations: Durations | None  # None if all segments are pieces of one
    angles: Sequence[isotropy.EulerDensity]
    uniformity: isotropy.Uniformity
    isotropies: Mapping[str, isotropy.Isotropy]  # by quantity
    rows: Mapping[str, isotropy.FrameOfRow]  # omega_lab, omega_body: the frame of their components
    lift: Lift | None  # None for a fixed centre
    multi_lag: Mapping[str, noise.MultiLag]  # acceleration, alpha_lab, if fitted
    widths: Mapping[str, noise.WidthCurve]  # velocity, acceleration, alpha_lab


@dataclass(frozen=True, kw_only=True, eq=False)
class Summary:
    """All numbers of a report."""

    settings: StatisticsSettings  # with the used integral time
    surroundings: Surroundings
    ensemble: Ensemble
    table: Mapping[str, Moments]  # Table I; without intervals for one segment
    warnings: Sequence[str]  # of noise, a sentence each
    dimensionless_numbers: Sequence[DimensionlessNumber]
    distributions: Distributions | None  # None with fewer than two segments

    @property
    def integral_time_s(self) -> float:
        """Integral time: of the settings, of the flow, or measured on the velocity; NaN if unknown."""
        return self.settings.integral_time_s or float("nan")


def summarise(
    tracks: Trajectory | Sequence[Trajectory],
    settings: StatisticsSettings | None = None,
    surroundings: Surroundings | None = None,
    progress: Advance = lambda done, total: None,
    name: str = "tracks",
) -> Summary:
    """Compute all statistics of tracks, `name` in messages; an integral time is measured if not given.
    A single segment gives only the table, without intervals; without a usable segment its numbers are NaN. Raises
    TrackError (no valid frame, or tracks of kernels and of smoothers together).
    Source: the paper, section IV, with docs/errata.md A5, E6, E7.
    """
    many = [tracks] if isinstance(tracks, Trajectory) else list(tracks)
    settings = settings or StatisticsSettings()
    around = surroundings or Surroundings()
    if settings.integral_time_s is None:
        settings = settings.model_copy(update={"integral_time_s": around.integral_time_s})
    ensemble = ensemble_of(many, settings, name, fewest=0)
    if ensemble.length_unit != "mm":  # not comparable with a flow in m
        around = replace(around, diameter_mm=None)
    progress(1, STEPS)
    if ensemble.segments >= FEWEST and settings.integral_time_s is None:
        first = lags.correlation(ensemble, next(iter(ensemble.values)), settings=settings)
        measured = float(first.integral_time_s.value[3])
        if measured > 0:  # leave out segments short against the integral time of all
            settings = settings.model_copy(update={"integral_time_s": measured})
            kept = ensemble.span_s >= settings.min_integral_times * measured
            ensemble = ensemble.at(kept) if kept.sum() >= FEWEST else ensemble
    table = dict(table_of_moments(ensemble, settings))
    progress(2, STEPS)
    more = _distributions(many, ensemble, settings, progress) if ensemble.segments >= FEWEST else None
    progress(STEPS, STEPS)
    return Summary(
        settings=settings,
        surroundings=around,
        ensemble=ensemble,
        table=table,
        warnings=noise.noise_warnings(table, ensemble.error),
        dimensionless_numbers=dimensionless_numbers(table, around) if ensemble.segments else [],
        distributions=more,
    )


def _distributions(
    tracks: Sequence[Trajectory], ensemble: Ensemble, settings: StatisticsSettings, progress: Advance
) -> Distributions:
    steps = count(4)

    def each(of: Callable[[str], Any], quantities: Iterable[str] = UNITS) -> dict[str, Any]:
        found = {quantity: of(quantity) for quantity in quantities if quantity in ensemble.values}
        progress(next(steps), STEPS)
        return found

    curves = each(lambda q: lags.correlation(ensemble, q, settings=settings), CORRELATED)
    longest_s = float(curves["omega_lab"].integral_time_s.value[3])
    lagged = lags.increments(ensemble, integral_time_s=longest_s if longest_s > 0 else None, settings=settings)
    chosen = np.unique(np.linspace(0, len(lagged.lag_frames) - 1, SHOWN_LAGS).round().astype(int))
    shown = lagged.lag_frames[chosen].tolist()
    return Distributions(
        densities=each(lambda q: tuple(density.density(ensemble, q, i, settings=settings) for i in range(3))),
        increments=lagged,
        increment_densities={lag: lags.increment_density(ensemble, lag, settings=settings) for lag in shown},
        correlations=curves,
        durations=_durations(tracks, ensemble, settings),
        angles=isotropy.euler_densities(ensemble, settings=settings),
        uniformity=isotropy.uniformity(ensemble.R_lab_body, ensemble.segment),
        isotropies=each(lambda q: isotropy.isotropy(ensemble, q, settings)),
        rows=each(lambda q: isotropy.frame_of_omega(ensemble, ensemble.values[q]), ("omega_lab", "omega_body")),
        lift=lift(ensemble, settings) if "velocity" in ensemble.values else None,
        multi_lag=_multi_lag(tracks, settings),
        widths=each(lambda q: noise.width_curve(tracks, q, settings=settings), WIDTHS_OF),
    )


def _durations(tracks: Sequence[Trajectory], ensemble: Ensemble, settings: StatisticsSettings) -> Durations | None:
    """Return the histogram of uncut segments, truncated at the least number of frames or of integral times."""
    whole = ensemble
    if settings.max_duration_s is not None:
        whole = ensemble_of(tracks, settings.model_copy(update={"max_duration_s": None}), fewest=1)
    if whole.segments < FEWEST:
        return None
    least_s = max(settings.min_frames * whole.step_s, settings.min_integral_times * (settings.integral_time_s or 0.0))
    return durations(whole.span_s, min(least_s, float(whole.span_s.min())), level=settings.level)


def _multi_lag(tracks: Sequence[Trajectory], settings: StatisticsSettings) -> dict[str, noise.MultiLag]:
    found = {}
    for quantity in ("alpha_lab",) if all(track.held for track in tracks) else noise.RATES:
        with suppress(TrackError):  # too few neighbouring frames: left out, noted on the page
            found[quantity] = noise.multi_lag(tracks, quantity, settings)
    return found
