"""`sphereorient report`, `overlay`, `export` and `view`: what a track is looked at with."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import app, check_writable, command_line, progress_bar
from sphereorient.cli.options import ExperimentPath, Quiet, SettingsPath, TrackPath, cameras_of, frames_of, settings_of
from sphereorient.errors import OutputError, SettingsError, TrackError, refusal

if TYPE_CHECKING:
    from sphereorient.trajectory import Trajectory


@app.command()
def report(
    tracks: Annotated[list[Path], typer.Argument(metavar="TRACK...", help="track.h5 of `sphereorient track`.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write: index.html, figures, tables.")],
    experiment: Annotated[
        list[Path] | None,
        typer.Option(help="experiment.yaml of a track, for pictures, the sphere's size and the flow; repeatable."),
    ] = None,
    settings: SettingsPath = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Override one setting, e.g. --set statistics.min_frames=30.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, only warnings.")] = False,
) -> None:
    """Write statistics of tracks with error bars, figures, and a page with the findings."""
    check_writable(out, folder_made=True)
    from sphereorient.experiment import load_experiment
    from sphereorient.report.build import write_report

    chosen = settings_of(settings, set_, "report").statistics
    known = [load_experiment(path) for path in experiment or ()]
    loaded, command = _load(tracks), command_line()
    with progress_bar(quiet, unit="") as advance:
        words = write_report(loaded, out, experiments=known, settings=chosen, progress=advance, command=command)
    for verdict in words:
        doubt = verdict.grade == "doubt"
        if doubt or not quiet:
            typer.echo(f"{verdict.title}: {verdict.words}", err=doubt)
    if not quiet:
        typer.echo(f"Wrote {out / 'index.html'}")


def _load(paths: list[Path]) -> "dict[str, Trajectory]":
    """Read the tracks; the name of each is the shortest unique end of its path."""
    from sphereorient.trajectory import Trajectory

    whole = [path.resolve() for path in paths]
    for path in whole:
        if whole.count(path) > 1:
            do = "name it once: twice it would count as new data"
            raise TrackError(refusal(str(path), expected="each track once", got="it twice", do=do))

    def name(path: Path) -> str:
        sizes = range(1, len(path.parts) + 1)
        unique = (size for size in sizes if [one.parts[-size:] for one in whole].count(path.parts[-size:]) == 1)
        return "/".join(path.parts[-next(unique) :])

    return {name(path): Trajectory.load(path) for path in whole}


@app.command()
def overlay(
    experiment: ExperimentPath,
    track: TrackPath,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Movie to write: .mp4, .mov or .mkv (H.264).")] = None,
    cameras: Annotated[str | None, typer.Option(help="Show only these, e.g. cam1 or cam1,cam2.")] = None,
    frames: Annotated[str, typer.Option(metavar="A:B", help="Frames A to B - 1 only; 100: is from 100 on.")] = ":",
    every: Annotated[int, typer.Option(min=1, help="Show one of so many frames.")] = 1,
    fps: Annotated[float, typer.Option(min=0.1, max=240.0, help="Frames a second of the movie.")] = 25.0,
    worst: Annotated[
        Path | None, typer.Option(help="Contact sheet to write of the worst frames, with the reasons (.png, .pdf).")
    ] = None,
    count: Annotated[int, typer.Option(min=1, max=120, help="Frames on that sheet.")] = 24,
    quiet: Quiet = False,
) -> None:
    """Draw a track on its movies: outline, body axes, re-rendered sphere, residual; and a sheet of the worst frames."""
    if out is None and worst is None:
        do = "add --out overlay.mp4 or --worst sheet.png"
        raise OutputError(refusal("overlay", expected="something to write", got="neither --out nor --worst", do=do))
    for path in (out, worst):
        if path is not None:
            check_writable(path)
    first, last = frames_of(frames) or (0, 0)
    if first is not None and last is not None and first >= last:
        do = "write e.g. --frames 100:200"
        raise SettingsError(refusal(f"--frames {frames}", expected="A:B, A below B", got=f"'{frames}'", do=do))
    from sphereorient.experiment import load_experiment
    from sphereorient.report.gallery import worst_frames
    from sphereorient.report.overlay import FrameSelection, overlay_movie
    from sphereorient.trajectory import Trajectory

    loaded, seen = load_experiment(experiment), Trajectory.load(track)
    names = cameras_of(cameras)
    with progress_bar(quiet) as advance:
        if out is not None:
            chosen = FrameSelection(cameras=names, first=first, last=last, every=every)
            shown = overlay_movie(seen, loaded, out, chosen, fps, lambda *at: advance("overlay", *at))
        if worst is not None:
            bad = worst_frames(seen, loaded, worst, count, cameras=names, progress=lambda *at: advance("worst", *at))
    if not quiet and out is not None:
        typer.echo(f"Wrote {out}: {shown} frames")
    if not quiet and worst is not None:
        typer.echo(f"Wrote {worst}: {len(bad)} frames" + ("" if bad else "; none is bad"))


@app.command()
def export(
    track: TrackPath,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write.")],
    to: Annotated[
        str | None,
        typer.Option(
            help="csv, parquet, mat, fictrac, tum, vtk, nwb or netcdf; default: by the suffix of the name.",
            metavar="FORMAT",
        ),
    ] = None,
    experiment: Annotated[
        Path | None, typer.Option(help="experiment.yaml of the track: FicTrac's table needs the camera.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Write a track for other programs: tables, MATLAB, FicTrac's table, poses (TUM), ParaView, NWB, netCDF."""
    from sphereorient.report.export import export_track, format_of
    from sphereorient.trajectory import Trajectory

    to = format_of(out, to)
    check_writable(out)
    loaded = Trajectory.load(track)
    camera = None
    if experiment is not None:
        from sphereorient.experiment import load_experiment

        camera = next(iter(load_experiment(experiment).cameras.values()))
    with progress_bar(quiet) as advance:
        export_track(loaded, out, to, lambda *at: advance("export", *at), camera)
    if not quiet:
        typer.echo(f"Wrote {out}: {len(loaded)} frames")


@app.command()
def view(
    track: TrackPath,
    experiment: Annotated[
        Path | None, typer.Option(help="experiment.yaml of the track: adds cameras, texture and pictures.")
    ] = None,
    save: Annotated[Path | None, typer.Option(help="Write this .rrd instead of opening a window.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Include the pictures of one of so many frames.")] = 1,
    pictures: Annotated[bool, typer.Option(help="Include the pictures of the movies.")] = True,
    quiet: Quiet = False,
) -> None:
    """Show a track in space and time with Rerun: cameras, pictures, the sphere, its motion, its warnings."""
    if save is not None:
        check_writable(save)
    from sphereorient.experiment import load_experiment
    from sphereorient.report.recording import view_track
    from sphereorient.trajectory import Trajectory

    measured = Trajectory.load(track)
    seen = None if experiment is None else load_experiment(experiment)
    with progress_bar(quiet) as advance:
        view_track(
            measured,
            experiment=seen,
            save=save,
            every=every,
            pictures=pictures,
            progress=lambda *at: advance("pictures", *at),
        )
    if not quiet and save is not None:
        typer.echo(f"Wrote {save}: {len(measured)} frames; look at it with `rerun {save}`")
