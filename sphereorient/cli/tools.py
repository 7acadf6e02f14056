"""`sphereorient spin`: spin of a ball from photographs; `texture`: design of a texture map."""

import json
import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from sphereorient.cli.app import (
    Commands,
    app,
    check_writable,
    command_line,
    echo_lines,
    new_table,
    print_table,
    progress_bar,
)
from sphereorient.cli.options import Quiet, names_in
from sphereorient.errors import TextureError, refusal
from sphereorient.files.provenance import without_nan
from sphereorient.files.whole_file import check_ending, make_folder, write_text

if TYPE_CHECKING:
    from torch import Tensor

    from sphereorient.tools.design.judge import Judgement
    from sphereorient.tools.spin.disks import Photographs
    from sphereorient.tools.spin.spin import SpinEstimate

SPREAD = ("min", "median", "max")
HEIGHT_MAX = 1024  # rows of a judged map; no picture resolves more


@dataclass(frozen=True, kw_only=True)
class _SpinOptions:
    photographs: Annotated[list[Path], Argument(metavar="PHOTOGRAPHS...", help="Pictures of a flight, or a folder.")]
    times: Annotated[str, Option(help="Table .csv with file,t_s; or pictures per second, e.g. 400.")]
    texture: Annotated[Path, Option(help="Table of dots .csv (x,y,z a line), or a texture map .png.")]
    out: Annotated[Path, Option("--out", "-o", help="Result to write, .json; a figure .png goes beside it.")]
    dot_radius: Annotated[float | None, Option(help="Radius of the dots on the ball, degrees; else measured.")] = None
    omega_max: Annotated[float, Option(min=1e-3, max=1e6, help="Fastest spin, rad/s.")] = 2 * math.pi * 300
    quiet: Quiet = False


@app.command()
def spin(given: _SpinOptions) -> None:
    """Measure angular velocity and orientations of a spinning ball from photographs (docs/photographs.md)."""
    check_ending(given.out, "--out", [".json"])
    check_writable(given.out)
    check_writable(given.out.with_suffix(".png"))
    from sphereorient.report.plots.style import write_figure
    from sphereorient.tools.spin.disks import load_ball, load_photographs
    from sphereorient.tools.spin.dots import DotTable
    from sphereorient.tools.spin.spin import SpinSettings, spin_figure, spin_of

    ball = load_ball(given.texture, given.dot_radius)
    loaded, settings = load_photographs(given.photographs, given.times), SpinSettings(omega_max_rad_s=given.omega_max)
    with progress_bar(given.quiet, unit="photographs") as advance:
        found = spin_of(loaded, ball, settings, advance)
        if isinstance(ball, DotTable) and given.dot_radius is None:
            ball = ball.measured(found.disks, found.R_view_body)
            found = spin_of(loaded, ball, settings, lambda stage, *rest: advance(f"{stage}, dots measured", *rest))
    result = without_nan(_spin_document(found, loaded))
    if isinstance(ball, DotTable):
        result["dot_radius_deg"] = ball.radius_deg
    write_text(given.out, json.dumps(result, indent=2) + "\n")
    drawn = ball.texture() if isinstance(ball, DotTable) else ball
    names = [Path(name).stem for name in loaded.names]
    write_figure(spin_figure(found, drawn, loaded.time_s, names), given.out.with_suffix(".png"))
    if not given.quiet:
        _print_spin(result)
        typer.echo(f"Wrote {given.out}, {given.out.with_suffix('.png')}")


def _spin_document(found: "SpinEstimate", photographs: "Photographs") -> dict[str, Any]:
    spins, sigma = found.spins, found.spins.rate_sigma()
    rate = spins.omega_view_rad_s.norm(dim=-1)
    return {
        "command": command_line(),
        "frame": "view: x right, y down, z from the camera to the ball",
        "spins": [
            {
                "omega_view_rad_s": spins.omega_view_rad_s[k].tolist(),
                "omega_covariance": spins.covariance[k, 3:, 3:].tolist(),
                "rate_rad_s": float(rate[k]),
                "rate_sigma_rad_s": float(sigma[k]),
                "R0_view_body": spins.R0_view_body[k].tolist(),
                "time0_s": float(spins.time0_s[k]),
                "evidence": float(spins.evidence[k]),
                "distinguished": k >= found.ambiguous,
            }
            for k in range(len(spins))
        ],
        "ambiguous": found.ambiguous,
        "mirrored_evidence": found.mirrored_evidence,
        "photographs": [
            {
                "file": name,
                "time_s": float(photographs.time_s[k]),
                "R_view_body": found.R_view_body[k].tolist(),
                "residual_deg": math.degrees(residual),
                "score": float(found.score[k]),
                "evidence": float(found.evidence[0, k]),
            }
            for k, (name, residual) in enumerate(zip(photographs.names, found.residual_rad.tolist(), strict=True))
        ],
    }


def _print_spin(result: dict[str, Any]) -> None:
    for k, one in enumerate(result["spins"]):
        omega = ", ".join(f"{each:.1f}" for each in one["omega_view_rad_s"])
        rate, sigma = one["rate_rad_s"], one["rate_sigma_rad_s"]
        ambiguous = result["ambiguous"] > 1 and not one["distinguished"]
        words = "; alias that the times do not exclude" if ambiguous and k else "" if not k else "; less likely"
        typer.echo(
            f"omega ({omega}) rad/s, |omega| {rate:.1f} +- {sigma:.1f} rad/s = {rate / (2 * math.pi):.2f} revolutions/s"
            f", evidence {one['evidence']:.0f}{words}"
        )
    followed = [one["residual_deg"] for one in result["photographs"] if one["residual_deg"] is not None]
    typer.echo(
        f"photographs: {len(followed)} of {len(result['photographs'])} follow the spin, "
        f"off by {sum(followed) / max(len(followed), 1):.1f}° on average"
    )
    typer.echo(f"mirrored texture: evidence {result['mirrored_evidence']:.0f}")
    if "dot_radius_deg" in result:
        typer.echo(f"dots: radius {result['dot_radius_deg']:.1f}°")


texture_app = Commands(help="Judge, make and print a texture map (docs/paint-design.md).", no_args_is_help=True)
app.add_typer(texture_app, name="texture")


@texture_app.callback()
def texture() -> None:
    """Judge, make and print a texture map (docs/paint-design.md)."""


@dataclass(frozen=True, kw_only=True)
class _DesignOptions:
    map_: Annotated[Path | None, Argument(metavar="[MAP.png]", help="Map to judge; else --make makes one.")] = None
    out: Annotated[Path, Option("--out", "-o", help="Folder of judgement, map and strips.")] = Path("design")
    make: Annotated[bool, Option("--make", help="Search for a map that is easy to paint and hard to confuse.")] = False
    kinds: Annotated[str, Option(help="With --make: kinds of texture to try.")] = "blobs,patches,dots"
    stroke: Annotated[float, Option(min=2, max=40, help="With --make: least width of the brush, degrees.")] = 10.0
    tries: Annotated[int, Option(min=1, max=1000, help="With --make: maps of each kind.")] = 24
    seed: Annotated[int, Option(help="With --make: the same seed gives the same map.")] = 0
    diameter_px: Annotated[float, Option(min=12, max=400, help="Diameter of the ball's picture, px.")] = 80.0
    noise: Annotated[float, Option(min=0.001, max=1, help="Noise of a pixel, as a share of black to white.")] = 0.05
    views: Annotated[int, Option(min=12, max=2000, help="Number of views to judge.")] = 96
    gores: Annotated[int | None, Option(help="Number of strips to print, e.g. 12; needs --diameter-mm.")] = None
    diameter_mm: Annotated[float | None, Option(help="Diameter of the ball, mm.")] = None
    as_json: Annotated[bool, Option("--json", help="Print the judgement as JSON.")] = False
    quiet: Annotated[bool, Option("--quiet", "-q", help="No progress, no table.")] = False


@texture_app.command()
def design(given: _DesignOptions) -> None:
    """Judge a map before it is painted, or make one; print it on strips that wrap the ball."""
    _check_design(given)
    check_writable(given.out, folder_made=True)
    from sphereorient.sphere import load_texture, reduced_texture
    from sphereorient.tools.design.gores import Gores, write_gores
    from sphereorient.tools.design.judge import DesignSettings, design_texture, judge_texture

    strips = None
    if given.gores is not None and given.diameter_mm is not None:
        strips = Gores(count=given.gores, diameter_mm=given.diameter_mm)
    settings = DesignSettings(diameter_px=given.diameter_px, noise_share=given.noise, views=given.views)
    if given.map_ is not None:
        title, drawn = given.map_.name, load_texture(given.map_)
        if len(drawn) > HEIGHT_MAX:
            drawn = reduced_texture(drawn, 2 * HEIGHT_MAX / math.pi)
        judgement = judge_texture(drawn, settings)
    else:
        with progress_bar(given.quiet or given.as_json, unit="maps") as advance:
            advancing, kinds = partial(advance, "search"), names_in(given.kinds)
            drawn, judgement, title = design_texture(
                kinds, given.stroke, settings, tries=given.tries, seed=given.seed, advance=advancing
            )
    files = _written(given.out, drawn, judgement, title, make=given.map_ is None)
    if strips is not None:
        files += write_gores(drawn, strips, given.out)
    if given.as_json:
        typer.echo(json.dumps({"map": title, **judgement.as_dict()}))
    elif not given.quiet:
        _print_judgement(judgement, title)
        typer.echo("Wrote " + ", ".join(str(file) for file in files))


def _check_design(given: _DesignOptions) -> None:
    if given.make == (given.map_ is not None):
        got, do = ("both", "leave one out") if given.make else ("neither", "name a map, or add --make")
        raise TextureError(refusal("texture design", expected="a map to judge or --make", got=got, do=do))
    if (given.gores is None) != (given.diameter_mm is None):
        got = "--gores alone" if given.diameter_mm is None else "--diameter-mm alone"
        raise TextureError(refusal("strips", expected="--gores and --diameter-mm", got=got, do="give both"))
    if not all(map(math.isfinite, (given.stroke, given.diameter_px, given.noise, given.diameter_mm or 0.0))):
        do = "correct the option"
        raise TextureError(refusal("texture design", expected="numbers", got="nan or infinity", do=do))


def _written(out: Path, drawn: "Tensor", judgement: "Judgement", title: str, *, make: bool) -> list[Path]:
    from sphereorient.report.plots.style import write_figure
    from sphereorient.report.texture_map import write_texture
    from sphereorient.tools.design.judge import design_figure

    make_folder(out, f"--out {out}")
    files = [out / "judgement.json", out / "design.png"]
    about = {"map": title, "command": command_line(), **judgement.as_dict()}
    write_text(files[0], json.dumps(about, indent=2) + "\n")
    write_figure(design_figure(drawn, judgement, title), files[1])
    if make:
        files.append(out / "texture.png")
        write_texture(drawn, files[-1])
    return files


def _print_judgement(judgement: "Judgement", title: str) -> None:
    measures = judgement.as_dict()
    table = new_table(title, "least", "middle", "most", title="judgement", title_justify="left")
    white, bound = measures["white_share"], measures["bound_deg"]
    table.add_row("white in a view, %", *(_number(white[name], 100, 0) for name in SPREAD))
    table.add_row("best possible error of a view, degrees", *(_number(bound[name], 1, 3) for name in SPREAD))
    print_table(table)
    settings = judgement.settings
    lines = [
        f"(ball of {settings.diameter_px:g} px, noise {100 * settings.noise_share:g} % of black to white, "
        f"{settings.views} views, position of the ball unknown)",
        f"worst view: {_place(measures['worst_view_lon_lat_deg'])}; best: {_place(measures['best_view_lon_lat_deg'])}",
        f"most similar views, {measures['most_alike_apart_deg']:.0f} degrees apart: similarity {judgement.alike:.2f}, "
        f"margin {judgement.margin:.2f}: {' and '.join(_place(each) for each in measures['most_alike_lon_lat_deg'])}",
        f"widest brush that paints it: {judgement.stroke_deg:.0f} degrees; borders {judgement.border:.1f} radii long",
    ]
    echo_lines(lines)


def _number(value: float | None, times: float, digits: int) -> str:
    return "undetermined" if value is None else f"{times * value:.{digits}f}"


def _place(lon_lat_deg: list[float]) -> str:
    return f"longitude {lon_lat_deg[0]:.0f}, latitude {lon_lat_deg[1]:.0f}"
