"""The numbers of a report as tables, one row a value with its interval; CSV and Parquet."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
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

TOGETHER = ("x", "y", "z", "all")
VECTOR = ("x", "y", "z", "vector")
Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Rows of equal keys under a file's name; made by `tables_of`."""

    name: str  # of the file, without suffix
    about: str  # what it holds, one line
    rows: Sequence[Row]

    @property
    def columns(self) -> list[str]:
        """Names of the columns, units at their ends."""
        return list(self.rows[0]) if self.rows else []


def tables_of(summary: Summary, tracks: Mapping[str, Trajectory], distances: Sequence[CameraDistance]) -> list[Table]:
    """Return all numbers of a report; tables without rows are left out.

    Args:
        summary: the statistics.
        tracks: by the name of their file.
        distances: between the cameras of all tracks.
    """
    level = f"{100 * summary.settings.level:g} % intervals"
    found = [
        Table(name="tracks", about="the tracks, and the frames that each camera lost", rows=list(_tracks(tracks))),
        Table(name="segments", about="segments that count", rows=list(_segments(summary, list(tracks)))),
        Table(name="moments", about=f"Table I of the paper, {level}", rows=list(_moments(summary))),
        Table(name="comparisons", about="the sphere against its flow", rows=list(_comparisons(summary))),
        Table(name="camera_distance", about="distance of the cameras' orientations", rows=list(_distances(distances))),
    ]
    if (more := summary.distributions) is not None:
        found += [
            Table(name="densities", about=f"PDFs in standard deviations, {level}", rows=list(_densities(more))),
            Table(name="fits", about=f"stretched exponential, {level}", rows=list(_fits(more))),
            Table(name="increments", about=f"omega_lab(t + lag) - omega_lab(t), {level}", rows=list(_increments(more))),
            Table(name="autocorrelations", about=f"autocorrelations, {level}", rows=list(_correlations(more))),
            Table(name="integral_times", about=f"to the first zero, {level}", rows=list(_integral_times(more))),
            Table(name="durations", about="histogram of segment durations", rows=list(_durations(more))),
            Table(name="angles", about=f"PDFs of the Euler angles, {level}", rows=list(_angles(more))),
            Table(name="isotropy", about=f"shares of the variance, {level}", rows=list(_isotropy(more))),
            Table(name="kernel_widths", about=f"rms and flatness by kernel width, {level}", rows=list(_widths(more))),
            Table(name="multi_lag", about=f"rms without noise by many lags, {level}", rows=list(_multi_lag(more))),
            Table(name="lift", about=f"a against omega x v, {level}", rows=list(_lift(more))),
        ]
    return [table for table in found if table.rows]


def write_tables(tables: Sequence[Table], folder: Path) -> list[str]:
    """Write each table as NAME.csv and, where pyarrow is installed, as NAME.parquet.

    Args:
        tables: of `tables_of`.
        folder: exists.

    Returns:
        The suffixes that were written.
    """
    for table in tables:
        with (folder / f"{table.name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, table.columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(table.rows)
    try:
        arrow = package("pyarrow", "table")
    except OutputError:  # said on the page; CSV holds the same numbers
        return ["csv"]
    import pyarrow.parquet as arrow_parquet

    for table in tables:
        columns = {name: [row[name] for row in table.rows] for name in table.columns}
        arrow_parquet.write_table(arrow.table(columns), folder / f"{table.name}.parquet", compression="zstd")
    return ["csv", "parquet"]


def _values(name: str, found: Interval, key: Any) -> Row:
    """Return value and interval as three columns."""
    parts = {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}
    return {column: float(np.asarray(values)[key]) for column, values in parts.items()}


def _tracks(tracks: Mapping[str, Trajectory]) -> Iterator[Row]:
    for name, track in tracks.items():
        lost = {
            f"lost_{camera}": sum(reason != Reason.OK for reason in seen.reason)
            for camera, seen in track.cameras.items()
        }
        time = track.time[np.isfinite(track.time)]
        yield {
            "file": name,
            "experiment": track.experiment,
            "method": track.method,
            "frames": len(track),
            "valid": int(track.valid.sum()),
            "duration_s": float(time[-1] - time[0]) if len(time) else float("nan"),
            "lost": "; ".join(f"{camera.removeprefix('lost_')}: {count}" for camera, count in lost.items()),
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
            for name in STATISTICS:
                row |= _values(name, getattr(part, name), i)
            yield row | {"samples": part.samples, "segments": part.segments}


def _comparisons(summary: Summary) -> Iterator[Row]:
    flow = summary.surroundings.flow
    if flow is not None:
        nu, epsilon = flow.viscosity_m2_s, flow.dissipation_w_kg
        inputs = f"nu = {nu:.4g} m^2/s, epsilon = {epsilon:.4g} W/kg"
        yield {"name": f"eta, m, of {inputs}", "formula": "(nu^3 / epsilon)^(1/4)", "value": flow.eta_m}
        yield {"name": f"tau_eta, s, of {inputs}", "formula": "(nu / epsilon)^(1/2)", "value": flow.tau_eta_s}
    for one in summary.comparisons:
        yield {"name": one.name, "formula": one.formula, "value": one.value}


def _distances(distances: Sequence[CameraDistance]) -> Iterator[Row]:
    for one in distances:
        for k, (low, high) in enumerate(zip(one.edges_rad[:-1], one.edges_rad[1:], strict=True)):
            row = {
                "cameras": " ".join(one.cameras),
                "from_deg": float(np.rad2deg(low)),
                "to_deg": float(np.rad2deg(high)),
                "pdf_per_deg": float(np.deg2rad(one.pdf[k])),
            }
            rough = float("nan") if one.uncorrected_pdf is None else float(np.deg2rad(one.uncorrected_pdf[k]))
            yield row | {"without_perspective_pdf_per_deg": rough}


def _densities(more: Distributions) -> Iterator[Row]:
    for quantity, parts in more.densities.items():
        for component, part in zip("xyz", parts, strict=True):
            head = {"quantity": quantity, "component": component}
            yield from (head | row for row in _density(part))
    for lag, part in more.increment_densities.items():
        head = {"quantity": f"increment of omega_lab over {lag} frames", "component": "x"}
        yield from (head | row for row in _density(part))


def _density(part: Density) -> Iterator[Row]:
    law = stretched_exponential(part.centres, float(part.fit.a.value))
    for k, centre in enumerate(part.centres.tolist()):
        row = {"standard_deviations": centre, "count": int(part.counts[k])} | _values("pdf", part.pdf, k)
        gauss = float(np.exp(-(centre**2) / 2) / np.sqrt(2 * np.pi))
        yield row | {"stretched_exponential": float(law[k]), "gaussian": gauss}


def _fits(more: Distributions) -> Iterator[Row]:
    for quantity, parts in more.densities.items():
        for component, part in zip("xyz", parts, strict=True):
            fit = part.fit
            row: Row = {"quantity": quantity, "component": component}
            row |= _values("a", fit.a, ()) | _values("flatness_of_fit", fit.flatness, ())
            row |= {"log_likelihood": fit.log_likelihood, "log_likelihood_gaussian": fit.log_likelihood_gaussian}
            yield row | {"better_than_gaussian": fit.better_than_gaussian}


def _increments(more: Distributions) -> Iterator[Row]:
    found = more.increments
    for k, lag_s in enumerate(found.lag_s.tolist()):
        for i, component in enumerate(TOGETHER):
            row: Row = {"lag_s": lag_s, "pairs": int(found.pairs[k]), "component": component}
            yield row | _values("rms", found.rms, (k, i)) | _values("flatness", found.flatness, (k, i))


def _correlations(more: Distributions) -> Iterator[Row]:
    for quantity, found in more.correlations.items():
        for k, lag_s in enumerate(found.lag_s.tolist()):
            for i, component in enumerate(VECTOR):
                row: Row = {"quantity": quantity, "lag_s": lag_s, "pairs": int(found.pairs[k]), "component": component}
                yield row | _values("correlation", found.value, (k, i))


def _integral_times(more: Distributions) -> Iterator[Row]:
    for quantity, found in more.correlations.items():
        for i, component in enumerate(VECTOR):
            row: Row = {"quantity": quantity, "component": component}
            row |= _values("integral_time_s", found.integral_time_s, i)
            yield row | {"reached_zero": bool(found.reached_zero[i])}


def _durations(more: Distributions) -> Iterator[Row]:
    found = more.durations
    if found is None:
        return
    for k, count in enumerate(found.counts.tolist()):
        row: Row = {"from_s": float(found.edges_s[k]), "to_s": float(found.edges_s[k + 1]), "segments": count}
        yield row | {"expected": float(found.expected[k])}


def _angles(more: Distributions) -> Iterator[Row]:
    for one in more.angles:
        edges = np.rad2deg(one.edges_rad)
        for k in range(len(one.uniform)):
            row: Row = {"angle": one.name, "from_deg": float(edges[k]), "to_deg": float(edges[k + 1])}
            row |= _values("pdf_per_rad", one.pdf, k)
            yield row | {"uniform_pdf_per_rad": float(one.uniform[k])}


def _isotropy(more: Distributions) -> Iterator[Row]:
    for quantity, found in more.isotropies.items():
        for i, component in enumerate("xyz"):
            pair = ("xy", "xz", "yz")[i]
            row: Row = {"quantity": quantity, "component": component}
            row |= _values("variance_share", found.variance_share, i) | {"pair": pair}
            row |= _values("cross_correlation", found.cross_correlation, i)
            yield row | {"p_value": found.p_value}


def _widths(more: Distributions) -> Iterator[Row]:
    names = ("rms", "flatness", "corrected_rms", "corrected_flatness", "noise_share")
    for quantity, found in more.widths.items():
        for k, width_s in enumerate(found.width_s.tolist()):
            for i, component in enumerate("xyz"):
                row: Row = {"quantity": quantity, "width_s": width_s, "component": component}
                for name in names:
                    row |= _values(name, getattr(found, name), (k, i))
                yield row


def _multi_lag(more: Distributions) -> Iterator[Row]:
    for quantity, found in more.multi_lag.items():
        for i, component in enumerate("xyz"):
            row: Row = {"quantity": quantity, "component": component, "rms": float(found.rms[i])}
            yield row | _values("variance", found.variance, i) | _values("noise_variance", found.noise_variance, i)


def _lift(more: Distributions) -> Iterator[Row]:
    for i, component in enumerate(VECTOR):
        row: Row = {"component": component}
        yield row | _values("correlation", more.lift.correlation, i) | _values("coefficient", more.lift.coefficient, i)
