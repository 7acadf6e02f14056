"""`sphereorient map`."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import Advance, ExperimentPath, app, camera_names, check_writable, progress_bar
from sphereorient.cli.compare_maps import print_moved

if TYPE_CHECKING:
    from torch import Tensor

    from sphereorient.experiment import Experiment
    from sphereorient.mapping import LearntMap
    from sphereorient.mapping.correct import Correction
    from sphereorient.methods.settings import Settings
    from sphereorient.report.map_figure import MapExample
    from sphereorient.trajectory import Trajectory

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
    photographs: Annotated[
        bool, typer.Option("--photographs", help="Pictures in any order, no movie: --set paint.unordered=true.")
    ] = False,
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
    from sphereorient.methods.settings import load_settings
    from sphereorient.sphere import load_texture

    overrides = [*(set_ or []), *(["paint.unordered=true"] if photographs else [])]
    chosen, begun = load_settings(settings, overrides), time.perf_counter()
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
        print_moved(made.correction.comparison, f"against {init}")
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
    from sphereorient.experiment import input_files
    from sphereorient.experiment.recording import open_recording
    from sphereorient.files.provenance import provenance
    from sphereorient.mapping import learn_map
    from sphereorient.mapping.correct import corrected
    from sphereorient.methods.results import map_track
    from sphereorient.methods.settings import settings_yaml
    from sphereorient.run.stages import one_thread

    with open_recording(path, names, textured=False) as recording, one_thread():
        learnt = learn_map(recording, settings.paint, settings.locate, advance)
        correction = None if old is None else corrected(learnt, old)
        learnt = learnt if correction is None else correction.learnt
        command = " ".join(["sphereorient", *sys.argv[1:]])
        origin = provenance(
            input_files(recording.experiment, list(recording.cameras)), recording.experiment.folder, command
        )
        track = map_track(recording.experiment, recording.clock, learnt, settings_yaml(settings), origin)
        return Made(
            experiment=recording.experiment,
            learnt=learnt,
            correction=correction,
            track=track,
            remarks=recording.remarks,
        )


def _write(made: Made, old: Tensor | None, paths: MapPaths) -> list[MapExample]:
    """Write all files; return how well re-rendered pictures match."""
    from sphereorient.report import map_figure, map_files
    from sphereorient.report.plots.style import write_figure

    map_files.write_texture(made.learnt.texture, paths.texture)
    map_files.write_seen(made.learnt.seen, paths.seen)
    map_files.write_learnt(made.learnt, made.track, paths.learnt)
    compared = map_figure.compare_pictures(made.track, made.experiment, paths.texture)
    write_figure(map_figure.map_figure(made.learnt, compared), paths.figure)
    if made.correction is not None and old is not None:
        write_figure(map_figure.moved_figure(old, made.correction.comparison), paths.moved)
    return compared


def _print(learnt: LearntMap, compared: list[MapExample]) -> None:
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
    alone = ~learnt.valid & learnt.position_lab_mm[:, 0].isfinite()  # of photographs
    if alone.any():
        named = ", ".join(str(k) for k in alone.nonzero()[:, 0].tolist())
        lines.append(f"without an attitude, sharing too little paint with the others: frames {named}")
    alike = np.array([example.correlation for example in compared])
    if np.isfinite(alike).any():
        middle, low = np.nanmedian(alike), np.nanpercentile(alike, 5)
        lines.append(f"pictures against re-rendered: correlation {middle:.3f} (median), {low:.3f} (worst twentieth)")
    for line in lines:
        typer.echo(line)
