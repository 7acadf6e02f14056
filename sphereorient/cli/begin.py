"""`sphereorient init` and `mark`: the first files of an experiment, and marks in its pictures."""

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from sphereorient.cli.app import app, check_writable, echo_lines, progress_bar
from sphereorient.cli.options import YAML, Quiet
from sphereorient.errors import CameraError, ExperimentError, SettingsError, SphereOrientError, refusal
from sphereorient.files.whole_file import TEXT_BYTES, check_ending, has_mark, read_text, relative_path, write_text
from sphereorient.files.yaml_file import DraftKey, draft_yaml, flow, given, open_keys, read_yaml

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from sphereorient.preflight.first_look import FirstLook

HEAD = "Made by `sphereorient init`. Remove # before the keys to use; paths are relative to this file."


@dataclass(frozen=True, kw_only=True)
class _InitOptions:
    movies: Annotated[
        list[Path] | None, Argument(metavar="[MOVIE]...", help="Movies or photographs, one per camera.")
    ] = None
    out: Annotated[Path | None, Option("--out", "-o", help="Default: experiment.yaml, or calibration.yaml.")] = None
    plate: Annotated[Path | None, Option(help="Folder of plate pictures: write calibration.yaml.")] = None
    from_fictrac: Annotated[Path | None, Option(help="FicTrac's config.txt: view, masks; movie, if not named.")] = None
    set_: Annotated[
        list[str] | None,
        Option("--set", help="Value of a key, e.g. --set sphere.diameter=18; a terminal prompts for missing ones."),
    ] = None
    vfov: Annotated[
        float | None, Option(min=0.01, max=179.0, help="Field of view of a single camera, top to bottom, degrees.")
    ] = None
    sphere_map: Annotated[Path | None, Option(help="Texture map of the ball, if there is one.")] = None
    quiet: Quiet = False


@app.command()
def init(given: _InitOptions) -> None:
    """Examine movies or plate pictures and write the first file: keys explained, measurable values filled in."""
    chosen = [source for source in (given.movies, given.plate, given.from_fictrac) if source]
    if len(chosen) != 1 and not (given.from_fictrac and given.movies and not given.plate):
        got, do = f"{len(chosen)} of them", "name movies, or --plate FOLDER, or --from-fictrac config.txt"
        raise SettingsError(refusal("init", expected="one source", got=got, do=do))
    changes = list(given.set_ or [])
    target = given.out or Path("calibration.yaml" if given.plate else "experiment.yaml")
    check_ending(target, "--out", YAML)
    check_writable(target)
    if given.sphere_map is not None and not given.plate:
        from sphereorient.sphere import load_texture

        load_texture(given.sphere_map)
        changes.append(f"sphere.texture={flow(relative_path(given.sphere_map, target.parent))}")
    if given.plate:
        _calibration(given.plate, target, changes, given.quiet)
    elif given.from_fictrac:
        _fictrac(given.from_fictrac, given.movies or [], target, changes, given.quiet)
    else:
        _experiment(given.movies or [], target, changes, given.vfov, given.quiet)


@app.command()
def mark(
    file: Annotated[
        Path, Argument(metavar="FILE", help="experiment.yaml: outline, masks; calibration.yaml: fiducials.")
    ],
    port: Annotated[int, Option(min=0, max=65535, help="0: any free one. Over SSH: ssh -L PORT:127.0.0.1:PORT.")] = 0,
    browser: Annotated[bool, Option(help="Open the page in the browser.")] = True,
) -> None:
    """Mark in the browser the ball and what hides it, or fiducials that `calibrate` does not find."""
    from sphereorient.preflight.mark import serve
    from sphereorient.preflight.mark_fiducials import FiducialMarking
    from sphereorient.preflight.mark_masks import MaskMarking

    content = read_yaml(file, ExperimentError)
    schema = str(content.get("schema")) if isinstance(content, dict) else ""
    marking = (FiducialMarking if schema.startswith("sphereorient-calibration/") else MaskMarking)(file)
    server = serve(marking, port)
    typer.echo(f"{server.address}\nCtrl-C ends it.")
    if browser:
        import webbrowser

        webbrowser.open(server.address)
    with server, suppress(KeyboardInterrupt):
        server.serve_forever()


def _experiment(movies: Sequence[Path], target: Path, changes: list[str], vfov: float | None, quiet: bool) -> None:
    from sphereorient.experiment.experiment import MAX_CAMERAS
    from sphereorient.preflight.first_look import camera_keys, field_key

    if len(movies) > MAX_CAMERAS:
        do = "name the movies of one ball; track other balls as separate experiments"
        raise SettingsError(refusal("MOVIE", expected=f"one to {MAX_CAMERAS} movies", got=f"{len(movies)}", do=do))
    cameras = target.parent / "cameras.yaml"
    drafted = has_mark(cameras) and HEAD in read_text(cameras, TEXT_BYTES, "cameras", CameraError, "remove it")
    alone = len(movies) == 1 and (drafted or not cameras.exists())
    looks = _looked(movies, target, quiet)
    missing = _write_experiment(looks, target, changes)
    if alone:
        (field,) = _asked([field_key(looks[0], vfov)])
        _write_cameras(cameras, camera_keys(looks[0], field))
        missing += open_keys([field])
    if quiet:
        return
    echo_lines(line for look in looks for line in _found(look))
    if len({len(look.movie) for look in looks}) > 1:
        typer.echo("The movies differ in length; `sphereorient check` measures whether they began together.")
    _end(target, missing, _next(target, cameras, looks), [cameras] if alone else [])


def _fictrac(config: Path, movies: Sequence[Path], target: Path, changes: list[str], quiet: bool) -> None:
    from sphereorient.files.picture import write_picture
    from sphereorient.movies import open_movie
    from sphereorient.preflight.fictrac import read_fictrac_config
    from sphereorient.preflight.first_look import camera_keys, field_key
    from sphereorient.preflight.mark_masks import drawn_mask

    said = read_fictrac_config(config)
    movie = movies[0] if movies else said.source
    if len(movies) > 1 or not isinstance(movie, Path):
        got = f"{len(movies)}" if movies else f"camera {said.source} (src_fn)"
        do = f"film some seconds of this set-up, then `sphereorient init MOVIE --from-fictrac {config}`"
        raise SettingsError(refusal("init --from-fictrac", expected="one movie", got=got, do=do))
    mask, cameras = target.parent / "cam1_mask.png", target.parent / "cameras.yaml"
    check_writable(cameras)
    check_writable(mask)
    hidden = [{"kind": "hide", "points": polygon} for polygon in said.ignored]
    shown = drawn_mask(open_movie(movie).frame_shape, hidden, None)
    (look,) = _looked([movie], target, quiet, shown, said.circle_px)
    height, width = look.movie.frame_shape
    R_cam_lab = said.R_animal_cam((width, height)).mT.tolist()  # the lab is the animal's frame
    made = [cameras]
    if hidden:
        write_picture(mask, shown.astype("uint8") * 255)
        made.append(mask)
    rate_hz = None if look.rate_hz else said.rate_hz or look.movie.played_hz  # ordinary cameras film at the played rate
    known = ["sphere.diameter=null", *([f"frame_rate={rate_hz}"] if rate_hz else [])]
    missing = _write_experiment([look], target, [*known, *changes], {look.name: mask.name} if hidden else None)
    model = "fisheye" if said.fisheye else "pinhole"
    _write_cameras(cameras, camera_keys(look, field_key(look, said.vfov_deg), R_cam_lab, model))
    if not quiet:
        echo_lines(_found(look))
        if not said.rate_hz and not any(one.startswith("frame_rate=") for one in changes):
            rate = f"{rate_hz:g} Hz, as players show it" if rate_hz else "its time stamps"
            typer.echo(f"src_fps gives no rate; the movie's is used ({rate}). Correct it if the camera's differs.")
        if said.unread:
            typer.echo(f"{config}, not read: {', '.join(said.unread)}")
        live = [] if isinstance(said.source, Path) else [f"sphereorient live {target} --source camera:{said.source}"]
        _end(target, missing, [*_next(target, cameras, [look]), *live], made)


def _calibration(folder: Path, target: Path, changes: list[str], quiet: bool) -> None:
    from sphereorient.calibration.document import SCHEMA
    from sphereorient.calibration.draft import calibration_keys, numbered_pictures, with_diameters

    pictures = numbered_pictures(folder)
    where = relative_path(folder, target.parent)
    with progress_bar(quiet, unit="pictures") as advance:
        keys, widths = calibration_keys(folder, pictures, "" if where == "." else f"{where}/", advance)
    keys = with_diameters(_asked(given(keys, changes)), widths)
    write_text(target, draft_yaml(SCHEMA, keys, HEAD))
    if not quiet:
        echo_lines(
            f"{key.name}: {key.value} ({key.comment})" for key in keys if key.name in ("plate.columns", "plate.rows")
        )
        _end(target, open_keys(keys), [f"sphereorient calibrate {target} --out cameras.yaml"], [])


def _looked(
    movies: Sequence[Path],
    target: Path,
    quiet: bool,
    shown: "NDArray[np.bool_] | None" = None,
    circle: tuple[float, float, float] | None = None,
) -> "list[FirstLook]":
    """Examine the movies and draw the findings beside the output file; `shown`: see `look_at`, `circle`: FicTrac's."""
    picture = target.with_suffix(".png")
    check_writable(picture)
    from sphereorient.preflight.first_look import look_at, with_circle
    from sphereorient.report.inputs import first_look_figure

    with progress_bar(quiet, unit="movies") as advance:
        looks = look_at(movies, advance, shown)
    if shown is not None:  # FicTrac's balls are fixed
        looks = [with_circle(look, circle) for look in looks]
    first_look_figure(looks, picture)
    return looks


def _write_experiment(
    looks: "Sequence[FirstLook]", target: Path, changes: list[str], masks: dict[str, str] | None = None
) -> list[DraftKey]:
    """Write experiment.yaml; return the keys that the user must fill in."""
    from sphereorient.experiment.experiment import SCHEMA
    from sphereorient.preflight.first_look import experiment_keys

    keys = _asked(given(experiment_keys(looks, target.parent, masks), changes))
    write_text(target, draft_yaml(SCHEMA, keys, HEAD))
    return open_keys(keys)


def _write_cameras(path: Path, keys: list[DraftKey]) -> None:
    from sphereorient.cameras.io.cameras_yaml import SCHEMA

    check_writable(path)
    write_text(path, draft_yaml(SCHEMA, keys, HEAD))


def _asked(keys: list[DraftKey]) -> list[DraftKey]:
    """Prompt for each open key at a terminal; Enter leaves it open."""
    if not sys.stdin.isatty():
        return keys
    for key in open_keys(keys):
        while True:
            answer = typer.prompt(f"{key.name}, {key.comment} (Enter: later)", default="", show_default=False)
            try:
                keys = given(keys, [f"{key.name}={answer}"] if answer.strip() else [])
            except SphereOrientError as error:
                typer.echo(str(error))
                continue
            break
    return keys


def _found(look: "FirstLook") -> list[str]:
    """Return a line on a movie and its ball, and the remarks of its reader."""
    remarks = [f"{look.name}: {remark}" for remark in look.movie.remarks]
    height, width = look.movie.frame_shape
    rate = f", {look.rate_hz:.6g} Hz" if look.rate_hz else ""
    shown = f"{look.name}: {look.movie.path}, {len(look.movie)} frames of {width} x {height} px{rate}; {look.words()}"
    return [shown, *remarks]


def _next(target: Path, cameras: Path, looks: "Sequence[FirstLook]") -> list[str]:
    calibrate = [
        "sphereorient init --plate FOLDER  # pictures of a calibration plate",
        f"sphereorient calibrate calibration.yaml --out {cameras}",
    ]
    return [
        *([] if cameras.exists() else calibrate),
        *([f"sphereorient mark {target}  # the outline is doubtful"] if any(look.doubtful for look in looks) else []),
        f"sphereorient check {target}",
        f"sphereorient track {target} --out {target.parent / 'track.h5'}",
        f"sphereorient report {target.parent / 'track.h5'} --experiment {target} --out {target.parent / 'report'}",
    ]


def _end(target: Path, missing: Sequence[DraftKey], after: Sequence[str], made: Sequence[Path]) -> None:
    picture = target.with_suffix(".png")
    typer.echo(f"Wrote {', '.join(map(str, [target, *made, *([picture] if picture.exists() else [])]))}")
    for key in missing:
        file = "cameras.yaml" if key.name.startswith("cameras.") else target.name
        typer.echo(f"write in {file}: {key.name}, {key.comment}")
    echo_lines(["next:", *(f"  {line}" for line in after)])
