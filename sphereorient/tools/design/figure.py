import math
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from sphereorient.report.plots.style import GREY, SHADE, WIDTH_IN, in_style, new_figure
from sphereorient.sphere import orthographic_view, reduced_texture
from sphereorient.tools.design.judge import Judgement, lon_lat_deg
from sphereorient.tools.design.patterns import facing

SIDE_PX = 96  # of the drawn views
WORST = "#B42318"
BEST = "#1A7F37"
ALIKE = "#0072B2"


@in_style
def design_figure(texture: Tensor, judgement: Judgement, title: str) -> Figure:
    """Draw a map (H, 2 H) with its best, worst and most similar views, and the bound and balance of all views."""
    figure = new_figure(WIDTH_IN, 6.2)
    rows = np.ravel(figure.subfigures(3, 1, height_ratios=[1.25, 0.75, 1.0], squeeze=False))
    _map_part(rows[0].subplots(), texture, judgement, title)
    _views_part(rows[1], texture, judgement)
    left, right = rows[2].subplots(1, 2, width_ratios=[1.6, 1.0])
    _information_part(left, judgement)
    _balance_part(right, judgement)
    return figure


def _map_part(axes: Axes, texture: Tensor, judgement: Judgement, title: str) -> None:
    axes.imshow(texture.numpy(), cmap="gray", vmin=0, vmax=1, extent=(-180, 180, -90, 90), interpolation="nearest")
    axes.grid(visible=False)
    for label, direction, colour in _named_views(judgement):
        lon, lat = lon_lat_deg(direction).tolist()
        axes.plot(lon, lat, "o", markersize=9, markerfacecolor="white", markeredgecolor=colour, markeredgewidth=1.4)
        axes.text(lon, lat, label[0], color=colour, fontsize=7, fontweight="bold", ha="center", va="center")
    axes.set(xticks=range(-180, 181, 60), yticks=range(-90, 91, 30), ylabel="latitude (degrees)")
    axes.set_xlabel("longitude (degrees)", labelpad=1)
    brush = f"brush up to {judgement.stroke_deg:.0f} degrees, borders {judgement.border:.0f} radii long"
    axes.set_title(f"{title}: {brush}", fontsize=8)


def _named_views(judgement: Judgement) -> list[tuple[str, Tensor, str]]:
    at = judgement.direction_body
    return [
        ("W worst view", at[judgement.worst], WORST),
        ("B best view", at[judgement.best], BEST),
        ("1 most alike", -judgement.alike_views[0, 2], ALIKE),
        ("2 most alike", -judgement.alike_views[1, 2], ALIKE),
    ]


def _views_part(part: Any, texture: Tensor, judgement: Judgement) -> None:
    size = SIDE_PX
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
    place = lon_lat_deg(judgement.direction_body).numpy()
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
    white = 100 * judgement.white.numpy()
    axes.hist(white, bins=list(range(0, 105, 5)), color=SHADE, edgecolor=GREY, linewidth=0.5)
    axes.axvline(float(np.median(white)), color="black", linewidth=1, linestyle="--")
    axes.set(xlim=(0, 100), xlabel="white in a view (%)", ylabel="views")
    axes.set_title(f"balance: {white.min():.0f} to {white.max():.0f} %", fontsize=7.5)
