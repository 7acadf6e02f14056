"""`sphereorient overlay`."""

from pathlib import Path
from typing import Annotated

import typer

from sphereorient.cli.app import ExperimentPath, app, camera_names, check_writable, frame_range, progress_bar
from sphereorient.errors import OutputError, SettingsError, refusal


@app.command()
def overlay(
    experiment: ExperimentPath,
    track: Annotated[Path, typer.Argument(metavar="TRACK", help="track.h5 that `sphereorient track` wrote of it.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Movie to write: .mp4, .mov or .mkv (H.264).")] = None,
    cameras: Annotated[str | None, typer.Option(help="Show only these, e.g. cam1 or cam1,cam2.")] = None,
    frames: Annotated[str, typer.Option(metavar="A:B", help="Frames A to B - 1 only; 100: is from 100 on.")] = ":",
    every: Annotated[int, typer.Option(min=1, help="Show one of so many frames.")] = 1,
    fps: Annotated[float, typer.Option(min=0.1, max=240.0, help="Frames a second of the movie.")] = 25.0,
    worst: Annotated[
        Path | None, typer.Option(help="Contact sheet to write of the worst frames, with the reasons (.png, .pdf).")
    ] = None,
    count: Annotated[int, typer.Option(min=1, max=120, help="Frames on that sheet.")] = 24,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False,
) -> None:
    """Draw a track on its movies: outline, body axes, re-rendered sphere, residual; and a sheet of the worst frames."""
    if out is None and worst is None:
        do = "add --out overlay.mp4 or --worst sheet.png"
        raise OutputError(refusal("overlay", expected="something to write", got="neither --out nor --worst", do=do))
    for path in (out, worst):
        if path is not None:
            check_writable(path)
    span = _range(frames)
    from sphereorient.experiment import load_experiment
    from sphereorient.report.gallery import worst_frames
    from sphereorient.report.overlay import FrameSelection, overlay_movie
    from sphereorient.trajectory import Trajectory

    loaded, seen = load_experiment(experiment), Trajectory.load(track)
    names = camera_names(cameras)
    with progress_bar(quiet) as advance:
        if out is not None:
            chosen = FrameSelection(cameras=names, first=span[0], last=span[1], every=every)
            shown = overlay_movie(seen, loaded, out, chosen, fps, lambda *at: advance("overlay", *at))
        if worst is not None:
            bad = worst_frames(seen, loaded, worst, count, cameras=names, progress=lambda *at: advance("worst", *at))
    if not quiet and out is not None:
        typer.echo(f"Wrote {out}: {shown} frames")
    if not quiet and worst is not None:
        typer.echo(f"Wrote {worst}: {len(bad)} frames" + ("" if bad else "; none is bad"))


def _range(text: str) -> tuple[int | None, int | None]:
    """Return first and last + 1 of A:B, None where left out."""
    found = frame_range(text)
    if found is None or (found[0] is not None and found[1] is not None and found[0] >= found[1]):
        do = "write e.g. --frames 100:200"
        raise SettingsError(refusal(f"--frames {text}", expected="A:B, A below B", got=f"'{text}'", do=do))
    return found
