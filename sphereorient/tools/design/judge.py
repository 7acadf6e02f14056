"""Judge and draw how precisely a texture map determines the orientation; search for one to paint by hand."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from pydantic import BaseModel, Field
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import PaintError, refusal
from sphereorient.report.plots.style import GREY, SHADE, WIDTH_IN, in_style, new_figure
from sphereorient.report.texture_map import draw_map
from sphereorient.search.normalisation import LocalNormalisation
from sphereorient.search.settings import GreySearchSettings
from sphereorient.sphere import Sampling, orthographic_view, reduced_texture
from sphereorient.sphere.texture import texture_coordinates
from sphereorient.tools.design import patterns
from sphereorient.tools.design.bound import cramer_rao_bound

SEARCH = GreySearchSettings()  # normalisation and size of the views, as in the search on grey values
ALIKE_STEP_DEG = 12.0  # of the first comparison; the grid is within 14.5 degrees of every view
CLOSER_DEG = (5.0, 2.5)  # steps of comparisons near the most similar views
CLOSEST = 24  # number of most similar views to compare again
RENDERED = 512  # views at once
FEW_VIEWS, FINALISTS = 24, 3  # of the first judgement in a search, and maps to judge in full
WHITE_SHARE = (0.15, 0.85)  # of a view, in a search
SIDE_PX = 96  # of the drawn views
WORST, BEST, ALIKE = "#B42318", "#1A7F37", "#0072B2"  # colours of the figure


class DesignSettings(BaseModel, frozen=True, extra="forbid"):
    """Pictures for which a map is judged."""

    diameter_px: float = Field(80.0, ge=12, le=400, description="of the ball in the pictures, px")
    noise_share: float = Field(0.05, gt=0, le=1, description="a pixel's noise over the step from black to white")
    views: int = Field(96, ge=12, le=2000, description="evenly spread views that are judged")
    apart_deg: float = Field(20.0, ge=10, le=90, description="views further apart than this must look different")


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """Quality of a map, from V views."""

    settings: DesignSettings
    direction_body: Tensor  # (V, 3), middles of the views
    white: Tensor  # (V,), share of the view that is white
    bound_rad: Tensor  # (V,), Cramér-Rao bound of the orientation, rms, position unknown; infinite: undetermined
    alike: float  # greatest similarity of two distinct views under any light, 1: the same
    alike_views: Tensor  # (2, 3, 3), these two
    stroke_deg: float  # widest brush that paints the map
    border: float  # length of all borders, radii

    @property
    def margin(self) -> float:
        """1 minus the similarity of the most similar views."""
        return 1.0 - self.alike

    def as_dict(self) -> dict[str, Any]:
        """Return all figures for JSON, angles in degrees; None: infinite."""
        places = lon_lat_deg(self.direction_body)
        return {
            "diameter_px": self.settings.diameter_px,
            "noise_share": self.settings.noise_share,
            "views": len(places),
            "white_share": _spread(self.white),
            "bound_deg": _spread(torch.rad2deg(self.bound_rad)),
            "worst_view_lon_lat_deg": places[self.bound_rad.argmax()].tolist(),
            "best_view_lon_lat_deg": places[self.bound_rad.argmin()].tolist(),
            "greatest_similarity": self.alike,
            "margin": self.margin,
            "most_alike_lon_lat_deg": lon_lat_deg(-self.alike_views[:, 2]).tolist(),
            "most_alike_apart_deg": math.degrees(float(so3.geodesic_distance(*self.alike_views))),
            "stroke_deg": self.stroke_deg,
            "border_radii": self.border,
        }


def lon_lat_deg(direction_body: Tensor) -> Tensor:
    """Return longitude and latitude (..., 2), degrees, of directions (..., 3)."""
    return torch.rad2deg(torch.stack(texture_coordinates(direction_body), -1))


def _spread(values: Tensor) -> dict[str, float | None]:
    named = {"min": float(values.min()), "median": float(values.median()), "max": float(values.max())}
    return {name: value if math.isfinite(value) else None for name, value in named.items()}


def judge_texture(texture: Tensor, settings: DesignSettings | None = None) -> Judgement:
    """Judge a map (H, 2 H): balance, bound (docs/errata.md), similarity of normalised views, widest brush."""
    settings = DesignSettings() if settings is None else settings
    direction = patterns.view_directions(settings.views)
    R = patterns.facing(direction)
    alike, two = greatest_similarity(texture, R, settings.apart_deg)
    return Judgement(
        settings=settings,
        direction_body=direction,
        white=_white(texture, R),
        bound_rad=_bounds(texture, R, settings),
        alike=alike,
        alike_views=two,
        stroke_deg=patterns.stroke_deg(texture),
        border=patterns.border_length(texture),
    )


def greatest_similarity(texture: Tensor, R_view_body: Tensor, apart_deg: float) -> tuple[float, Tensor]:
    """Return the greatest similarity, <= 1, of two views at least `apart_deg` apart, and these, (2, 3, 3) float64.
    Views (V, 3, 3) of a map (H, 2 H) are compared with all of SO(3).
    """
    size = SEARCH.size_px
    texture, view = reduced_texture(texture.float(), size), orthographic_view(size)
    normalise = LocalNormalisation(size, detail=SEARCH.detail, window=SEARCH.window, clip=SEARCH.clip)

    def vectors(R: Tensor) -> Tensor:
        return torch.cat([normalise(view.render(texture, some.float())) for some in torch.split(R, RENDERED)])

    own = vectors(R_view_body)
    best, match = torch.full((len(own),), -1.0), R_view_body.clone()

    def compare(rows: slice, others: Tensor) -> None:
        """Keep the best of more orientations (K, 3, 3) for some of the views."""
        similarity = own[rows] @ vectors(others).T
        trace = R_view_body[rows].flatten(1) @ others.flatten(1).T
        similarity = similarity.masked_fill(trace > 1 + 2 * math.cos(math.radians(apart_deg)), -1.0)
        top, place = similarity.max(1)
        better = top > best[rows]
        best[rows] = torch.where(better, top, best[rows])
        match[rows] = torch.where(better[:, None, None], others[place], match[rows])

    for some in torch.split(so3.lattman_grid(math.radians(ALIKE_STEP_DEG)), RENDERED):
        compare(slice(None), some)
    top = best.topk(min(CLOSEST, len(best))).indices.tolist()
    for step in CLOSER_DEG:
        around = so3.local_grid(math.radians(step), math.radians(2 * step))
        for k in top:
            compare(slice(k, k + 1), around @ match[k])
    k = int(best.argmax())
    return float(best[k]), torch.stack([R_view_body[k], match[k]])


def design_texture(
    kinds: Sequence[str],
    stroke: float,
    settings: DesignSettings | None = None,
    *,
    tries: int = 24,
    seed: int = 0,
    advance: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Tensor, Judgement, str]:
    """Return the paintable map (512, 1024) with the best worst view, its judgement and its description.
    Draws `tries` maps of each of the `kinds` (of `PATTERNS`), with sizes of 1.5 to 5 times the brush, whose width is at
    least `stroke` degrees; of the best few, the least bound / margin wins. Raises PaintError: no map can be painted
    with such a brush.
    """
    settings = DesignSettings() if settings is None else settings
    # The first judgement uses a small diameter, as the ratio of bounds hardly depends on it.
    small = settings.model_copy(update={"diameter_px": min(40.0, settings.diameter_px)})
    R, (low, high) = patterns.facing(patterns.view_directions(FEW_VIEWS)), WHITE_SHARE
    found: list[tuple[float, str, float, int]] = []
    for number in range(tries * len(kinds)):
        kind, k = kinds[number // tries], number % tries
        size = float(np.clip(1.5 * stroke * (5.0 / 1.5) ** (k / max(tries - 1, 1)), *patterns.SIZES_DEG))
        texture = patterns.patterned_texture(kind, size, seed + k, 256)
        white = _white(texture, R)
        if patterns.stroke_deg(texture) >= stroke and low <= float(white.min()) <= float(white.max()) <= high:
            found.append((float(_bounds(texture, R, small).amax()), kind, size, seed + k))
        advance(number + 1, tries * len(kinds))
    if not found:
        expected, do = f"one that a brush of {stroke:g} degrees can paint", "take a finer brush or more tries"
        raise PaintError(refusal("texture map", expected=expected, got=f"none of {tries * len(kinds)}", do=do))
    judged = []
    for _, kind, size, own_seed in sorted(found)[:FINALISTS]:
        texture = patterns.patterned_texture(kind, size, own_seed)
        words = f"{kind} of {size:.1f} degrees, seed {own_seed}"
        judged.append((texture, judge_texture(texture, settings), words))
    return min(judged, key=lambda one: float(one[1].bound_rad.amax()) / max(one[1].margin, 1e-3))


def _white(texture: Tensor, R_view_body: Tensor) -> Tensor:
    texture = reduced_texture(texture.float(), SEARCH.size_px)
    return orthographic_view(SEARCH.size_px).paint(texture, R_view_body.float()).mean(-1).double()


def _bounds(texture: Tensor, R_view_body: Tensor, settings: DesignSettings) -> Tensor:
    pictures = {"diameter_px": settings.diameter_px, "noise_share": settings.noise_share}
    sampling = Sampling(supersampling=6 if settings.diameter_px < 40 else 4)
    bound = cramer_rao_bound(texture.float(), R_view_body.float(), **pictures, sampling=sampling)
    return bound.orientation_rms_rad.double()


@in_style
def design_figure(texture: Tensor, judgement: Judgement, title: str) -> Figure:
    """Draw a map (H, 2 H) with its best, worst and most similar views, and the bound and balance of all views."""
    figure = new_figure(WIDTH_IN, 6.2)
    rows = np.ravel(figure.subfigures(3, 1, height_ratios=[1.25, 0.75, 1.0], squeeze=False))
    _map_part(rows[0].subplots(), texture, judgement, title)
    _views_part(rows[1], texture, judgement)
    left, right = rows[2].subplots(1, 2, width_ratios=[1.6, 1.0])
    _information_part(left, judgement)
    white = 100 * judgement.white.numpy()
    right.hist(white, bins=list(range(0, 105, 5)), color=SHADE, edgecolor=GREY, linewidth=0.5)
    right.axvline(float(np.median(white)), color="black", linewidth=1, linestyle="--")
    right.set(xlim=(0, 100), xlabel="white in a view (%)", ylabel="views")
    right.set_title(f"balance: {white.min():.0f} to {white.max():.0f} %", fontsize=7.5)
    return figure


def _map_part(axes: Axes, texture: Tensor, judgement: Judgement, title: str) -> None:
    brush = f"brush up to {judgement.stroke_deg:.0f} degrees, borders {judgement.border:.0f} radii long"
    draw_map(axes, texture, f"{title}: {brush}", interpolation="nearest")
    axes.title.set_fontsize(8)
    axes.set_ylabel("latitude (degrees)")
    at, (first, second) = judgement.direction_body, judgement.alike_views
    named = {"W": (at[judgement.bound_rad.argmax()], WORST), "B": (at[judgement.bound_rad.argmin()], BEST)}
    for label, (direction, colour) in (named | {"1": (-first[2], ALIKE), "2": (-second[2], ALIKE)}).items():
        lon, lat = lon_lat_deg(direction).tolist()
        axes.plot(lon, lat, "o", markersize=9, markerfacecolor="white", markeredgecolor=colour, markeredgewidth=1.4)
        axes.text(lon, lat, label, color=colour, fontsize=7, fontweight="bold", ha="center", va="center")


def _views_part(part: Any, texture: Tensor, judgement: Judgement) -> None:
    texture, view = reduced_texture(texture, SIDE_PX), orthographic_view(SIDE_PX)
    shown = [*judgement.bound_rad.argsort(descending=True)[:3].tolist(), int(judgement.bound_rad.argmin())]
    drawn = []
    for k, name, colour in zip(shown, ("W: ", "", "", "B: "), (WORST, WORST, WORST, BEST), strict=True):
        angle = math.degrees(float(judgement.bound_rad[k]))
        text = f"{angle:.3f}°" if math.isfinite(angle) else "open"
        drawn.append((name + text, patterns.facing(judgement.direction_body[k]), colour))
    drawn += [(f"{n + 1}: alike {judgement.alike:.2f}", R, ALIKE) for n, R in enumerate(judgement.alike_views)]
    for axes, (text, R, colour) in zip(part.subplots(1, len(drawn)), drawn, strict=True):
        seen = view.render(texture, R.float(), math.nan).numpy()
        axes.imshow(seen, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        middle = (SIDE_PX / 2 - 0.5,) * 2
        axes.add_patch(Circle(middle, SIDE_PX / 2, fill=False, color=SHADE, lw=0.6, clip_on=False))
        axes.set_axis_off()
        axes.set_title(text, fontsize=7, color=colour)


def _information_part(axes: Axes, judgement: Judgement) -> None:
    place = lon_lat_deg(judgement.direction_body).numpy()
    bound = np.rad2deg(judgement.bound_rad.numpy())
    fine = np.isfinite(bound)
    dots = axes.scatter(place[fine, 0], place[fine, 1], c=bound[fine], cmap="viridis_r", s=26, linewidths=0)
    axes.plot(place[~fine, 0], place[~fine, 1], "x", color=WORST)
    axes.set(xlim=(-180, 180), ylim=(-90, 90), xticks=range(-180, 181, 90), yticks=(-90, 0, 90))
    axes.set(xlabel="longitude of the view's middle (degrees)", ylabel="latitude")
    ball = f"ball of {judgement.settings.diameter_px:g} px, noise {100 * judgement.settings.noise_share:g} %"
    axes.set_title(f"best possible error of one view, {ball}", fontsize=7.5)
    axes.figure.colorbar(dots, ax=axes, pad=0.02).set_label("degrees", fontsize=7)
