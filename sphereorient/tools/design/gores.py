"""Gores: a texture map as strips from pole to pole (sinusoidal projection) that wrap a ball, printed at true size.
Sheet: x right, y up, mm, first strip at longitude -180 degrees; north up and east right, seen from outside.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.errors import PaintError, refusal
from sphereorient.files.whole_file import put_aside, write_text
from sphereorient.report.plots.style import in_style
from sphereorient.sphere import sample_texture

GORES = (4, 48)
DIAMETERS_MM = (2.0, 500.0)
STEP_MM = 0.1  # largest step of the lattice for borders
STEP_RAD = math.radians(0.5)  # likewise on the ball
MM = 1 / 25.4  # inches
MARGIN_MM = 12.0  # of the sheet, for the printer and the scale line
RULE_MM = (10.0, 50.0)  # lengths of the scale line, for small and large balls
CUT = "#C000C0"
FOLD: dict[str, Any] = {"color": "#00A0A0", "linewidth": 0.3, "linestyle": (0, (6, 4))}


@dataclass(frozen=True, kw_only=True)
class Gores:
    """Strips for a ball; raises PaintError if their number or the diameter is out of range."""

    count: int
    diameter_mm: float

    def __post_init__(self) -> None:
        checked = ("gores", self.count, GORES, ""), ("diameter", self.diameter_mm, DIAMETERS_MM, " mm")
        for name, value, (low, high), unit in checked:
            if not low <= value <= high:
                do = "choose strips that can be printed and cut"
                raise PaintError(refusal(name, expected=f"{low:g} .. {high:g}{unit}", got=f"{value:g}{unit}", do=do))

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width (the equator) and height (pole to pole) of the strips."""
        return math.pi * self.diameter_mm, math.pi * self.diameter_mm / 2

    @property
    def sheet_mm(self) -> tuple[float, float]:
        """Width and height of the printed sheet."""
        width, height = self.size_mm
        return max(width, RULE_MM[0] + 70.0) + 2 * MARGIN_MM, height + 2 * MARGIN_MM

    def middles_rad(self) -> list[float]:
        """Return the longitudes of the strips' middles, rad, from west to east."""
        return [-math.pi + 2 * math.pi * (k + 0.5) / self.count for k in range(self.count)]

    def outline_mm(self, points: int = 181) -> list[NDArray[np.float64]]:
        """Return the closed cutting line of each strip, (2 points, 2), mm."""
        latitude = np.linspace(-math.pi / 2, math.pi / 2, points)
        half = math.pi / self.count * np.cos(latitude)
        loop = np.column_stack([[*half, *-half[::-1]], [*latitude, *latitude[::-1]]])
        return [0.5 * self.diameter_mm * (loop + np.array([middle, 0.0])) for middle in self.middles_rad()]


def _gore_texture(gores: Gores, texture: Tensor, strip: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return x (columns), y (rows), mm, and texture (rows, columns) of one strip, continued beyond its outline."""
    radius, middle_rad = 0.5 * gores.diameter_mm, gores.middles_rad()[strip]
    step = min(STEP_MM, radius * STEP_RAD)
    height, half = gores.size_mm[1], math.pi * radius / gores.count
    x = torch.linspace(-half, half, math.ceil(2 * half / step) + 1, dtype=torch.float64)
    y = torch.linspace(-height / 2, height / 2, math.ceil(height / step) + 1, dtype=torch.float64)
    latitude = (y / radius)[:, None]
    level = latitude.cos()
    longitude = middle_rad + x / radius / level.clamp_min(1e-3)
    up = latitude.sin().expand_as(longitude)
    direction = torch.stack([level * longitude.cos(), level * longitude.sin(), up], dim=-1)
    return radius * middle_rad + x, y, sample_texture(texture.double(), direction)


@in_style
def gores_figure(texture: Tensor, gores: Gores, *, filled: bool) -> Figure:
    """Draw the strips at true size; not `filled`: only the borders of the colours, to cut out or trace."""
    (width, height), (equator, meridian) = gores.sheet_mm, gores.size_mm
    figure = Figure(figsize=(width * MM, height * MM))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(-width / 2, width / 2), ylim=(-height / 2, height / 2))
    axes.set_axis_off()
    for strip, (outline, middle_rad) in enumerate(zip(gores.outline_mm(), gores.middles_rad(), strict=True)):
        x, y, grey = _gore_texture(gores, texture, strip)
        if filled:
            drawn = axes.contourf(x, y, grey, levels=[-1.0, 0.5], colors=["black"])
        else:
            drawn = axes.contour(x, y, grey, levels=[0.5], colors=["black"], linewidths=0.5)
        drawn.set_clip_path(matplotlib.path.Path(outline), axes.transData)
        axes.plot(*outline.T, color=CUT, linewidth=0.3)
        middle = 0.5 * gores.diameter_mm * middle_rad
        axes.plot([middle, middle], [-meridian / 2, meridian / 2], **FOLD)
    axes.plot([-equator / 2, equator / 2], [0, 0], **FOLD)
    length = RULE_MM[1] if equator >= RULE_MM[1] else RULE_MM[0]
    start, level = -width / 2 + MARGIN_MM, -meridian / 2 - 0.4 * MARGIN_MM
    axes.plot([start, start + length], [level, level], color="black", linewidth=0.8, gid="rule")
    for end in (start, start + length):
        axes.plot([end, end], [level - 1.2, level + 1.2], color="black", linewidth=0.8)
    text = f"{length:g} mm: measure it. Ball {gores.diameter_mm:g} mm, {gores.count} strips, print at 100 %"
    axes.text(start, level - 2.0, text, fontsize=6, va="top", ha="left")
    return figure


def write_gores(texture: Tensor, gores: Gores, folder: Path) -> list[Path]:
    """Write strips and stencil as PDF and SVG of true size, and instructions; return the files or raise OutputError."""
    written = []
    for name, filled in (("gores", True), ("stencil", False)):
        for suffix, when in ((".pdf", "CreationDate"), (".svg", "Date")):
            path = folder / f"{name}{suffix}"
            figure = gores_figure(texture, gores, filled=filled)
            with put_aside(path) as aside, matplotlib.rc_context({"svg.hashsalt": "sphereorient"}):
                figure.savefig(aside, metadata={when: None})
            written.append(path)
    path = folder / "gores.txt"
    write_text(path, instructions(gores))
    return [*written, path]


def instructions(gores: Gores) -> str:
    """Return the text page for the strips, from the template gores.txt."""
    (width, height), sheet = gores.size_mm, gores.sheet_mm
    slope = math.pi / gores.count * math.sin(math.pi / 4)  # of a strip's edge to its centre line, at latitude 45
    sizes = {"width": width, "height": height, "sheet_width": sheet[0], "sheet_height": sheet[1]}
    errors = {"stretch": 100 * (math.hypot(1, slope) - 1), "turn": math.degrees(math.atan(slope))}
    text = Path(__file__).with_name("gores.txt").read_text(encoding="utf-8")
    return text.format(**vars(gores), **sizes, **errors)
