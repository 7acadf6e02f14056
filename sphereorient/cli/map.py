"""`sphereorient map` and `compare-maps`."""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import Advance, ExperimentPath, app, camera_names, check_writable, progress_bar

if TYPE_CHECKING:
    from torch import Tensor

    from sphereorient.experiment import Experiment
    from sphereorient.paint import LearntMap
    from sphereorient.paint.compare import MapComparison
    from sphereorient.paint.correct import Correction
    from sphereorient.report.map_figure import Example
    from sphereorient.settings import Settings
    from sphereorient.trajectory import Trajectory

OFTEN = 10  # pictures from which on a place counts as well seen
CHANGED = 0.15  # of black to white paint: a change that is told


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

    def written(self, moved: bool) -> list[Path]:
        """Return the files that there are, `moved` where an old map was corrected."""
        return [self.texture, self.seen, self.learnt, self.figure, *([self.moved] if moved else [])]


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
    from sphereorient.settings import load_settings
    from sphereorient.sphere import load_texture

    chosen, begun = load_settings(settings, set_ or []), time.perf_counter()
    old = None if init is None else load_texture(init)
    paths = MapPaths.beside(out)
    with progress_bar(quiet) as advance:
        made = _learn(experiment, camera_names(cameras), chosen, old, advance)
        advance("figure", 0, 1)
        compared = _write(made, old, paths)
        advance("figure", 1, 1)
    if quiet:
        return
    for remark in made.remarks:
        typer.echo(f"note: {remark}")
    _print(made.learnt, compared)
    if made.correction is not None:
        _print_moved(made.correction.comparison, f"against {init}")
        typer.echo(f"kept of the old map, never seen here: {100 * made.correction.kept_share:.0f} % of the sphere")
    typer.echo(f"time: {time.perf_counter() - begun:.0f} s")
    typer.echo("Wrote " + ", ".join(str(file) for file in paths.written(init is not None)))
    if made.experiment.texture_path != paths.texture:
        typer.echo(f"next: write texture: {out.name} under sphere: in the experiment, then `sphereorient track`")


@dataclass(frozen=True, kw_only=True, eq=False)
class Made:
    """What was learnt; made by `_learn`, written and printed by the command."""

    experiment: Experiment
    learnt: LearntMap
    correction: Correction | None  # of an old map, where one was given
    track: Trajectory
    remarks: tuple[str, ...]


def _learn(path: Path, names: list[str] | None, settings: Settings, old: Tensor | None, advance: Advance) -> Made:
    """Learn a map, and bring it into an old one's frame where there is one."""
    from sphereorient.paint import learn_map
    from sphereorient.paint.correct import corrected
    from sphereorient.pipeline import one_thread
    from sphereorient.provenance import provenance
    from sphereorient.recording import open_unpainted
    from sphereorient.results import map_track
    from sphereorient.settings import settings_yaml

    with open_unpainted(path, names) as recording, one_thread():
        learnt = learn_map(recording, settings.paint, settings.locate, advance)
        correction = None if old is None else corrected(learnt, old)
        learnt = learnt if correction is None else correction.learnt
        command = " ".join(["sphereorient", *sys.argv[1:]])
        origin = provenance(recording.experiment, list(recording.cameras), command)
        track = map_track(recording.experiment, recording.clock, learnt, settings_yaml(settings), origin)
        return Made(
            experiment=recording.experiment,
            learnt=learnt,
            correction=correction,
            track=track,
            remarks=recording.remarks,
        )


def _write(made: Made, old: Tensor | None, paths: MapPaths) -> list[Example]:
    """Write all files; return how well re-rendered pictures match."""
    from sphereorient.report import map_figure, map_files

    map_files.write_texture(made.learnt.texture, paths.texture)
    map_files.write_seen(made.learnt.seen, paths.seen)
    map_files.write_learnt(made.learnt, made.track, paths.learnt)
    compared = map_figure.compare_pictures(made.track, made.experiment, paths.texture)
    map_figure.write_figure(map_figure.map_figure(made.learnt, compared), paths.figure)
    if made.correction is not None and old is not None:
        map_figure.write_figure(map_figure.moved_figure(old, made.correction.comparison), paths.moved)
    return compared


def _print(learnt: LearntMap, compared: list[Example]) -> None:
    """Say what was learnt from what, and whether to believe it."""
    import numpy as np

    from sphereorient.report.map_files import shares_seen

    seen, often = shares_seen(learnt.seen, (1, OFTEN))
    closure, last = learnt.closure, learnt.rounds[-1]
    before, after = (math.degrees(drift) for drift in (closure.drift_before_rad, closure.drift_after_rad))
    drift = f"drift {before:.2f}° before, {after:.2f}° after" if closure.closed else "the drift is not known"
    state = "arrived" if learnt.arrived else "not arrived: --set paint.rounds=N for more"
    lines = [
        f"seen: {100 * seen:.1f} % of the sphere, {100 * often:.1f} % of it in {OFTEN} pictures or more",
        f"frames: {len(learnt.valid)}, with the ball {int(learnt.valid.sum())}, fitted {int(learnt.fitted.sum())}",
        f"loops: {closure.closed} of {closure.loops} closed; {drift}",
        f"rounds: {len(learnt.rounds)}, the last moved attitudes by {math.degrees(last.moved_rad):.4f}° ({state})",
    ]
    alike = np.array([example.correlation for example in compared])
    if np.isfinite(alike).any():
        middle, low = np.nanmedian(alike), np.nanpercentile(alike, 5)
        lines.append(f"pictures against re-rendered: correlation {middle:.3f} (median), {low:.3f} (worst twentieth)")
    for line in lines:
        typer.echo(line)


def _print_moved(comparison: MapComparison, against: str) -> None:
    count = len(comparison.length_rad)
    if not count:
        typer.echo(f"{against}: no patch could be located")
        return
    rms, most = math.degrees(comparison.rms_rad), math.degrees(comparison.max_rad)
    typer.echo(f"{against}: paint lies {rms:.2f}° off (rms of {count} patches), {most:.2f}° at most")


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

    from sphereorient.paint.compare import compare_maps, paint_change, turned_map, without_changed
    from sphereorient.report import map_figure
    from sphereorient.so3 import angle

    after, before = _known_map(new), _known_map(old)
    comparison = compare_maps(after, before, turned=not same_frame)
    change = paint_change(turned_map(after, comparison.R_other_reference, len(before)), before)
    comparison = without_changed(comparison, change, CHANGED)
    known = change[torch.isfinite(change)]
    changed = float((known.abs() > CHANGED).float().mean()) if len(known) else math.nan
    if out is not None:
        map_figure.write_figure(map_figure.moved_figure(before, comparison, change), out)
    if as_json:
        typer.echo(json.dumps(_numbers(comparison, changed)))
        return
    _print_moved(comparison, f"{new} against {old}")
    turn_deg = math.degrees(float(angle(comparison.R_other_reference)))
    typer.echo(f"body frames: {turn_deg:.2f}° apart; correlation {comparison.correlation:.3f}")
    typer.echo(
        f"paint that changed by more than {100 * CHANGED:g} % of black to white: {100 * changed:.1f} % of the map"
    )
    if out is not None:
        typer.echo(f"Wrote {out}")


def _numbers(comparison: MapComparison, changed: float) -> dict[str, object]:
    """Return the figures of a comparison; what could not be measured is null."""
    count = len(comparison.length_rad)
    return {
        "patches": count,
        "moved_rms_deg": math.degrees(comparison.rms_rad) if count else None,
        "moved_max_deg": math.degrees(comparison.max_rad) if count else None,
        "correlation": comparison.correlation,
        "changed_share": changed if math.isfinite(changed) else None,
        "R_new_old": comparison.R_other_reference.tolist(),
    }


def _known_map(path: Path) -> Tensor:
    """Read a map, NaN where the counts beside it say that it was never seen."""
    import torch

    from sphereorient.report.map_files import read_seen, seen_path
    from sphereorient.sphere import load_texture

    texture, seen = load_texture(path), read_seen(seen_path(path))
    if seen is None or seen.shape != texture.shape:
        return texture
    return torch.where(seen > 0, texture, torch.nan)
