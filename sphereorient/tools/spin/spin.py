"""The spin of a ball from a few photographs: orientations in each alone, then a uniform spin."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from matplotlib.figure import Figure
from pydantic import BaseModel, Field
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import PaintError, refusal
from sphereorient.files.threads import Progress, silent
from sphereorient.report.plots.style import WIDTH_IN, in_style, new_figure
from sphereorient.search import Candidates, GreySearch, GreySearchSettings, Proposer
from sphereorient.search.refine_rotation import DetailLevel, detail_level, refine_rotation
from sphereorient.sphere import orthographic_view, reduced_texture
from sphereorient.sphere.texture_table import texture_table
from sphereorient.tools.spin import fit
from sphereorient.tools.spin.disks import BallOutline, Photographs
from sphereorient.tools.spin.dots import DOT_SEARCH, DotSearch, DotTable
from sphereorient.tools.spin.fit import PictureCandidates, Spins

FINEST = 0.05  # detail of the last fit, radii: a pixel of a disk of 40
FOLLOWED_RAD = math.radians(20.0)  # largest angle between a picture's own orientation and the spin's
AS_EVIDENT = 6.0  # difference of evidence (log); below, pictures do not distinguish two spins
AT_ONCE = 4  # photographs per report of progress
COLUMNS, MOST_DRAWN = 6, 36  # photographs of the figure: per row, and in all


class SpinSettings(BaseModel, frozen=True, extra="forbid"):
    """How a spin is searched in photographs."""

    omega_max_rad_s: float = Field(2 * math.pi * 300, gt=0, description="rad/s; all aliases below it are reported")
    search: GreySearchSettings = Field(DOT_SEARCH, description="of orientations in each photograph alone")


@dataclass(frozen=True, kw_only=True, eq=False)
class SpinEstimate:
    """A spin from F photographs, with K - 1 aliases; view frame: x right, y down, z from the camera to the ball."""

    spins: Spins  # first indistinguishable ones, by rate; then by evidence
    ambiguous: int  # number of indistinguishable spins; 1: unambiguous
    evidence: Tensor  # (K, F), of each picture for each spin, log
    mirrored_evidence: float  # of the best spin of the mirrored texture
    alone: Candidates  # orientations from each picture alone, best first
    R_view_body: Tensor  # (F, 3, 3), each picture's own orientation near the first spin's, else that spin's
    residual_rad: Tensor  # (F,), between the two; NaN: no own orientation
    score: Tensor  # (F,), share of the picture's variance that the texture explains there
    balls: tuple[BallOutline, ...]
    disks: Tensor  # (F, S, S), grey levels


def spin_of(
    photographs: Photographs,
    texture: Tensor | DotTable,
    settings: SpinSettings | None = None,
    progress: Progress = silent,
) -> SpinEstimate:
    """Find the uniform spin of a ball of known texture from photographs of a far, uncalibrated camera.
    Times at multiples of one step allow several spins, whole revolutions per step apart: returns all below the limit.
    `texture` is the map (H, 2 H), 0 black .. 1 white, or a table of dots. Raise PaintError for no ball, no spin better
    than chance, or a mirrored texture that fits better.
    """
    settings = SpinSettings() if settings is None else settings
    time_s = photographs.time_s.double()
    disks, found = photographs.disks(settings.search.size_px)
    mirrored = texture.mirrored() if isinstance(texture, DotTable) else texture.flip(-1)
    alone, seen = _searched(disks, time_s, texture, settings, progress, "attitudes")
    _, reflected = _searched(disks, time_s, mirrored, settings, progress, "mirror image")
    spins = fit.fit_spins(seen, settings.omega_max_rad_s)
    mirrored_evidence = _greatest(fit.fit_spins(reflected, settings.omega_max_rad_s))
    _check_evidence(_greatest(spins), mirrored_evidence)
    drawn = texture.texture() if isinstance(texture, DotTable) else texture
    view = orthographic_view(settings.search.size_px)
    level = detail_level(view, texture_table(drawn.float(), FINEST), FINEST, every=1)
    own, _ = _refined(level, disks, spins.R_view_body(time_s)[0], 6)
    # Refit the spins to one orientation per picture; keep the evidence of all candidates.
    single = fit.picture_candidates(time_s, torch.arange(len(own) + 1), own, torch.ones(len(own)))
    fitted = fit.refine_spins(single, spins, iterations=8)
    total = fit.evidence_of(seen, spins).sum(1)
    close = total > total.max() - AS_EVIDENT
    rate = fitted.omega_view_rad_s.norm(dim=-1)
    order = torch.where(close, rate - rate.max() - 1.0, total.max() - total).argsort(stable=True)
    spins = replace(fitted, evidence=total).of(order)
    predicted = spins.R_view_body(time_s)[0]
    apart = so3.geodesic_distance(own, predicted)
    followed = apart < FOLLOWED_RAD
    return SpinEstimate(
        spins=spins,
        ambiguous=int(close.sum()),
        evidence=fit.evidence_of(seen, spins),
        mirrored_evidence=mirrored_evidence,
        alone=alone,
        R_view_body=torch.where(followed[:, None, None], own, predicted),
        residual_rad=torch.where(followed, apart, torch.nan),
        score=_refined(level, disks, predicted, 0)[1],
        balls=found,
        disks=disks,
    )


def _searched(
    disks: Tensor, time_s: Tensor, texture: Tensor | DotTable, settings: SpinSettings, progress: Progress, stage: str
) -> tuple[Candidates, PictureCandidates]:
    """Search each disk alone."""
    of, parts = settings.search, []
    search: Proposer = DotSearch(texture, of) if isinstance(texture, DotTable) else GreySearch(texture, of)
    for first in range(0, len(disks), AT_ONCE):
        progress(stage, first, len(disks))
        parts.append(search.propose(disks[first : first + AT_ONCE]))
    progress(stage, len(disks), len(disks))
    alone = Candidates.joined(parts)
    return alone, fit.picture_candidates(time_s, alone.offset, alone.R_view_body, alone.score.square())


def _check_evidence(best: float, mirrored: float) -> None:
    """Raise PaintError unless the texture explains the pictures better than its mirror image does."""
    got = f"evidence {best:.0f}, and {mirrored:.0f} for its mirror image"
    if mirrored > best + AS_EVIDENT:
        do = "flip the map left to right, or change the sign of one column of the table"
        raise PaintError(refusal("texture", expected="the ball's, not its mirror image", got=got, do=do))
    if mirrored > best - AS_EVIDENT:
        do = "check that texture, times and pictures belong together and that the ball spins uniformly, or add pictures"
        raise PaintError(refusal("spin", expected="one that explains more than chance", got=got, do=do))


def _greatest(spins: Spins) -> float:
    return float(spins.evidence.max()) if len(spins) else 0.0


def _refined(level: DetailLevel, disks: Tensor, R_view_body: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Refine each disk's own orientation (F, 3, 3) float64 from a given one; return also its score (F,)."""
    each = [refine_rotation(level, disk, R[None].float(), steps) for disk, R in zip(disks, R_view_body, strict=True)]
    R, score = (torch.cat(parts).double() for parts in zip(*each, strict=True))
    return so3.nearest_rotation(R), score


@in_style
def spin_figure(found: SpinEstimate, texture: Tensor, time_s: Tensor, names: Sequence[str]) -> Figure:
    """Draw photographs and the map (H, 2 H) at the first spin's orientations, in order of the times (F,), s."""
    chosen = time_s.argsort()[:MOST_DRAWN].tolist()
    size, rows = found.disks.shape[-1], math.ceil(len(chosen) / COLUMNS)
    texture = reduced_texture(texture.float(), size)
    predicted = orthographic_view(size).render(texture, found.spins.R_view_body(time_s)[0].float(), math.nan)
    figure = new_figure(WIDTH_IN, 2.4 * rows + 0.4)
    axes = figure.subplots(2 * rows, COLUMNS, squeeze=False)
    for each in axes.flat:
        each.set_axis_off()
    inside = torch.isfinite(predicted[0])
    for place, k in enumerate(chosen):
        filmed, drawn = axes[2 * (place // COLUMNS) :, place % COLUMNS][:2]
        disk = torch.where(inside, found.disks[k], torch.nan)
        filmed.imshow(disk.numpy(), cmap="gray", interpolation="nearest")
        drawn.imshow(predicted[k].numpy(), cmap="gray", vmin=0, vmax=1.2, interpolation="nearest")
        off = float(found.residual_rad[k])
        words = f"{math.degrees(off):.1f}° off" if math.isfinite(off) else "no orientation"
        filmed.set_title(f"{names[k]}, {1e3 * float(time_s[k]):.1f} ms\n{words}", fontsize=6)
    return figure
