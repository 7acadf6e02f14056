"""The numbers of a report as tables, one row for each value with its interval; CSV and Parquet."""

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sphereorient.errors import OutputError
from sphereorient.report.export_columns import package
from sphereorient.statistics import Interval, Summary
from sphereorient.statistics.cameras import CameraDistance
from sphereorient.statistics.density import Density, stretched_exponential
from sphereorient.statistics.moments import COMPONENTS, STATISTICS
from sphereorient.statistics.summary import Distributions
from sphereorient.trajectory import Reason, Trajectory

POOLED = ("x", "y", "z", "all")
VECTOR = ("x", "y", "z", "vector")
Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Rows of equal keys under a file's name; made by `tables_of`."""

    name: str  # of the file, without suffix
    about: str  # its content, one line
    rows: Sequence[Row]

    @property
    def columns(self) -> list[str]:
        """Names of the columns, with their units at the end."""
        return list(self.rows[0]) if self.rows else []


def tables_of(summary: Summary, tracks: Mapping[str, Trajectory], distances: Sequence[CameraDistance]) -> list[Table]:
    """Return all non-empty tables of a report, from the statistics, the tracks by file name, and camera distances."""
    level = f"{100 * summary.settings.level:g} % intervals"
    found: list[tuple[str, str, Iterable[Row]]] = [
        ("tracks", "the tracks, and the frames that each camera lost", _tracks(tracks)),
        ("segments", "segments that count", _segments(summary, list(tracks))),
        ("moments", f"Table I of the paper, {level}", _moments(summary)),
        ("comparisons", "the sphere against its flow", _comparisons(summary)),
        ("camera_distance", "distance of the cameras' orientations", _distances(distances)),
    ]
    if (more := summary.distributions) is not None:
        found += [
            ("densities", f"PDFs in standard deviations, {level}", _densities(more)),
            ("fits", f"stretched exponential, {level}", _fits(more)),
            ("increments", f"omega_lab(t + lag) - omega_lab(t), {level}", _increments(more)),
            ("autocorrelations", f"autocorrelations, {level}", _correlations(more)),
            ("integral_times", f"to the first zero, {level}", _integral_times(more)),
            ("durations", "histogram of segment durations", _durations(more)),
            ("angles", f"PDFs of the Euler angles, {level}", _angles(more)),
            ("isotropy", f"shares of the variance, {level}", _isotropy(more)),
            ("kernel_widths", f"rms and flatness by kernel width, {level}", _widths(more)),
            ("multi_lag", f"rms without noise by many lags, {level}", _multi_lag(more)),
            ("lift", f"a against omega x v, {level}", _lift(more)),
        ]
    tables = [Table(name=name, about=about, rows=list(rows)) for name, about, rows in found]
    return [table for table in tables if table.rows]


def write_tables(tables: Sequence[Table], folder: Path) -> list[str]:
    """Write each table as NAME.csv and, if pyarrow is installed, as NAME.parquet; return the suffixes written."""
    for table in tables:
        with (folder / f"{table.name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, table.columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(table.rows)
    try:
        arrow = package("pyarrow", "table")
    except OutputError:  # the page says so; CSV has the same numbers
        return ["csv"]
    import pyarrow.parquet as arrow_parquet

    for table in tables:
        columns = {name: [row[name] for row in table.rows] for name in table.columns}
        arrow_parquet.write_table(arrow.table(columns), folder / f"{table.name}.parquet", compression="zstd")
    return ["csv", "parquet"]


def _values(key: Any, **found: Interval) -> Row:
    """Return values and their intervals as three columns each."""
    row = {}
    for name, of in found.items():
        for column, values in ((name, of.value), (f"{name}_low", of.low), (f"{name}_high", of.high)):
            row[column] = float(np.asarray(values)[key])
    return row


def _tracks(tracks: Mapping[str, Trajectory]) -> Iterator[Row]:
    for name, track in tracks.items():
        lost = {camera: sum(why != Reason.OK for why in seen.reason) for camera, seen in track.cameras.items()}
        time = track.time[np.isfinite(track.time)]
        yield {
            "file": name,
            "experiment": track.experiment,
            "method": track.method,
            "frames": len(track),
            "valid": int(track.valid.sum()),
            "duration_s": float(time[-1] - time[0]) if len(time) else float("nan"),
            "lost": "; ".join(f"{camera}: {count}" for camera, count in lost.items()),
        }


def _segments(summary: Summary, names: Sequence[str]) -> Iterator[Row]:
    ensemble = summary.ensemble
    for k, (first, last) in enumerate(zip(ensemble.starts[:-1].tolist(), ensemble.starts[1:].tolist(), strict=True)):
        yield {
            "segment": k,
            "file": names[int(ensemble.track[k])],
            "begins_s": float(ensemble.time_s[first]),
            "duration_s": float(ensemble.span_s[k]),
            "frames": last - first,
        }


def _moments(summary: Summary) -> Iterator[Row]:
    for quantity, part in summary.table.items():
        for i, component in enumerate(COMPONENTS):
            row: Row = {"quantity": quantity, "component": component, "units": part.units}
            row |= _values(i, **{name: getattr(part, name) for name in STATISTICS})
            yield row | {"samples": part.samples, "segments": part.segments}


def _comparisons(summary: Summary) -> Iterator[Row]:
    flow = summary.surroundings.flow
    if flow is not None:
        inputs = f"nu = {flow.viscosity_m2_s:.4g} m^2/s, epsilon = {flow.dissipation_w_kg:.4g} W/kg"
        yield {"name": f"eta, m, of {inputs}", "formula": "(nu^3 / epsilon)^(1/4)", "value": flow.eta_m}
        yield {"name": f"tau_eta, s, of {inputs}", "formula": "(nu / epsilon)^(1/2)", "value": flow.tau_eta_s}
    for one in summary.comparisons:
        yield {"name": one.name, "formula": one.formula, "value": one.value}


def _distances(distances: Sequence[CameraDistance]) -> Iterator[Row]:
    for one in distances:
        edges = np.rad2deg(one.edges_rad).tolist()
        pdf = np.deg2rad(one.pdf).tolist()
        rough = np.full(len(pdf), np.nan) if one.uncorrected_pdf is None else np.deg2rad(one.uncorrected_pdf)
        names = ("cameras", "from_deg", "to_deg", "pdf_per_deg", "without_perspective_pdf_per_deg")
        for values in zip(edges[:-1], edges[1:], pdf, rough.tolist(), strict=True):
            yield dict(zip(names, (" ".join(one.cameras), *values), strict=True))


def _densities(more: Distributions) -> Iterator[Row]:
    for quantity, component, part in _by_component(more):
        yield from _density({"quantity": quantity, "component": component}, part)
    for lag, part in more.increment_densities.items():
        yield from _density({"quantity": f"increment of omega_lab over {lag} frames", "component": "x"}, part)


def _by_component(more: Distributions) -> Iterator[tuple[str, str, Density]]:
    for quantity, parts in more.densities.items():
        for component, part in zip("xyz", parts, strict=True):
            yield quantity, component, part


def _density(head: Row, part: Density) -> Iterator[Row]:
    law = stretched_exponential(part.centres, float(part.fit.a.value))
    for k, centre in enumerate(part.centres.tolist()):
        row = head | {"standard_deviations": centre, "count": int(part.counts[k])} | _values(k, pdf=part.pdf)
        gauss = float(np.exp(-(centre**2) / 2) / np.sqrt(2 * np.pi))
        yield row | {"stretched_exponential": float(law[k]), "gaussian": gauss}


def _fits(more: Distributions) -> Iterator[Row]:
    for quantity, component, part in _by_component(more):
        fit = part.fit
        row: Row = {"quantity": quantity, "component": component}
        row |= _values((), a=fit.a, flatness_of_fit=fit.flatness)
        row |= {"log_likelihood": fit.log_likelihood, "log_likelihood_gaussian": fit.log_likelihood_gaussian}
        yield row | {"better_than_gaussian": fit.better_than_gaussian}


def _increments(more: Distributions) -> Iterator[Row]:
    found = more.increments
    for k, lag_s in enumerate(found.lag_s.tolist()):
        for i, component in enumerate(POOLED):
            row: Row = {"lag_s": lag_s, "pairs": int(found.pairs[k]), "component": component}
            yield row | _values((k, i), rms=found.rms, flatness=found.flatness)


def _correlations(more: Distributions) -> Iterator[Row]:
    for quantity, found in more.correlations.items():
        for k, lag_s in enumerate(found.lag_s.tolist()):
            for i, component in enumerate(VECTOR):
                row: Row = {"quantity": quantity, "lag_s": lag_s, "pairs": int(found.pairs[k]), "component": component}
                yield row | _values((k, i), correlation=found.value)


def _integral_times(more: Distributions) -> Iterator[Row]:
    for quantity, found in more.correlations.items():
        for i, component in enumerate(VECTOR):
            row: Row = {"quantity": quantity, "component": component}
            row |= _values(i, integral_time_s=found.integral_time_s)
            yield row | {"reached_zero": bool(found.reached_zero[i])}


def _durations(more: Distributions) -> Iterator[Row]:
    if (found := more.durations) is not None:
        for k, (count, expected) in enumerate(zip(found.counts.tolist(), found.expected.tolist(), strict=True)):
            row: Row = {"from_s": float(found.edges_s[k]), "to_s": float(found.edges_s[k + 1])}
            yield row | {"segments": count, "expected": expected}


def _angles(more: Distributions) -> Iterator[Row]:
    for one in more.angles:
        edges = np.rad2deg(one.edges_rad)
        for k, uniform in enumerate(one.uniform.tolist()):
            row: Row = {"angle": one.name, "from_deg": float(edges[k]), "to_deg": float(edges[k + 1])}
            yield row | _values(k, pdf_per_rad=one.pdf) | {"uniform_pdf_per_rad": uniform}


def _isotropy(more: Distributions) -> Iterator[Row]:
    for quantity, found in more.isotropies.items():
        for i, (component, pair) in enumerate(zip("xyz", ("xy", "xz", "yz"), strict=True)):
            row: Row = {"quantity": quantity, "component": component}
            row |= _values(i, variance_share=found.variance_share) | {"pair": pair}
            yield row | _values(i, cross_correlation=found.cross_correlation) | {"p_value": found.p_value}


def _widths(more: Distributions) -> Iterator[Row]:
    names = ("rms", "flatness", "corrected_rms", "corrected_flatness", "noise_share")
    for quantity, found in more.widths.items():
        for k, width_s in enumerate(found.width_s.tolist()):
            for i, component in enumerate("xyz"):
                row: Row = {"quantity": quantity, "width_s": width_s, "component": component}
                yield row | _values((k, i), **{name: getattr(found, name) for name in names})


def _multi_lag(more: Distributions) -> Iterator[Row]:
    for quantity, found in more.multi_lag.items():
        for i, component in enumerate("xyz"):
            row: Row = {"quantity": quantity, "component": component, "rms": float(found.rms[i])}
            yield row | _values(i, variance=found.variance, noise_variance=found.noise_variance)


def _lift(more: Distributions) -> Iterator[Row]:
    for i, component in enumerate(VECTOR):
        found = more.lift
        yield {"component": component} | _values(i, correlation=found.correlation, coefficient=found.coefficient)
