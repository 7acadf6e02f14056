"""`sphereorient map`."""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import ExperimentPath, app, camera_names, check_writable, progress_bar, settings_of
from sphereorient.cli.compare_maps import print_moved

if TYPE_CHECKING:
    from torch import Tensor

    from sphereorient.mapping import LearntMap
    from sphereorient.methods.map import MapResult
    from sphereorient.report.map_figure import MapExample

OFTEN = 10  # pictures from which on a texel counts as well seen


@app.command("map")
def map_(
    experiment: ExperimentPath,
    out: Annotated[Path, typer.Option("--out", "-o", help="Texture map to write, .png; its other files go beside it.")],
    init: Annotated[
        Path | None, typer.Option(help="An old map: gives the body frame, and the texture of what is never seen.")
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
    """Learn the texture map of a ball, and all attitudes, from movies in which it turns: no map needed."""
    from sphereorient.report.map_files import check_picture_name

    check_picture_name(out)
    check_writable(out)
    from sphereorient.methods.map import learn_map
    from sphereorient.sphere import load_texture

    overrides = [*(set_ or []), *(["paint.unordered=true"] if photographs else [])]
    chosen, begun = settings_of(settings, overrides, "map"), time.perf_counter()
    old = None if init is None else load_texture(init)
    command = " ".join(["sphereorient", *sys.argv[1:]])
    with progress_bar(quiet) as advance:
        names = camera_names(cameras)
        result = learn_map(experiment, chosen, init=old, cameras=names, progress=advance, command=command)
        advance("figure", 0, 1)
        files, compared = _write(result, old, out)
        advance("figure", 1, 1)
    if quiet:
        return
    for remark in result.remarks:
        typer.echo(f"note: {remark}")
    _print(result.learnt, compared)
    if result.comparison is not None:
        print_moved(result.comparison, f"against {init}")
        typer.echo(f"kept of the old map, never seen here: {100 * result.kept_share:.0f} % of the sphere")
    typer.echo(f"time: {time.perf_counter() - begun:.0f} s")
    typer.echo("Wrote " + ", ".join(str(file) for file in files))
    if result.experiment.texture_path != out:
        typer.echo(f"next: write texture: {out.name} under sphere: in the experiment, then `sphereorient track`")


def _write(result: MapResult, old: Tensor | None, out: Path) -> tuple[list[Path], list[MapExample]]:
    """Write all files beside the map; return them, and how well re-rendered pictures match."""
    from sphereorient.report import map_figure, map_files
    from sphereorient.report.plots.style import write_figure

    endings = ("_seen.png", "_map.h5", "_map.png", "_moved.png")
    seen, learnt, figure, moved = (out.with_name(out.stem + ending) for ending in endings)
    map_files.write_texture(result.texture, out)
    map_files.write_seen(result.seen, seen)
    map_files.write_learnt(result.learnt, result.track, learnt)
    compared = map_figure.compare_pictures(result.track, result.experiment, out)
    write_figure(map_figure.map_figure(result.learnt, compared), figure)
    if result.comparison is None or old is None:
        return [out, seen, learnt, figure], compared
    write_figure(map_figure.moved_figure(old, result.comparison), moved)
    return [out, seen, learnt, figure, moved], compared


def _print(learnt: LearntMap, compared: list[MapExample]) -> None:
    """Print from what the map was learnt, and how well it explains the pictures."""
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
        f"iterations: {len(learnt.rounds)}, the last moved attitudes by {math.degrees(last.moved_rad):.4f}° ({state})",
    ]
    alone = ~learnt.valid & learnt.position_lab_mm[:, 0].isfinite()  # of photographs
    if alone.any():
        named = ", ".join(str(k) for k in alone.nonzero()[:, 0].tolist())
        lines.append(f"without an attitude, because they share too little with the others: frames {named}")
    alike = np.array([example.correlation for example in compared])
    if np.isfinite(alike).any():
        middle, low = np.nanmedian(alike), np.nanpercentile(alike, 5)
        lines.append(f"pictures against re-rendered: correlation {middle:.3f} (median), {low:.3f} (worst twentieth)")
    for line in lines:
        typer.echo(line)
