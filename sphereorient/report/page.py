"""The page of a report: one HTML file without external parts."""

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import yaml
from jinja2 import Environment, StrictUndefined, Template

from sphereorient.files.provenance import versions
from sphereorient.report import frame_warnings as quality
from sphereorient.report.gallery import Gallery
from sphereorient.report.plots.style import SYMBOLS, decimals, superscript
from sphereorient.report.tables import Table
from sphereorient.statistics import Interval, Summary
from sphereorient.statistics.moments import COMPONENTS
from sphereorient.trajectory import Trajectory

MOST_STRETCHES = 200  # rows of the table
UNFOLDED = 12  # pictures that are visible without JavaScript
Cell = tuple[str, str]  # a number or text, and its interval
Grid = dict[str, Any]  # a table of the page: title, about, head, rows of cells; the files have all digits


def page_html(summary: Summary, tracks: Mapping[str, Trajectory], command: str, **parts: Any) -> str:
    """Return the page of a report, from statistics, tracks by file name, and the command. `parts`: verdicts; figures
    (name, title, caption, png in base64, width in px); tables, and the suffixes of their files; strips (HTML).
    """
    css, js = strip_assets()
    tables = {table.name: table for table in parts["tables"]}
    names = sorted({track.experiment for track in tracks.values() if track.experiment})
    what = "Rotation of a sphere" if all(track.held for track in tracks.values()) else "Motion of a sphere"
    if len({track.sphere for track in tracks.values()}) == len(tracks) > 1:
        what = f"Motion of {len(tracks)} spheres"
    elif len(tracks) > 1:
        what += f", {len(tracks)} tracks compared"
    around = {key: value for key, value in vars(summary.surroundings).items() if value is not None}
    settings = summary.settings.model_dump() | {"surroundings": around}
    page = {
        "title": f"{what}: {_some(names)}" if names else what,
        "subtitle": f"{_some(list(tracks))}; made {datetime.now(UTC).isoformat(' ', 'minutes')[:16]} UTC",
        "tiles": _tiles(summary, tracks),
        "each": _each(tables["tracks"], next(iter(tracks.values())).length_unit) if len(tracks) > 1 else None,
        "grids": [grid for grid in (_behaviour(tables), *_moments(summary), _flow(tables)) if grid["rows"]],
        "settings": str(yaml.safe_dump(settings, sort_keys=False)).rstrip(),
        "provenance": [_provenance(name, track) for name, track in tracks.items()],
        "footer": f"sphereorient {versions()['sphereorient']}; {command}",
    }
    template, css = _template("page.html.j2"), _asset("page.css") + css
    return template.render(page=page, summary=summary, tracks=tracks, css=css, js=js, **parts)


@cache
def _template(name: str) -> Template:
    """Compile a template; numbers that JSON lacks raise an error."""
    trimmed = name == "strip.html.j2"
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=trimmed, lstrip_blocks=trimmed)
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment.from_string(_asset(name))


def _asset(name: str) -> str:
    return files("sphereorient.report").joinpath(name).read_text(encoding="utf-8")


def strip_assets() -> tuple[str, str]:
    """Return style and script of the strips, for the head of a page."""
    return _asset("strip.css"), _asset("strip.js")


def strip_html(name: str, track: Trajectory, gallery: Gallery | None) -> str:
    """Return the HTML section (text escaped) with the quality of every frame of a track; needs `strip_assets`.
    It has interactive strips; without JavaScript, a table of the bad stretches and the pictures.
    """
    numbers = quality.frame_numbers(track) if gallery is None else gallery.numbers
    found = quality.bad_stretches(track)
    shown = () if gallery is None else gallery.frames
    return _template("strip.html.j2").render(
        name=name,
        numbers=numbers,
        time_s=track.time,
        status=quality.status_of(track),
        strip=quality.strip_of(track, numbers),
        worst=quality.choose_worst(track, 1),
        stretches=found[:MOST_STRETCHES],
        more=found[MOST_STRETCHES:],
        gallery=gallery,
        unfolded=shown[:UNFOLDED],
        folded=sorted(shown[UNFOLDED:], key=lambda frame: frame.k),
        caption=_caption,
    )


def _caption(status: int, why: Sequence[str]) -> str:
    good = quality.STATUS_WORDS[status]
    words = [words for words in why if words != good]
    return "; ".join(words if words and words[0].startswith(good) else [good, *words])


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def _tiles(summary: Summary, tracks: Mapping[str, Trajectory]) -> list[tuple[str, str]]:
    frames = sum(len(track) for track in tracks.values())
    valid = sum(int(track.valid.sum()) for track in tracks.values())
    shown = frames - sum(int(track.without_ball.sum()) for track in tracks.values())
    sigma = np.concatenate([quality.stated_error(track.orientation_cov) for track in tracks.values()])
    sigma = sigma[np.isfinite(sigma)]
    median = f"{np.rad2deg(np.median(sigma)):.2g}\u00b0" if len(sigma) else "unknown"
    found = [
        (f"{frames:,}", "frames"),
        (f"{100 * valid / max(shown, 1):.4g} %", "valid" if shown == frames else f"of {shown:,} with a ball valid"),
        (f"{summary.ensemble.segments:,}", "segment" if summary.ensemble.segments == 1 else "segments"),
        (median, "stated error of the orientation, median"),
    ]
    for quantity in (name for name in ("velocity", "omega_lab") if name in summary.table):
        part = summary.table[quantity]
        rms = float(np.sqrt(np.square(part.rms.value[:3]).sum()))
        known = f"{rms:.3g} {superscript(part.units)}" if math.isfinite(rms) else "unknown"
        found.append((known, f"rms of {SYMBOLS[quantity]}, all components"))
    return found


def _each(tracks: Table, length: str) -> Grid:
    shown = {
        "frames": "frames",
        "valid": "valid",
        "doubtful": "in doubt",
        "stated_error_deg": "stated error, \u00b0",
        f"stated_error_{length}": f"stated error, {length}",
        **({"rms_v_m_s": "rms of v, m/s"} if length == "mm" else {"rms_v_radii_s": "rms of v, radii/s"}),
        "rms_omega_rad_s": "rms of \u03c9, rad/s",
        "duration_s": "duration, s",
    }
    cells = [[(row["file"], ""), *((_plain(row[name]), "") for name in shown)] for row in tracks.rows]
    about = "The numbers below are of all tracks together."
    return {"title": "Tracks side by side", "about": about, "head": ["", *shown.values()], "rows": cells}


def _plain(value: object) -> str:
    if not isinstance(value, float):
        return f"{value:,}" if isinstance(value, int) else str(value)
    return f"{value:.3g}" if math.isfinite(value) else "\u2013"


def _moments(summary: Summary) -> list[Grid]:
    lost, done = {
        "added": ("noise that passes the filter", "subtracted"),
        "removed": ("motion that the smoother removes", "added"),
    }[summary.ensemble.error]
    by_errors = f"With {lost} {done}, by the track's own error bars."
    shown = {  # by field of Moments; the corrected ones are unknown for the norm
        "mean": ("Mean", "Of components and norm."),
        "rms": ("Rms", "About the mean, as measured."),
        "corrected_rms": ("Rms, corrected", by_errors),
        "noise_share": ("Share of the errors, %", f"Of the variance: {lost}."),
        "flatness": ("Flatness", "3 for a Gaussian."),
        "corrected_flatness": ("Flatness, corrected", by_errors),
        "skewness": ("Skewness", "0 for a symmetric distribution."),
    }
    grids = []
    for name, (title, about) in shown.items():
        columns = COMPONENTS[:3] if name.startswith(("corrected", "noise")) else COMPONENTS
        factor, most = (100.0, 3) if name == "noise_share" else (1.0, 6)
        rows: list[list[Cell]] = []
        for quantity, part in summary.table.items():
            found = getattr(part, name).scaled(factor)
            unit = f", {superscript(part.units)}" if name in ("mean", "rms", "corrected_rms") else ""
            cells = [_cell(found.part(i), most) for i in range(len(columns))]
            rows.append([(f"{SYMBOLS[quantity]}{unit}", ""), *cells])
        grids.append({"title": title, "about": about, "head": ["", *columns], "rows": rows})
    return grids


def _cell(of: Interval, most: int) -> Cell:
    value, low, high = float(of.value), float(of.low), float(of.high)
    if not math.isfinite(value + low + high):
        return f"{value:.4g}" if math.isfinite(value) else "\u2013", ""
    digits = min(decimals(high - low), most)
    return f"{value:.{digits}f}", f"{low:.{digits}f} to {high:.{digits}f}"


def _flow(tables: Mapping[str, Table]) -> Grid:
    rows = tables["comparisons"].rows if "comparisons" in tables else ()
    cells = [[(row["name"], ""), (row["formula"], ""), (f"{row['value']:.4g}", "")] for row in rows]
    about = "Components' rms, corrected if the errors are known."
    return {"title": "The sphere and its flow", "about": about, "head": ["", "", "value"], "rows": cells}


def _behaviour(tables: Mapping[str, Table]) -> Grid:
    shown = {"heading_rad": "heading, rad", "length_ratio": "path, ratio", "end_share": "distance of ends, of the path"}
    rows = tables["behaviour"].rows if "behaviour" in tables else ()
    cells = []
    for row in rows:
        gains = [
            (f"{row[key]:.4f}", f"{row[f'{key}_low']:.4f} to {row[f'{key}_high']:.4f}")
            if math.isfinite(row[key])
            else ("\u2013", row["reason"])
            for key in ("gain", "gain_smooth")
        ]
        drift = _plain(row["drift_deg_min"]), f"\u00b1 {_plain(row['drift_sigma_deg_min'])}"
        walk = [(_plain(row[key]), "") for key in shown]
        cells.append([(f"{row['file']}, {row['about']}", ""), *gains, drift, *walk])
    head = ["", "gain", "gain, smoothed", "drift, \u00b0 a minute", *shown.values()]
    return {"title": "Against the reference", "about": "About the lab's axes.", "head": head, "rows": cells}


def _provenance(name: str, track: Trajectory) -> dict[str, Any]:
    entries = [("experiment", track.experiment), ("method", track.method), ("frame rate, Hz", f"{track.frame_rate:g}")]
    for key, value in track.provenance.items():
        text = str(value)
        if isinstance(value, Mapping):
            text = ", ".join(f"{inner} {entry}" for inner, entry in value.items())
        elif isinstance(value, list | tuple):
            text = "; ".join(map(str, value))
        if text:
            entries.append((str(key), text))
    return {"name": name, "entries": entries, "settings": track.settings.rstrip()}
