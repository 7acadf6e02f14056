"""A map that grows with the frames as they come, of a ball that stays in its place."""

import math
from collections.abc import Iterator, Sequence
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
    extended,
    first_map,
    first_state,
    iterate,
    iterating,
    map_height,
    optics_of,
)
from sphereorient.mapping.learn import final_map, interpolated
from sphereorient.mapping.settings import MapSettings
from sphereorient.pose.camera_view import Optics
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.lasting import lasting_errors
from sphereorient.pose.pixels import Pixels, stacked
from sphereorient.pose.poses import PoseStart
from sphereorient.search import GreySearch
from sphereorient.sphere.texture_table import texture_table

MOST_PIXELS = 1200  # of a disk
MOST_FITTED = 48  # frames of an iteration, evenly spread
FIRST = 2  # iterations before the first map
MORE = 2.0  # times the frames of an iteration from which another one is due
SIZED = 2  # times that the distance of the ball is sought
COARSER = 2 / 3  # rows of the map over those of a whole movie's: an iteration must not take long
FIRST_FRAMES, FIRST_TURN = 24, math.radians(40.0)  # from which a map is begun
HELD_ITERATIONS = 2  # in which the place stays as the outline gave it
BLUR_ITERATIONS = 5  # in which the blur is estimated: a place found with a wrong one is off
SIZE_STEP = 0.01  # of the distances that are tried
LATER = 4  # number, as `iterate` counts, of the later iterations: smoothness has settled
TRIED = 6  # number, as `iterate` counts, of iterations that try a size: light and poses anew
MOST_LEFT = 20.0  # grey levels: what an occluder leaves counts no more
RECENT = 6  # frames by which the body frame of those that come is known
FITTED = 3  # iterations of such frames
MOST_NEW = 12  # frames by which the map is extended at once, evenly spread
TABLE_SIDE = 256  # cells of the table of the paint: 0.8 degrees, below a texel
UNSEEN_SIDE = 128  # cells of the table of what is unseen: 1.6 degrees
LEAST_WEIGHT = 0.05  # of a typical texel's: less is unseen
WRONG_FRAMES, WRONG_POSES, WRONG_ITERATIONS = 10, 3, 3  # tried at random orientations


@dataclass(frozen=True, kw_only=True, eq=False)
class LiveMap:
    """All that following the ball with a map needs; made by `GrowingMap`."""

    number: int  # 1, 2 .. of the maps of one run
    appearance: Appearance
    centre: FixedCentre
    search: GreySearch | None  # with its bank made; None: there was no time for it yet
    R_map_body: Tensor  # (3, 3): the body frame of the orientations handed over is that of the map times this
    R_recent_map: Tensor  # (3, 3): likewise its inverse, by the last frames: orientations without a map drift
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
        self._pixels: list[Pixels] = []
        self._state: State | None = None
        self._R_map_body = torch.eye(3, dtype=torch.float64)
        self._rows = torch.zeros(0, dtype=torch.int64)  # of the frames that were fitted to the map
        self._R_lab_map = self._R  # their orientations
        self._shown = 0  # frames that are in the map
        self._tie = 0.0  # of the last iteration's map, as the state's
        self._found: LiveMap | None = None  # the last one
        self._number = 0
        self._iterated, self._sized, self._trusted = 0, 0, False
        self._iterating: Iterator[None] | None = None  # in progress
        self._judged = 0  # iterations before the last map that was judged
        self.done = 0  # iterations
        self.moved_rad = math.inf  # by the last iteration; infinite where frames came since

    @property
    def arrived(self) -> bool:
        """Whether all frames are in the map, and the last iteration moved them by less than the setting."""
        return self.moved_rad < math.radians(self._settings.arrived_deg)

    @property
    def whole(self) -> bool:
        """Whether no frame came since the last iteration."""
        return math.isfinite(self.moved_rad)

    def __len__(self) -> int:
        return len(self._R)

    def add(self, crops: Sequence[Crop], R_lab_body: Tensor) -> None:
        """Take a frame: a crop of each camera, and its orientation (3, 3)."""
        known = self._crops
        self._crops = replace(
            known,
            crops=[[*row, crop] for row, crop in zip(known.crops, crops, strict=True)],
            position_lab_mm=self._place.position_lab_mm.expand(len(self) + 1, 3),  # pixels of one stencil
            seen=torch.ones(len(self) + 1, len(crops), dtype=torch.bool),
        )
        self._R = torch.cat([self._R, R_lab_body[None]])
        self.moved_rad = math.inf

    def ready(self) -> bool:
        """Whether the frames are enough for a map."""
        return len(self) >= FIRST_FRAMES and bool((so3.geodesic_distance(self._R, self._R[0]) > FIRST_TURN).any())

    def grown(self, *, idle: bool) -> LiveMap | None:
        """Return the map with all frames, None: not yet, or nothing has changed. While frames come, each call extends
        the map by them; once they are twice as many as in the last iteration, it does a part of another one as well.
        `idle`: there is time for a whole one.
        """
        due = idle or not self._trusted or len(self) >= MORE * self._iterated
        if self._iterating is None and self.ready() and not self.arrived and due:
            size = idle and self.done >= FIRST and self._sized < SIZED
            self._sized += size
            self._iterating = self.iterating(size=size)
        done = self.done
        if self._iterating is not None and (idle or not self._trusted):
            self.finish()
        elif self._iterating is not None:
            next(self._iterating, None)
        if self.done > done:
            self._iterating = None
        if self._trusted and self._shown < len(self):
            self.extend()
        elif self.done == done:
            return None
        if self.done < FIRST:
            return None
        found = self.live_map(searched=idle)
        self._trusted = found.trusted
        return found if found.trusted else None

    def finish(self) -> None:
        """Finish the iteration that is in progress."""
        for _ in self._iterating or ():
            pass
        self._iterating = None

    def iterate(self, *, size: bool = False) -> None:
        """Improve map, orientations and light once, with all frames; `size`: and the distance of the ball, which takes
        three times as long.
        """
        self._iterating = self.iterating(size=size)
        self.finish()

    def iterating(self, *, size: bool) -> Iterator[None]:
        """Do what `iterate` does, with pauses in which frames may come and extend the map so far."""
        state, k, count = self._with_all_frames(), self.done, len(self)
        before = state.R_lab_body
        if size and state.use.shape[1] == 1:
            state = _better_size(state, self._settings_of(state))
        after, iteration = yield from iterating(state, self._settings_of(state), SEPARATE_ITERATIONS + min(k, LATER))
        if k < HELD_ITERATIONS:
            after = replace(after, position_lab_mm=state.position_lab_mm)
        self._state, self._tie, self.done = after, after.tie, k + 1
        self._shown = self._iterated = count
        self.moved_rad = iteration.moved_rad if len(self) == count else math.inf
        self._rows, self._R_lab_map = after.frames, after.R_lab_body
        # The body frame goes on: an iteration moves that of the map.
        self._R_map_body = so3.nearest_rotation((after.R_lab_body.mT @ before @ self._R_map_body).mean(0))

    def extend(self) -> None:
        """Let the map show what the frames since then show, fitted to what it shows already."""
        assert self._state is not None
        assert self._found is not None
        rows, self._shown = evenly_spread(torch.arange(self._shown, len(self)), MOST_NEW), len(self)
        if len(rows):
            fitter, level = self._found.appearance.fitter, self._found.appearance.fitter.optics.fine
            new = self._of(rows, self._R_aligned(rows), self._state)
            held = self._found.centre.precision.expand(len(rows), 3, 3)
            fit = fitter.fit(new.pixels, PoseStart(new.position_lab_mm, new.R_lab_body, new.use, held), level, FITTED)
            good = ((fit.score > self._found.appearance.score_min) | ~new.use).all(1)
            self._rows = torch.cat([self._rows, rows[good]])
            self._R_lab_map = torch.cat([self._R_lab_map, fit.R_lab_body[good]])
            R = torch.where(good[:, None, None], fit.R_lab_body, self._R_aligned(rows))
            self._state = extended(self._state, replace(new, R_lab_body=R), self._tie, level.paint.unseen)

    def _settings_of(self, state: State) -> MapSettings:
        blur_px = self._settings.blur_px if self.done < BLUR_ITERATIONS else state.blur_px
        return self._settings.model_copy(update={"blur_px": blur_px})

    def _with_all_frames(self) -> State:
        rows, before = evenly_spread(torch.arange(len(self)), MOST_FITTED), self._state
        if before is None:
            disks = disks_of(self._crops, rows, self._settings)
            assert self._settings.height is not None
            first = first_map(disks, self._R[rows], self._settings.height)
            state = first_state(self._crops, rows, self._R[rows], first, self._settings)
            return self._of(rows, self._R[rows], state)
        R = interpolated(self._R_aligned(torch.arange(len(self))), self._rows, self._R_lab_map)
        return self._of(rows, R[rows], before)

    def _R_aligned(self, rows: Tensor) -> Tensor:
        """Return R_lab_body (n, 3, 3) as handed over, in the body frame of the map by the last frames fitted to it."""
        return self._R[rows] @ self._R_recent_map

    @property
    def _R_recent_map(self) -> Tensor:
        last = self._rows[-RECENT:]
        return so3.nearest_rotation((self._R[last].mT @ self._R_lab_map[-RECENT:]).mean(0))

    def _of(self, rows: Tensor, R_lab_map: Tensor, state: State) -> State:
        """Return a state of some frames, by number, at their orientations."""
        for k in range(len(self._pixels), len(self)):
            self._pixels.append(pixels_of(self._crops, state.fitter, torch.tensor([k]), self._settings.pixels))
        return replace(
            state,
            frames=rows,
            pixels=stacked([self._pixels[k] for k in rows.tolist()]),
            use=self._crops.seen[rows],
            position_lab_mm=state.position_lab_mm[:1].expand(len(rows), 3),
            R_lab_body=R_lab_map,
        )

    def live_map(self, *, searched: bool = True) -> LiveMap:
        """Return what following the ball with the present map needs; `searched`: with a search of it, else with the
        one before. A map that was only extended is trusted as that of the last iteration.
        """
        assert self._state is not None
        unseen = _unseen(self._state)
        optics = _optics(self._state, unseen)
        areas = texel_areas(len(unseen))
        self._number += 1
        if self._found is None or self._judged < self.done:
            search = None if self._found is None else self._found.search
            self._found, self._judged = replace(_judged(self._state, optics), search=search), self.done
            if searched:
                self._found = replace(self._found, search=_search(self._state))
        appearance = self._found.appearance
        fitter = replace(appearance.fitter, optics=optics)
        self._found = replace(
            self._found,
            number=self._number,
            appearance=replace(appearance, fitter=fitter, still=fitter),
            R_map_body=self._R_map_body,
            R_recent_map=self._R_recent_map,
            seen_share=float((areas * ~unseen).sum() / areas.sum()),
        )
        return self._found

    def paint(self) -> tuple[Tensor, Tensor]:
        """Return the map without the blur of the pictures, NaN where unknown, and its counts, (H, 2 H) each, in the
        body frame of the orientations handed over.
        """
        assert self._state is not None
        texture, seen, _ = final_map(self._state, self._R_map_body.mT)
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


def _unseen(state: State) -> Tensor:
    """Return which texels no picture shows well, (H, 2 H) bool."""
    assert state.weight is not None
    return state.weight < LEAST_WEIGHT * state.weight[state.weight > 0].median()


def _optics(state: State, unseen: Tensor) -> Optics:
    optics = optics_of(state.texture, state.fitter.views, state.blur_px, TABLE_SIDE)
    if bool(unseen.any()):
        optics.fine.paint.unseen = texture_table(unseen.float(), optics.fine.paint.blur_rad, UNSEEN_SIDE)
    return optics


def _judged(state: State, optics: Optics) -> LiveMap:
    """Return what following needs of a map whose pictures are fitted anew."""
    fitter = replace(state.fitter, optics=optics)
    X, use = state.position_lab_mm, state.use
    fit = fitter.fit(state.pixels, PoseStart(X, state.R_lab_body, use), optics.fine, 3)
    fitter = replace(fitter, widest_px=WIDER * float(fitter.disks_px(X).largest_px.max()))
    right, wrong = float(fit.score[use].median()), _wrong_score(fitter, state)
    appearance = Appearance(
        fitter=fitter,
        still=fitter,
        lasting=lasting_errors(state.pixels, fit, use, fitter.model(optics.fine)),
        score_min=0.5 * (right + min(wrong, right)),
        right_score=right,
    )
    return LiveMap(
        number=0,
        appearance=appearance,
        centre=centre_of(fitter, state.pixels, fit, use, X[0]),
        search=None,
        R_map_body=torch.eye(3, dtype=torch.float64),
        R_recent_map=torch.eye(3, dtype=torch.float64),
        seen_share=0.0,
        trusted=right > wrong + NO_BETTER,
    )


def _search(state: State) -> GreySearch:
    search = GreySearch(state.texture.clamp(0, 1))
    search.prepare()
    return search


def _wrong_score(fitter: Fitter, state: State) -> float:
    """Return the score that wrong orientations reach in one picture of ten."""
    rows = evenly_spread(torch.arange(len(state.use)), WRONG_FRAMES).repeat(WRONG_POSES)
    turns = so3.random_rotations(len(rows), generator=torch.Generator().manual_seed(0))
    fine = fitter.optics.fine
    begin = PoseStart(state.position_lab_mm[rows], turns, state.use[rows])
    fit = fitter.fit(state.disks(rows), begin, fine, WRONG_ITERATIONS)
    return float(fit.score[state.use[rows]].quantile(0.9))
