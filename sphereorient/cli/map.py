"""`sphereorient map` and `compare-maps`."""

from __future__ import annotations

import json
import math
import resource
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import ExperimentPath, app, camera_names, check_writable, progress_bar

if TYPE_CHECKING:
    from torch import Tensor

    from sphereorient.paint import LearntMap
    from sphereorient.paint.compare import MapComparison
    from sphereorient.report.map_figure import Example

OFTEN = 10  # pictures from which on a place counts as well seen


@dataclass(frozen=True, kw_only=True)
class MapPaths:
    """The files that `map` writes, all beside the map; made by `beside`."""

    texture: Path
    seen: Path
    learnt: Path
    figure: Path
    moved: Path

    @classmethod
    def beside(cls, texture: Path) -> MapPaths:
        """Return the names that go with a map's."""
        stem = texture.with_suffix("")
        return cls(
            texture=texture,
            seen=texture.with_name(f"{stem.name}_seen.png"),
            learnt=texture.with_name(f"{stem.name}_map.h5"),
            figure=texture.with_name(f"{stem.name}_map.png"),
            moved=texture.with_name(f"{stem.name}_moved.png"),
        )


@app.command("map")
def map_(
    experiment: ExperimentPath,
    out: Annotated[Path, typer.Option("--out", "-o", help="Map to write, .png; its other files go beside it.")],
    init: Annotated[
        Path | None, typer.Option(help="An old map: gives the body frame, and the paint of what is never seen.")
    ] = None,
    cameras: Annotated[str | None, typer.Option(help="Use these cameras only, e.g. cam1 or cam1,cam2.")] = None,
    settings: Annotated[Path | None, typer.Option(help="YAML as `sphereorient settings` writes it.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Override one setting, e.g. --set paint.rounds=20.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False,
) -> None:
    """Learn the map of a ball's paint, and all attitudes, from movies in which it turns: no map needed."""
    from sphereorient.report.map_files import check_picture_name

    check_picture_name(out)
    check_writable(out)
    from sphereorient.paint import learn_map
    from sphereorient.paint.correct import corrected
    from sphereorient.pipeline import one_thread
    from sphereorient.provenance import provenance
    from sphereorient.recording import open_unpainted
    from sphereorient.report import map_figure, map_files
    from sphereorient.results import map_track
    from sphereorient.settings import load_settings, settings_yaml
    from sphereorient.sphere import load_texture

    chosen = load_settings(settings, set_ or [])
    old = None if init is None else load_texture(init)
    paths, begun = MapPaths.beside(out), time.perf_counter()
    command = " ".join(["sphereorient", *sys.argv[1:]])
    with open_unpainted(experiment, camera_names(cameras)) as recording, one_thread(), progress_bar(quiet) as advance:
        learnt, comparison, kept = learn_map(recording, chosen.paint, chosen.locate, advance), None, 0.0
        if old is not None:
            correction = corrected(learnt, old)
            learnt, comparison, kept = correction.learnt, correction.comparison, correction.kept_share
        origin = provenance(recording.experiment, list(recording.cameras), command)
        track = map_track(recording.experiment, recording.clock, learnt, settings_yaml(chosen), origin)
        source = recording.experiment
        map_files.write_texture(learnt.texture, paths.texture)
        map_files.write_seen(learnt.seen, paths.seen)
        map_files.write_learnt(learnt, track, paths.learnt)
        advance("figure", 0, 1)
        compared = map_figure.compare_pictures(track, source, paths.texture)
        map_figure.write_figure(map_figure.map_figure(learnt, compared), paths.figure)
        if comparison is not None and old is not None:
            map_figure.write_figure(map_figure.moved_figure(old, comparison), paths.moved)
        advance("figure", 1, 1)
    if not quiet:
        for remark in recording.remarks:
            typer.echo(f"note: {remark}")
        _print(learnt, compared, time.perf_counter() - begun)
        if comparison is not None:
            _print_moved(comparison, f"against {init}")
            typer.echo(f"of the old map's paint {100 * kept:.0f} % of the sphere was kept: never seen here")
        _print_files(paths, init is not None, source.texture_path != paths.texture)


def _print(learnt: LearntMap, compared: list[Example], seconds: float) -> None:
    """Say what was learnt from what, and whether to believe it."""
    import numpy as np

    from sphereorient.report.map_files import shares_seen

    seen, often = shares_seen(learnt.seen, (1, OFTEN))
    valid, fitted, frames = int(learnt.valid.sum()), int(learnt.fitted.sum()), len(learnt.valid)
    closure = learnt.closure
    before, after = (math.degrees(drift) for drift in (closure.drift_before_rad, closure.drift_after_rad))
    lines = [
        f"seen: {100 * seen:.1f} % of the sphere, {100 * often:.1f} % of it in {OFTEN} pictures or more",
        f"frames: {frames}, with the ball {valid}, that the map was fitted to {fitted}",
    ]
    if closure.closed:
        lines.append(f"loops: {closure.closed} of {closure.loops} closed; drift {before:.2f}° before, {after:.2f}° after")
    else:
        lines.append(f"loops: none of {closure.loops} closed: the drift of the attitudes is not known")
    last = learnt.rounds[-1]
    state = "arrived" if learnt.arrived else "not arrived: --set paint.rounds=N for more"
    lines.append(f"rounds: {len(learnt.rounds)}, the last moved attitudes by {math.degrees(last.moved_rad):.4f}° ({state})")
    alike = np.array([example.correlation for example in compared])
    if np.isfinite(alike).any():
        middle, low = np.nanmedian(alike), np.nanpercentile(alike, 5)
        lines.append(f"pictures against re-rendered ones: correlation {middle:.3f} (median), {low:.3f} (worst twentieth)")
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    lines.append(f"time {seconds:.0f} s, memory {memory:.2f} GB")
    for line in lines:
        typer.echo(line)


def _print_moved(comparison: MapComparison, against: str) -> None:
    count = len(comparison.length_rad)
    if not count:
        typer.echo(f"{against}: no patch could be located")
        return
    rms, most = math.degrees(comparison.rms_rad), math.degrees(comparison.max_rad)
    typer.echo(f"{against}: paint lies {rms:.2f}° off (rms of {count} patches), {most:.2f}° at most")


def _print_files(paths: MapPaths, moved: bool, unknown: bool) -> None:
    files = [paths.texture, paths.seen, paths.learnt, paths.figure, *([paths.moved] if moved else [])]
    typer.echo("Wrote " + ", ".join(str(file) for file in files))
    if unknown:
        typer.echo(f"next: write texture: {paths.texture.name} under sphere: in the experiment, then `sphereorient track`")


@app.command("compare-maps")
def compare_maps_(
    new: Annotated[Path, typer.Argument(metavar="NEW.png", help="A map; NEW_seen.png beside it tells what it knows.")],
    old: Annotated[Path, typer.Argument(metavar="OLD.png", help="The map that it is compared with; likewise.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Figure: arrows, and where the paint itself changed.")
    ] = None,
    same_frame: Annotated[
        bool, typer.Option("--same-frame", help="The body frames are one; else a rotation is found and removed.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Compare two maps of one ball: how far the paint moved, and where it wore off."""
    if out is not None:
        check_writable(out)
    import torch

    from sphereorient.paint.compare import compare_maps, paint_change, turned_map
    from sphereorient.report import map_figure

    after, before = _known_map(new), _known_map(old)
    comparison = compare_maps(after, before, turned=not same_frame)
    change = paint_change(turned_map(after, comparison.R_other_reference, len(before)), before)
    known = change[torch.isfinite(change)]
    numbers = {
        "patches": len(comparison.length_rad),
        "moved_rms_deg": math.degrees(comparison.rms_rad),
        "moved_max_deg": math.degrees(comparison.max_rad),
        "correlation": comparison.correlation,
        "changed_share": float((known.abs() > map_figure.CHANGE_REACH / 2).float().mean()) if len(known) else math.nan,
        "R_new_old": comparison.R_other_reference.tolist(),
    }
    if out is not None:
        map_figure.write_figure(map_figure.moved_figure(before, comparison, change), out)
    if as_json:
        typer.echo(json.dumps(numbers))
        return
    _print_moved(comparison, f"{new} against {old}")
    turn = math.degrees(float(_angle(comparison)))
    typer.echo(f"body frames turned by {turn:.2f}° against each other; correlation {comparison.correlation:.3f}")
    changed = 100 * numbers["changed_share"]  # type: ignore[operator]
    typer.echo(f"paint that changed by more than {map_figure.CHANGE_REACH / 2:g} of black to white: {changed:.1f} % of the map")
    if out is not None:
        typer.echo(f"Wrote {out}")


def _angle(comparison: MapComparison) -> Tensor:
    from sphereorient.so3 import angle

    return angle(comparison.R_other_reference)


def _known_map(path: Path) -> Tensor:
    """Read a map, NaN where the counts beside it say that it was never seen."""
    import torch

    from sphereorient.report.map_files import read_seen, seen_path
    from sphereorient.sphere import load_texture

    texture, seen = load_texture(path), read_seen(seen_path(path))
    if seen is None or seen.shape != texture.shape:
        return texture
    return torch.where(seen > 0, texture, torch.nan)
