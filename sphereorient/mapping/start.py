"""What the iterations start with: attitudes of a movie or of photographs without a map, and a first map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sphereorient.experiment.recording import Progress
from sphereorient.mapping.chain import PairwiseAttitudes, find_chain
from sphereorient.mapping.crops import Crops
from sphereorient.mapping.disks import Disks, disks_of
from sphereorient.mapping.iterations import ROW, State, first_map, first_state, iterate, map_height
from sphereorient.mapping.photographs import find_photographs, finer_settings
from sphereorient.mapping.record import evenly_spread
from sphereorient.mapping.settings import MapSettings
from sphereorient.pose.defocus import FIRST_BLUR_PX
from sphereorient.pose.fitter import widest_px

POSITION_ITERATIONS = 4  # that find the position of a ball that stays in its place
FEW_PIXELS = 250_000  # of photographs together
PIXELS_A_TEXEL = 3.0
# Blur of photographs, in radii, of the first iterations, and their number. Errors: 0.8 degrees after the comparison of
# pairs, 0.06 after these, 0.05 at the end (12 pictures of 200 px); without these, 0.09 after twice as many others.
COARSE, COARSE_ITERATIONS = 0.015, 5


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """What the iterations start with."""

    crops: Crops  # with the estimated position of a ball that stays in its place
    frames: Tensor  # (M,) int64, of the crops, that have an attitude
    rows: Tensor  # (n,) int64, of those, that the map is fitted to
    chain: PairwiseAttitudes  # of the M frames
    state: State  # of the n


def start_from_movie(crops: Crops, settings: MapSettings, progress: Progress) -> Start:
    """Find attitudes from neighbouring frames and loops, and a first map; raises as `fit_map`."""
    start = _from_chain(crops, settings, progress)
    if not crops.fixed:
        return start
    # The outline of what changes in the pictures is a pixel or two off, and the chain's rotations with it; a few
    # iterations correct the position, and the chain starts anew.
    state = start.state
    for k in range(POSITION_ITERATIONS):
        progress("place", k, POSITION_ITERATIONS)
        state, _ = iterate(state, settings, k)
    progress("place", POSITION_ITERATIONS, POSITION_ITERATIONS)
    known = torch.isfinite(crops.position_lab_mm).all(1)[:, None]
    X = torch.where(known, state.position_lab_mm[0], torch.nan)
    return _from_chain(replace(crops, position_lab_mm=X), settings, progress)


def _from_chain(crops: Crops, settings: MapSettings, progress: Progress) -> Start:
    progress("chain", 0, 1)
    frames = crops.frames_with_ball()
    rows = evenly_spread(torch.arange(len(frames)), settings.frames_max)
    disks = disks_of(crops, frames, settings)
    chain = find_chain(disks, settings)
    progress("chain", 1, 1)
    first = first_map(disks, chain.R_lab_body, map_height(crops.views, settings))
    state = first_state(crops, frames[rows], chain.R_lab_body[rows], first, settings)
    return Start(crops=crops, frames=frames, rows=rows, chain=chain, state=state)


def start_from_photographs(crops: Crops, settings: MapSettings, progress: Progress) -> Start:
    """Find attitudes of pictures in any order, and a first map; raises as `fit_map`.

    Of more than `frames_max` pictures, evenly spread ones are used; the others get no attitude.
    """
    progress("photographs", 0, 1)
    frames = evenly_spread(crops.frames_with_ball(), settings.frames_max)
    disks = disks_of(crops, frames, finer_settings(settings, widest_px(crops.views)))
    chain = find_photographs(disks_of(crops, frames, settings), disks, settings)
    progress("photographs", 1, 1)
    frames, disks = frames[chain.rows], disks.where(chain.rows)
    few = _settings_of_few(settings, crops, frames)
    R, X = _coarse(crops, frames, disks, chain.R_lab_body, few, progress)
    crops = replace(crops, position_lab_mm=crops.position_lab_mm.index_put((frames,), X))
    first = first_map(disks, R, map_height(crops.views, few))
    return Start(
        crops=crops,
        frames=frames,
        rows=torch.arange(len(frames)),
        chain=replace(chain, R_lab_body=R),
        state=first_state(crops, frames, R, first, few),
    )


def _settings_of_few(settings: MapSettings, crops: Crops, frames: Tensor) -> MapSettings:
    """Return settings for few pictures: more pixels of each, and fewer texels than pixels.

    With a texel for each pixel the map explains the pictures at any attitudes, and these never improve.
    """
    disks = int(crops.seen[frames].sum())
    pixels = max(settings.pixels, FEW_PIXELS // disks)
    seen = disks * min(pixels, math.pi / 4 * widest_px(crops.views) ** 2)
    rows = int(math.sqrt(seen / PIXELS_A_TEXEL / 2)) // ROW * ROW
    height = settings.height or min(map_height(crops.views, settings), max(ROW, rows))
    return settings.model_copy(update={"pixels": pixels, "height": height})


def _coarse(
    crops: Crops, frames: Tensor, disks: Disks, R_lab_body: Tensor, settings: MapSettings, progress: Progress
) -> tuple[Tensor, Tensor]:
    """Return attitudes (M, 3, 3) and positions (M, 3), mm, after iterations in blurred pictures.

    Errors of the pairs' attitudes are larger than a pixel, too large for sharp pictures.
    """
    extra_px = COARSE * widest_px(crops.views) / 2
    whole_px = math.hypot(settings.blur_px or FIRST_BLUR_PX, extra_px)
    rows = max(ROW, map_height(crops.views, settings) // 2)
    coarse = settings.model_copy(update={"blur_px": whole_px, "height": rows})
    state = first_state(crops, frames, R_lab_body, first_map(disks, R_lab_body, rows), settings, extra_px)
    for k in range(COARSE_ITERATIONS):
        progress("coarse map", k, COARSE_ITERATIONS)
        state, _ = iterate(state, coarse, k)
    progress("coarse map", COARSE_ITERATIONS, COARSE_ITERATIONS)
    return state.R_lab_body, state.position_lab_mm
