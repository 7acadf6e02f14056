"""The page of a report: one HTML file that needs nothing beside it."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from typing import Any

import numpy as np
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined

from sphereorient.files.provenance import versions
from sphereorient.report.strip_html import strip_assets
from sphereorient.report.tables import Table
from sphereorient.report.verdicts import Verdict
from sphereorient.statistics import Interval, Summary
from sphereorient.statistics.moments import COMPONENTS
from sphereorient.trajectory import Trajectory

NAMES = {
    "velocity": "v",
    "acceleration": "a",
    "omega_lab": "\u03c9 lab",
    "omega_body": "\u03c9 body",
    "alpha_lab": "\u03b1 lab",
    "alpha_body": "\u03b1 body",
}
UNITS = {"m/s": "m/s", "m/s^2": "m/s\u00b2", "rad/s": "rad/s", "rad/s^2": "rad/s\u00b2"}
CONTENTS = (
    ("summary", "Summary"),
    ("numbers", "Numbers"),
    ("figures", "Figures"),
    ("frames", "Frame by frame"),
    ("tables", "Tables"),
    ("settings", "Settings and provenance"),
)


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """A figure that was written; made by build, shown by the page."""

    name: str
    caption: str
    png: bytes
    half: bool = False  # two beside each other

    @property
    def shown(self) -> dict[str, Any]:
        """What the template asks for."""
        return {
            "name": self.name,
            "caption": self.caption,
            "png": base64.b64encode(self.png).decode(),
            "half": self.half,
            "files": f"figures/{self.name}.png, .pdf",
        }


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A number with its interval, as text."""

    value: str
    range: str = ""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A table to read; the files hold all digits."""

    title: str
    about: str
    head: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]


def page_html(
    summary: Summary,
    tracks: Mapping[str, Trajectory],
    words: Sequence[Verdict],
    figures: Sequence[Drawn],
    tables: Sequence[Table],
    suffixes: Sequence[str],
    strips: Sequence[str],
    command: str,
) -> str:
    """Return the page.

    Args:
        summary: the statistics.
        tracks: by the name of their file.
        words: what the numbers say.
        figures: in the order of the page.
        tables: that were written.
        suffixes: of their files.
        strips: HTML of the tracks' quality strips, of `strip_html`.
        command: that made the report.
    """
    css, js = strip_assets()
    environment = Environment(
        loader=PackageLoader("sphereorient.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=False,
    )
    own = files("sphereorient.report").joinpath("page.css").read_text("utf-8")
    names = sorted({track.experiment for track in tracks.values() if track.experiment})
    page = {
        "title": f"Motion of a sphere: {_some(names)}" if names else "Motion of a sphere",
        "subtitle": f"{_some(list(tracks))}; made {datetime.now(UTC).isoformat(' ', 'minutes')[:16]} UTC",
        "contents": CONTENTS,
        "tiles": _tiles(summary, tracks),
        "verdicts": words,
        "numbers_about": _numbers_about(summary),
        "grids": [grid for grid in (*_moments(summary), _flow(summary)) if grid.rows],
        "figures": [figure.shown for figure in figures],
        "frames_about": _frames_about(len(strips), tracks),
        "strips": strips,
        "tables_about": _tables_about(suffixes),
        "tables": tables,
        "suffixes": suffixes,
        "settings": _settings(summary),
        "provenance": [_provenance(name, track) for name, track in tracks.items()],
        "footer": f"sphereorient {versions()['sphereorient']}; {command}",
    }
    return environment.get_template("page.html.j2").render(page=page, css=own + css, js=js)


def _some(names: Sequence[str], most: int = 4) -> str:
    """Return names in a row, the many cut short."""
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def _tiles(summary: Summary, tracks: Mapping[str, Trajectory]) -> list[dict[str, str]]:
    frames = sum(len(track) for track in tracks.values())
    valid = sum(int(track.valid.sum()) for track in tracks.values())
    found = [
        (f"{frames:,}", "frames"),
        (f"{100 * valid / max(frames, 1):.4g} %", "valid"),
        (f"{summary.ensemble.segments:,}", "segment" if summary.ensemble.segments == 1 else "segments"),
        (_median_error(tracks), "stated error of the orientation, median"),
    ]
    for quantity in ("velocity", "omega_lab"):
        part = summary.table[quantity]
        rms = float(np.sqrt(np.square(part.rms.value[:3]).sum()))
        found.append((f"{rms:.3g} {UNITS[part.units]}", f"rms of {NAMES[quantity]}, all components"))
    return [{"number": number, "words": words} for number, words in found]


def _median_error(tracks: Mapping[str, Trajectory]) -> str:
    parts = [np.sqrt(np.trace(track.orientation_cov, axis1=1, axis2=2) / 3) for track in tracks.values()]
    sigma = np.concatenate(parts)
    sigma = sigma[np.isfinite(sigma)]
    return f"{np.rad2deg(np.median(sigma)):.2g}\u00b0" if len(sigma) else "unknown"


@dataclass(frozen=True, kw_only=True)
class Shown:
    """A statistic of Table I on the page."""

    name: str  # a field of Moments
    title: str
    about: str
    percent: bool = False
    of_norm: bool = True  # whether it is known of the norm, too


def _statistics(error: str) -> list[Shown]:
    """Return what is shown, and in words what the track's own errors do to it."""
    lost, done = {
        "added": ("noise that the filter let through", "taken off"),
        "removed": ("motion that the smoother could not follow", "put back"),
    }[error]
    by_errors = f"With {lost} {done}, by the track's own error bars."
    return [
        Shown(name="mean", title="Mean", about="Of components and norm."),
        Shown(name="rms", title="Rms", about="About the mean, as measured."),
        Shown(name="corrected_rms", title="Rms, corrected", about=by_errors, of_norm=False),
        Shown(
            name="noise_share",
            title="Share of the errors, %",
            about=f"Of the variance: {lost}.",
            percent=True,
            of_norm=False,
        ),
        Shown(name="flatness", title="Flatness", about="3 for a Gaussian."),
        Shown(name="corrected_flatness", title="Flatness, corrected", about=by_errors, of_norm=False),
        Shown(name="skewness", title="Skewness", about="0 where x and -x are as likely."),
    ]


def _moments(summary: Summary) -> list[Grid]:
    """Return a grid for each statistic, a row for each quantity."""
    grids = []
    for shown in _statistics(summary.ensemble.error):
        rows: list[list[str | Cell]] = []
        columns = COMPONENTS if shown.of_norm else COMPONENTS[:3]
        for quantity, part in summary.table.items():
            with_unit = shown.name in ("mean", "rms", "corrected_rms")
            found = getattr(part, shown.name).scaled(100.0 if shown.percent else 1.0)
            symbol = f"{NAMES[quantity]}, {UNITS[part.units]}" if with_unit else NAMES[quantity]
            rows.append([symbol, *(_cell(found, i, 3 if shown.percent else 6) for i in range(len(columns)))])
        grids.append(Grid(title=shown.title, about=shown.about, head=["", *columns], rows=rows))
    return grids


def _numbers_about(summary: Summary) -> str:
    if summary.distributions is None:
        return "Of one segment: without intervals, since nothing says how much another one would differ."
    level = f"{100 * summary.settings.level:g} %"
    return f"In small print {level} intervals from resampled segments."


def _cell(found: Interval, i: int, most: int = 6) -> Cell:
    """Return a number with its interval, of at most so many decimals."""
    value, low, high = (float(np.asarray(x)[i]) for x in (found.value, found.low, found.high))
    if not math.isfinite(value):
        return Cell(value="\u2013")
    if not math.isfinite(low + high):
        return Cell(value=f"{value:.4g}")
    digits = min(_digits(high - low), most)
    return Cell(value=f"{value:.{digits}f}", range=f"{low:.{digits}f} to {high:.{digits}f}")


def _digits(width: float) -> int:
    """Return how many decimals a number with an interval of this width deserves."""
    return 4 if width <= 0 else min(max(1 - math.floor(math.log10(width)), 0), 6)


def _flow(summary: Summary) -> Grid:
    flow = summary.surroundings.flow
    rows: list[list[str | Cell]] = []
    about = "Components' rms, corrected where the errors are known."
    if flow is not None:
        about += f" Of the viscosity {flow.viscosity_m2_s:.4g} m\u00b2/s and the dissipation "
        about += f"{flow.dissipation_w_kg:.4g} W/kg that the experiment names."
        rows += [["Kolmogorov's length, m", "eta = (nu^3 / epsilon)^(1/4)", f"{flow.eta_m:.4g}"]]
        rows += [["Kolmogorov's time, s", "tau_eta = (nu / epsilon)^(1/2)", f"{flow.tau_eta_s:.4g}"]]
    rows += [[one.name, one.formula, f"{one.value:.4g}"] for one in summary.comparisons]
    return Grid(title="The sphere and its flow", about=about, head=["", "", "value"], rows=rows)


def _frames_about(strips: int, tracks: Mapping[str, Trajectory]) -> str:
    if strips < len(tracks):
        return f"The {strips} of {len(tracks)} tracks with the most frames in doubt. Click where to look."
    return "Click where to look; arrow keys go frame by frame."


def _tables_about(suffixes: Sequence[str]) -> str:
    if "parquet" in suffixes:
        return "All numbers with all digits and their intervals, beside this page."
    return "All numbers, beside this page; for Parquet, too: pip install 'sphereorient[table]'."


def _settings(summary: Summary) -> str:
    tree = summary.settings.model_dump() | {
        "surroundings": {key: value for key, value in vars(summary.surroundings).items() if value is not None}
    }
    return str(yaml.safe_dump(tree, sort_keys=False)).rstrip()


def _provenance(name: str, track: Trajectory) -> dict[str, Any]:
    entries = [("experiment", track.experiment), ("method", track.method), ("frame rate, Hz", f"{track.frame_rate:g}")]
    for key, value in track.provenance.items():
        if isinstance(value, Mapping):
            text = ", ".join(f"{inner} {told}" for inner, told in value.items())
        elif isinstance(value, list | tuple):
            text = "; ".join(map(str, value))
        else:
            text = str(value)
        if text:
            entries.append((str(key), text))
    return {"name": name, "entries": entries, "settings": track.settings.rstrip()}
