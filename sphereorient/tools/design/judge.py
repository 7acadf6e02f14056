"""How good a painted map is for measuring attitudes, and the search for a good one that a hand can paint."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import PaintError, refusal
from sphereorient.evaluate.bound import cramer_rao_bound
from sphereorient.search.normalisation import LocalNormalisation
from sphereorient.search.settings import GreySearchSettings
from sphereorient.sphere import Sampling, orthographic_view, reduced_texture
from sphereorient.tools.design.paint import border_length, facing, scaled_paint, stroke_deg, view_directions

SEARCH = GreySearchSettings()  # normalisation and size of the views, as the search on grey values sees them
ALIKE_STEP_DEG = 12.0  # of the first comparison: no view is beyond 14.5 degrees of one that is compared with
CLOSER_DEG = (5.0, 2.5)  # steps of the comparisons about the most alike
CLOSEST = 24  # of the most alike that are looked at closer
RENDERED = 512  # views at once
FEW_VIEWS, FINALISTS = 24, 3  # of the first judgement in a search, and those that are judged in full
WHITE_SHARE = (0.15, 0.85)  # of a view: outside of it one paint is a rarity


class DesignSettings(BaseModel):
    """What paint is judged for."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    diameter_px: float = Field(80.0, ge=12, le=400, description="of the ball in the pictures, px")
    noise_share: float = Field(0.05, gt=0, le=1, description="a pixel's noise over the step from black to white")
    views: int = Field(96, ge=12, le=2000, description="evenly spread, that are judged")
    apart_deg: float = Field(20.0, ge=10, le=90, description="views further apart than this must look different")


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """What can be said of a map; made by `judge_paint`. V views."""

    settings: DesignSettings
    direction_body: Tensor  # (V, 3), middles of the views
    white: Tensor  # (V,), share of the view that is white
    bound_rad: Tensor  # (V,), rms of the best possible error of the attitude, place unknown; infinite: open
    alike: float  # greatest similarity of two distinct views under any light, 1: the same
    alike_views: Tensor  # (2, 3, 3), these two
    stroke_deg: float  # widest brush that paints the map
    border: float  # length of all borders, radii

    @property
    def margin(self) -> float:
        """What is left to tell the most alike views apart: 1 less their similarity."""
        return 1.0 - self.alike

    @property
    def alike_apart_rad(self) -> float:
        """Angle between the two most alike views."""
        return float(so3.geodesic_distance(*self.alike_views))

    @property
    def worst(self) -> int:
        """The view with the greatest bound."""
        return int(self.bound_rad.argmax())

    @property
    def best(self) -> int:
        """The view with the least bound."""
        return int(self.bound_rad.argmin())

    def as_dict(self) -> dict[str, Any]:
        """Return all figures for JSON, angles in degrees; None: infinite."""
        bound = torch.rad2deg(self.bound_rad)
        places = torch.rad2deg(lon_lat(self.direction_body))
        two = [torch.rad2deg(lon_lat(-R[2])).tolist() for R in self.alike_views]
        return {
            "diameter_px": self.settings.diameter_px,
            "noise_share": self.settings.noise_share,
            "views": len(bound),
            "white_share": _spread(self.white),
            "bound_deg": _spread(bound),
            "worst_view_lon_lat_deg": places[self.worst].tolist(),
            "best_view_lon_lat_deg": places[self.best].tolist(),
            "greatest_similarity": self.alike,
            "margin": self.margin,
            "most_alike_lon_lat_deg": two,
            "most_alike_apart_deg": math.degrees(self.alike_apart_rad),
            "stroke_deg": self.stroke_deg,
            "border_radii": self.border,
        }


def judge_paint(texture: Tensor, settings: DesignSettings | None = None) -> Judgement:
    """Judge a map: balance, information and likeness of its views, and how fine a brush it takes.

    Args:
        texture: (H, 2 H), 0 black .. 1 white.
        settings: pictures that are expected.

    Source: the bound is ERRATA's; likeness is the correlation of normalised pictures, as in the grey search.
    """
    settings = DesignSettings() if settings is None else settings
    direction = view_directions(settings.views)
    R = facing(direction)
    alike, two = most_alike(texture, R, settings.apart_deg)
    return Judgement(
        settings=settings,
        direction_body=direction,
        white=_white(texture, R),
        bound_rad=_bounds(texture, R, settings),
        alike=alike,
        alike_views=two,
        stroke_deg=stroke_deg(texture),
        border=border_length(texture),
    )


def most_alike(texture: Tensor, R_view_body: Tensor, apart_deg: float) -> tuple[float, Tensor]:
    """Find the two views that are most alike though they are apart.

    Args:
        texture: (H, 2 H).
        R_view_body: (V, 3, 3), views that are compared with all of SO(3); turns of the picture need not be among them.
        apart_deg: angle beyond which views are apart.

    Returns:
        Their similarity, 1 at most, and the two, (2, 3, 3) float64.
    """
    look = _Look(texture)
    own = look(R_view_body)
    grid = so3.lattman_grid(math.radians(ALIKE_STEP_DEG))
    best = torch.full((len(own),), -1.0)
    match = R_view_body.clone()
    for some in torch.split(grid, RENDERED):
        best, match = _better(best, match, R_view_body, own, some, look(some), apart_deg)
    top = best.topk(min(CLOSEST, len(best))).indices
    for step in CLOSER_DEG:
        around = so3.local_grid(math.radians(step), math.radians(2 * step))
        for k in top.tolist():
            near = around @ match[k]
            one = slice(k, k + 1)
            best[one], match[one] = _better(
                best[one], match[one], R_view_body[one], own[one], near, look(near), apart_deg
            )
    k = int(best.argmax())
    return float(best[k]), torch.stack([R_view_body[k], match[k]])


def make_paint(
    kinds: Sequence[str],
    stroke: float,
    settings: DesignSettings | None = None,
    *,
    tries: int = 24,
    seed: int = 0,
    advance: Callable[[int, int], None] | None = None,
) -> tuple[Tensor, Judgement, str]:
    """Search for the paint whose worst view says most, among those that a brush can paint.

    Seeds and sizes are tried; the best few by a quick look at the worst view's bound are judged in full, and of these
    wins the one with the least product of this bound and 1 / margin: precise, and hard to confuse.

    Args:
        kinds: of `paint.design.PAINTS`.
        stroke: least width of brush, degrees.
        settings: pictures that are expected.
        tries: paints drawn of each kind.
        seed: of the search.
        advance: called with the number of paints looked at, and of all.

    Returns:
        The map (512, 1024), its judgement, and what it is in words.

    Raises:
        PaintError: none of them can be painted with such a brush.
    """
    settings = DesignSettings() if settings is None else settings
    R = facing(view_directions(FEW_VIEWS))
    found: list[tuple[float, str, float, int]] = []
    for number, (kind, size, own_seed) in enumerate(_drafts(kinds, stroke, tries, seed)):
        texture = scaled_paint(kind, size, own_seed, 256)
        white = _white(texture, R)
        if (
            stroke_deg(texture) >= stroke
            and WHITE_SHARE[0] <= float(white.min()) <= float(white.max()) <= WHITE_SHARE[1]
        ):
            # The ratio of bounds hardly depends on the diameter: the quick look is at a small one.
            small = settings.model_copy(update={"diameter_px": min(40.0, settings.diameter_px)})
            found.append((float(_bounds(texture, R, small).amax()), kind, size, own_seed))
        if advance is not None:
            advance(number + 1, tries * len(kinds))
    if not found:
        expected, do = f"one that a brush of {stroke:g} degrees can paint", "take a finer brush or more tries"
        raise PaintError(refusal("paint", expected=expected, got=f"none of {tries * len(kinds)}", do=do))
    judged = []
    for _, kind, size, own_seed in sorted(found)[:FINALISTS]:
        texture = scaled_paint(kind, size, own_seed)
        judgement = judge_paint(texture, settings)
        worst = float(judgement.bound_rad.amax())
        judged.append(
            (worst / max(judgement.margin, 1e-3), texture, judgement, f"{kind} of {size:.1f} degrees, seed {own_seed}")
        )
    _, texture, judgement, words = min(judged, key=lambda one: one[0])
    return texture, judgement, words


def lon_lat(direction_body: Tensor) -> Tensor:
    """Longitude and latitude (..., 2), rad, of directions (..., 3)."""
    x, y, z = direction_body.unbind(-1)
    return torch.stack([torch.atan2(y, x), torch.atan2(z, torch.hypot(x, y))], -1)


class _Look:
    """Evened views of a map."""

    def __init__(self, texture: Tensor) -> None:
        size = SEARCH.size_px
        self._texture, self._view = reduced_texture(texture.float(), size), orthographic_view(size)
        self._normalise = LocalNormalisation(size, detail=SEARCH.detail, window=SEARCH.window, clip=SEARCH.clip)

    def __call__(self, R_view_body: Tensor) -> Tensor:
        """Vectors (K, P) of length 1."""
        parts = [
            self._normalise(self._view.render(self._texture, some.float()))
            for some in torch.split(R_view_body, RENDERED)
        ]
        return torch.cat(parts)


def _better(
    best: Tensor, match: Tensor, R: Tensor, own: Tensor, others: Tensor, look: Tensor, apart_deg: float
) -> tuple[Tensor, Tensor]:
    """Best similarity (V,) and its attitude (V, 3, 3) after more attitudes (K, 3, 3) were looked at."""
    likeness = own @ look.T
    trace = R.flatten(1) @ others.flatten(1).T
    likeness = likeness.masked_fill(trace > 1 + 2 * math.cos(math.radians(apart_deg)), -1.0)
    top, place = likeness.max(1)
    better = top > best
    return torch.where(better, top, best), torch.where(better[:, None, None], others[place], match)


def _drafts(kinds: Sequence[str], stroke: float, tries: int, seed: int) -> list[tuple[str, float, int]]:
    """Kind, size and seed of the paints to try: sizes from 1.5 to 5 times the brush's width."""
    drafts = []
    for kind in kinds:
        for k in range(tries):
            size = 1.5 * stroke * (5.0 / 1.5) ** (k / max(tries - 1, 1))
            drafts.append((kind, min(max(size, 3.0), 60.0), seed + k))
    return drafts


def _white(texture: Tensor, R_view_body: Tensor) -> Tensor:
    """Share of each view (V,) that is white."""
    texture = reduced_texture(texture.float(), SEARCH.size_px)
    return orthographic_view(SEARCH.size_px).paint(texture, R_view_body.float()).mean(-1).double()


def _bounds(texture: Tensor, R_view_body: Tensor, settings: DesignSettings) -> Tensor:
    bound = cramer_rao_bound(
        texture.float(),
        R_view_body.float(),
        diameter_px=settings.diameter_px,
        noise_share=settings.noise_share,
        sampling=Sampling(supersampling=6 if settings.diameter_px < 40 else 4),
    )
    return bound.orientation_rms_rad.double()


def _spread(values: Tensor) -> dict[str, float | None]:
    """Least, middle and greatest; None where there is none."""
    named = {"min": values.min(), "median": values.median(), "max": values.max()}
    return {name: float(value) if bool(value.isfinite()) else None for name, value in named.items()}
