"""Poses of all frames: a full search where a block of frames begins, then each frame from the one before it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, combinations, pairwise

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.follow.appearance import Appearance
from sphereorient.follow.fixed_centre import FixedCentre
from sphereorient.follow.initialise import Poses, explaining_first, initialise, poses_of
from sphereorient.locate import Frame, LocateSettings
from sphereorient.pose.fit import Fit
from sphereorient.pose.fitter import Fitter, Picture, PyramidLevel
from sphereorient.search.proposer import Proposer
from sphereorient.search.settings import RefineSettings
from sphereorient.trajectory import Reason

ARRIVED_RAD = 0.02  # a fit whose last step is longer has not arrived
NEAR_RAD = 0.006  # a first step that is longer wants another one before all pixels are looked at
FIRST_EVERY = 4  # the first step of a fit looks at every fourth pixel
LONG_STEP = 3.0  # times the step before: after a longer one the motion before says little
CONTRADICTS_USUAL = 4.0  # times as far apart as the cameras' own turns usually are, and
CONTRADICTS_SIGMAS = 2.8  # of these turns, wider where a bubble hides much: then they look at different instants
AGREES_AGAIN = 0.5  # of these limits: cameras that contradicted each other must agree better than others
MOVE_SHARE = 0.3  # of the radius: how far the ball may have moved where nothing is known of its motion
ASTRAY_SHARE = 0.01  # of the radius: how far a place may be from where three frames say it is


@dataclass(frozen=True, kw_only=True, eq=False)
class _Expected:
    """What a frame's predecessors say of it."""

    position_lab_mm: Tensor  # (3,)
    R_lab_body: Tensor  # (3, 3)
    use: Tensor  # (C,) bool, cameras that saw the ball
    reason: tuple[Reason, ...]  # C, why the others did not
    place_precision: Tensor  # (3, 3), 1/mm^2
    rough: bool = False  # from one predecessor alone: nothing is known of the motion


@dataclass(eq=False)
class _Lane:
    """One block on its way: the last poses, in the order of their frames."""

    first: int
    last: int  # + 1
    time_s: Sequence[float]  # of the window's frames
    past: deque[tuple[int, Poses]] = field(default_factory=lambda: deque(maxlen=3))

    def expected(self, frame: int, radius_mm: float) -> _Expected | None:
        """Place and turn go on, their change too where three frames tell it."""
        rows = [poses for number, poses in self.past if number >= frame - len(self.past)]
        numbers = [number for number, _ in self.past]
        if not rows or numbers[-1] != frame - 1:
            return None
        reason = tuple(Reason.LOW_SCORE if why is Reason.OK else why for why in rows[-1].reason)
        if len(rows) < 2 or numbers[-2] != frame - 2:
            return self._beside(rows[-1], reason, radius_mm)
        t0, t1, t2 = (self.time_s[k] for k in range(frame - 2, frame + 1))
        on = (t2 - t1) / (t1 - t0)  # 1 for even frames
        if on > LONG_STEP:
            return self._beside(rows[-1], reason, radius_mm)
        *_, X0, X1 = (poses.position_lab_mm[0] for poses in rows)
        *_, C0, C1 = (poses.covariance[0, 3:, 3:] for poses in rows)
        *_, R0, R1 = (poses.R_lab_body[0] for poses in rows)
        turn, move, spread = on * so3.log(R1 @ R0.mT), on * (X1 - X0), (1 + on) ** 2 * C1 + on**2 * C0
        if len(rows) == 3:
            before = (t1 - t0) / (t0 - self.time_s[frame - 3])
            # The rate changes from the middle of one step to that of the next as it did between the two before.
            more = (t2 - t0) / (t1 - self.time_s[frame - 3])
            turn = (1 + more) * turn - on * before * more * so3.log(R0 @ rows[0].R_lab_body[0].mT)
            a, b = on * (1 + more), on * before * more
            further = (1 + a) ** 2 * C1 + (a + b) ** 2 * C0 + b**2 * rows[0].covariance[0, 3:, 3:]
            # Not so the distances that one camera tells: they scatter by more than the ball is accelerated.
            if float(further.diagonal().sum()) < (ASTRAY_SHARE * radius_mm) ** 2:
                move, spread = (1 + more) * move - b * (X0 - rows[0].position_lab_mm[0]), further
        astray = (ASTRAY_SHARE * radius_mm) ** 2 * torch.eye(3, dtype=torch.float64)
        return _Expected(
            position_lab_mm=X1 + move,
            R_lab_body=so3.exp(turn) @ R1,
            use=rows[-1].use,
            reason=reason,
            place_precision=torch.linalg.inv(spread + astray),
        )

    def _beside(self, last: Poses, reason: tuple[Reason, ...], radius_mm: float) -> _Expected:
        """Near the last pose, the motion being unknown."""
        spread = last.covariance[0, 3:, 3:] + (MOVE_SHARE * radius_mm) ** 2 * torch.eye(3, dtype=torch.float64)
        return _Expected(
            position_lab_mm=last.position_lab_mm[0],
            R_lab_body=last.R_lab_body[0],
            use=last.use,
            reason=reason,
            place_precision=torch.linalg.inv(spread),
            rough=True,
        )

    def saw(self, frame: int, poses: Poses) -> None:
        """Remember the best pose of a frame, if a picture bears it out."""
        if len(poses) and bool(poses.use.any()):
            self.past.append((frame, poses))


class BlockTracker:
    """Follows the ball through blocks of frames, each block by itself.

    A block begins with a search that knows nothing, and ends with its last frame: where blocks begin is a matter of
    frame numbers alone, so no chunk, worker or restart can change a result, and a pose gone wrong ends there at last.

    Args:
        learnt: blur, light and scores of the movies.
        proposers: by name of view.
        locating: how outlines are found.
        settings: blocks and lanes.
        place: of a ball that turns in it, with its error; None: each frame tells its own.
    """

    def __init__(
        self,
        learnt: Appearance,
        proposers: Mapping[str, Proposer],
        locating: LocateSettings,
        settings: RefineSettings,
        place: FixedCentre | None = None,
    ) -> None:
        self.fitter: Fitter = learnt.fitter
        self.score_min = learnt.score_min
        self.clear_score = learnt.clear_score
        self.usual_apart_rad = learnt.usual_apart_rad
        self.proposers = proposers
        self.locating = locating
        self.settings = settings
        self.place = place

    def windows(self, frames: range) -> list[list[int]]:
        """Return the lengths of the blocks that are followed side by side, window by window.

        Args:
            frames: the experiment's frame numbers; those that are multiples of the setting begin a block.
        """
        length = self.settings.block_frames
        firsts = [frames.start, *range((frames.start // length + 1) * length, frames.stop, length)] if frames else []
        lengths = [last - first for first, last in pairwise([*firsts, frames.stop])]
        return [lengths[k : k + self.settings.lanes] for k in range(0, len(lengths), self.settings.lanes)]

    def track(
        self, shots: Sequence[Sequence[Frame]], window: Sequence[int], time_s: Sequence[float]
    ) -> Iterator[Poses]:
        """Follow the blocks of one window.

        Args:
            shots: of each view, the frames of these blocks in order.
            window: lengths of the blocks.
            time_s: of the same frames.

        Yields:
            The poses of each frame, in order.
        """
        firsts = list(accumulate([0, *window[:-1]]))
        lanes = [_Lane(first, first + length, time_s) for first, length in zip(firsts, window, strict=True)]
        found: dict[int, Poses] = {}
        for k in range(max(window)):
            now = [lane for lane in lanes if lane.first + k < lane.last]
            frames = {lane.first: [movie[lane.first + k] for movie in shots] for lane in now}
            for lane, poses in zip(now, self._step(now, k, frames), strict=True):
                lane.saw(lane.first + k, poses)
                found[lane.first + k] = poses
        yield from (found[k] for k in range(sum(window)))

    def _step(self, lanes: Sequence[_Lane], k: int, frames: Mapping[int, Sequence[Frame]]) -> Iterator[Poses]:
        """Measure one frame of each lane: predicted where that holds, searched for where not."""
        expected = {lane.first: self._in_place(lane.expected(lane.first + k, self.fitter.radius_mm)) for lane in lanes}
        ahead = {first: pose for first, pose in expected.items() if pose is not None}
        followed = dict(zip(ahead, self._follow(list(ahead.values()), [frames[n] for n in ahead]), strict=True))
        for lane in lanes:
            poses = followed.get(lane.first)
            poses = self._search(frames[lane.first]) if poses is None else poses
            yield poses if self.place is None else replace(poses, covariance=self.place.with_error(poses.covariance))

    def _in_place(self, expected: _Expected | None) -> _Expected | None:
        """Return what is expected, the place as it is known of all frames where it is."""
        if expected is None or self.place is None:
            return expected
        return replace(expected, position_lab_mm=self.place.position_lab_mm, place_precision=self.place.precision)

    def _follow(self, expected: Sequence[_Expected], shots: Sequence[Sequence[Frame]]) -> list[Poses | None]:
        """Fit expected poses, all in one batch of fixed size; None where the pictures do not bear one out."""
        if not expected:
            return []
        asked, missing = len(expected), self.settings.lanes - len(expected)
        expected, shots = [*expected, *[expected[-1]] * missing], [*shots, *[shots[-1]] * missing]
        frames = [[shot.picture for shot in row] for row in shots]
        usable = torch.tensor([[shot.usable for shot in row] for row in shots])
        X, R, use, precision = (
            torch.stack([getattr(one, name) for one in expected])
            for name in ("position_lab_mm", "R_lab_body", "use", "place_precision")
        )
        use = use & usable
        if any(one.rough for one in expected):
            X, R = self._approached(frames, X, R, use, precision, torch.tensor([one.rough for one in expected]))
        fit = self._fitted(frames, X, R, use, precision)
        good = first = self._borne_out(fit, use)
        within = self.fitter.largest_px(X) <= self.fitter.widest_px  # others are searched for, frame by frame
        before = torch.tensor([[why is Reason.CONTRADICTS for why in one.reason] for one in expected])
        alone: list[Fit] = []
        if not bool((good | ~within).all()):
            # One picture without the ball spoils what all say together: each camera by itself; of two that say
            # different things the one that the frames before bear out counts.
            alone = [self._fitted(frames, X, R, _only(usable, k), precision) for k in range(use.shape[1])]
            told = [self._borne_out(one, _only(usable, k)) for k, one in enumerate(alone)]
            astray = [
                torch.where(right, so3.geodesic_distance(one.R_lab_body, R), torch.inf)
                for one, right in zip(alone, told, strict=True)
            ]
            nearest, which = torch.stack(astray).min(0)
            for k, one in enumerate(alone):
                chosen = ~good & torch.isfinite(nearest) & (which == k)
                fit, use = _chosen(chosen, one, fit), torch.where(chosen[:, None], _only(usable, k), use)
            good = good | torch.isfinite(nearest)
        # What is told of another camera only where this frame itself asks: it must not depend on those beside it.
        doubtful = ~first | before.any(1)
        if bool((usable & ~use).any()):
            # A camera that was blind may see again: that shows at the pose which all of them give together.
            both = self._fitted(frames, fit.position_lab_mm, fit.R_lab_body, usable, precision)
            unused = good & (usable & ~use).any(1)
            limit = torch.where(before.any(1), AGREES_AGAIN, 1.0)
            contradicts = self._contradictory(both, usable, limit)
            back = unused & self._borne_out(both, usable) & ~contradicts
            doubtful = doubtful | (unused & contradicts)
            fit, use = _chosen(back, both, fit), torch.where(back[:, None], usable, use)
        others = (good & doubtful)[:, None] & usable & ~use
        for k in range(use.shape[1] if bool(others.any()) else 0):
            one = alone[k] if alone else self._fitted(frames, X, R, _only(usable, k), precision)
            others[:, k] &= self._borne_out(one, _only(usable, k))
            fit = _beside(fit, one, others[:, k], k)
        reasons = [
            [_reason(*of_camera) for of_camera in zip(used, told_too, row, one.reason, strict=True)]
            for used, told_too, row, one in zip(use.tolist(), others.tolist(), shots, expected, strict=True)
        ]
        good = good & within
        return [poses_of(fit, torch.tensor([n]), use[n], reasons[n]) if good[n] else None for n in range(asked)]

    def _approached(
        self,
        frames: Sequence[Sequence[Picture]],
        X: Tensor,
        R: Tensor,
        use: Tensor,
        precision: Tensor,
        rough: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Bring rough poses (B,) bool within reach of the finest detail, through coarser ones."""
        for level, every, iterations in ((self.fitter.optics.coarse, 1, 4), (self.fitter.optics.middle, 3, 3)):
            pixels = self.fitter.pixels(frames, X, level, self.fitter.widest_px)
            fit = self.fitter.fit(pixels.thinned(every), X, R, use, level, iterations, precision)
            X = torch.where(rough[:, None], self._from(fit.position_lab_mm), X)
            R = torch.where(rough[:, None, None], fit.R_lab_body, R)
        return X, R

    def _fitted(self, frames: Sequence[Sequence[Picture]], X: Tensor, R: Tensor, use: Tensor, precision: Tensor) -> Fit:
        """Fit poses that are about right: to some of the pixels, longer where that moves them, and then to all."""
        if self.place is None:
            # With all cameras the pictures tell the place; with one of two its distance is better known from before.
            precision = torch.where(use.all(1)[:, None, None], 0.0, precision)
        fine, widest = self.fitter.optics.fine, self.fitter.widest_px
        pixels = self.fitter.pixels(frames, X, fine, widest)
        some = pixels.thinned(FIRST_EVERY)
        fit = self.fitter.fit(some, X, R, use, fine, 1, precision)
        far = self._far(fit, use)
        if bool(far.any()):
            more = self.fitter.fit(some, self._from(fit.position_lab_mm), fit.R_lab_body, use, fine, 2, precision)
            fit = _chosen(far, more, fit)
            begin = torch.where(far[:, None], self._from(fit.position_lab_mm), X)
            pixels = self.fitter.pixels(frames, begin, fine, widest)
        fit = self.fitter.fit(pixels, self._from(fit.position_lab_mm), fit.R_lab_body, use, fine, 1, precision)
        far = self._far(fit, use)
        if bool(far.any()):
            more = self.fitter.fit(pixels, self._from(fit.position_lab_mm), fit.R_lab_body, use, fine, 3, precision)
            fit = _chosen(far, more, fit)
        return fit

    def _from(self, position_lab_mm: Tensor) -> Tensor:
        """Return where a further fit begins: where the last one ended (B, 3), or where the ball is in all frames.

        What is known beforehand is of that one place: a fit that began beside it would take that for known.
        """
        return position_lab_mm if self.place is None else self.place.position_lab_mm.expand_as(position_lab_mm)

    def _far(self, fit: Fit, use: Tensor) -> Tensor:
        """Fits whose last step was so long that another one is wanted, (B,) bool."""
        turn, move = fit.step[:, :3].norm(dim=-1), fit.step[:, 3:].norm(dim=-1)
        # One camera's distances scatter; what shows in its picture shows in the turn as well.
        far: Tensor = (turn > NEAR_RAD) | ((use.sum(1) > 1) & (move > NEAR_RAD * self.fitter.radius_mm))
        return far

    def _borne_out(self, fit: Fit, use: Tensor) -> Tensor:
        """Poses that have arrived and that all pictures in use explain well, (B,) bool."""
        explained = (fit.score >= self.score_min) | ~use
        arrived = fit.step[:, :3].norm(dim=-1) < ARRIVED_RAD
        good: Tensor = use.any(1) & explained.all(1) & arrived & ~self._contradictory(fit, use)
        return good

    def _contradictory(self, said: Fit | Poses, use: Tensor, limit: Tensor | float = 1.0) -> Tensor:
        """Poses of which two cameras say different things, (B,) bool: their pictures are not of one instant."""
        wrong = torch.zeros(len(use), dtype=torch.bool)
        for k, m in combinations(range(use.shape[1]), 2):
            apart = said.own_turn[:, k] - said.own_turn[:, m]
            spread = said.own_covariance[:, k] + said.own_covariance[:, m]
            away = (apart[:, None] @ torch.linalg.pinv(spread) @ apart[..., None])[:, 0, 0].clamp_min(0).sqrt()
            far = apart.norm(dim=-1) > limit * CONTRADICTS_USUAL * self.usual_apart_rad
            wrong = wrong | (use[:, k] & use[:, m] & far & (away > limit * CONTRADICTS_SIGMAS))
        return wrong

    def _search(self, shots: Sequence[Frame]) -> Poses:
        """Find the poses of a frame of which nothing is known, by those cameras whose pictures bear them out."""
        count = self.settings.candidates
        poses = initialise(
            self.fitter, self.proposers, shots, self.locating, candidates=count, score_min=self.clear_score
        )
        if not len(poses):
            return poses
        frames, usable = [shot.picture for shot in shots], torch.tensor([shot.usable for shot in shots])
        if self.place is not None:
            poses = self._moved_there(poses, frames)
        if bool((usable & ~poses.use).any()):
            poses = self._all_seeing(poses, frames, usable)
        seen = poses.use & (poses.score[0] >= self.score_min)
        reason = [
            Reason.LOW_SCORE if was and not now else why
            for was, now, why in zip(poses.use.tolist(), seen.tolist(), poses.reason, strict=True)
        ]
        if bool(self._contradictory(poses, seen.expand(len(poses), -1))[0]):
            return self._by_each(poses, frames, seen)
        if bool((seen == poses.use).all()) or not bool(seen.any()):
            # Nothing is thrown away where no camera is sure: the path decides.
            return replace(poses, use=seen, reason=tuple(reason))
        X, R = poses.position_lab_mm, poses.R_lab_body
        fit = self._looked_at(frames, X, R, seen.expand(len(poses), -1), self.fitter.optics.fine, 4)
        return poses_of(fit, fit.nll.argsort(stable=True), seen, reason)

    def _looked_at(
        self, frames: Sequence[Picture], X: Tensor, R: Tensor, use: Tensor, level: PyramidLevel, iterations: int
    ) -> Fit:
        """Fit poses to one frame, of which no other frame tells but where the ball is in all of them."""
        X = self._from(X)
        pixels = self.fitter.pixels([frames] * len(X), X, level)
        known = None if self.place is None else self.place.precision.expand(len(X), 3, 3)
        return self.fitter.fit(pixels, X, R, use, level, iterations, known)

    def _moved_there(self, poses: Poses, frames: Sequence[Picture]) -> Poses:
        """Fit poses again where the ball is in all frames."""
        R, optics = poses.R_lab_body, self.fitter.optics
        for level, iterations in ((optics.middle, 3), (optics.fine, 4)):
            fit = self._looked_at(frames, poses.position_lab_mm, R, poses.use.expand(len(R), -1), level, iterations)
            R = fit.R_lab_body
        order = explaining_first(fit.nll, fit.score[:, poses.use].mean(-1)).argsort(stable=True)
        return poses_of(fit, order, poses.use, poses.reason)

    def _by_each(self, poses: Poses, frames: Sequence[Picture], seen: Tensor) -> Poses:
        """Fit poses to each camera's picture alone; the first that bears one out counts, the others contradict."""
        X, R, fine = poses.position_lab_mm, poses.R_lab_body, self.fitter.optics.fine
        each = seen.expand(len(poses), -1)
        alone = [self._looked_at(frames, X, R, _only(each, k), fine, 4) for k in range(len(seen))]
        right = [bool(seen[k]) and bool(self._borne_out(one, _only(each, k))[0]) for k, one in enumerate(alone)]
        if not any(right):
            return poses
        main = right.index(True)
        fit = alone[main]
        for k, one in enumerate(alone):
            if k != main and right[k]:
                fit = _beside(fit, one, torch.ones(len(poses), dtype=torch.bool), k)
        reason = [
            Reason.OK if k == main else Reason.CONTRADICTS if right[k] else why for k, why in enumerate(poses.reason)
        ]
        return poses_of(fit, fit.nll.argsort(stable=True), _only(each, main)[0], reason)

    def _all_seeing(self, poses: Poses, frames: Sequence[Picture], usable: Tensor) -> Poses:
        """Fit poses to all pictures, where that explains all: a disk without an outline may still be there."""
        X, R, optics = poses.position_lab_mm, poses.R_lab_body, self.fitter.optics
        every = usable.expand(len(poses), -1)
        for level, iterations in ((optics.coarse, 4), (optics.middle, 3), (optics.fine, 3)):
            fit = self._looked_at(frames, X, R, every, level, iterations)
            X, R = fit.position_lab_mm, fit.R_lab_body
        order = fit.nll.argsort(stable=True)
        if not bool(self._borne_out(fit, every)[order[0]]):
            return poses
        return poses_of(
            fit, order, usable, [Reason.OK if ok else why for ok, why in zip(usable, poses.reason, strict=True)]
        )


def _only(usable: Tensor, camera: int) -> Tensor:
    """Leave one camera of those usable (B, C)."""
    only = torch.zeros_like(usable)
    only[:, camera] = usable[:, camera]
    return only


def _beside(fit: Fit, other: Fit, rows: Tensor, camera: int) -> Fit:
    """Put what a camera says by itself beside poses (B,) that it has no part in."""
    if not bool(rows.any()):
        return fit
    own = {
        "own_turn": so3.log(other.R_lab_body @ fit.R_lab_body.mT),
        "own_move": other.position_lab_mm - fit.position_lab_mm,
        **{name: getattr(other, name)[:, camera] for name in ("own_covariance", "deviation", "score")},
    }
    told = {name: getattr(fit, name).clone() for name in own}
    for name, value in own.items():
        told[name][rows, camera] = value[rows]
    return replace(fit, **told)


def _reason(used: bool, contradicts: bool, shot: Frame, before: Reason) -> Reason:
    """Say why a camera does not count: its picture is none, it says something else, or it was blind before."""
    if used:
        return Reason.OK
    if contradicts:
        return Reason.CONTRADICTS
    if not shot.usable:
        return shot.reason
    return before if before in (Reason.NOT_FOUND, Reason.OUTLINE) else Reason.LOW_SCORE


def _chosen(rows: Tensor, one: Fit, other: Fit) -> Fit:
    """Return one fit where the mask (B,) holds and the other elsewhere."""
    parts = {}
    for name in one.__dataclass_fields__:
        a, b = getattr(one, name), getattr(other, name)
        parts[name] = torch.where(rows.reshape(-1, *[1] * (a.ndim - 1)), a, b)
    return Fit(**parts)
