"""The spin of a ball from a few photographs: attitudes from each alone, then one even spin through all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import PaintError, refusal
from sphereorient.search import GreySearch, GreySearchSettings, Proposals, Proposer
from sphereorient.search.refine_rotation import DetailLevel, detail_level, level_reference, refine_rotation
from sphereorient.sphere import orthographic_view
from sphereorient.sphere.texture_table import texture_table
from sphereorient.tools.spin.disks import BallOutline, Photograph, cut_disks
from sphereorient.tools.spin.dot_search import DOT_SEARCH, DotSearch
from sphereorient.tools.spin.dots import DotTable
from sphereorient.tools.spin.fit import Sighted, Spins, evidence_of, fit, fit_spins, sighted

PICTURES_MIN = 3
FINEST = 0.05  # detail of the last fit, radii: a pixel of a disk of 40
CLIMB_STEPS = 6
FOLLOWED_RAD = math.radians(20.0)  # how far a picture's own attitude may lie from the spin's
LAST_STEPS = 8
AS_EVIDENT = 6.0  # difference of evidence (log) below which pictures do not tell two spins apart


class SpinSettings(BaseModel):
    """How a spin is looked for in photographs."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    omega_max_rad_s: float = Field(
        2 * math.pi * 300, gt=0, description="fastest spin that is told of, rad/s: aliases of the frame rate below it"
    )
    search: GreySearchSettings = Field(DOT_SEARCH, description="of attitudes in each photograph alone")


@dataclass(frozen=True, kw_only=True, eq=False)
class SpinFound:
    """What photographs tell of a spin; made by `spin_of`. F pictures, K spins.

    The view frame is the camera's at the ball: x right, y down, z from the camera to the ball.
    """

    spins: Spins  # those that pictures cannot tell apart first, the slowest of them leading; then by evidence
    ambiguous: int  # number of spins that pictures cannot tell apart; 1: the first is the only one
    evidence: Tensor  # (K, F), of each picture for each spin, log
    mirrored_evidence: float  # of the best spin of the mirror image of the paint
    alone: Proposals  # attitudes that each picture allows by itself, best first
    R_view_body: Tensor  # (F, 3, 3), each picture's own attitude near the first spin's, that spin's where it has none
    residual_rad: Tensor  # (F,), between the two; NaN where the picture has none
    score: Tensor  # (F,), share of the picture's light and dark that the paint explains there
    balls: tuple[BallOutline, ...]
    disks: Tensor  # (F, S, S), grey levels


def spin_of(
    pictures: Sequence[Photograph],
    times_s: Sequence[float] | Tensor,
    paint: Tensor | DotTable,
    settings: SpinSettings | None = None,
    *,
    balls: Sequence[BallOutline] | None = None,
) -> SpinFound:
    """Find the even spin of a ball of known paint from photographs of it; no camera need be calibrated.

    The ball may be anywhere in each photograph and is taken to be seen from far away. Photographs at multiples of one
    step of time leave several spins, whole turns per step apart: all below the limit are returned, none is guessed.

    Args:
        pictures: F of (H, W) or (H, W, 3), three at least; crops of any size.
        times_s: F, s, from any origin, all different.
        paint: the map (H, 2 H), 0 dark .. 1 bright, or a table of dots.
        settings: limits and search.
        balls: F, where the balls are; None: they are looked for.

    Raises:
        PaintError: too few pictures, times that do not fit them, no ball, no spin that explains more than chance, or
            paint whose mirror image explains more.
    """
    settings = SpinSettings() if settings is None else settings
    time_s = torch.as_tensor(times_s, dtype=torch.float64)
    _check(len(pictures), time_s)
    disks, found = cut_disks(pictures, settings.search.size_px, balls)
    alone, seen, spins = _spins(disks, time_s, paint, settings)
    mirror = _most(_spins(disks, time_s, _mirrored(paint), settings)[2])
    _check_explained(spins, mirror)
    level = _level(paint, settings.search.size_px)
    own, _ = _climbed(level, disks, spins.R_view_body(time_s)[0])
    spins, ambiguous = _slowest_first(_refitted(time_s, own, seen, spins))
    predicted = spins.R_view_body(time_s)[0]
    apart = so3.geodesic_distance(own, predicted)
    followed = apart < FOLLOWED_RAD
    return SpinFound(
        spins=spins,
        ambiguous=ambiguous,
        evidence=evidence_of(seen, spins),
        mirrored_evidence=mirror,
        alone=alone,
        R_view_body=torch.where(followed[:, None, None], own, predicted),
        residual_rad=torch.where(followed, apart, torch.nan),
        score=_climbed(level, disks, predicted, steps=0)[1],
        balls=found,
        disks=disks,
    )


def _spins(
    disks: Tensor, time_s: Tensor, paint: Tensor | DotTable, settings: SpinSettings
) -> tuple[Proposals, Sighted, Spins]:
    proposer: Proposer = (
        DotSearch(paint, settings.search) if isinstance(paint, DotTable) else GreySearch(paint, settings.search)
    )
    alone = proposer.propose(disks)
    seen = sighted(time_s, alone.offset, alone.R_view_body, alone.score.square())
    return alone, seen, fit_spins(seen, settings.omega_max_rad_s)


def _most(spins: Spins) -> float:
    """Evidence of the best; 0, that of random attitudes, where there is none."""
    return float(spins.evidence.max()) if len(spins) else 0.0


def _mirrored(paint: Tensor | DotTable) -> Tensor | DotTable:
    """The paint of the mirror image: body y, and with it longitude, reversed."""
    return paint.mirrored() if isinstance(paint, DotTable) else paint.flip(-1)


def _level(paint: Tensor | DotTable, size_px: int) -> DetailLevel:
    texture = paint.texture() if isinstance(paint, DotTable) else paint
    return detail_level(orthographic_view(size_px), texture_table(texture.float(), FINEST), FINEST, every=1)


def _climbed(level: DetailLevel, disks: Tensor, R_view_body: Tensor, steps: int = CLIMB_STEPS) -> tuple[Tensor, Tensor]:
    """Each disk's own attitude (F, 3, 3) float64 near a given one, and its score (F,)."""
    each = [
        refine_rotation(level, level_reference(level, disk), R[None].float(), steps)
        for disk, R in zip(disks, R_view_body, strict=True)
    ]
    R = torch.cat([R for R, _ in each]).double()
    return so3.nearest_rotation(R), torch.cat([score for _, score in each]).double()


def _refitted(time_s: Tensor, own: Tensor, seen: Sighted, spins: Spins) -> Spins:
    """The spins fitted anew to one attitude a picture, found near the first spin's; evidence as before."""
    single = sighted(time_s, torch.arange(len(own) + 1), own, torch.ones(len(own)))
    fitted = fit(single, spins, steps=LAST_STEPS)
    return Spins(
        omega_view_rad_s=fitted.omega_view_rad_s,
        R0_view_body=fitted.R0_view_body,
        time0_s=fitted.time0_s,
        evidence=evidence_of(seen, spins).sum(1),
        scatter_rad=fitted.scatter_rad,
        covariance=fitted.covariance,
    )


def _slowest_first(spins: Spins) -> tuple[Spins, int]:
    """Put those that pictures cannot tell apart first, by rate; their number."""
    close = spins.evidence > spins.evidence.max() - AS_EVIDENT
    rate = spins.omega_view_rad_s.norm(dim=-1)
    key = torch.where(close, rate - rate.max() - 1.0, spins.evidence.max() - spins.evidence)
    return spins.of(key.argsort(stable=True)), int(close.sum())


def _check(count: int, time_s: Tensor) -> None:
    do = "give one time in seconds for each photograph"
    if count < PICTURES_MIN:
        expected = f"{PICTURES_MIN} photographs at least"
        raise PaintError(refusal("spin", expected=expected, got=str(count), do="add pictures of the same flight"))
    if time_s.shape != (count,) or not bool(time_s.isfinite().all()):
        got = f"{tuple(time_s.shape)} times" if bool(time_s.isfinite().all()) else "a time that is no number"
        raise PaintError(refusal("times_s", expected=f"{count} times", got=got, do=do))
    if bool((time_s.sort().values.diff() <= 0).any()):
        raise PaintError(refusal("times_s", expected="different times", got="one of them twice", do=do))


def _check_explained(spins: Spins, mirror: float) -> None:
    """Refuse what explains no more than chance; how much that is, the mirror image of the paint tells."""
    best = _most(spins)
    got = f"evidence {best:.0f}, and {mirror:.0f} for its mirror image"
    if mirror > best + AS_EVIDENT:
        do = "flip the map left to right, or change the sign of one column of the table"
        raise PaintError(refusal("paint", expected="that of the ball, not of its mirror image", got=got, do=do))
    if mirror > best - AS_EVIDENT:
        do = "check that paint, times and pictures belong together and that the ball spins evenly, or add pictures"
        raise PaintError(refusal("spin", expected="one that explains more than chance", got=got, do=do))
