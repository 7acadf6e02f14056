"""How all figures of a report look: colours, lines, sizes, and how they are written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar

import matplotlib
import matplotlib.style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sphereorient.files.outputs import put_aside
from sphereorient.report.figure import AXIS_COLOURS

P = ParamSpec("P")
R = TypeVar("R")

WIDTH_IN = 7.0  # of a page with margins: 178 mm
DPI = 150  # of the PNG
BLACK = "#000000"
GREY = "#666666"
SHADE = "#BBBBBB"  # of what does not count
SETTINGS: Final[dict[str, Any]] = {
    "font.family": ["sans-serif"],
    "font.sans-serif": ["DejaVu Sans"],  # comes with matplotlib: the same letters everywhere
    "font.size": 8,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.linewidth": 0.5,
    "grid.alpha": 0.4,
    "hatch.linewidth": 0.6,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.title_fontsize": 7,
    "legend.frameon": False,
    "legend.handlelength": 2.6,  # inches enough to tell the dashes apart
    "lines.linewidth": 1.1,
    "lines.markersize": 3.2,
    "pdf.fonttype": 42,  # letters are embedded whole: they can be searched and edited
}


@dataclass(frozen=True, kw_only=True)
class Look:
    """How one component is drawn; told apart by colour, and in grey print by line, marker and hatch."""

    name: str
    colour: str
    line: Any  # matplotlib's line style
    marker: str
    width: float = 1.1  # of lines, points
    hatch: str = ""

    @property
    def drawn(self) -> dict[str, Any]:
        """Colour, style and width as `Axes.plot` takes them."""
        return {"color": self.colour, "linestyle": self.line, "linewidth": self.width}


X = Look(name="x", colour=AXIS_COLOURS[0], line="-", marker="o", hatch="")
Y = Look(name="y", colour=AXIS_COLOURS[1], line=(0, (6, 1.5)), marker="s", hatch="////")
Z = Look(name="z", colour=AXIS_COLOURS[2], line=(0, (6, 1.5, 1.2, 1.5)), marker="^", hatch="....")
ALL = Look(name="all", colour=BLACK, line="-", marker="D", width=1.7)
SECOND = Look(name="second", colour=BLACK, line=(0, (3, 2)), marker="x")  # a law, or what is compared with
COMPONENTS = (X, Y, Z)


def in_style(draw: Callable[P, R]) -> Callable[P, R]:
    """Run a function in the style of the reports, whatever the user's own matplotlibrc says."""

    @wraps(draw)
    def styled(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.style.context(["default", SETTINGS]):
            return draw(*args, **kwargs)

    return styled


def new_figure(width_in: float = WIDTH_IN, height_in: float = 3.0) -> Figure:
    """Return an empty figure whose parts make room for each other.

    Args:
        width_in: of the figure, inches.
        height_in: of the figure, inches.
    """
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


@in_style
def write_figure(figure: Figure, stem: Path) -> tuple[Path, Path]:
    """Write a figure as PNG for pages and as PDF for print; the same figure gives the same bytes.

    Args:
        figure: of one of the functions of `plots`.
        stem: the files' path without the suffix; the folder must exist.

    Returns:
        stem.png and stem.pdf.

    Raises:
        OutputError: a file cannot be written.
    """
    undated: dict[str, dict[str, Any]] = {".png": {"Software": None}, ".pdf": {"CreationDate": None}}
    paths = (stem.with_name(f"{stem.name}.png"), stem.with_name(f"{stem.name}.pdf"))
    for path in paths:
        with put_aside(path) as aside:
            figure.savefig(aside, dpi=DPI, metadata=undated[path.suffix])
    return paths
