"""The style of all figures: colours and lines, marks with intervals, legends, numbers as text, and the writer."""

import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from sphereorient.files.whole_file import put_aside
from sphereorient.statistics import Interval, Summary
from sphereorient.statistics.cameras import CameraDistance
from sphereorient.trajectory import Trajectory
from sphereorient.trajectory.trajectory import COLOURS

Floats = NDArray[np.float64]
Plan = tuple[str, str, str, Callable[[], Figure]]  # a figure of a report: name, title, caption, function
ByFile = Mapping[str, Trajectory]  # tracks by the name of their file
Reported = tuple[Summary, ByFile, Sequence[CameraDistance]]  # the input of a report

WIDTH_IN = 7.0  # of a page with margins: 178 mm
DPI = 150  # of the PNG
# Okabe and Ito's colours: distinct for colour-blind readers, and in grey print.
AXIS_COLOURS = COLOURS["x"], COLOURS["y"], COLOURS["z"]
BLACK = "#000000"
GREY = "#666666"
SHADE = "#BBBBBB"  # of unused frames
BAND = 0.2  # opacity
SYMBOLS = {
    "velocity": "v",
    "acceleration": "a",
    "omega_lab": "ω lab",
    "omega_body": "ω body",
    "alpha_lab": "α lab",
    "alpha_body": "α body",
}


@dataclass(frozen=True, kw_only=True)
class LineStyle:
    """Style of one component; components differ in colour and, for grey print, in line, marker and hatch."""

    name: str
    colour: str
    line: Any  # matplotlib's line style
    marker: str
    width: float = 1.1  # of lines, points
    hatch: str = ""

    @property
    def drawn(self) -> dict[str, Any]:
        """Colour, style and width as arguments of `Axes.plot`."""
        return {"color": self.colour, "linestyle": self.line, "linewidth": self.width}

    def handle(self, label: str, **more: Any) -> Line2D:
        """Return a legend entry in this style; `more` are arguments of `Line2D`."""
        return Line2D([], [], label=label, **(self.drawn | more))


X = LineStyle(name="x", colour=AXIS_COLOURS[0], line="-", marker="o")
Y = LineStyle(name="y", colour=AXIS_COLOURS[1], line=(0, (6, 1.5)), marker="s", hatch="////")
Z = LineStyle(name="z", colour=AXIS_COLOURS[2], line=(0, (6, 1.5, 1.2, 1.5)), marker="^", hatch="....")
ALL = LineStyle(name="all", colour=BLACK, line="-", marker="D", width=1.7)
BALLS = "#CC79A7", "#E69F00", "#56B4E9", "#8C6D31", "#7B4173"  # of the second ball and more; no hues of the axes
SECOND = LineStyle(name="second", colour=BLACK, line=(0, (3, 2)), marker="x")  # a law, or a reference
PLAIN = LineStyle(name="", colour=GREY, line="-", marker="o")  # of legends for all components
COMPONENTS = (X, Y, Z)


# Decorator of drawing functions: style of the reports, independent of the user's matplotlibrc.
in_style = matplotlib.style.context(["default", Path(__file__).with_name("report.mplstyle")])


def new_figure(width_in: float = WIDTH_IN, height_in: float = 3.0) -> Figure:
    """Return an empty figure with a constrained layout, inches."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def panel_grid(count: int, row_in: float, head_in: float, shared: bool = False) -> tuple[Figure, list[Axes]]:
    """Return a figure of `count` panels, at most two in a row, `row_in` inches high, with room for a head."""
    columns = min(2, count)
    rows = -(-count // columns)
    figure = new_figure(WIDTH_IN * columns / 2, head_in + row_in * rows)
    panels = np.ravel(figure.subplots(rows, columns, sharex=shared, sharey=shared, squeeze=False))
    for axes in panels[count:]:
        axes.remove()
    return figure, list(panels[:count])


@in_style
def write_figure(figure: Figure, path: Path, dpi: float = DPI) -> tuple[Path, ...]:
    """Write a figure, the same bytes for the same figure, and return the files.
    Without a suffix `path` gets PNG and PDF; its folder must exist. Raise OutputError if a file cannot be written.
    """
    undated: dict[str, dict[str, Any]] = {".png": {"Software": None}, ".pdf": {"CreationDate": None}}
    known = path.suffix[1:].lower() in figure.canvas.get_supported_filetypes()
    paths = (path,) if known else tuple(path.with_name(path.name + suffix) for suffix in undated)
    for each in paths:
        with put_aside(each) as aside:
            figure.savefig(aside, dpi=dpi, metadata=undated.get(each.suffix.lower()))
        figure.set_layout_engine("none")  # one layout for all files
    return paths


def points(axes: Axes, x: Floats, of: Interval, style: LineStyle, label: str = "", joined: bool = False) -> None:
    """Draw values (K,) at x (K,) as markers with intervals, without NaN; an empty label gives no legend entry."""
    drawn = style.drawn if joined else style.drawn | {"linestyle": "none"}
    axes.plot(x, of.value, marker=style.marker, label=label or "_", **drawn)
    there = np.isfinite(of.low) & np.isfinite(of.high) & np.isfinite(x)
    # vlines, not errorbar: a corrected interval may exclude its value
    axes.vlines(x[there], of.low[there], of.high[there], color=style.colour, linewidth=0.8)


def band(axes: Axes, x: Floats, low: Floats, high: Floats, style: LineStyle) -> None:
    """Shade the area between two curves (K,), interrupted at NaN."""
    there = np.isfinite(low) & np.isfinite(high) & np.isfinite(x)
    if there.any():
        axes.fill_between(x, low, high, where=there.tolist(), color=style.colour, alpha=BAND, linewidth=0)


def curve(axes: Axes, x: Floats, of: Interval, style: LineStyle, **more: Any) -> None:
    """Draw a curve (K,) with its intervals; `more` are arguments of `Axes.plot`."""
    axes.plot(x, of.value, **style.drawn, **more)
    band(axes, x, of.low, of.high, style)


def legend_above(axes: Axes, ncols: int = 1, handles: Sequence[Any] | None = None, title: str | None = None) -> None:
    """Put the legend above the axes."""
    handles = axes.get_legend_handles_labels()[0] if handles is None else list(handles)
    if handles:
        place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "alignment": "left"}
        space: dict[str, Any] = {"borderaxespad": 0.2, "columnspacing": 1.2, "labelspacing": 0.25}
        axes.legend(handles=handles, ncols=ncols, title=title, **place, **space)


def legend_of_figure(figure: Figure, handles: Sequence[Any], ncols: int) -> None:
    """Put one legend above all panels."""
    figure.legend(handles=list(handles), loc="outside upper center", ncols=ncols, columnspacing=1.4)


def note(figure: Figure, words: str) -> None:
    """Write a note below all panels, with line breaks."""
    letters = round(15 * figure.get_figwidth())  # per line, narrow enough for wide letters
    figure.supxlabel(textwrap.fill(words, letters), fontsize=8.0)  # as in report.mplstyle


def plain_logarithms(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers: 1, 2, 5, 10, or powers of ten over a wide range."""
    low, high = axis.get_view_interval()
    decades = abs(math.log10(high / low)) if low > 0 and high > 0 else 1.0
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 2.5 else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: np.format_float_positional(value, precision=12, trim="-")))
    axis.set_minor_formatter(NullFormatter())


def say_empty(axes: Any, words: str = "nothing measured") -> None:
    """Write the reason into an empty panel."""
    write = axes.text2D if hasattr(axes, "text2D") else axes.text
    write(0.5, 0.5, words, transform=axes.transAxes, ha="center", va="center", color=GREY)


def of_tracks(names: Iterable[str], tracks: ByFile) -> str:
    """Return the label of some tracks in a title; empty if there is only one track."""
    return "" if len(tracks) == 1 else f" of {', '.join(names)}"


def in_frame(quantity: str) -> str:
    """Return a quantity's symbol with the frame of its components: 'v lab'."""
    symbol = SYMBOLS.get(quantity, quantity)
    return symbol if " " in symbol else f"{symbol} lab"


def interval_text(of: Interval, unit: str = "", factor: float = 1.0) -> str:
    """Return a scalar times `factor` with its interval as text: '0.921 ms (0.905 to 0.938)'."""
    value, low, high = (factor * float(x) for x in (of.value, of.low, of.high))
    behind = f" {unit}" if unit else ""
    if not math.isfinite(value + low + high):
        return f"{value:.3g}{behind}" if math.isfinite(value) else "unknown"
    places = decimals(high - low)
    return f"{value:.{places}f}{behind} ({low:.{places}f} to {high:.{places}f})"


def superscript(units: str) -> str:
    """Return units with a superscript 2."""
    return units.replace("^2", "\u00b2")


def decimals(width: float) -> int:
    """Return how many decimals show an interval of this width with two digits."""
    return min(max(1 - math.floor(math.log10(width)), 0), 6) if width > 0 else 3


def three_digits(value: float) -> str:
    """Return a number with three digits or more, never as a power of ten."""
    return f"{value:.{decimals(value / 10)}f}" if math.isfinite(value) else "unknown"


def p_value_text(p_value: float) -> str:
    """Return a p-value as text: 'p = 0.046', 'p < 0.001'."""
    if not math.isfinite(p_value):
        return "p unknown"
    return "p < 0.001" if p_value < 1e-3 else f"p = {p_value:.{2 if p_value >= 0.1 else 3}f}"
