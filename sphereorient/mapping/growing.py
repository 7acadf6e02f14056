"""A map that grows with the frames as they come, of a ball that stays in its place."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import centre_lab_mm
from sphereorient.follow.appearance import NO_BETTER, WIDER, Appearance
from sphereorient.follow.fixed_centre import FixedCentre, centre_of
from sphereorient.mapping import iterations
from sphereorient.mapping.chain import chained
from sphereorient.mapping.disks import Crop, Crops, disks_of, evenly_spread, pixels_of
from sphereorient.mapping.iterations import State
from sphereorient.mapping.learn import final_map, interpolated
from sphereorient.mapping.settings import MapSettings
from sphereorient.pose.camera_view import Optics
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.lasting import lasting_errors
from sphereorient.pose.pixels import Pixels, stacked
from sphereorient.search import GreySearch
from sphereorient.sphere.texture import texel_areas
from sphereorient.sphere.texture_table import texture_table

MOST_PIXELS = 1200  # of a disk
MOST_FITTED = 48  # frames of an iteration, evenly spread
FIRST = 2  # iterations before the first map
MORE = 2.0  # another iteration is due at so many times the frames of the last one
SIZED = 2  # iterations that estimate the distance of the ball
COARSER = 2 / 3  # rows of the map over those of a whole movie's: an iteration must not take long
FIRST_FRAMES, FIRST_TURN = 24, math.radians(40.0)  # of the first iteration, at least
HELD_ITERATIONS = 2  # in which the position stays that of the outline
BLUR_ITERATIONS = 5  # in which the blur is estimated: a wrong blur shifts the position
SIZE_STEP = 0.01  # of the distances that are tried
LATER = 4  # number, as `iterate` counts, of the later iterations: smoothness has settled
TRIED = 6  # number, as `iterate` counts, of iterations that try a distance: light and poses anew
MOST_LEFT = 20.0  # grey levels at which residuals are cut off: occluders
RECENT = 6  # frames that give the rotation from the orientations handed over to those of the map
FITTED = 3  # iterations of a fit to the map
MOST_NEW = 12  # frames by which the map is extended at once, evenly spread
TABLE_SIDE = 256  # cells of the table of the paint: 0.8 degrees, below a texel
UNSEEN_SIDE = 128  # cells of the table of what is unseen: 1.6 degrees
LEAST_WEIGHT = 0.05  # of a typical texel's: less is unseen
WRONG_FRAMES, WRONG_POSES, WRONG_ITERATIONS = 10, 3, 3  # tried at random orientations


@dataclass(frozen=True, kw_only=True, eq=False)
class LiveMap:
    """All that following the ball with a map needs; made by `GrowingMap`."""

    number: int  # 1, 2 .. of the maps of one run
    iterations: int  # before it
    appearance: Appearance
    centre: FixedCentre
    search: GreySearch | None  # with its bank made; None: there was no time for it yet
    R_map_body: Tensor  # (3, 3), from the body frame of the orientations handed over to that of the map
    R_recent_map: Tensor  # (3, 3), its inverse by the last frames: orientations without a map drift
    seen_share: float  # of the sphere
    trusted: bool  # whether it explains pictures clearly better at right orientations than at wrong ones


@dataclass(frozen=True, kw_only=True, eq=False)
class _Learnt:
    """The result of the last iteration, extended by later frames."""

    state: State
    iterations: int
    fitted: int  # frames that had come before the last iteration
    shown: int  # frames that had come before it was extended
    moved_rad: float  # by the last iteration
    tie: float  # of the last iteration's map, see `State`
    rows: Tensor  # (n,), frames that were fitted to the map
    R_lab_map: Tensor  # (n, 3, 3), their orientations
    R_map_body: Tensor  # (3, 3), see `LiveMap`


class GrowingMap:
    """The map of the frames handed over so far.

    `place` is an empty record of crops with views and one position, see `fixed_place`.
    """

    def __init__(self, place: Crops, settings: MapSettings) -> None:
        rows = round(COARSER * iterations.map_height(place.views, settings) / iterations.ROW) * iterations.ROW
        self._height = settings.height or max(iterations.ROW, rows)
        pixels = min(settings.pixels, MOST_PIXELS)
        self._settings = settings.model_copy(update={"height": self._height, "pixels": pixels})
        self._place, self._crops = place, replace(place, position_lab_mm=place.position_lab_mm[:0])
        self._R = torch.zeros(0, 3, 3, dtype=torch.float64)  # R_lab_body as handed over
        self._pixels: list[Pixels] = []  # of the frames, as far as they were needed
        self._learnt: _Learnt | None = None
        self._found: LiveMap | None = None  # the last one
        self._iterating: Iterator[None] | None = None  # in progress
        self._sized = 0  # iterations that estimated the distance

    @property
    def done(self) -> int:
        """Number of iterations."""
        return 0 if self._learnt is None else self._learnt.iterations

    @property
    def whole(self) -> bool:
        """Whether no frame came since the last iteration."""
        return self._learnt is not None and self._learnt.fitted == len(self)

    @property
    def arrived(self) -> bool:
        """Whether all frames are in the map, and the last iteration moved them by less than the setting."""
        limit_rad = math.radians(self._settings.arrived_deg)
        return self._learnt is not None and self.whole and self._learnt.moved_rad < limit_rad

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

    def ready(self) -> bool:
        """Whether the frames are enough for a map."""
        return len(self) >= FIRST_FRAMES and bool((so3.geodesic_distance(self._R, self._R[0]) > FIRST_TURN).any())

    def grown(self, *, idle: bool) -> LiveMap | None:
        """Return the map with all frames; None: not yet, or nothing has changed. While frames come, each call extends
        the map by them, and does a part of another iteration once there are twice as many frames as in the last one.
        `idle`: there is time for a whole iteration.
        """
        learnt, done = self._learnt, self.done
        trusted = self._found is not None and self._found.trusted
        due = idle or not trusted or learnt is None or len(self) >= MORE * learnt.fitted
        if self._iterating is None and self.ready() and not self.arrived and due:
            size = idle and done >= FIRST and self._sized < SIZED
            self._sized += size
            self._iterating = self._iteration(size=size)
        for _ in islice(self._iterating or (), None if idle or not trusted else 1):
            pass
        learnt = self._learnt
        if learnt is not None and trusted and learnt.shown < len(self):
            self._extend(learnt)
        elif self.done == done:
            return None
        found = None if self.done < FIRST else self.live_map(searched=idle)
        return found if found is not None and found.trusted else None

    def iterate(self, *, size: bool = False) -> None:
        """Improve map, orientations and light once; `size`: and the ball's distance, in three times as long."""
        for _ in self._iteration(size=size):
            pass

    def _iteration(self, *, size: bool) -> Iterator[None]:
        """Do what `iterate` does, with pauses in which frames may come and extend the map so far."""
        state, k, count = self._with_all_frames(), self.done, len(self)
        before, settings = state.R_lab_body, self._settings
        if k >= BLUR_ITERATIONS:
            settings = settings.model_copy(update={"blur_px": state.blur_px})
        if size and state.use.shape[1] == 1:
            state = _better_size(state, settings)
        for found in iterations.iterating(state, settings, iterations.SEPARATE_ITERATIONS + min(k, LATER)):
            if found is None:
                yield
        assert found is not None
        after, iteration = found
        if k < HELD_ITERATIONS:
            after = replace(after, position_lab_mm=state.position_lab_mm)
        R_map_body = torch.eye(3, dtype=torch.float64) if self._learnt is None else self._learnt.R_map_body
        self._learnt = _Learnt(
            state=after,
            iterations=k + 1,
            fitted=count,
            shown=count,
            moved_rad=iteration.moved_rad,
            tie=after.tie,
            rows=after.frames,
            R_lab_map=after.R_lab_body,
            # The body frame handed over stays: an iteration moves that of the map.
            R_map_body=so3.nearest_rotation((after.R_lab_body.mT @ before @ R_map_body).mean(0)),
        )
        self._iterating = None

    def _extend(self, learnt: _Learnt) -> None:
        """Extend the map by the frames since then, whose poses are fitted to it."""
        assert self._found is not None
        appearance = self._found.appearance
        rows = evenly_spread(torch.arange(learnt.shown, len(self)), MOST_NEW)
        fitter, level, R_aligned = appearance.fitter, appearance.fitter.optics.fine, self._R_aligned(learnt)[rows]
        new = self._of(rows, R_aligned, learnt.state)
        fit = fitter.fit(new.pixels, new.start(self._found.centre.precision), level, FITTED)
        good = ((fit.score > appearance.score_min) | ~new.use).all(1)
        new = replace(new, R_lab_body=torch.where(good[:, None, None], fit.R_lab_body, R_aligned))
        self._learnt = replace(
            learnt,
            state=iterations.extended(learnt.state, new, learnt.tie, level.paint.unseen),
            shown=len(self),
            rows=torch.cat([learnt.rows, rows[good]]),
            R_lab_map=torch.cat([learnt.R_lab_map, fit.R_lab_body[good]]),
        )

    def _with_all_frames(self) -> State:
        rows, learnt = evenly_spread(torch.arange(len(self)), MOST_FITTED), self._learnt
        if learnt is None:
            disks = disks_of(self._crops, rows, self._settings)
            first = iterations.first_map(disks, self._R[rows], self._height)
            state = iterations.first_state(self._crops, rows, self._R[rows], first, self._settings)
            return self._of(rows, self._R[rows], state)
        R = interpolated(self._R_aligned(learnt), learnt.rows, learnt.R_lab_map)
        return self._of(rows, R[rows], learnt.state)

    def _R_aligned(self, learnt: _Learnt) -> Tensor:
        """Return all R_lab_body (n, 3, 3) as handed over, in the body frame of the map."""
        return self._R @ self._R_recent_map(learnt)

    def _R_recent_map(self, learnt: _Learnt) -> Tensor:
        last = learnt.rows[-RECENT:]
        return so3.nearest_rotation((self._R[last].mT @ learnt.R_lab_map[-RECENT:]).mean(0))

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
        learnt, found = self._learnt, self._found
        assert learnt is not None
        optics, seen_share = _optics(learnt.state)
        search = None if found is None else found.search
        if found is None or found.iterations < learnt.iterations:
            appearance, centre, trusted = _judged(learnt.state, optics)
            if searched:
                search = GreySearch(learnt.state.texture.clamp(0, 1))
                search.prepare()
        else:
            appearance, centre, trusted = found.appearance, found.centre, found.trusted
        fitter = replace(appearance.fitter, optics=optics)
        self._found = LiveMap(
            number=1 if found is None else found.number + 1,
            iterations=learnt.iterations,
            appearance=replace(appearance, fitter=fitter, still=fitter),
            centre=centre,
            search=search,
            R_map_body=learnt.R_map_body,
            R_recent_map=self._R_recent_map(learnt),
            seen_share=seen_share,
            trusted=trusted,
        )
        return self._found

    def paint(self) -> tuple[Tensor, Tensor]:
        """Return the map without blur, NaN where unknown, and its counts, (H, 2 H), in the handed body frame."""
        assert self._learnt is not None
        texture, seen, _ = final_map(self._learnt.state, self._learnt.R_map_body.mT)
        return texture, seen


def _better_size(state: State, settings: MapSettings) -> State:
    """Return the state with the distance of the ball from its camera, near the present one, at which light and map
    leave least: an outline that is too large by one part in a hundred makes all turns too small by that.
    """
    tried = [_at_distance(state, 1 + k * SIZE_STEP) for k in (-1, 0, 1)]
    held = [replace(iterations.iterate(one, settings, TRIED)[0], position_lab_mm=one.position_lab_mm) for one in tried]
    return _at_distance(state, 1 + SIZE_STEP * iterations.lowest(*(_left(one) for one in held)))


def _at_distance(state: State, factor: float) -> State:
    """Return the state with the ball at `factor` times its distance: it looks smaller, and has turned further."""
    camera = centre_lab_mm(state.fitter.views[0].camera)
    X = camera + factor * (state.position_lab_mm - camera)
    steps = so3.exp(factor * so3.log(state.R_lab_body[1:] @ state.R_lab_body[:-1].mT))
    return replace(state, position_lab_mm=X, R_lab_body=chained(steps) @ state.R_lab_body[0])


def _left(state: State) -> float:
    """Return the mean square, grey levels, that light and map leave."""
    parts = [(at.weight > 0, at.residual.square().clamp_max(MOST_LEFT**2)) for at in state.linearised()]
    seen, squares = (torch.cat(part) for part in zip(*parts, strict=True))
    return float((squares * seen).sum() / seen.sum())


def _optics(state: State) -> tuple[Optics, float]:
    """Return the optics of the map, whose texels that no picture shows well are unseen, and the share of the others."""
    assert state.weight is not None
    unseen = state.weight < LEAST_WEIGHT * state.weight[state.weight > 0].median()
    optics = iterations.optics_of(state.texture, state.fitter.views, state.blur_px, TABLE_SIDE)
    areas = texel_areas(len(unseen))
    if bool(unseen.any()):
        optics.fine.paint.unseen = texture_table(unseen.float(), optics.fine.paint.blur_rad, UNSEEN_SIDE)
    return optics, float((areas * ~unseen).sum() / areas.sum())


def _judged(state: State, optics: Optics) -> tuple[Appearance, FixedCentre, bool]:
    """Return the ball's appearance and centre by a fit of the map's pictures, and whether the map is trusted."""
    fitter = replace(state.fitter, optics=optics)
    X, use = state.position_lab_mm, state.use
    fit = fitter.fit(state.pixels, state.start(), optics.fine, FITTED)
    fitter = replace(fitter, widest_px=WIDER * float(fitter.disks_px(X).largest_px.max()))
    right, wrong = float(fit.score[use].median()), _wrong_score(fitter, state)
    appearance = Appearance(
        fitter=fitter,
        still=fitter,
        lasting=lasting_errors(state.pixels, fit, use, fitter.model(optics.fine)),
        score_min=0.5 * (right + min(wrong, right)),
        right_score=right,
    )
    return appearance, centre_of(fitter, state.pixels, fit, use, X[0]), right > max(wrong, 0.0) + NO_BETTER


def _wrong_score(fitter: Fitter, state: State) -> float:
    """Return the score that wrong orientations reach in one picture of ten."""
    some = state.where(evenly_spread(torch.arange(len(state.use)), WRONG_FRAMES).repeat(WRONG_POSES))
    turns = so3.random_rotations(len(some.use), generator=torch.Generator().manual_seed(0))
    begin = replace(some, R_lab_body=turns).start()
    fit = fitter.fit(some.pixels, begin, fitter.optics.fine, WRONG_ITERATIONS)
    return float(fit.score[some.use].quantile(0.9))
