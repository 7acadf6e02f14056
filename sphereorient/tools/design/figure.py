"""Figures of a painted map: what it is worth, and the strips to print."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from sphereorient.errors import OutputError, refusal
from sphereorient.files.outputs import put_aside
from sphereorient.report.plots.style import DPI, GREY, SHADE, WIDTH_IN, in_style, new_figure
from sphereorient.sphere import orthographic_view, reduced_texture
from sphereorient.tools.design.gores import Gores, painted_gore
from sphereorient.tools.design.judge import Judgement, lon_lat
from sphereorient.tools.design.paint import facing

MM = 1 / 25.4  # inches
MARGIN_MM = 12.0  # of the sheet, for the printer and the line below
RULE_MM = (10.0, 50.0)  # lengths of the line to check the scale by, for small and for large balls
SIDE_PX = 96  # of the drawn views
WORST = "#B42318"
BEST = "#1A7F37"
ALIKE = "#0072B2"
CUT, FOLD = "#C000C0", "#00A0A0"  # lines that are not paint


@in_style
def design_figure(texture: Tensor, judgement: Judgement, title: str) -> Figure:
    """Draw the map with the views that matter, their pictures, and what each view of the sphere can say.

    Args:
        texture: (H, 2 H), the map.
        judgement: of it.
        title: of the map.
    """
    figure = new_figure(WIDTH_IN, 6.2)
    rows = np.ravel(figure.subfigures(3, 1, height_ratios=[1.25, 0.75, 1.0], squeeze=False))
    _map_part(rows[0].subplots(), texture, judgement, title)
    _views_part(rows[1], texture, judgement)
    left, right = rows[2].subplots(1, 2, width_ratios=[1.6, 1.0])
    _information_part(left, judgement)
    _balance_part(right, judgement)
    return figure


def write_design(figure: Figure, path: Path) -> None:
    """Write the figure of a design as PNG.

    Raises:
        OutputError: it cannot be written.
    """
    with put_aside(path) as aside:
        figure.savefig(aside, dpi=DPI, metadata={"Software": None})


def write_gores(texture: Tensor, gores: Gores, folder: Path) -> list[Path]:
    """Write the strips, painted and as outlines of the paint alone, as PDF and SVG of true size, and how to use them.

    Returns:
        The files.

    Raises:
        OutputError: they cannot be written.
    """
    written = []
    for name, filled in (("gores", True), ("stencil", False)):
        for suffix in (".pdf", ".svg"):
            path = folder / f"{name}{suffix}"
            figure = gores_figure(texture, gores, filled=filled)
            with put_aside(path) as aside, matplotlib.rc_context({"svg.hashsalt": "sphereorient"}):
                when = {"CreationDate": None} if suffix == ".pdf" else {"Date": None}
                figure.savefig(aside, metadata=when)
            written.append(path)
    path = folder / "gores.txt"
    try:
        path.write_text(how_to_use(gores), encoding="utf-8")
    except OSError as error:
        do = "choose a folder that exists and may be written"
        raise OutputError(refusal(str(path), expected="a file that can be written", got=str(error), do=do)) from error
    return [*written, path]


@in_style
def gores_figure(texture: Tensor, gores: Gores, *, filled: bool) -> Figure:
    """Draw the strips at true size: cut along the solid lines, fold marks dashed.

    Args:
        texture: (H, 2 H), the map.
        gores: of the ball.
        filled: black paint as black areas; otherwise only the borders of the paint, to be cut out or traced.
    """
    width, height = sheet_mm(gores)
    figure = Figure(figsize=(width * MM, height * MM))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    low = -(height - gores.size_mm[1]) / 2
    axes.set(xlim=(-width / 2, width / 2), ylim=(low - gores.size_mm[1] / 2, low - gores.size_mm[1] / 2 + height))
    for strip, outline in enumerate(gores.outline_mm()):
        x, y, paint = painted_gore(gores, texture, strip)
        fence = matplotlib.path.Path(outline)
        if filled:
            drawn = axes.contourf(x, y, paint, levels=[-1.0, 0.5], colors=["black"])
        else:
            drawn = axes.contour(x, y, paint, levels=[0.5], colors=["black"], linewidths=0.5)
        drawn.set_clip_path(fence, axes.transData)
        axes.plot(*outline.T, color=CUT, linewidth=0.3)
        middle = 0.5 * gores.diameter_mm * gores.middles_rad()[strip]
        axes.plot([middle, middle], [-gores.size_mm[1] / 2, gores.size_mm[1] / 2], **_fold())
    axes.plot([-gores.size_mm[0] / 2, gores.size_mm[0] / 2], [0, 0], **_fold())
    _rule(axes, gores)
    return figure


def sheet_mm(gores: Gores) -> tuple[float, float]:
    """Width and height of the printed sheet, mm."""
    width, height = gores.size_mm
    return max(width, RULE_MM[0] + 70.0) + 2 * MARGIN_MM, height + 2 * MARGIN_MM


def how_to_use(gores: Gores) -> str:
    """Return the page of text that comes with the strips."""
    width, height = gores.size_mm
    sheet = sheet_mm(gores)
    return f"""\
{gores.count} strips for a ball of {gores.diameter_mm:g} mm

gores.pdf, gores.svg      the paint: black is black paint, the rest is white
stencil.pdf, stencil.svg  the borders of the paint only, to be traced or cut out

1. Print at 100 % ("actual size"; no "fit to page"). The sheet is {sheet[0]:.0f} x {sheet[1]:.0f} mm; where that is
   larger than your paper, let the printer spread it over several pages ("poster") or take another shop.
2. Measure the line at the bottom. If it is not as long as it says, the scale is wrong, and so would be all angles.
   The equator (the dashed line across) must be {width:.1f} mm long and a strip {height:.1f} mm high: around the ball
   once, and from pole to pole.
3. Cut along the solid coloured lines. Leave the strips joined at the equator: they touch there, and the chain goes
   around the ball. The two ends of the chain meet at longitude 180 degrees.
4. Draw an equator on the ball (a ring that it just falls through helps) and two poles. Lay the chain's dashed line on
   the equator, printed side out, and bring the tips to the poles. Dashed lines down the strips are meridians: fold
   them slightly, so that the strips follow the ball.
5. As a stencil: print stencil.pdf on adhesive foil, cut the black areas out, lay it on the white ball as above and
   paint through it. To trace: carbon paper below, a pen along the borders.
6. Each strip has true lengths along its middle and along all parallels; at its edges, half-way to the pole, a length
   is off by up to {_edge_share(gores):.1f} % and a direction by up to {_edge_deg(gores):.1f} degrees.

The map that the measurement needs is the one that is on the ball, not the one that was meant: compare both, or learn
it from a movie.
"""


def _edge_share(gores: Gores) -> float:
    """By how many per cent a meridian is longer at a strip's edge than in its middle, at latitude 45 degrees."""
    slope = math.pi / gores.count * math.sin(math.pi / 4)
    return 100 * (math.hypot(1, slope) - 1)


def _edge_deg(gores: Gores) -> float:
    """By how much a meridian's direction is off there."""
    return math.degrees(math.atan(math.pi / gores.count * math.sin(math.pi / 4)))


def _fold() -> dict[str, Any]:
    return {"color": FOLD, "linewidth": 0.3, "linestyle": (0, (6, 4))}


def _rule(axes: Axes, gores: Gores) -> None:
    """A line of known length below the strips, with what is printed."""
    width, height = gores.size_mm
    length = RULE_MM[1] if width >= RULE_MM[1] else RULE_MM[0]
    start, level = -sheet_mm(gores)[0] / 2 + MARGIN_MM, -height / 2 - 0.4 * MARGIN_MM
    axes.plot([start, start + length], [level, level], color="black", linewidth=0.8, gid="rule")
    for end in (start, start + length):
        axes.plot([end, end], [level - 1.2, level + 1.2], color="black", linewidth=0.8)
    text = f"{length:g} mm: measure it. Ball {gores.diameter_mm:g} mm, {gores.count} strips, print at 100 %"
    axes.text(start, level - 2.0, text, fontsize=6, va="top", ha="left")


def _map_part(axes: Axes, texture: Tensor, judgement: Judgement, title: str) -> None:
    axes.imshow(texture.numpy(), cmap="gray", vmin=0, vmax=1, extent=(-180, 180, -90, 90), interpolation="nearest")
    axes.grid(visible=False)
    for label, direction, colour in _named_views(judgement):
        lon, lat = torch.rad2deg(lon_lat(direction)).tolist()
        axes.plot(lon, lat, "o", markersize=9, markerfacecolor="white", markeredgecolor=colour, markeredgewidth=1.4)
        axes.text(lon, lat, label[0], color=colour, fontsize=7, fontweight="bold", ha="center", va="center")
    axes.set(xticks=range(-180, 181, 60), yticks=range(-90, 91, 30), ylabel="latitude (degrees)")
    axes.set_xlabel("longitude (degrees)", labelpad=1)
    brush = f"brush up to {judgement.stroke_deg:.0f} degrees, borders {judgement.border:.0f} radii long"
    axes.set_title(f"{title}: {brush}", fontsize=8)


def _named_views(judgement: Judgement) -> list[tuple[str, Tensor, str]]:
    """Name, direction and colour of the views that are drawn."""
    at = judgement.direction_body
    return [
        ("W worst view", at[judgement.worst], WORST),
        ("B best view", at[judgement.best], BEST),
        ("1 most alike", -judgement.alike_views[0, 2], ALIKE),
        ("2 most alike", -judgement.alike_views[1, 2], ALIKE),
    ]


def _views_part(part: Any, texture: Tensor, judgement: Judgement) -> None:
    size = max(16, SIDE_PX)
    texture, view = reduced_texture(texture, size), orthographic_view(size)
    worst = judgement.bound_rad.argsort(descending=True)[:3]
    at = judgement.direction_body
    shown = [(("W", "", "")[n], facing(at[k]), judgement.bound_rad[k], WORST) for n, k in enumerate(worst.tolist())]
    shown.append(("B", facing(at[judgement.best]), judgement.bound_rad[judgement.best], BEST))
    drawn = [(f"{name + ': ' if name else ''}{_degrees(float(bound))}", R, colour) for name, R, bound, colour in shown]
    drawn += [(f"{n + 1}: alike {judgement.alike:.2f}", R, ALIKE) for n, R in enumerate(judgement.alike_views)]
    for axes, (text, R, colour) in zip(part.subplots(1, len(drawn)), drawn, strict=True):
        axes.imshow(
            view.render(texture, R.float(), math.nan).numpy(), cmap="gray", vmin=0, vmax=1, interpolation="nearest"
        )
        circle = matplotlib.patches.Circle(
            (size / 2 - 0.5, size / 2 - 0.5), size / 2, fill=False, color=SHADE, lw=0.6, clip_on=False
        )
        axes.add_patch(circle)
        axes.set_axis_off()
        axes.set_title(text, fontsize=7, color=colour)


def _degrees(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):.3f}°" if math.isfinite(angle_rad) else "open"


def _information_part(axes: Axes, judgement: Judgement) -> None:
    """The bound of every view, at its middle's place on the map."""
    place = torch.rad2deg(lon_lat(judgement.direction_body)).numpy()
    bound = np.rad2deg(judgement.bound_rad.numpy())
    fine = np.isfinite(bound)
    dots = axes.scatter(place[fine, 0], place[fine, 1], c=bound[fine], cmap="viridis_r", s=26, linewidths=0)
    axes.plot(place[~fine, 0], place[~fine, 1], "x", color=WORST)
    axes.set(xlim=(-180, 180), ylim=(-90, 90), xticks=range(-180, 181, 90), yticks=(-90, 0, 90))
    axes.set(xlabel="longitude of the view's middle (degrees)", ylabel="latitude")
    settings = judgement.settings
    text = (
        f"best possible error of one view, ball of {settings.diameter_px:g} px, noise {100 * settings.noise_share:g} %"
    )
    axes.set_title(text, fontsize=7.5)
    bar = axes.figure.colorbar(dots, ax=axes, pad=0.02)
    bar.set_label("degrees", fontsize=7)


def _balance_part(axes: Axes, judgement: Judgement) -> None:
    """How white the views are."""
    white = 100 * judgement.white.numpy()
    axes.hist(white, bins=list(range(0, 105, 5)), color=SHADE, edgecolor=GREY, linewidth=0.5)
    axes.axvline(float(np.median(white)), color="black", linewidth=1, linestyle="--")
    axes.set(xlim=(0, 100), xlabel="white in a view (%)", ylabel="views")
    axes.set_title(f"balance: {white.min():.0f} to {white.max():.0f} %", fontsize=7.5)
