"""A report: a folder with one page, the figures, and the tables."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from matplotlib.figure import Figure

from sphereorient.errors import OutputError, refusal
from sphereorient.experiment import Experiment
from sphereorient.report import plots
from sphereorient.report.belonging import experiments_of, surroundings_of
from sphereorient.report.gallery import gallery
from sphereorient.report.page import Drawn, page_html
from sphereorient.report.strip import stretches
from sphereorient.report.strip_html import strip_html
from sphereorient.report.tables import tables_of, write_tables
from sphereorient.report.verdicts import Verdict, verdicts
from sphereorient.statistics import StatisticsSettings, Summary, summarise
from sphereorient.statistics.cameras import CameraDistance, camera_distances, without_perspective
from sphereorient.trajectory import Trajectory

PARTS = ("index.html", "figures", "tables")
MOST_STRIPS = 8  # tracks shown frame by frame
PICTURES = 120  # frames of a report whose pictures are embedded
Progress = Callable[[str, int, int], None]


def write_report(
    tracks: Mapping[str, Trajectory],
    out: Path,
    *,
    experiments: Sequence[Experiment] = (),
    settings: StatisticsSettings | None = None,
    progress: Progress = lambda stage, done, total: None,
    command: str = "",
) -> list[Verdict]:
    """Write the report of tracks, whole or not at all.

    Args:
        tracks: by the name of their file.
        out: folder; it is made, or replaced where it holds an older report and nothing else.
        experiments: those of the tracks, for the pictures, the sphere's diameter and the flow.
        settings: of the statistics.
        progress: called with stage, steps done and all steps.
        command: as the user gave it.

    Returns:
        What the numbers say, as it stands on the page.

    Raises:
        TrackError: no usable frame, or tracks that do not go together.
        ExperimentError: an experiment of no track, or experiments that contradict each other.
        OutputError: `out` cannot be written, or holds something else.
    """
    known = experiments_of(tracks, experiments)
    around = surroundings_of(experiments)
    summary = summarise(
        list(tracks.values()), settings, around, lambda done, total: progress("numbers", done, total), _named(tracks)
    )
    distances = _distances(tracks, known)
    words = verdicts(summary, tracks, distances)
    with _folder(out) as aside:
        tables = tables_of(summary, tracks, distances)
        suffixes = write_tables(tables, aside / "tables")
        figures = _draw_all(summary, tracks, distances, aside / "figures", progress)
        page = page_html(
            summary,
            tracks,
            words,
            figures,
            tables,
            suffixes,
            list(_strips(tracks, known, progress)),
            command,
        )
        (aside / "index.html").write_text(page, "utf-8")
    return words


def _named(tracks: Mapping[str, Trajectory]) -> str:
    names = list(tracks)
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _distances(tracks: Mapping[str, Trajectory], experiments: Mapping[str, Experiment | None]) -> list[CameraDistance]:
    rough = [
        None if (known := experiments[name]) is None else without_perspective(track, known.cameras)
        for name, track in tracks.items()
    ]
    return camera_distances(list(tracks.values()), rough)


Plan = tuple[str, str, Callable[[], Figure], bool]  # name, caption, how it is drawn, two beside each other


def _plans(summary: Summary, tracks: Mapping[str, Trajectory], distances: Sequence[CameraDistance]) -> Iterator[Plan]:
    """Yield the figures in the order of the page."""
    name, track = max(tracks.items(), key=lambda item: int(item[1].valid.sum()))
    of = "" if len(tracks) == 1 else f" of {name}"
    yield "track", f"Track{of}, with bands of two standard errors.", lambda: plots.track_figure(track), False
    yield "path", f"Path{of} with the sphere's axes.", lambda: plots.path_figure(track), True
    if any(len(one.distance_rad) for one in distances):
        caption = "Distance of the cameras' own orientations."
        yield "camera_distance", caption, lambda: plots.camera_distance_figure(distances), True
    yield (
        "noise",
        "What of each variance is noise, or was smoothed away.",
        lambda: plots.noise_figure(summary.table, summary.ensemble.error),
        True,
    )
    more = summary.distributions
    if more is None:
        return
    caption = "PDFs of the components in their standard deviations, the stretched exponential and the Gaussian."
    yield "densities", caption, lambda: plots.densities_figure(summary, list(more.densities)), False
    caption = "Increments of omega over lags: PDFs, shifted by decades, and flatness."
    yield "increments", caption, lambda: plots.increments_figure(more, summary.table), False
    caption = "Autocorrelations and integral times."
    yield "correlations", caption, lambda: plots.correlations_figure(more.correlations), False
    caption = "Euler angles against the law of uniform attitudes."
    yield "angles", caption, lambda: plots.angles_figure(more.angles, more.uniformity), False
    caption = "Rms and flatness by the width of a Gaussian kernel; a plateau, if there is one, is the motion's."
    yield "kernel_widths", caption, lambda: plots.widths_figure(more.widths), False
    caption = "Shares of the components in the variance, in the lab and in the body."
    yield "isotropy", caption, lambda: plots.isotropy_figure(more.isotropies), True
    if (found := more.durations) is not None:
        yield "durations", "Durations of the segments.", lambda: plots.durations_figure(found), True


def _draw_all(
    summary: Summary,
    tracks: Mapping[str, Trajectory],
    distances: Sequence[CameraDistance],
    folder: Path,
    progress: Progress,
) -> list[Drawn]:
    plans = list(_plans(summary, tracks, distances))
    drawn = []
    for k, (name, caption, draw, half) in enumerate(plans):
        progress("figures", k, len(plans))
        figure = draw()
        plots.write_figure(figure, folder / name)
        drawn.append(Drawn(name=name, caption=caption, png=(folder / f"{name}.png").read_bytes(), half=half))
    progress("figures", len(plans), len(plans))
    return drawn


def _strips(
    tracks: Mapping[str, Trajectory], experiments: Mapping[str, Experiment | None], progress: Progress
) -> Iterator[str]:
    """Yield the quality strips of the tracks, those with the most frames in doubt where there are too many."""
    bad = {name: sum(one.frames for one in stretches(track)) for name, track in tracks.items()}
    worst = sorted(tracks, key=lambda name: -bad[name])[:MOST_STRIPS]
    chosen = [name for name in tracks if name in worst]
    pictured = sum(experiments[name] is not None for name in chosen)
    for k, name in enumerate(chosen):
        seen = None
        if (experiment := experiments[name]) is not None:
            count = max(PICTURES // pictured, 12)
            seen = gallery(tracks[name], experiment, count, lambda done, total: progress("pictures", done, total))
        yield strip_html(name, tracks[name], seen)
        progress("strips", k + 1, len(chosen))


@contextmanager
def _folder(out: Path) -> Iterator[Path]:
    """Give a folder to write in; at the end it takes the report's place, or vanishes where something failed."""
    if out.exists() and (not out.is_dir() or {path.name for path in out.iterdir()} - set(PARTS)):
        do = "choose a new folder"
        expected = "a new folder, or one that holds an older report only"
        raise OutputError(refusal(f"--out {out}", expected=expected, got="something else in it", do=do))
    aside, old = (out.with_name(f".{out.name}.{word}") for word in ("partial", "old"))
    shutil.rmtree(aside, ignore_errors=True)
    try:
        for part in ("figures", "tables"):
            (aside / part).mkdir(parents=True)
        yield aside
        if out.exists():
            shutil.rmtree(old, ignore_errors=True)
            out.replace(old)
        aside.replace(out)
    except OSError as error:
        got = f"'{error.strerror or error}'"
        do = "choose a folder that exists, may be written and has room"
        raise OutputError(refusal(f"--out {out}", expected="a folder that can be written", got=got, do=do)) from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
