"""The numbers of a report as tables, one row for each value with its interval; CSV and Parquet."""

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import Flag, OutputError, Reason
from sphereorient.files.provenance import package
from sphereorient.files.whole_file import put_aside
from sphereorient.report.columns import plain_cell
from sphereorient.report.frame_warnings import stated_error
from sphereorient.statistics import Interval, Summary
from sphereorient.statistics.behaviour import Behaviour
from sphereorient.statistics.cameras import CameraDistance
from sphereorient.statistics.density import Density, stretched_exponential
from sphereorient.statistics.isotropy import Isotropy
from sphereorient.statistics.lags import Correlation
from sphereorient.statistics.moments import COMPONENTS, STATISTICS
from sphereorient.statistics.noise import MultiLag, WidthCurve
from sphereorient.statistics.summary import Distributions
from sphereorient.trajectory import Trajectory

POOLED = ("x", "y", "z", "all")
VECTOR = ("x", "y", "z", "vector")
LIKELIHOODS = ("log_likelihood", "log_likelihood_gaussian", "better_than_gaussian")
WIDTHS = ("rms", "flatness", "corrected_rms", "corrected_flatness", "noise_share")
Row = dict[str, Any]
Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Rows of equal keys under a file's name; made by `tables_of`."""

    name: str  # of the file, without suffix
    about: str  # its content, one line
    rows: Sequence[Row]  # names of columns have their units at the end


def tables_of(summary: Summary, tracks: Mapping[str, Trajectory], distances: Sequence[CameraDistance]) -> list[Table]:
    """Return all non-empty tables of a report, from the statistics, the tracks by file name, and camera distances."""
    level = f"{100 * summary.settings.level:g} % intervals"
    found: list[tuple[str, str, Iterable[Row]]] = [
        ("tracks", "the tracks, and the lost frames of each camera", _tracks(tracks)),
        ("segments", "segments in use", _segments(summary, list(tracks))),
        ("moments", f"Table I of the paper, {level}", _moments(summary)),
        ("comparisons", "the sphere against its flow", _comparisons(summary)),
        ("camera_distance", "distance of the cameras' orientations", _distances(distances)),
    ]
    if (more := summary.distributions) is not None:
        found += [
            ("densities", f"PDFs in standard deviations, {level}", _densities(more)),
            ("fits", f"stretched exponential, {level}", _fits(more)),
            ("increments", f"omega_lab(t + lag) - omega_lab(t), {level}", _increments(more)),
            ("autocorrelations", f"autocorrelations, {level}", _each(more.correlations, _correlation)),
            ("integral_times", f"to the first zero, {level}", _each(more.correlations, _integral_time)),
            ("durations", "histogram of segment durations", _durations(more)),
            ("angles", f"PDFs of the Euler angles, {level}", _angles(more)),
            ("isotropy", f"shares of the variance, {level}", _each(more.isotropies, _isotropy)),
            ("kernel_widths", f"rms and flatness by kernel width, {level}", _each(more.widths, _width)),
            ("multi_lag", f"rms without noise by many lags, {level}", _each(more.multi_lag, _multi_lag)),
        ]
        tabled = {name: of for name, of in vars(more).items() if hasattr(of, "columns")}
        found += [(name, f"{of.about}, {level}", _rows(**of.columns())) for name, of in tabled.items()]
    tables = [Table(name=name, about=about, rows=list(rows)) for name, about, rows in found]
    return [table for table in tables if table.rows]


def behaviour_tables(found: Mapping[str, Behaviour]) -> list[Table]:
    """Return the table of gain, drift and walk against a reference, by file name; none without a reference."""
    rows = [row for name, one in found.items() for row in _rows(file=name, **one.columns())]
    about = "gain, drift and walk against the reference, 95 %"
    return [Table(name="behaviour", about=about, rows=rows)] if rows else []


def write_tables(tables: Sequence[Table], folder: Path) -> list[str]:
    """Write each table as NAME.csv and, if pyarrow is installed, as NAME.parquet; return the suffixes written."""
    for table in tables:
        write_csv(table.rows, folder / f"{table.name}.csv")
    try:
        arrow = package("pyarrow", "table")
    except OutputError:  # reported on the page; CSV has the same numbers
        return ["csv"]
    import pyarrow.parquet as arrow_parquet

    for table in tables:
        content = arrow.Table.from_pylist(table.rows)
        arrow_parquet.write_table(content, folder / f"{table.name}.parquet", compression="zstd")
    return ["csv", "parquet"]


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """Write rows of equal keys as CSV, whole or not at all; OutputError."""
    with put_aside(path) as aside, aside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: plain_cell(value) for name, value in row.items()} for row in rows)


def _rows(**columns: Any) -> Iterator[Row]:
    """Yield a row for each entry of columns that broadcast to one shape; an interval becomes three columns."""
    parts: Row = {}
    for name, of in columns.items():
        whole = isinstance(of, Interval)
        parts |= {name: of.value, f"{name}_low": of.low, f"{name}_high": of.high} if whole else {name: of}
    entries = zip(*(values.ravel().tolist() for values in np.broadcast_arrays(*parts.values())), strict=True)
    yield from (dict(zip(parts, row, strict=True)) for row in entries)


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _rms(vectors: Floats) -> float:
    """Return the root of the mean squared length of vectors (N, 3); NaN if all are unknown."""
    known = vectors[np.isfinite(vectors).all(axis=1)]
    return float(np.sqrt((known**2).sum(axis=1).mean())) if len(known) else float("nan")


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
            "doubtful": int((track.valid & (track.flags & (Flag.DOUBTFUL_FIT | Flag.IDENTITY) > 0)).sum()),
            "stated_error_deg": _median(np.rad2deg(stated_error(track.orientation_cov))),
            f"stated_error_{track.length_unit}": _median(stated_error(track.position_cov)),
            "rms_v_m_s" if track.length_unit == "mm" else "rms_v_radii_s": _rms(track.velocity),
            "rms_omega_rad_s": _rms(track.omega_lab),
            "duration_s": float(time[-1] - time[0]) if len(time) else float("nan"),
            "lost": "; ".join(f"{camera}: {count}" for camera, count in lost.items()),
        }


def _segments(summary: Summary, names: Sequence[str]) -> Iterator[Row]:
    of = summary.ensemble
    return _rows(
        segment=np.arange(of.segments),
        file=np.array(names, object)[of.track],
        begins_s=of.time_s[of.starts[:-1]],
        duration_s=of.span_s,
        frames=np.diff(of.starts),
    )


def _moments(summary: Summary) -> Iterator[Row]:
    for quantity, of in summary.table.items():
        found = {name: getattr(of, name) for name in STATISTICS}
        more = {"samples": of.samples, "segments": of.segments}
        yield from _rows(quantity=quantity, component=COMPONENTS, units=of.units, **found, **more)


def _comparisons(summary: Summary) -> Iterator[Row]:
    if (flow := summary.surroundings.flow) is not None:
        inputs = f"nu = {flow.viscosity_m2_s:.4g} m^2/s, epsilon = {flow.dissipation_w_kg:.4g} W/kg"
        yield {"name": f"eta, m, of {inputs}", "formula": "(nu^3 / epsilon)^(1/4)", "value": flow.eta_m}
        yield {"name": f"tau_eta, s, of {inputs}", "formula": "(nu / epsilon)^(1/2)", "value": flow.tau_eta_s}
    yield from ({"name": one.name, "formula": one.formula, "value": one.value} for one in summary.dimensionless_numbers)


def _distances(distances: Sequence[CameraDistance]) -> Iterator[Row]:
    for one in distances:
        edges = np.rad2deg(one.edges_rad)
        yield from _rows(
            cameras=" ".join(one.cameras),
            from_deg=edges[:-1],
            to_deg=edges[1:],
            pdf_per_deg=np.deg2rad(one.pdf),
            without_perspective_pdf_per_deg=np.deg2rad(np.nan if one.uncorrected_pdf is None else one.uncorrected_pdf),
        )


def _densities(more: Distributions) -> Iterator[Row]:
    steps = {(f"increment of omega_lab over {lag} frames", "x"): part for lag, part in more.increment_densities.items()}
    for (quantity, component), part in (_by_component(more) | steps).items():
        yield from _rows(
            quantity=quantity,
            component=component,
            standard_deviations=part.centres,
            count=part.counts,
            pdf=part.pdf,
            stretched_exponential=stretched_exponential(part.centres, float(part.fit.a.value)),
            gaussian=np.exp(-(part.centres**2) / 2) / np.sqrt(2 * np.pi),
        )


def _by_component(more: Distributions) -> dict[tuple[str, str], Density]:
    return {
        (quantity, component): part
        for quantity, parts in more.densities.items()
        for component, part in zip("xyz", parts, strict=True)
    }


def _fits(more: Distributions) -> Iterator[Row]:
    for (quantity, component), part in _by_component(more).items():
        found = {"a": part.fit.a, "flatness_of_fit": part.fit.flatness}
        found |= {name: getattr(part.fit, name) for name in LIKELIHOODS}
        yield from _rows(quantity=quantity, component=component, **found)


def _increments(more: Distributions) -> Iterator[Row]:
    of = more.increments
    by_lag = {"lag_s": of.lag_s[:, None], "pairs": of.pairs[:, None]}
    return _rows(**by_lag, component=POOLED, rms=of.rms, flatness=of.flatness)


def _each(records: Mapping[str, Any], columns: Callable[[Any], Row]) -> Iterator[Row]:
    """Yield the rows of a record for each quantity, by a function that returns its columns."""
    for quantity, of in records.items():
        yield from _rows(quantity=quantity, **columns(of))


def _correlation(of: Correlation) -> Row:
    by_lag = {"lag_s": of.lag_s[:, None], "pairs": of.pairs[:, None]}
    return {**by_lag, "component": VECTOR, "correlation": of.value}


def _integral_time(of: Correlation) -> Row:
    return {"component": VECTOR, "integral_time_s": of.integral_time_s, "reached_zero": of.reached_zero}


def _isotropy(of: Isotropy) -> Row:
    shares = {"component": list("xyz"), "variance_share": of.variance_share}
    return {**shares, "pair": ["xy", "xz", "yz"], "cross_correlation": of.cross_correlation, "p_value": of.p_value}


def _width(of: WidthCurve) -> Row:
    return {"width_s": of.width_s[:, None], "component": list("xyz"), **{name: getattr(of, name) for name in WIDTHS}}


def _multi_lag(of: MultiLag) -> Row:
    return {"component": list("xyz"), "rms": of.rms, "variance": of.variance, "noise_variance": of.noise_variance}


def _durations(more: Distributions) -> Iterator[Row]:
    if (of := more.durations) is not None:
        yield from _rows(from_s=of.edges_s[:-1], to_s=of.edges_s[1:], segments=of.counts, expected=of.expected)


def _angles(more: Distributions) -> Iterator[Row]:
    for of in more.angles:
        edges = np.rad2deg(of.edges_rad)
        densities = {"pdf_per_rad": of.pdf, "uniform_pdf_per_rad": of.uniform}
        yield from _rows(angle=of.name, from_deg=edges[:-1], to_deg=edges[1:], **densities)
