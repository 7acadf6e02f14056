"""`sphereorient calibrate`, `check-cameras` and `convert-cameras`."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from sphereorient.cli.app import app, check_writable, command_line, echo_lines, print_table, progress_bar
from sphereorient.cli.options import YAML, ExperimentPath, SphereName, names_in, tracks_in
from sphereorient.errors import CameraError, ExperimentError, refusal
from sphereorient.files.whole_file import check_ending, put_aside

if TYPE_CHECKING:
    from sphereorient.cameras.io.opencv import FoundCamera

MADE_BY = "X_cam = R X_lab + T, mm; made by"


@app.command()
def calibrate(
    source: Annotated[Path, Argument(metavar="FILE", help="calibration.yaml; with --refine-with: cameras.yaml.")],
    out: Annotated[Path, Option("--out", "-o", help="cameras.yaml to write, and a figure beside it.")],
    refine_with: Annotated[Path | None, Option(help="track.h5 of these cameras: repair them by the sphere.")] = None,
    quiet: Annotated[bool, Option("--quiet", "-q", help="No progress, no tables.")] = False,
) -> None:
    """Calibrate cameras from pictures of a plate, or repair cameras that moved, by a track of their movies."""
    check_ending(out, "--out", YAML)
    check_writable(out)
    picture = out.with_suffix(".png")
    if refine_with is not None:
        from sphereorient.calibration.self_calibration import refine_with_track, repair_lines
        from sphereorient.cameras import load_cameras, save_cameras

        repaired = refine_with_track(source, refine_with)
        save_cameras(out, load_cameras(source) | dict(repaired.cameras), f"repaired by {command_line()}")
        if not quiet:
            echo_lines([*repair_lines(repaired), f"Wrote {out}. Track again with it; a second repair is better still."])
        return
    check_writable(picture)
    from sphereorient.calibration.plates import calibrate_cameras
    from sphereorient.cameras import save_cameras
    from sphereorient.report import calibration_figure

    with progress_bar(quiet) as advance:
        result = calibrate_cameras(source, advance)
    with put_aside(picture) as partial:
        calibration_figure(result, partial)
        doubtful = "".join(f"\ndoubtful: {line}" for line in result.verdict)
        save_cameras(out, result.cameras, f"{MADE_BY} {command_line()}{doubtful}", result.covariance)
    if quiet:
        for line in result.verdict:
            typer.echo(f"doubtful: {line}", err=True)
        return
    from sphereorient.calibration.calibrated import parameters_table, pictures_table, summary

    print_table(pictures_table(result))
    print_table(parameters_table(result))
    echo_lines([*summary(result), f"Wrote {out} and {picture}"])


@app.command("check-cameras")
def check_cameras_command(
    experiment: ExperimentPath,
    track: Annotated[
        Path | None, Option(help="track.h5 of this experiment; else the movies are tracked first.")
    ] = None,
    sphere: SphereName = None,
    quiet: Annotated[bool, Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Report how far the cameras' lines of sight to the sphere miss each other, over a movie."""
    from sphereorient.calibration.self_calibration import check_cameras, check_lines, contradiction_lines
    from sphereorient.experiment import load_experiment
    from sphereorient.run.stages import track_movies
    from sphereorient.trajectory import Tracks

    known = load_experiment(experiment)
    if len(known.cameras) < 2:
        do = "name an experiment of two cameras"
        raise ExperimentError(refusal(str(experiment), expected="two cameras or more", got="one", do=do))
    if track is not None:
        results = tracks_in(track, sphere)
    else:
        with progress_bar(quiet) as advance:
            results = Tracks.of(track_movies(known, progress=advance)).picked(sphere)
    for ball, result in results.items():
        lines = check_lines(check_cameras(known.cameras, result)) or ["no frame in which two cameras see the sphere"]
        echo_lines([*([f"ball {ball}:"] if len(results) > 1 else []), *lines, *contradiction_lines(result)])


@app.command("convert-cameras")
def convert_cameras(
    sources: Annotated[list[Path], Argument(metavar="SOURCE...", help="Of OpenCV, ROS, anipose, COLMAP, or OpenPTV")],
    out: Annotated[Path, Option("--out", "-o", help="cameras.yaml to write.")],
    names: Annotated[str | None, Option(help="Names of the cameras, e.g. cam1,cam2; else those of the files.")] = None,
    image_size: Annotated[str | None, Option(metavar="W,H", help="Picture size, px, if not in the files.")] = None,
    par: Annotated[Path | None, Option(help="OpenPTV's ptv.par or YAML (sensor, indices, wall), for .ori.")] = None,
) -> None:
    """Convert cameras of other programs to cameras.yaml. A .addpar beside its .ori is read too."""
    check_ending(out, "--out", YAML)
    check_writable(out)
    size = _size(image_size)
    from sphereorient.cameras import centre_lab_mm, save_cameras

    found = _found(sources, size, par)
    cameras = dict(zip(_names([one.name for one in found], names), (one.camera for one in found), strict=True))
    unplaced = [name for name, one in zip(cameras, found, strict=True) if not one.placed]
    save_cameras(out, cameras, f"{MADE_BY} {command_line()}", unplaced=unplaced)
    lines = [f"Wrote {out}: {', '.join(cameras)}"]
    if unread := dict.fromkeys(key for one in found for key in one.unread):
        lines.append(f"not read: {', '.join(unread)}")
    if unplaced:
        what = "the lab is the camera's frame" if len(found) == 1 else f"write them into {out}"
        where = " (COLMAP has them in images.txt)" if any(source.suffix == ".txt" for source in sources) else ""
        lines.append(f"no R and T in the files{where}: {', '.join(unplaced)}; {what}")
    elif len(found) > 1:
        apart = centre_lab_mm(found[0].camera) - centre_lab_mm(found[-1].camera)
        lines.append(f"T taken as mm: the first and the last camera are {float(apart.norm()):.4g} mm apart")
    echo_lines(lines)


def _found(sources: Sequence[Path], size: tuple[int, int] | None, par: Path | None) -> "list[FoundCamera]":
    from sphereorient.cameras.io.opencv import FoundCamera, load_camera_files
    from sphereorient.cameras.io.openptv import load_openptv, load_ptv_par

    if any(source.suffix != ".ori" for source in sources):
        return load_camera_files(sources, size)
    if par is None:
        raise CameraError(refusal("--par", expected="OpenPTV's ptv.par", got="none", do="add --par parameters/ptv.par"))
    common, found = load_ptv_par(par), []
    for source in sources:
        addpar = source.with_suffix(".addpar")
        camera = load_openptv(source, common, addpar if addpar.exists() else None)
        found.append(FoundCamera(name=source.name.partition(".")[0], camera=camera))
    return found


def _names(usual: Sequence[str], text: str | None) -> Sequence[str]:
    names = usual if text is None else names_in(text)
    if len(names) != len(usual):
        got, do = f"{len(names)} for {len(usual)} cameras", f"name all of {', '.join(usual)}, in this order"
        raise CameraError(refusal("--names", expected="one name a camera", got=got, do=do))
    if len(set(names)) < len(names):
        got, do = ", ".join(names), "give each camera its own name, such as --names cam1,cam2"
        raise CameraError(refusal("--names", expected="different names", got=got, do=do))
    return names


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"\s*(\d{1,6})\s*,\s*(\d{1,6})\s*", text)
    if found is None:
        got, do = f"'{text[:20]}'", "write it as 1280,1024"
        raise CameraError(refusal("--image-size", expected="width and height in pixels", got=got, do=do))
    return int(found[1]), int(found[2])
