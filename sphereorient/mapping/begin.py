"""What the rounds begin with: attitudes without a map, from a movie or from photographs, and the first map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sphereorient.experiment.recording import Progress
from sphereorient.mapping.chain import Chain, find_chain, spread
from sphereorient.mapping.cut import disks_of
from sphereorient.mapping.disks import Disks
from sphereorient.mapping.first import ROW, first_map, first_stage, height_of
from sphereorient.mapping.footage import Footage, too_few
from sphereorient.mapping.photographs import find_photographs, finer_settings
from sphereorient.mapping.rounds import Stage, next_round
from sphereorient.mapping.settings import PaintSettings
from sphereorient.pose.defocus import FIRST_BLUR_PX
from sphereorient.pose.fitter import widest_px

PLACE_ROUNDS = 4  # that find the place of a ball that stays there
FEW_PIXELS = 250_000  # of photographs together
PIXELS_A_TEXEL = 3.0
# Blur of photographs, in radii, in which rounds begin, and how many: 0.8 degrees off after the comparison of pairs,
# 0.06 after these, 0.05 in the end (12 pictures of 200 px); without these, 0.09 after twice as many of the others.
COARSE, COARSE_ROUNDS = 0.015, 5


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """What the rounds begin with; made by `start_from_movie` and `start_from_photographs`."""

    footage: Footage  # with the place of a ball that stays there as it was found
    frames: Tensor  # (M,) int64, of the footage, that have an attitude
    rows: Tensor  # (n,) int64, of those, that the map is fitted to
    chain: Chain  # of the M frames
    stage: Stage  # of the n


def start_from_movie(footage: Footage, settings: PaintSettings, progress: Progress) -> Start:
    """Find attitudes from neighbouring frames and loops, and make ready for the rounds.

    Raises:
        PaintError: one frame only, a sphere that never turns, or nothing seen twice.
    """
    if footage.fixed:
        footage = _placed(footage, settings, progress)
    return _chained(footage, settings, progress)


def _chained(footage: Footage, settings: PaintSettings, progress: Progress) -> Start:
    progress("chain", 0, 1)
    frames = _with_ball(footage)
    rows = spread(torch.arange(len(frames)), settings.frames_max)
    disks = disks_of(footage, frames, settings)
    chain = find_chain(disks, settings)
    progress("chain", 1, 1)
    first = first_map(disks, chain.R_lab_body, height_of(footage.views, settings))
    stage = first_stage(footage, frames[rows], chain.R_lab_body[rows], first, settings)
    return Start(footage=footage, frames=frames, rows=rows, chain=chain, stage=stage)


def _placed(footage: Footage, settings: PaintSettings, progress: Progress) -> Footage:
    """Return the footage of a ball that stays where it is with its place as a few rounds find it.

    What changes in the pictures has an outline that is a pixel or two off, the more where the rim is hidden; turns
    taken from disks about such a place are too long and lean, and rounds alone do not put that right.
    """
    stage = _chained(footage, settings, progress).stage
    for k in range(PLACE_ROUNDS):
        progress("place", k, PLACE_ROUNDS)
        stage, _ = next_round(stage, settings, k)
    progress("place", PLACE_ROUNDS, PLACE_ROUNDS)
    known = torch.isfinite(footage.position_lab_mm).all(1)[:, None]
    return replace(footage, position_lab_mm=torch.where(known, stage.position_lab_mm[0], torch.nan))


def _with_ball(footage: Footage) -> Tensor:
    """Return the frames (M,) int64 that show the ball."""
    frames = torch.nonzero(footage.seen.any(1))[:, 0]
    if len(frames) < 2:
        raise too_few(len(frames))
    return frames


def start_from_photographs(footage: Footage, settings: PaintSettings, progress: Progress) -> Start:
    """Find attitudes of pictures in any order, and make ready for the rounds.

    Of more than `frames_max` pictures so many, evenly spread, are taken: what has no neighbours cannot follow them.

    Raises:
        PaintError: too few pictures, none that share paint, a sphere that does not turn, or two balls.
    """
    progress("photographs", 0, 1)
    frames = spread(_with_ball(footage), settings.frames_max)
    finer = finer_settings(settings, widest_px(footage.views))
    disks = disks_of(footage, frames, finer)
    chain = find_photographs(disks_of(footage, frames, settings), disks, settings)
    progress("photographs", 1, 1)
    frames, disks = frames[chain.rows], disks.where(chain.rows)
    few = denser(settings, footage, frames)
    R, X = _coarse(footage, frames, disks, chain.R_lab_body, few, progress)
    footage = replace(footage, position_lab_mm=footage.position_lab_mm.index_put((frames,), X))
    first = first_map(disks, R, height_of(footage.views, few))
    return Start(
        footage=footage,
        frames=frames,
        rows=torch.arange(len(frames)),
        chain=replace(chain, R_lab_body=R),
        stage=first_stage(footage, frames, R, first, few),
    )


def denser(settings: PaintSettings, footage: Footage, frames: Tensor) -> PaintSettings:
    """Return settings for few pictures: more pixels of each, and no more texels than these pixels tell.

    With a texel for each pixel any attitudes explain the pictures, and rounds leave them where they are.
    """
    disks = int(footage.seen[frames].sum())
    pixels = max(settings.pixels, FEW_PIXELS // disks)
    widest = widest_px(footage.views)
    told = disks * min(pixels, math.pi / 4 * widest**2)
    rows = int(math.sqrt(told / PIXELS_A_TEXEL / 2)) // ROW * ROW
    height = settings.height or min(height_of(footage.views, settings), max(ROW, rows))
    return settings.model_copy(update={"pixels": pixels, "height": height})


def _coarse(
    footage: Footage, frames: Tensor, disks: Disks, R_lab_body: Tensor, settings: PaintSettings, progress: Progress
) -> tuple[Tensor, Tensor]:
    """Return attitudes (M, 3, 3) and places (M, 3), mm, of some frames as rounds in blurred pictures find them.

    Pairs of photographs leave attitudes off by a pixel of theirs and more, from where sharp pictures lead nowhere.
    """
    extra_px = COARSE * widest_px(footage.views) / 2
    whole_px = math.hypot(settings.blur_px or FIRST_BLUR_PX, extra_px)
    rows = max(ROW, height_of(footage.views, settings) // 2)
    coarse = settings.model_copy(update={"blur_px": whole_px, "height": rows})
    stage = first_stage(footage, frames, R_lab_body, first_map(disks, R_lab_body, rows), settings, extra_px)
    for k in range(COARSE_ROUNDS):
        progress("coarse map", k, COARSE_ROUNDS)
        stage, _ = next_round(stage, coarse, k)
    progress("coarse map", COARSE_ROUNDS, COARSE_ROUNDS)
    return stage.R_lab_body, stage.position_lab_mm
