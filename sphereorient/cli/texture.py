"""`sphereorient texture`: design of a ball's texture."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import app, check_writable, command_line, echo_lines, progress_bar
from sphereorient.cli.options import names_in
from sphereorient.errors import OutputError, TextureError, refusal

if TYPE_CHECKING:
    from torch import Tensor

    from sphereorient.tools.design.judge import Judgement

SPREAD = ("min", "median", "max")
HEIGHT_MAX = 1024  # of a map that is judged: finer than any picture shows

texture_app = typer.Typer(help="Judge, make and print a texture map (docs/paint-design.md).", no_args_is_help=True)
app.add_typer(texture_app, name="texture")


@texture_app.callback()
def texture() -> None:
    """Judge, make and print a texture map (docs/paint-design.md)."""


@texture_app.command()
def design(
    map_: Annotated[
        Path | None, typer.Argument(metavar="[MAP.png]", help="Map to judge; without it --make makes one.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for judgement, picture, map and strips.")] = Path(
        "design"
    ),
    make: Annotated[
        bool, typer.Option("--make", help="Search for a map that is easy to paint and hard to confuse.")
    ] = False,
    kinds: Annotated[str, typer.Option(help="With --make: kinds of texture to try.")] = "blobs,patches,dots",
    stroke: Annotated[
        float, typer.Option(min=2, max=40, help="With --make: least width of the brush, degrees on the ball.")
    ] = 10.0,
    tries: Annotated[int, typer.Option(min=1, max=1000, help="With --make: maps of each kind.")] = 24,
    seed: Annotated[int, typer.Option(help="With --make: the same seed gives the same map.")] = 0,
    diameter_px: Annotated[float, typer.Option(min=12, max=400, help="Diameter of the ball's picture, px.")] = 80.0,
    noise: Annotated[
        float, typer.Option(min=0.001, max=1, help="Noise of a pixel over the step from black to white.")
    ] = 0.05,
    views: Annotated[int, typer.Option(min=12, max=2000, help="Views that are judged.")] = 96,
    gores: Annotated[int | None, typer.Option(help="Print so many strips, e.g. 12; needs --diameter-mm.")] = None,
    diameter_mm: Annotated[float | None, typer.Option(help="Diameter of the ball, mm.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the judgement as JSON.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no table.")] = False,
) -> None:
    """Judge a map before it is painted, or make one; print it on strips that wrap the ball."""
    _check(map_, make, gores, diameter_mm, stroke, diameter_px, noise, 0.0 if diameter_mm is None else diameter_mm)
    check_writable(out)
    from sphereorient.tools.design.gores import Gores, write_gores
    from sphereorient.tools.design.judge import DesignSettings, design_texture, judge_texture

    strips = Gores(count=gores, diameter_mm=diameter_mm) if gores is not None and diameter_mm is not None else None
    settings = DesignSettings(diameter_px=diameter_px, noise_share=noise, views=views)
    if map_ is not None:
        title, drawn = map_.name, _loaded(map_)
        judgement = judge_texture(drawn, settings)
    else:
        with progress_bar(quiet or as_json, unit="maps") as advance:
            drawn, judgement, title = design_texture(
                names_in(kinds), stroke, settings, tries=tries, seed=seed, advance=lambda *at: advance("search", *at)
            )
    files = _written(out, drawn, judgement, title, make=map_ is None)
    if strips is not None:
        files += write_gores(drawn, strips, out)
    if as_json:
        typer.echo(json.dumps({"map": title, **judgement.as_dict()}))
    elif not quiet:
        _print(judgement, title)
        typer.echo("Wrote " + ", ".join(str(file) for file in files))


def _check(map_: Path | None, make: bool, gores: int | None, diameter_mm: float | None, *numbers: float) -> None:
    """Refuse options that contradict each other, nan and infinity."""
    if make == (map_ is not None):
        got, do = ("both", "leave one of them away") if make else ("neither", "name a map, or say --make")
        raise TextureError(refusal("texture design", expected="a map to judge or --make", got=got, do=do))
    if (gores is None) != (diameter_mm is None):
        got = "--gores alone" if diameter_mm is None else "--diameter-mm alone"
        raise TextureError(refusal("strips", expected="--gores and --diameter-mm", got=got, do="give both"))
    if not all(math.isfinite(number) for number in numbers):
        do = "correct the option"
        raise TextureError(refusal("texture design", expected="numbers", got="nan or infinity", do=do))


def _loaded(path: Path) -> Tensor:
    """Read a map, averaged down where it is finer than any picture shows."""
    from sphereorient.sphere import load_texture, reduced_texture

    drawn = load_texture(path)
    height = drawn.shape[0]
    return drawn if height <= HEIGHT_MAX else reduced_texture(drawn, 2 * HEIGHT_MAX / math.pi)


def _written(out: Path, drawn: Tensor, judgement: Judgement, title: str, *, make: bool) -> list[Path]:
    """Write judgement and figure, and the map where it was made; return the files."""
    from sphereorient.files.outputs import put_aside
    from sphereorient.report.map_files import write_texture
    from sphereorient.report.plots.style import write_figure
    from sphereorient.tools.design.figure import design_figure

    try:
        out.mkdir(exist_ok=True)
    except OSError as error:
        do = "choose another --out"
        raise OutputError(refusal(f"--out {out}", expected="a folder", got=str(error.strerror), do=do)) from error
    files = [out / "judgement.json", out / "design.png"]
    with put_aside(files[0]) as aside:
        about = {"map": title, "command": command_line(), **judgement.as_dict()}
        aside.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    write_figure(design_figure(drawn, judgement, title), files[1])
    if make:
        files.append(out / "texture.png")
        write_texture(drawn, files[-1])
    return files


def _print(judgement: Judgement, title: str) -> None:
    """Print the judgement as a table."""
    from rich.console import Console
    from rich.table import Table

    told = judgement.as_dict()
    table = Table(title, "least", "middle", "most", title="judgement", title_justify="left")
    white, bound = told["white_share"], told["bound_deg"]
    table.add_row("white in a view, %", *(_number(white[name], 100, 0) for name in SPREAD))
    table.add_row("best possible error of a view, degrees", *(_number(bound[name], 1, 3) for name in SPREAD))
    Console().print(table)
    settings = judgement.settings
    lines = [
        f"(ball of {settings.diameter_px:g} px, noise {100 * settings.noise_share:g} % of black to white, "
        f"{settings.views} views, position of the ball unknown)",
        f"worst view: {_place(told['worst_view_lon_lat_deg'])}; best: {_place(told['best_view_lon_lat_deg'])}",
        f"most similar views, {told['most_alike_apart_deg']:.0f} degrees apart: similarity {judgement.alike:.2f}, "
        f"margin {judgement.margin:.2f}: {' and '.join(_place(each) for each in told['most_alike_lon_lat_deg'])}",
        f"widest brush that paints it: {judgement.stroke_deg:.0f} degrees; borders {judgement.border:.1f} radii long",
    ]
    echo_lines(lines)


def _number(value: float | None, times: float, digits: int) -> str:
    return "undetermined" if value is None else f"{times * value:.{digits}f}"


def _place(lon_lat_deg: list[float]) -> str:
    return f"longitude {lon_lat_deg[0]:.0f}, latitude {lon_lat_deg[1]:.0f}"
