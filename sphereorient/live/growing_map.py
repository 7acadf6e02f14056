"""A map that grows with the frames as they come, of a ball that stays in its place."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import centre_lab_mm
from sphereorient.follow.appearance import NO_BETTER, WIDER, Appearance
from sphereorient.follow.fixed_centre import FixedCentre, centre_of
from sphereorient.mapping.chain import chained
from sphereorient.mapping.disks import Crop, Crops, disks_of, evenly_spread, pixels_of
from sphereorient.mapping.grid import texel_areas
from sphereorient.mapping.iterations import (
    ROW,
    SEPARATE_ITERATIONS,
    State,
    first_map,
    first_state,
    iterate,
    map_height,
    map_weight,
    optics_of,
)
from sphereorient.mapping.learn import final_map, interpolated
from sphereorient.mapping.settings import MapSettings
from sphereorient.pose.fitter import Fitter, Optics
from sphereorient.pose.lasting import lasting_errors
from sphereorient.pose.pixels import Pixels, stacked
from sphereorient.search import GreySearch
from sphereorient.sphere.texture_table import texture_table

MOST_PIXELS = 1200  # of a disk
MOST_FITTED = 48  # frames of an iteration, evenly spread
COARSER = 2 / 3  # rows of the map over those of a whole movie's: an iteration must not take long
FIRST_FRAMES, FIRST_TURN = 24, math.radians(40.0)  # from which a map is begun
HELD_ITERATIONS = 4  # in which the place stays as the outline gave it
BLUR_AFTER, BLUR_ITERATIONS = 1, 5  # iterations after which the blur is estimated, and until which
SIZE_STEP = 0.01  # of the distances that are tried
LATER = 4  # number, as `iterate` counts, of the later iterations: smoothness has settled
TRIED = 6  # number, as `iterate` counts, of iterations that try a size: light and poses anew
MOST_LEFT = 20.0  # grey levels: what an occluder leaves counts no more
RECENT = 10  # frames by which the body frame goes on from relative orientations
UNSEEN_SIDE = 128  # cells of the table of what is unseen: 1.6 degrees
LEAST_WEIGHT = 0.05  # of a typical texel's: less is unseen
WRONG_POSES, WRONG_ITERATIONS = 3, 3  # of each frame tried, at random orientations


@dataclass(frozen=True, kw_only=True, eq=False)
class LiveMap:
    """All that following the ball with a map needs; made by `GrowingMap`."""

    number: int  # 1, 2 .. of the maps of one run
    appearance: Appearance
    centre: FixedCentre
    search: GreySearch
    R_map_body: Tensor  # (3, 3): the body frame of the orientations handed over is that of the map times this
    seen_share: float  # of the sphere
    trusted: bool  # whether it explains pictures clearly better at right orientations than at wrong ones


class GrowingMap:
    """The map of the frames handed over so far.

    `place` is an empty record of crops with views and one position, see `fixed_place`.
    """

    def __init__(self, place: Crops, settings: MapSettings) -> None:
        rows = round(COARSER * map_height(place.views, settings) / ROW) * ROW
        height, pixels = settings.height or max(ROW, rows), min(settings.pixels, MOST_PIXELS)
        self._settings = settings.model_copy(update={"height": height, "pixels": pixels})
        self._place, self._crops = place, replace(place, position_lab_mm=place.position_lab_mm[:0])
        self._R = torch.zeros(0, 3, 3, dtype=torch.float64)  # R_lab_body as handed over
        self._absolute: list[int] = []  # number of the map that each came from; 0: relative
        self._pixels: list[Pixels] = []
        self._state: State | None = None
        self._number = 0
        self.done = 0  # iterations
        self.moved_rad = math.inf  # by the last iteration; infinite where frames came since

    @property
    def arrived(self) -> bool:
        """Whether all frames are in the map, and the last iteration moved them by less than the setting."""
        return self.moved_rad < math.radians(self._settings.arrived_deg)

    def __len__(self) -> int:
        return len(self._R)

    def add(self, crops: Sequence[Crop], R_lab_body: Tensor, number: int) -> None:
        """Take a frame: a crop of each camera, its orientation (3, 3), and the map that this came from, 0: none."""
        known = self._crops
        self._crops = replace(
            known,
            crops=[[*row, crop] for row, crop in zip(known.crops, crops, strict=True)],
            position_lab_mm=self._place.position_lab_mm.expand(len(self) + 1, 3),  # pixels of one stencil
            seen=torch.ones(len(self) + 1, len(crops), dtype=torch.bool),
        )
        self._R = torch.cat([self._R, R_lab_body[None]])
        self._absolute.append(number)
        self.moved_rad = math.inf

    def ready(self) -> bool:
        """Whether the frames are enough for a map."""
        return len(self) >= FIRST_FRAMES and bool((so3.geodesic_distance(self._R, self._R[0]) > FIRST_TURN).any())

    def iterate(self, *, size: bool = False) -> None:
        """Improve map, orientations and light once, with all frames; `size`: and the distance of the ball, which takes
        three times as long.
        """
        state, k = self._with_all_frames(), self.done
        if size and state.use.shape[1] == 1:
            state = _better_size(state, self._settings_of(state))
        after, iteration = iterate(state, self._settings_of(state), SEPARATE_ITERATIONS + min(k, LATER))
        if k < HELD_ITERATIONS:
            after = replace(after, position_lab_mm=state.position_lab_mm)
        self._state, self.done, self.moved_rad = after, k + 1, iteration.moved_rad

    def _settings_of(self, state: State) -> MapSettings:
        blur_px = self._settings.blur_px if BLUR_AFTER <= self.done < BLUR_ITERATIONS else state.blur_px
        return self._settings.model_copy(update={"blur_px": blur_px})

    def _with_all_frames(self) -> State:
        rows, before = evenly_spread(torch.arange(len(self)), MOST_FITTED), self._state
        if before is None:
            disks = disks_of(self._crops, rows, self._settings)
            assert self._settings.height is not None
            first = first_map(disks, self._R[rows], self._settings.height)
            state = first_state(self._crops, rows, self._R[rows], first, self._settings)
        else:
            R = interpolated(self._R @ self._gauge().mT, before.frames, before.R_lab_body)
            use, X = self._crops.seen[rows], before.position_lab_mm[:1].expand(len(rows), 3)
            state = replace(before, frames=rows, use=use, position_lab_mm=X, R_lab_body=R[rows])
        for k in range(len(self._pixels), len(self)):
            self._pixels.append(pixels_of(self._crops, state.fitter, torch.tensor([k]), self._settings.pixels))
        return replace(state, pixels=stacked([self._pixels[k] for k in rows.tolist()]))

    def _gauge(self) -> Tensor:
        """Return R_map_body (3, 3): of the frames that came from the newest map, or else of the last ones."""
        assert self._state is not None
        frames, newest = self._state.frames, max(self._absolute)
        same = torch.tensor([self._absolute[k] == newest for k in frames.tolist()])
        rows = torch.nonzero(same)[:, 0] if newest and bool(same.any()) else torch.arange(len(frames))[-RECENT:]
        return so3.nearest_rotation((self._state.R_lab_body[rows].mT @ self._R[frames[rows]]).mean(0))

    def live_map(self, *, searched: bool = True) -> LiveMap:
        """Return what following the ball with the present map needs; `searched`: with the bank of its search made."""
        assert self._state is not None
        state = self._state
        weight = map_weight(state)
        unseen = weight < LEAST_WEIGHT * weight[weight > 0].median()
        optics = _optics(state, unseen)
        fitter = replace(state.fitter, optics=optics)
        X, use = state.position_lab_mm, state.use
        fit = fitter.fit(state.pixels, X, state.R_lab_body, use, optics.fine, 3)
        fitter = replace(fitter, widest_px=WIDER * float(fitter.largest_px(X).max()))
        right, wrong = float(fit.score[use].median()), _wrong_score(fitter, state)
        appearance = Appearance(
            fitter=fitter,
            still=fitter,
            lasting=lasting_errors(state.pixels, fit, use, fitter.model(optics.fine)),
            score_min=0.5 * (right + min(wrong, right)),
            right_score=right,
        )
        search = GreySearch(state.texture.clamp(0, 1))
        self._number += 1
        if searched:
            search.prepare()
        areas = texel_areas(len(unseen))
        return LiveMap(
            number=self._number,
            appearance=appearance,
            centre=centre_of(fitter, state.pixels, fit, use, X[0]),
            search=search,
            R_map_body=self._gauge(),
            seen_share=float((areas * ~unseen).sum() / areas.sum()),
            trusted=right > wrong + NO_BETTER,
        )

    def paint(self) -> tuple[Tensor, Tensor]:
        """Return the map without the blur of the pictures, NaN where unknown, and its counts, (H, 2 H) each, in the
        body frame of the orientations handed over.
        """
        assert self._state is not None
        texture, seen, _ = final_map(self._state, self._gauge().mT)
        return texture, seen


def _better_size(state: State, settings: MapSettings) -> State:
    """Return the state with the distance of the ball from its camera, near the present one, at which light and map
    leave least: an outline that is too large by one part in a hundred makes all turns too small by that.
    """
    tried = [_at_distance(state, 1 + k * SIZE_STEP) for k in (-1, 0, 1)]
    held = [replace(iterate(one, settings, TRIED)[0], position_lab_mm=one.position_lab_mm) for one in tried]
    low, here, high = (_left(one) for one in held)
    bend = low - 2 * here + high
    shift = 0.5 * (low - high) / bend if bend > 0 else (1.0 if high < low else -1.0)
    return _at_distance(state, 1 + SIZE_STEP * min(max(shift, -1.0), 1.0))


def _at_distance(state: State, factor: float) -> State:
    """Return the state with the ball at `factor` times its distance: it looks smaller, and has turned further."""
    camera = centre_lab_mm(state.fitter.views[0].camera)
    X = camera + factor * (state.position_lab_mm - camera)
    steps = so3.exp(factor * so3.log(state.R_lab_body[1:] @ state.R_lab_body[:-1].mT))
    return replace(state, position_lab_mm=X, R_lab_body=chained(steps) @ state.R_lab_body[0])


def _left(state: State) -> float:
    """Return the mean square, grey levels, that light and map leave."""
    seen, squares = zip(
        *((at.weight > 0, at.residual.square().clamp_max(MOST_LEFT**2)) for at in state.linearised()), strict=True
    )
    return float((torch.cat(squares) * torch.cat(seen)).sum() / torch.cat(seen).sum())


def _optics(state: State, unseen: Tensor) -> Optics:
    optics = optics_of(state.texture, state.fitter.views, state.blur_px)
    if bool(unseen.any()):
        optics.fine.paint.unseen = texture_table(unseen.float(), optics.fine.paint.blur_rad, UNSEEN_SIDE)
    return optics


def _wrong_score(fitter: Fitter, state: State) -> float:
    """Return the score that wrong orientations reach in one picture of ten."""
    rows = evenly_spread(torch.arange(len(state.use)), RECENT).repeat(WRONG_POSES)
    turns = so3.random_rotations(len(rows), generator=torch.Generator().manual_seed(0))
    fine = fitter.optics.fine
    fit = fitter.fit(state.disks(rows), state.position_lab_mm[rows], turns, state.use[rows], fine, WRONG_ITERATIONS)
    return float(fit.score[state.use[rows]].quantile(0.9))
