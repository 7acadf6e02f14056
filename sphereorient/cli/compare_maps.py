"""`sphereorient compare-maps`: two maps of one ball, or a series of them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import app, check_writable
from sphereorient.errors import PaintError, refusal

if TYPE_CHECKING:
    from torch import Tensor

    from sphereorient.mapping.compare import MapComparison
    from sphereorient.tools.wear.series import WearSeries

PLACES_TOLD = 10  # worn places that are printed; JSON has all


@app.command("compare-maps")
def compare_maps_(
    maps: Annotated[
        list[Path],
        typer.Argument(
            metavar="NEW.png OLD.png",
            help="Two maps; NEW_seen.png beside one tells what it knows. With --series: FIRST.png SECOND.png ...",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Figure: arrows, and where the paint itself changed.")
    ] = None,
    series: Annotated[
        bool,
        typer.Option(
            "--series", help="Maps in the order of their movies, all compared with the first: how wear grows."
        ),
    ] = False,
    same_frame: Annotated[
        bool, typer.Option("--same-frame", help="The body frames are one; else a rotation is found and removed.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Compare maps of one ball: how far the paint moved, and where it wore off."""
    if out is not None:
        check_writable(out)
    if series:
        _compare_series(maps, out, turned=not same_frame, as_json=as_json)
        return
    if len(maps) != 2:
        do = "name the new map and the old one, or add --series and name the first one first"
        raise PaintError(refusal("maps", expected="two", got=str(len(maps)), do=do))
    new, old = maps
    _compare_two(new, old, out, turned=not same_frame, as_json=as_json)


def _compare_two(new: Path, old: Path, out: Path | None, *, turned: bool, as_json: bool) -> None:
    from sphereorient.mapping.compare import CHANGED, compare_maps, texture_change, turned_map, without_changed
    from sphereorient.report import map_figure
    from sphereorient.so3 import angle

    after, before = _known_map(new), _known_map(old)
    comparison = compare_maps(after, before, turned=turned)
    change = texture_change(turned_map(after, comparison.R_other_reference, len(before)), before)
    comparison = without_changed(comparison, change, CHANGED)
    known = change[change.isfinite()]
    changed = float((known.abs() > CHANGED).float().mean()) if len(known) else math.nan
    if out is not None:
        map_figure.write_figure(map_figure.moved_figure(before, comparison, change), out)
    if as_json:
        typer.echo(json.dumps(_numbers(comparison, changed)))
        return
    print_moved(comparison, f"{new} against {old}")
    turn_deg = math.degrees(float(angle(comparison.R_other_reference)))
    typer.echo(f"body frames: {turn_deg:.2f}° apart; correlation {comparison.correlation:.3f}")
    typer.echo(
        f"paint that changed by more than {100 * CHANGED:g} % of black to white: {100 * changed:.1f} % of the map"
    )
    if out is not None:
        typer.echo(f"Wrote {out}")


def _compare_series(maps: list[Path], out: Path | None, *, turned: bool, as_json: bool) -> None:
    from sphereorient.report import map_figure
    from sphereorient.tools.wear import figure as wear_figure
    from sphereorient.tools.wear.series import wear_series

    known = [_known_map(path) for path in maps]
    found = wear_series(known, turned)
    names = _short(maps)
    if out is not None:
        map_figure.write_figure(wear_figure.wear_figure(known[0], found, names), out)
    if as_json:
        typer.echo(json.dumps(_series_numbers(found, [str(path) for path in maps])))
        return
    _print_series(found, names)
    if out is not None:
        typer.echo(f"Wrote {out}")


def _print_series(found: WearSeries, names: list[str]) -> None:
    """Print what is worn in each map, then place by place."""
    width = max(len(name) for name in names)
    typer.echo(f"{'against ' + names[0]:{width + 8}}  known of the ball  worn of it  since the map before  stays worn")
    for name, one in zip(names[1:], found.growth, strict=True):
        typer.echo(
            f"{name:{width + 8}}  {_percent(one.known):>17}  {_percent(one.worn):>10}  "
            f"{_percent(one.grown, '+'):>20}  {_percent(one.stays):>10}"
        )
    for name, wear in zip(names[1:], found.wear, strict=True):
        print_moved(wear.comparison, f"{name} against {names[0]}")
    if not found.places:
        typer.echo("no worn place")
    for number, place in enumerate(found.places[:PLACES_TOLD], start=1):
        shares = ", ".join(_percent(share, digits=2) for share in place.share)
        typer.echo(
            f"place {number} at longitude {place.longitude_deg:.0f}°, latitude {place.latitude_deg:.0f}°: "
            f"{shares} of the ball"
        )
    if len(found.places) > PLACES_TOLD:
        typer.echo(f"and {len(found.places) - PLACES_TOLD} smaller places")


def _short(maps: list[Path]) -> list[str]:
    """Return names that tell the maps apart."""
    stems = [path.stem for path in maps]
    return stems if len(set(stems)) == len(stems) else [str(path) for path in maps]


def _percent(share: float, sign: str = "", digits: int = 1) -> str:
    return f"{100 * share:{sign}.{digits}f} %" if math.isfinite(share) else "-"


def _series_numbers(found: WearSeries, names: list[str]) -> dict[str, object]:
    """Return the figures of a series; what could not be measured is null."""
    rows = [
        {
            "map": name,
            "known_share": _or_none(one.known),
            "worn_share": _or_none(one.worn),
            "grown_share": _or_none(one.grown),
            "stays_share": _or_none(one.stays),
            "scatter": _or_none(wear.scatter),
            **_moved(wear.comparison),
            "R_map_first": wear.comparison.R_other_reference.tolist(),
        }
        for name, one, wear in zip(names[1:], found.growth, found.wear, strict=True)
    ]
    places = [
        {
            "longitude_deg": place.longitude_deg,
            "latitude_deg": place.latitude_deg,
            "worn_share_of_ball": [_or_none(share) for share in place.share],
        }
        for place in found.places
    ]
    return {"first": names[0], "maps": rows, "places": places}


def print_moved(comparison: MapComparison, against: str) -> None:
    """Say how far paint lies from where the other map has it."""
    count = len(comparison.length_rad)
    if not count:
        typer.echo(f"{against}: no patch could be located")
        return
    rms, most = math.degrees(comparison.rms_rad), math.degrees(comparison.max_rad)
    typer.echo(f"{against}: paint lies {rms:.2f}° off (rms of {count} patches), {most:.2f}° at most")


def _moved(comparison: MapComparison) -> dict[str, object]:
    """Return the figures of a displacement."""
    return {
        "patches": len(comparison.length_rad),
        "moved_rms_deg": _or_none(math.degrees(comparison.rms_rad)),
        "moved_max_deg": _or_none(math.degrees(comparison.max_rad)),
        "correlation": comparison.correlation,
    }


def _numbers(comparison: MapComparison, changed: float) -> dict[str, object]:
    """Return the figures of a comparison of two; what could not be measured is null."""
    return {
        **_moved(comparison),
        "changed_share": _or_none(changed),
        "R_new_old": comparison.R_other_reference.tolist(),
    }


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _known_map(path: Path) -> Tensor:
    """Read a map, NaN where the counts beside it say that it was never seen."""
    import torch

    from sphereorient.report.map_files import read_seen, seen_path
    from sphereorient.sphere import load_texture

    texture, seen = load_texture(path), read_seen(seen_path(path))
    if seen is None or seen.shape != texture.shape:
        return texture
    return torch.where(seen > 0, texture, torch.nan)
