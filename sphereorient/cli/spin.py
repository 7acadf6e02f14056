"""`sphereorient spin`: the spin of a ball from photographs."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sphereorient.cli.app import app, check_writable, progress_bar
from sphereorient.errors import OutputError, refusal

if TYPE_CHECKING:
    from sphereorient.tools.spin.disks import Photographs
    from sphereorient.tools.spin.spin import SpinFound


@app.command()
def spin(
    photographs: Annotated[
        list[Path], typer.Argument(metavar="PHOTOGRAPHS...", help="Pictures of one flight, or a folder of them.")
    ],
    times: Annotated[
        str, typer.Option(help="Table .csv with file,t_s; or pictures a second, e.g. 400, at equal intervals.")
    ],
    texture: Annotated[Path, typer.Option(help="Table of dots .csv (x,y,z a line), or a texture map .png.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Result to write, .json; a figure .png goes beside it.")],
    dot_radius: Annotated[
        float | None, typer.Option(help="Radius of the dots, degrees on the ball; else it is measured in the pictures.")
    ] = None,
    omega_max: Annotated[float, typer.Option(min=1e-3, help="Fastest spin, rad/s.")] = 2 * math.pi * 300,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False,
) -> None:
    """Measure angular velocity and attitudes of a spinning ball from photographs (docs/photographs.md)."""
    if out.suffix.lower() != ".json":
        do = "choose a name such as spin.json"
        raise OutputError(refusal(f"--out {out}", expected=".json", got=out.suffix or "no ending", do=do))
    check_writable(out)
    from sphereorient.files.outputs import put_aside
    from sphereorient.report.plots.style import write_figure
    from sphereorient.tools.spin.disks import load_ball, load_photographs
    from sphereorient.tools.spin.dots import DotTable
    from sphereorient.tools.spin.spin import SpinSettings, spin_figure, spin_of

    ball = load_ball(texture, dot_radius)
    loaded, settings = load_photographs(photographs, times), SpinSettings(omega_max_rad_s=omega_max)
    with progress_bar(quiet, unit="photographs") as advance:
        found = spin_of(loaded, ball, settings, advance)
        if isinstance(ball, DotTable) and dot_radius is None:
            ball = ball.measured(found.disks, found.R_view_body)
            found = spin_of(loaded, ball, settings, lambda stage, *rest: advance(f"{stage}, dots measured", *rest))
    result = _numbers(found, loaded)
    if isinstance(ball, DotTable):
        result["dot_radius_deg"] = ball.radius_deg
    with put_aside(out) as aside:
        aside.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    drawn = ball.texture() if isinstance(ball, DotTable) else ball
    names = [Path(name).stem for name in loaded.names]
    write_figure(spin_figure(found, drawn, loaded.time_s, names), out.with_suffix(".png"))
    if not quiet:
        _print(result)
        typer.echo(f"Wrote {out}, {out.with_suffix('.png')}")


def _numbers(found: SpinFound, photographs: Photographs) -> dict[str, Any]:
    """Return the result for JSON; null: not measured."""
    spins, sigma = found.spins, found.spins.rate_sigma()
    rate = spins.omega_view_rad_s.norm(dim=-1)
    return {
        "command": " ".join(["sphereorient", *sys.argv[1:]]),
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
                "residual_deg": math.degrees(residual) if math.isfinite(residual) else None,
                "score": float(found.score[k]),
                "evidence": float(found.evidence[0, k]),
            }
            for k, (name, residual) in enumerate(zip(photographs.names, found.residual_rad.tolist(), strict=True))
        ],
    }


def _print(result: dict[str, Any]) -> None:
    """Print each spin, and how well the photographs follow the first."""
    for k, one in enumerate(result["spins"]):
        omega = ", ".join(f"{each:.1f}" for each in one["omega_view_rad_s"])
        rate, sigma = one["rate_rad_s"], one["rate_sigma_rad_s"]
        ambiguous = result["ambiguous"] > 1 and not one["distinguished"]
        words = "; alias that the times do not exclude" if ambiguous and k else "" if not k else "; less likely"
        typer.echo(
            f"omega ({omega}) rad/s, |omega| {rate:.1f} +- {sigma:.1f} rad/s = {rate / (2 * math.pi):.2f} turns/s, "
            f"evidence {one['evidence']:.0f}{words}"
        )
    followed = [one["residual_deg"] for one in result["photographs"] if one["residual_deg"] is not None]
    typer.echo(
        f"photographs: {len(followed)} of {len(result['photographs'])} follow the spin, "
        f"off by {sum(followed) / max(len(followed), 1):.1f}° on average"
    )
    typer.echo(f"mirrored texture: evidence {result['mirrored_evidence']:.0f}")
    if "dot_radius_deg" in result:
        typer.echo(f"dots: radius {result['dot_radius_deg']:.1f}°")
