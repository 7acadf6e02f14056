"""`sphereorient report`, `overlay` and `export`: views of a track."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from sphereorient.cli.app import app, check_writable, command_line, progress_bar
from sphereorient.cli.options import (
    Align,
    CommonOptions,
    ExperimentPath,
    FicTracConfigPath,
    Quiet,
    SphereName,
    TrackPath,
    cameras_of,
    file_of,
    frames_of,
    tracks_in,
)
from sphereorient.errors import OutputError, SettingsError, TrackError, refusal

if TYPE_CHECKING:
    from sphereorient.trajectory import Tracks, Trajectory


@dataclass(frozen=True, kw_only=True)
class _ReportOptions(CommonOptions):
    tracks: Annotated[list[Path], Argument(metavar="TRACK...", help="track.h5 of `sphereorient track`.")]
    out: Annotated[Path, Option("--out", "-o", help="Folder to write: index.html, figures, tables.")]
    experiment: Annotated[list[Path] | None, Option(help="experiment.yaml: pictures, size, flow; repeatable.")] = None
    sphere: SphereName = None
    against: Annotated[Path | None, Option(help="Reference: truth.h5, another track.h5, or FicTrac's .dat.")] = None
    align: Align = "none"


@app.command()
def report(given: _ReportOptions) -> None:
    """Write statistics of tracks with error bars, figures, and a page with the findings."""
    check_writable(given.out, folder_made=True)
    from sphereorient.bench.score import against, reference_of
    from sphereorient.experiment import load_experiment
    from sphereorient.report.build import write_report

    chosen = given.chosen("report").statistics
    known = [load_experiment(path) for path in given.experiment or ()]
    loaded, command = load_tracks(given.tracks, given.sphere), command_line()
    found = {}
    if given.against is not None:
        for name, track in loaded.items():
            found[name] = against(reference_of(given.against, track), track, given.align)[1]
    with progress_bar(given.quiet, unit="") as advance:
        write = partial(write_report, experiments=known, settings=chosen, progress=advance, behaviours=found)
        words = write(loaded, given.out, command=command)
    for verdict in words:
        doubt = verdict.grade == "doubt"
        if doubt or not given.quiet:
            typer.echo(f"{verdict.title}: {verdict.words}", err=doubt)
    if not given.quiet:
        typer.echo(f"Wrote {given.out / 'index.html'}")


def load_tracks(paths: list[Path], sphere: str | None) -> "dict[str, Trajectory]":
    """Read tracks by name: the shortest unique end of the path, then the name of the sphere."""
    whole = [path.resolve() for path in paths]
    for path in whole:
        if whole.count(path) > 1:
            do = "name it once; a second time it would count as new data"
            raise TrackError(refusal(str(path), expected="each track once", got="it twice", do=do))

    def name(path: Path) -> str:
        sizes = range(1, len(path.parts) + 1)
        unique = (size for size in sizes if [one.parts[-size:] for one in whole].count(path.parts[-size:]) == 1)
        return "/".join(path.parts[-next(unique) :])

    return {
        f"{name(path)}:{ball}" if ball else name(path): track
        for path in whole
        for ball, track in tracks_in(path, sphere).items()
    }


@dataclass(frozen=True, kw_only=True)
class _OverlayOptions:
    experiment: ExperimentPath
    track: TrackPath
    out: Annotated[Path | None, Option("--out", "-o", help="Movie to write: .mp4, .mov or .mkv (H.264).")] = None
    cameras: Annotated[str | None, Option(help="Show only these, e.g. cam1 or cam1,cam2.")] = None
    frames: Annotated[str, Option(metavar="A:B", help="Only frames A to B - 1; 100: means from 100 on.")] = ":"
    every: Annotated[int, Option(min=1, help="Show every N-th frame.")] = 1
    fps: Annotated[float, Option(min=0.1, max=240.0, help="Frames per second of the movie.")] = 25.0
    worst: Annotated[Path | None, Option(help="Contact sheet of the worst frames, with reasons (.png, .pdf).")] = None
    count: Annotated[int, Option(min=1, max=120, help="Frames on that sheet.")] = 24
    sphere: SphereName = None
    quiet: Quiet = False


@app.command()
def overlay(given: _OverlayOptions) -> None:
    """Draw a track on its movies: outline, body axes, re-rendered sphere, residual; and a sheet of the worst frames."""
    if given.out is None and given.worst is None:
        do = "add --out overlay.mp4 or --worst sheet.png"
        raise OutputError(refusal("overlay", expected="something to write", got="neither --out nor --worst", do=do))
    if given.out is not None:
        check_writable(given.out)
    first, last = frames_of(given.frames, SettingsError)
    from sphereorient.experiment import load_experiment
    from sphereorient.report.gallery import worst_frames
    from sphereorient.report.overlay import FrameSelection, overlay_movie

    loaded, seen = load_experiment(given.experiment), tracks_in(given.track, given.sphere)
    names, sheets = cameras_of(given.cameras), {} if given.worst is None else _paths(given.worst, seen)
    bad = {}
    with progress_bar(given.quiet) as advance:
        if given.out is not None:
            chosen = FrameSelection(cameras=names, first=first, last=last, every=given.every)
            shown = overlay_movie(seen, loaded, given.out, chosen, given.fps, lambda *at: advance("overlay", *at))
        for ball, sheet in sheets.items():
            advancing = partial(advance, f"worst {ball}".strip())
            bad[sheet] = len(worst_frames(seen[ball], loaded, sheet, given.count, cameras=names, progress=advancing))
    if not given.quiet and given.out is not None:
        typer.echo(f"Wrote {given.out}: {shown} frames")
    for sheet, frames_shown in bad.items() if not given.quiet else ():
        typer.echo(f"Wrote {sheet}: {frames_shown} frames" + ("" if frames_shown else "; none is bad"))


def _paths(out: Path, tracks: "Tracks") -> dict[str, Path]:
    from sphereorient.report.columns import plain_names

    plain = plain_names(tracks, "ball")
    paths = {name: file_of(out, name and plain[name]) for name in tracks}
    for path in paths.values():
        check_writable(path)
    return paths


@dataclass(frozen=True, kw_only=True)
class _ExportOptions:
    track: TrackPath
    out: Annotated[Path, Option("--out", "-o", help="File to write.")]
    to: Annotated[
        str | None,
        Option(
            help="csv, parquet, mat, fictrac, tum, vtk, nwb or netcdf; default: by the suffix of --out.",
            metavar="FORMAT",
        ),
    ] = None
    experiment: Annotated[Path | None, Option(help="experiment.yaml, for the camera of FicTrac's table.")] = None
    axes: FicTracConfigPath = None
    sphere: SphereName = None
    quiet: Quiet = False


@app.command()
def export(given: _ExportOptions) -> None:
    """Write a track for other programs: tables, MATLAB, FicTrac's table, poses (TUM), ParaView, NWB, netCDF.
    Several balls give one file each, named OUT_BALL.
    """
    from sphereorient.report.export import export_track, format_of

    to = format_of(given.out, given.to)
    if given.axes is not None and to != "fictrac":
        do = "write --to fictrac, or leave out --axes"
        raise SettingsError(refusal("--axes", expected="FicTrac's table", got=str(to), do=do))
    loaded = tracks_in(given.track, given.sphere)
    paths = _paths(given.out, loaded)
    axes = None
    if given.experiment is not None:
        from sphereorient.experiment import load_experiment
        from sphereorient.preflight.fictrac import fictrac_axes

        axes = fictrac_axes(next(iter(load_experiment(given.experiment).cameras.values())), given.axes)
    with progress_bar(given.quiet) as advance:
        for ball, path in paths.items():
            export_track(loaded[ball], path, to, partial(advance, f"export {ball}".strip()), axes)
    for ball, path in paths.items() if not given.quiet else ():
        typer.echo(f"Wrote {path}: {len(loaded[ball])} frames")
