"""`sphereorient map` and `compare-maps`: learn a texture map from movies, compare two or a series."""

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from sphereorient.cli.app import app, check_writable, command_line, echo_lines, progress_bar
from sphereorient.cli.options import CameraOptions, ExperimentPath, NoCache, Resume, file_of
from sphereorient.errors import PaintError, refusal
from sphereorient.files.provenance import without_nan
from sphereorient.files.threads import counted
from sphereorient.files.whole_file import check_ending

if TYPE_CHECKING:
    from torch import Tensor

    from sphereorient.methods.map import MapResult
    from sphereorient.sphere.compare import MapComparison
    from sphereorient.tools.wear import WearSeries

OFTEN = 10  # pictures; a texel in so many is well seen
PAINT_MIN = 0.7  # correlation of held-out pictures; below it a map is doubtful
PLACES_PRINTED = 10  # worn places that are printed; JSON has all


@dataclass(frozen=True, kw_only=True)
class _MapOptions(CameraOptions):
    experiment: ExperimentPath
    out: Annotated[Path, Option("--out", "-o", help="Texture map to write, .png; other files go beside it.")]
    init: Annotated[Path | None, Option(help="Old map: defines the body frame, fills paint not seen here.")] = None
    photographs: Annotated[
        bool, Option("--photographs", help="Pictures in any order, not a movie: --set paint.unordered=true.")
    ] = False
    resume: Resume = False
    no_cache: NoCache = False


@app.command("map")
def map_(given: _MapOptions) -> None:
    """Learn the texture map of a ball, and all orientations, from movies in which it rotates, without a map. Several
    balls give a map each, OUT_NAME.png; balls of the same paint share one.
    """
    check_ending(given.out, "--out", [".png", ".tif", ".tiff"])  # other formats lose grey values
    from sphereorient.experiment import load_experiment
    from sphereorient.methods.map import learn_map
    from sphereorient.run.store import FolderStore, Request
    from sphereorient.sphere import load_known

    outs = {name: file_of(given.out, name) for name in load_experiment(given.experiment).names}
    for one in outs.values():
        for path in _files_of(one):
            check_writable(path)
    also = ["paint.unordered=true"] if given.photographs else []
    chosen, begun = given.chosen("map", *also), time.perf_counter()
    old = None if given.init is None else load_known(given.init)
    request = Request(experiment=given.experiment, out=given.out, method="map", settings=chosen, cameras=given.names)
    store = FolderStore(request.parts)
    with store.held(request, resume=given.resume), progress_bar(given.quiet, unit="iterations") as advance:
        kept = store.folder / "map.h5"
        found = learn_map(
            given.experiment,
            chosen,
            init=old,
            cameras=given.names,
            progress=advance,
            kept=kept,
            command=command_line(),
        )
        results, files = found if isinstance(found, dict) else {found.paint_of: found}, []
        for name, result in counted("figure", results.items(), len(results), advance):
            files += _write(result, old, outs[name])
        store.remove()
    if given.quiet:
        return
    echo_lines(f"note: {remark}" for remark in next(iter(results.values())).remarks)
    for name, result in results.items():
        if name:
            typer.echo(f"ball {name}")
        print_map(result)
        if result.comparison is not None:
            _print_moved(result.comparison, f"against {given.init}")
            typer.echo(f"kept from the old map, not seen here: {100 * result.kept_share:.0f} % of the sphere")
    typer.echo(f"time: {time.perf_counter() - begun:.0f} s")
    typer.echo("Wrote " + ", ".join(str(file) for file in files))
    for name, result in results.items():
        map_path = outs[result.paint_of]
        if result.experiment.texture_path != map_path:
            place = f"ball {name} of spheres:" if name else "sphere:"
            why = "" if result.paint_of == name else f" (same paint as {result.paint_of})"
            line = f"next: add texture: {map_path.name} under {place} in the experiment{why}, then `sphereorient track`"
            typer.echo(line)


def _files_of(out: Path) -> list[Path]:
    """Return the files of the map: map, counts, results, figure, and figure of displacements."""
    return [out, *(out.with_name(out.stem + end) for end in ("_seen.png", "_map.h5", "_map.png", "_moved.png"))]


def _write(result: "MapResult", old: "Tensor | None", out: Path) -> list[Path]:
    from sphereorient.report import texture_map
    from sphereorient.report.plots.style import write_figure

    _, seen, learnt, figure, moved = _files_of(out)
    texture_map.write_texture(result.texture, out)
    texture_map.write_seen(result.seen, out)
    texture_map.write_learnt(result.learnt, result.track, learnt)
    compared = texture_map.compare_pictures(result.learnt, result.track, result.experiment, out)
    write_figure(texture_map.map_figure(result.learnt, compared), figure)
    if result.comparison is None or old is None:
        return [out, seen, learnt, figure]
    write_figure(texture_map.moved_figure(old, result.comparison), moved)
    return [out, seen, learnt, figure, moved]


def print_map(result: "MapResult") -> None:
    """Print what was learnt; frames by the experiment's numbers."""
    from sphereorient.report.frame_warnings import frame_numbers
    from sphereorient.report.texture_map import shares_seen

    learnt, numbers = result.learnt, frame_numbers(result.track)
    seen, often = shares_seen(learnt.seen, (1, OFTEN))
    closure, last = learnt.closure, learnt.rounds[-1]
    before, after = (math.degrees(drift) for drift in (closure.drift_before_rad, closure.drift_after_rad))
    drift = f"drift {before:.2f}° before, {after:.2f}° after" if closure.closed else "drift not known"
    state = "arrived" if learnt.arrived else "not arrived: --set paint.rounds=N for more"
    lines = [
        f"seen: {100 * seen:.1f} % of the sphere, {100 * often:.1f} % of it in {OFTEN} pictures or more",
        f"frames: {len(learnt.valid)}, with the ball {int(learnt.valid.sum())}, fitted {int(learnt.fitted.sum())}",
        f"loops: {closure.closed} of {closure.loops} closed; {drift}",
        f"iterations: {len(learnt.rounds)}, last change of orientation {math.degrees(last.moved_rad):.4f}° ({state})",
    ]
    alone = ~learnt.valid & learnt.position_lab_mm[:, 0].isfinite()  # of photographs
    if alone.any():
        named = ", ".join(str(k) for k in numbers[alone.numpy()].tolist())
        lines.append(f"without an orientation, because they overlap the others too little: frames {named}")
    paint = learnt.paint[learnt.paint.isfinite()]
    if len(paint):
        middle, low = paint.quantile(0.5), paint.quantile(0.05)
        said = f"paint in pictures held out of the map: correlation {middle:.3f} (median), {low:.3f} (5th percentile)"
        lines.append(said if middle > PAINT_MIN else f"doubt: {said}; do not trust the map")
    if len(learnt.jumps):
        named = ", ".join(str(k) for k in numbers[learnt.jumps[:PLACES_PRINTED].numpy()].tolist())
        lines.append(f"doubt: the angular velocity jumps at {len(learnt.jumps)} frames: {named}")
    echo_lines(lines)


@app.command("compare-maps")
def compare_maps_(
    maps: Annotated[
        list[Path],
        Argument(
            metavar="NEW.png OLD.png",
            help="Two maps; NEW_seen.png beside one marks its unknown texels. With --series: FIRST.png SECOND.png ...",
        ),
    ],
    out: Annotated[Path | None, Option("--out", "-o", help="Figure: displacements, changes of the texture.")] = None,
    series: Annotated[bool, Option("--series", help="Maps in order of time: wear of each since the first.")] = False,
    same_frame: Annotated[
        bool, Option("--same-frame", help="Same body frame; else the rotation is estimated.")
    ] = False,
    as_json: Annotated[bool, Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Compare texture maps of one ball: displacement of the texture, and wear."""
    if out is not None:
        check_writable(out)
    if not series and len(maps) != 2:
        do = "name the new map and the old one, or add --series and name maps in order of time"
        raise PaintError(refusal("maps", expected="two", got=str(len(maps)), do=do))
    (_compare_series if series else _compare_two)(maps, out, turned=not same_frame, as_json=as_json)
    if out is not None and not as_json:
        typer.echo(f"Wrote {out}")


def _compare_two(maps: list[Path], out: Path | None, *, turned: bool, as_json: bool) -> None:
    from sphereorient.report import texture_map
    from sphereorient.report.plots.style import write_figure
    from sphereorient.sphere import load_known
    from sphereorient.sphere.compare import CHANGED, compare_maps, texture_change, turned_map, without_changed

    after, before = (load_known(path) for path in maps)
    comparison = compare_maps(after, before, turned=turned)
    R = comparison.R_other_reference
    change = texture_change(turned_map(after, R, len(before)), before)
    comparison = without_changed(comparison, change, CHANGED)
    known = change[change.isfinite()]
    changed = float((known.abs() > CHANGED).float().mean()) if len(known) else math.nan
    if out is not None:
        write_figure(texture_map.moved_figure(before, comparison, change), out)
    if as_json:
        numbers = {**_numbers(comparison), "changed_share": changed, "R_new_old": R.tolist()}
        typer.echo(json.dumps(without_nan(numbers)))
        return
    _print_moved(comparison, f"{maps[0]} against {maps[1]}")
    typer.echo(
        f"body frames: {math.degrees(comparison.angle_rad):.2f}° apart; correlation {comparison.correlation:.3f}"
    )
    typer.echo(f"texture changed by more than {100 * CHANGED:g} % of black to white: {100 * changed:.1f} % of the map")


def _compare_series(maps: list[Path], out: Path | None, *, turned: bool, as_json: bool) -> None:
    from sphereorient.report.plots.style import write_figure
    from sphereorient.sphere import load_known
    from sphereorient.tools.wear import wear_figure, wear_series

    known = [load_known(path) for path in maps]
    found = wear_series(known, turned)
    stems = [path.stem for path in maps]
    names = stems if len(set(stems)) == len(stems) else [str(path) for path in maps]
    if out is not None:
        write_figure(wear_figure(known[0], found, names), out)
    if as_json:
        typer.echo(json.dumps(without_nan(_series_numbers(found, [str(path) for path in maps]))))
    else:
        _print_series(found, names)


def _print_series(found: "WearSeries", names: list[str]) -> None:
    width = max(len(name) for name in names)
    typer.echo(f"{'against ' + names[0]:{width + 8}}  known of the ball  worn of it  since the map before  stays worn")
    for name, one in zip(names[1:], found.growth, strict=True):
        typer.echo(
            f"{name:{width + 8}}  {_percent(one.known):>17}  {_percent(one.worn):>10}  "
            f"{_percent(one.grown, '+'):>20}  {_percent(one.stays):>10}"
        )
    for name, wear in zip(names[1:], found.wear, strict=True):
        _print_moved(wear.comparison, f"{name} against {names[0]}")
    if not found.places:
        typer.echo("no worn place")
    for number, place in enumerate(found.places[:PLACES_PRINTED], start=1):
        shares = ", ".join(_percent(share, digits=2) for share in place.share)
        typer.echo(
            f"place {number} at longitude {place.longitude_deg:.0f}°, latitude {place.latitude_deg:.0f}°: "
            f"{shares} of the ball"
        )
    if len(found.places) > PLACES_PRINTED:
        typer.echo(f"and {len(found.places) - PLACES_PRINTED} smaller places")


def _percent(share: float, sign: str = "", digits: int = 1) -> str:
    return f"{100 * share:{sign}.{digits}f} %" if math.isfinite(share) else "-"


def _series_numbers(found: "WearSeries", names: list[str]) -> dict[str, object]:
    rows = [
        {
            "map": name,
            **{f"{what}_share": getattr(one, what) for what in ("known", "worn", "grown", "stays")},
            "scatter": wear.scatter,
            **_numbers(wear.comparison),
            "R_map_first": wear.comparison.R_other_reference.tolist(),
        }
        for name, one, wear in zip(names[1:], found.growth, found.wear, strict=True)
    ]
    places = [
        {
            "longitude_deg": place.longitude_deg,
            "latitude_deg": place.latitude_deg,
            "worn_share_of_ball": list(place.share),
        }
        for place in found.places
    ]
    return {"first": names[0], "maps": rows, "places": places}


def _print_moved(comparison: "MapComparison", against: str) -> None:
    count = len(comparison.length_rad)
    if not count:
        typer.echo(f"{against}: no patch could be located")
        return
    rms, most = math.degrees(comparison.rms_rad), math.degrees(comparison.max_rad)
    typer.echo(f"{against}: texture displaced by {rms:.2f}° (rms of {count} patches), {most:.2f}° at most")


def _numbers(comparison: "MapComparison") -> dict[str, object]:
    return {
        "patches": len(comparison.length_rad),
        "moved_rms_deg": math.degrees(comparison.rms_rad),
        "moved_max_deg": math.degrees(comparison.max_rad),
        "correlation": comparison.correlation,
    }
