"""Poses of one ball in single frames: predicted from the frames before, or by a search."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import Reason
from sphereorient.follow.appearance import Appearance
from sphereorient.follow.chunk import Ahead, Chunk, Expected
from sphereorient.follow.fixed_centre import FixedCentre
from sphereorient.follow.initialise import LOOSE, Initialiser, by_decreasing_size, explaining_first
from sphereorient.follow.settings import RefineSettings
from sphereorient.locate import Frame
from sphereorient.pose.camera_view import SIZES, Picture, Shown, size_steps
from sphereorient.pose.fit import HOPELESS
from sphereorient.pose.fitter import DisksPx, Fitter, Steps
from sphereorient.pose.neighbours import Neighbours, joined_neighbours
from sphereorient.pose.poses import FittedPoses, Poses, PoseStart, no_pose, poses_of, supported

Floats = NDArray[np.float64]

ARRIVED_RAD = 0.02  # a fit whose last step is longer has not converged
MORE_THAN_USUAL = 0.5  # excess of unexplained variance of a doubtful fit, which is repeated
CONTRADICTS_USUAL = 4.0  # times the usual angle between rotations by each camera alone, and
CONTRADICTS_SIGMAS = 2.8  # of these rotations: above both, the pictures are of different instants
LEAST_VISIBLE = 0.08  # least share of a disk not hidden by other spheres for a camera to be used
HIDDEN_LESS = 0.5  # decrease of the least score with the share of a disk that others hide
SILENT = 0.4  # share of a disk; for less the score may be 0, as for unknown paint
AGREES_AGAIN = 0.5  # of these limits, for cameras that contradicted each other before
# Results of a camera alone, besides rotation and displacement from the pose.
OWN = ("own_covariance", "own_sigma_mm", "limb_coverage", "excess", "score")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Predicted:
    """B predictions of a ball, with the pictures of C cameras."""

    frames: Sequence[Sequence[Frame]]  # B of C
    pictures: Sequence[Sequence[Shown]]
    position_lab_mm: Tensor  # (B, 3)
    R_lab_body: Tensor  # (B, 3, 3)
    precision: Tensor  # (B, 3, 3), mm^-2, of the position
    start: partial[PoseStart]  # of a fit, without pose and use
    known: Tensor  # (B, C) bool, cameras that saw the ball before
    readable: Tensor  # (B, C) bool
    sees: Tensor  # (B, C) bool, cameras in which other balls do not hide too much of it
    contradicted: Tensor  # (B,) bool, a camera contradicted the others before
    beyond: Tensor  # (B,) bool, disks larger than the stencil, see `BallTracker._wider`
    disks_px: DisksPx
    visible: Tensor | None  # (B, C), share of the disks not hidden by other balls; None: all


class _Found(NamedTuple):
    """Fits of B predictions, cameras in use (B, C) bool, whether these support the fit (B,), and cameras (B, C) with a
    picture that can show the ball.
    """

    fit: FittedPoses
    use: Tensor
    good: Tensor
    usable: Tensor

    @property
    def unused(self) -> Tensor:
        """Usable cameras (B, C) that are not in use."""
        return self.usable & ~self.use


class BallTracker:
    """Measures one ball in frames of several chunks at a time; see `Tracker`. `centre`: of a ball that only rotates;
    None: each frame has its own position.
    """

    def __init__(
        self,
        appearance: Appearance,
        search: Initialiser,
        settings: RefineSettings,
        exposure_s: float = 0.0,
        centre: FixedCentre | None = None,
    ) -> None:
        self.fitter: Fitter = appearance.fitter
        self.search = replace(search, fitter=appearance.still, score_min=appearance.clear_score)
        self.score_min = appearance.score_min
        self.usual_score = appearance.usual_score
        self.usual_apart_rad = appearance.usual_apart_rad
        self.settings = settings
        self.exposure_s = exposure_s
        self.centre = centre
        self._of_size: dict[int, BallTracker] = {}

    def turns(self, chunks: Sequence[Chunk], found: Sequence[Poses]) -> Floats:
        """Return the rotation of each chunk's ball since its last pose, (n, 3), rad, lab; 0 if there is none."""
        turns = np.tile(np.eye(3), (self._lanes(len(chunks)), 1, 1))
        for row, (chunk, poses) in enumerate(zip(chunks, found, strict=True)):
            if chunk.past and supported(poses):
                turns[row] = poses.R_lab_body[0].numpy() @ chunk.past[-1][1].R_lab_body[0].numpy().T
        return so3.log(torch.from_numpy(turns))[: len(chunks)].numpy()

    def _disks_px(self, position_lab_mm: Tensor) -> DisksPx:
        """Return the disks of positions (n, 3); those of a fixed centre are computed once."""
        if self.centre is None:
            return self.fitter.disks_px(position_lab_mm)
        middles, radius, _ = self._disks_of_centre
        return DisksPx(middles.expand(-1, len(position_lab_mm), -1), radius.expand(len(position_lab_mm)))

    @cached_property
    def _disks_of_centre(self) -> DisksPx:
        assert self.centre is not None
        return self.fitter.disks_px(self.centre.position_lab_mm[None])

    def _lanes(self, count: int) -> int:
        """Return the fixed size of batches: the last bits depend on it."""
        return max(count, self.settings.chunks)

    def ahead(self, chunk: Chunk, frame: int) -> Expected | None:
        """Return the prediction of a frame of a chunk."""
        pose = chunk.expected(frame, self.fitter.radius_mm, self.exposure_s)
        if pose is None or self.centre is None:
            return pose
        place, spread = self.centre.position_lab_mm.numpy(), self.centre.spread_mm2.numpy()
        return replace(pose, position_lab_mm=place, place_spread=spread)

    def follow(self, expected: Sequence[Expected], frames: Sequence[Sequence[Frame]]) -> list[Poses | None]:
        """Fit predicted poses in one batch of fixed size; None if the pictures do not support a pose."""
        if not expected:
            return []
        asked, missing = len(expected), self._lanes(len(expected)) - len(expected)
        expected, frames = [*expected, *[expected[-1]] * missing], [*frames, *[frames[-1]] * missing]
        there = self._predicted(expected, frames)
        first = self._first_fit(there)
        found, alone = self._with_fewer(there, first)
        found, doubtful = self._with_more(there, found)
        # Test another camera only if this frame needs it: results must not depend on the batch.
        others = (found.good & (~first.good | there.contradicted | doubtful))[:, None] & found.unused
        fit = found.fit
        for k in range(others.shape[1] if bool(others.any()) else 0):
            only = _only(found.usable, [k])
            one = alone[k] if alone else self._fitted(there, there.position_lab_mm, there.R_lab_body, only)
            others[:, k] &= self._supported(one, only, there.visible)
            fit = _beside(fit, one, others[:, k], k)
        reasons = [
            [_reason(*of_camera) for of_camera in zip(*seen, row, one.reason, strict=True)]
            for *seen, row, one in zip(
                found.use.tolist(), others.tolist(), there.sees.tolist(), frames, expected, strict=True
            )
        ]
        poses = [
            poses_of(fit, slice(n, n + 1), found.use[n], reasons[n]) if found.good[n] else None for n in range(asked)
        ]
        for n in torch.nonzero(there.beyond[:asked])[:, 0].tolist():
            (poses[n],) = self._wider(float(there.disks_px.largest_px[n])).follow([expected[n]], [frames[n]])
        return poses

    def followed(self, expected: Expected, frames: Sequence[Frame]) -> Poses | None:
        """Fit the predicted pose of one frame, as `follow`; None at once if no picture shows anything similar."""
        pictures = [[shot.shown for shot in frames]]
        contradicted = Reason.CONTRADICTS in expected.reason
        if not contradicted and bool(expected.use.all()) and all(shot.readable for shot in frames):
            use = expected.use[None]
            X, R, precision, moved = self._begun([expected], pictures, use, None)
            disks_px = self._disks_px(X)
            if float(disks_px.largest_px) <= self.fitter.widest_px:
                start = PoseStart(X, R, use, precision, moved, held=self.centre is not None)
                fit = self.fitter.settled(pictures, start, disks_px)
                if fit.score.numpy().max() < HOPELESS:
                    return None
                if not bool(self._poor(fit, use)) and bool(self._supported(fit, use)):
                    return poses_of(fit, slice(1), expected.use, [Reason.OK] * len(frames))
        (poses,) = self.follow([expected], [frames])
        return poses

    def spotted(self, frames: Sequence[Frame]) -> Poses:
        """Find the pose of a frame without history by the ball's blob, in a quarter of the time of `searched`, which
        also finds a ball with others beside or in front of it.
        """
        there = self.search.glanced(frames, None if self.centre is None else self.centre.position_lab_mm)
        if not bool(there.use.any()) or not len(there):
            return there
        spread = (LOOSE * self.fitter.radius_mm) ** 2 * torch.eye(3).double()
        begin = Expected(
            position_lab_mm=there.position_lab_mm[0].numpy(),
            R_before=there.R_lab_body[0].numpy(),
            turn=np.zeros(3),
            use=there.use,
            reason=there.reason,
            place_spread=(spread if self.centre is None else self.centre.spread_mm2).numpy(),
            rough=False,
            moved=np.zeros(6),
            open_share=0.0,
        )
        return self.followed(begin, frames) or no_pose(len(frames), there.reason)

    def _begun(
        self,
        expected: Sequence[Expected],
        pictures: Sequence[Sequence[Shown]],
        use: Tensor,
        among: Neighbours | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the start of fits: position (B, 3), mm, rotation (B, 3, 3), precision of the position (B, 3, 3),
        mm^-2, and motion during the exposure (B, 6). Rough predictions are first improved by coarse fits.
        """
        X, R_before, turn, spread, moved = (
            torch.from_numpy(np.stack([getattr(one, name) for one in expected]))
            for name in ("position_lab_mm", "R_before", "turn", "place_spread", "moved")
        )
        R, precision = so3.exp(turn) @ R_before, torch.from_numpy(np.linalg.inv(spread.numpy()))
        if any(one.rough for one in expected):
            was, rough = (X, R), torch.tensor([one.rough for one in expected])
            X, R = self._approached(pictures, (X, R), use, precision, rough, among)
            share = torch.tensor([[one.rough * one.open_share] for one in expected], dtype=X.dtype)
            moved = moved + share * torch.cat([so3.log(R @ was[1].mT), X - was[0]], dim=-1)
        return X, R, precision, moved

    def _predicted(self, expected: Sequence[Expected], frames: Sequence[Sequence[Frame]]) -> _Predicted:
        """Return the predictions, and the pictures that may show the ball."""
        known, among = torch.stack([one.use for one in expected]), joined_neighbours([one.among for one in expected])
        pictures = [[shot.shown for shot in row] for row in frames]
        readable = torch.tensor([[shot.readable for shot in row] for row in frames])
        X, R, precision, moved = self._begun(expected, pictures, known & readable, among)
        disks_px = self._disks_px(X)
        if among is not None:
            disks_px = disks_px._replace(spoilt=self.fitter.spoilt(X, disks_px, moved, among))
        visible = None if disks_px.spoilt is None else disks_px.spoilt.left
        return _Predicted(
            frames=frames,
            pictures=pictures,
            position_lab_mm=X,
            R_lab_body=R,
            precision=precision,
            start=partial(PoseStart, place_precision=precision, moved=moved, held=self.centre is not None, among=among),
            known=known,
            readable=readable,
            sees=torch.ones_like(known) if visible is None else visible > LEAST_VISIBLE,
            contradicted=torch.tensor([Reason.CONTRADICTS in one.reason for one in expected]),
            beyond=disks_px.largest_px > self.fitter.widest_px,
            disks_px=disks_px,
            visible=visible,
        )

    def _first_fit(self, there: _Predicted) -> _Found:
        """Fit the pictures of all cameras that saw the ball before."""
        X, R, disks_px, visible = there.position_lab_mm, there.R_lab_body, there.disks_px, there.visible
        usable = there.readable & there.sees
        use = there.known & usable
        fit = self._fitted(there, X, R, use, disks_px)
        if visible is None and bool((poor := self._poor(fit, use)).any()):
            # With sharp pictures the fit may stay at its start: repeat it from coarse to fine.
            which = poor.nonzero()[:, 0]
            some, pictures = there.start(X, R, use).of(which), [there.pictures[k] for k in which.tolist()]
            at = some.position_lab_mm, some.R_lab_body
            near, turned = self._approached(pictures, at, some.use, there.precision[which], poor[which], None)
            again = self.fitter.settled(pictures, replace(some, position_lab_mm=self._from(near), R_lab_body=turned))
            better = (again.score * some.use).sum(1) > (fit.score * use)[which].sum(1)
            fit = fit.with_rows(which[better].tolist(), again.of(better))
        good = self._supported(fit, use, visible)
        if not bool(good.all()):
            # Testing for dark or white pictures decodes them whole: only if a picture is not as expected.
            rows = zip(usable, good.tolist(), there.frames, strict=True)
            usable = there.sees & torch.stack([all_ if ok else _usable(row) for all_, ok, row in rows])
            changed = (use != (there.known & usable)).any(1)
            if bool(changed.any()):
                use = there.known & usable
                fit = self._fitted(there, X, R, use, disks_px).where(changed, fit)
                good = torch.where(changed, self._supported(fit, use, visible), good)
        return _Found(fit, use, good, usable)

    def _with_fewer(self, there: _Predicted, found: _Found) -> tuple[_Found, dict[int, FittedPoses]]:
        """Leave out as few cameras as possible if a picture without the ball spoils the joint fit; among subsets of one
        size, the fit nearest the prediction is taken. Return also the fits of single cameras.
        """
        fit, use, good, usable = found
        X, R = there.position_lab_mm, there.R_lab_body
        alone: dict[int, FittedPoses] = {}
        for some in by_decreasing_size(range(use.shape[1])):
            if bool((good | there.beyond).all()):
                break
            fits = [self._fitted(there, X, R, _only(usable, one), there.disks_px) for one in some]
            holds = [
                self._supported(fit_, _only(usable, one), there.visible) & usable[:, one].all(1)
                for one, fit_ in zip(some, fits, strict=True)
            ]
            astray = [
                torch.where(right, so3.geodesic_distance(one.R_lab_body, R), torch.inf)
                for one, right in zip(fits, holds, strict=True)
            ]
            nearest, which = torch.stack(astray).min(0)
            for k, one in enumerate(fits):
                chosen = ~good & torch.isfinite(nearest) & (which == k)
                fit, use = one.where(chosen, fit), torch.where(chosen[:, None], _only(usable, some[k]), use)
            good = good | torch.isfinite(nearest)
            alone = {k: one for (k, *rest), one in zip(some, fits, strict=True) if not rest}
        return _Found(fit, use, good, usable), alone

    def _with_more(self, there: _Predicted, found: _Found) -> tuple[_Found, Tensor]:
        """Test cameras that did not see the ball before at the joint pose. Return also for which frames, (B,) bool,
        they contradict the others.
        """
        fit, use, good, usable = found
        if not bool(found.unused.any()):
            return found, torch.zeros_like(good)
        both = self._fitted(there, fit.position_lab_mm, fit.R_lab_body, usable)
        unused = good & found.unused.any(1)
        limit = torch.where(there.contradicted, AGREES_AGAIN, 1.0)
        contradicts = self.contradictory(both, usable, limit)
        back = unused & self._supported(both, usable, there.visible) & ~contradicts
        fit, use = both.where(back, fit), torch.where(back[:, None], usable, use)
        several = good & ~back & ((usable & ~use).sum(1) > 1)
        for k in range(use.shape[1] if bool(several.any()) else 0):
            # Some of several such cameras may see it.
            rows = several & (usable & ~use)[:, k]
            wider = torch.where(rows[:, None], use | _only(usable, [k]), use)
            both = self._fitted(there, fit.position_lab_mm, fit.R_lab_body, wider)
            rows &= self._supported(both, wider, there.visible) & ~self.contradictory(both, wider, limit)
            fit, use = both.where(rows, fit), torch.where(rows[:, None], wider, use)
        return _Found(fit, use, good, usable), unused & contradicts

    def _wider(self, radius_px: float) -> "BallTracker":
        """Return a tracker of single frames for a disk larger than those of the appearance."""
        steps = size_steps(radius_px / self.fitter.widest_px)
        if steps not in self._of_size:
            wider = self._of_size[steps] = copy(self)
            wider.fitter = replace(self.fitter, widest_px=self.fitter.widest_px * SIZES**steps)
            wider.settings, wider._of_size = self.settings.model_copy(update={"chunks": 1}), {}
        return self._of_size[steps]

    def _poor(self, fit: FittedPoses, use: Tensor) -> Tensor:
        """Return which poses (B,) leave much more of a picture in use unexplained than right poses usually do."""
        return ((1.0 - fit.score > MORE_THAN_USUAL * (1.0 - self.usual_score)) & use).any(1)

    def _approached(
        self,
        pictures: Sequence[Sequence[Shown]],
        poses: tuple[Tensor, Tensor],
        use: Tensor,
        precision: Tensor,
        rough: Tensor,
        among: Neighbours | None,
    ) -> tuple[Tensor, Tensor]:
        """Fit rough poses, (B,) bool, at coarser levels, to bring them into the basin of the finest level."""
        X, R = poses
        for level, every, iterations in ((self.fitter.optics.coarse, 1, 4), (self.fitter.optics.middle, 3, 3)):
            pixels = self.fitter.pixels(pictures, X, level, self.fitter.widest_px, neighbours=among)
            fit = self.fitter.fit(pixels.thinned(every), PoseStart(X, R, use, precision), level, iterations)
            X = torch.where(rough[:, None], self._from(fit.position_lab_mm), X)
            R = torch.where(rough[:, None, None], fit.R_lab_body, R)
        return X, R

    def _fitted(
        self, there: _Predicted, X: Tensor, R: Tensor, use: Tensor, disks_px: DisksPx | None = None
    ) -> FittedPoses:
        """Fit poses that are nearly right."""
        begin = there.start(position_lab_mm=self._from(X), R_lab_body=R, use=use)
        return self.fitter.settled(there.pictures, begin, disks_px)

    def _from(self, position_lab_mm: Tensor) -> Tensor:
        """Return the start (B, 3) of a further fit: the last result, or the fixed centre."""
        return position_lab_mm if self.centre is None else self.centre.position_lab_mm.expand_as(position_lab_mm)

    def _supported(self, fit: FittedPoses, use: Tensor, visible: Tensor | None = None) -> Tensor:
        """Return which poses have converged and explain all pictures in use well, (B,) bool. The limit is lower for
        disks with a visible share `visible` (B, C) below 1, and absent if that is too little for a score.
        """
        seen = use.numpy()
        explained = (fit.score.numpy() >= self.score_min) | ~seen
        if visible is not None:
            left, score = visible.numpy(), fit.score.numpy()
            explained |= (score >= self.score_min - HIDDEN_LESS * (1.0 - left)) & (left < 1.0)
            explained |= (score == 0) & (left < SILENT)
        arrived = np.linalg.norm(fit.step.numpy()[:, :3], axis=-1) < ARRIVED_RAD
        if visible is not None:  # little visible paint may not determine the pose at all
            arrived &= ((score > 0) & seen).any(1) & np.isfinite(fit.covariance.numpy()).all((1, 2))
        good = torch.from_numpy(seen.any(1) & explained.all(1) & arrived)
        return good if use.shape[1] == 1 else good & ~self.contradictory(fit, use)

    def contradictory(self, said: FittedPoses | Poses, use: Tensor, limit: Tensor | float = 1.0) -> Tensor:
        """Return for which poses two cameras disagree, (B,) bool: their pictures are of different instants."""
        wrong = torch.zeros(len(use), dtype=torch.bool)
        for k, m in combinations(range(use.shape[1]), 2):
            apart = said.own_turn[:, k] - said.own_turn[:, m]
            spread = said.own_covariance[:, k] + said.own_covariance[:, m]
            away = (apart[:, None] @ torch.linalg.pinv(spread) @ apart[..., None])[:, 0, 0].clamp_min(0).sqrt()
            far = apart.norm(dim=-1) > limit * CONTRADICTS_USUAL * self.usual_apart_rad
            wrong = wrong | (use[:, k] & use[:, m] & far & (away > limit * CONTRADICTS_SIGMAS))
        return wrong

    def start(
        self, frames: Sequence[Frame], names: Sequence[str], known: Mapping[str, Tensor], past: Mapping[str, Ahead]
    ) -> dict[str, Poses]:
        """Find a ball alone in the scene; `SceneStart` finds several."""
        return dict.fromkeys(names, self.searched(frames))

    def searched(self, frames: Sequence[Frame]) -> Poses:
        """Find the poses of a frame without history, in the cameras whose pictures support them."""
        poses = self.search.poses(frames)
        if not len(poses):
            return poses
        pictures, usable = [shot.picture for shot in frames], _usable(frames)
        if self.centre is not None:
            optics = self.search.fitter.optics
            fit = self._looked_at(pictures, poses, poses.use, ((optics.middle, 1, 3), (optics.fine, 1, 4)))
            order = explaining_first(fit, poses.use).argsort(stable=True)
            poses = poses_of(fit, order, poses.use, poses.reason)
        if bool((usable & ~poses.use).any()):
            poses = self._all_seeing(poses, pictures, usable)
        seen = poses.use & (poses.score[0] >= self.score_min)
        reason = [
            Reason.LOW_SCORE if was and not now else why
            for was, now, why in zip(poses.use.tolist(), seen.tolist(), poses.reason, strict=True)
        ]
        if not bool(seen.any()):
            return no_pose(len(frames), reason)
        if bool(self.contradictory(poses, seen.expand(len(poses), -1))[0]):
            return self._by_each(poses, pictures, seen)
        if bool((seen == poses.use).all()):
            return poses
        fit = self._looked_at(pictures, poses, seen, ((self.search.fitter.optics.fine, 1, 4),))
        return poses_of(fit, fit.nll.argsort(stable=True), seen, reason)

    def looked_past(self, poses: Poses, frames: Sequence[Frame], among: Neighbours) -> Poses:
        """Fit M poses found by a search, with the other balls `among`, of one pose, in the cameras that see this one;
        cameras that support none are left out.
        """
        fitter, count = self.search.fitter, len(poses)
        pictures, X = [shot.picture for shot in frames], poses.position_lab_mm[:1]
        visible = self.fitter.spoilt(X, fitter.disks_px(X), None, among).left[0]
        use, every = poses.use & (visible > LEAST_VISIBLE), among.of([0] * count)
        if not bool(use.any()):
            return replace(poses, use=use)
        fit = self._looked_at(pictures, poses, use, ((fitter.optics.fine, 1, 4),), every)
        order = explaining_first(fit, use).argsort(stable=True)
        best = fit.of(order[:1])
        seen = use & (best.score[0] > 0) & (best.score[0] >= self.score_min - HIDDEN_LESS * (1.0 - visible))
        seen &= torch.isfinite(best.covariance).all()
        reason = [
            Reason.OK if now else Reason.HIDDEN if covered else Reason.LOW_SCORE if why is Reason.OK else why
            for now, covered, why in zip(seen.tolist(), (visible <= LEAST_VISIBLE).tolist(), poses.reason, strict=True)
        ]
        if bool(seen.any()) and not bool((seen == use).all()):
            fit = self._looked_at(pictures, poses, seen, ((fitter.optics.fine, 1, 4),), every)
            order = explaining_first(fit, seen).argsort(stable=True)
        return poses_of(fit, order, seen, reason)

    def _looked_at(
        self, pictures: Sequence[Picture], poses: Poses, use: Tensor, steps: Steps, among: Neighbours | None = None
    ) -> FittedPoses:
        """Fit M poses to the pictures in use, (C,) or (M, C), step by step."""
        X, R, count = self._from(poses.position_lab_mm), poses.R_lab_body, len(poses)
        known = None if self.centre is None else self.centre.precision.expand(count, 3, 3)
        begin = PoseStart(X, R, use.expand(count, -1), known, held=self.centre is not None, among=among)
        return self.search.fitter.fit_through(steps, [pictures] * count, begin)

    def _by_each(self, poses: Poses, pictures: Sequence[Picture], seen: Tensor) -> Poses:
        """Fit poses to the largest set of cameras that supports one, of equal sets the first; the others contradict."""
        each = seen.expand(len(poses), -1)
        steps = ((self.search.fitter.optics.fine, 1, 4),)

        def supporting(some: Sequence[Sequence[int]]) -> dict[tuple[int, ...], FittedPoses]:
            fits = {tuple(one): self._looked_at(pictures, poses, _only(each, one), steps) for one in some}
            return {one: fit for one, fit in fits.items() if bool(self._supported(fit, _only(each, one))[0])}

        seeing = torch.nonzero(seen)[:, 0].tolist()
        right = next(filter(None, map(supporting, by_decreasing_size(seeing))), None)
        if right is None:
            return poses
        main, fit = next(iter(right.items()))
        alone = right if len(main) == 1 else supporting([[k] for k in seeing if k not in main])
        others = {k: one for (k,), one in alone.items() if k not in main}
        for k, one in others.items():
            fit = _beside(fit, one, torch.ones(len(poses), dtype=torch.bool), k)
        reason = [
            Reason.OK if k in main else Reason.CONTRADICTS if k in others else why for k, why in enumerate(poses.reason)
        ]
        return poses_of(fit, fit.nll.argsort(stable=True), _only(each, main)[0], reason)

    def _all_seeing(self, poses: Poses, pictures: Sequence[Picture], usable: Tensor) -> Poses:
        """Fit poses to all pictures; kept if that explains all, as a disk without an outline may be visible."""
        fit = self._looked_at(pictures, poses, usable, self.search.fitter.optics.steps)
        order = fit.nll.argsort(stable=True)
        if not bool(self._supported(fit, usable.expand(len(poses), -1))[order[0]]):
            return poses
        reason = [Reason.OK if ok else why for ok, why in zip(usable, poses.reason, strict=True)]
        return poses_of(fit, order, usable, reason)


def _usable(frames: Sequence[Frame]) -> Tensor:
    return torch.tensor([shot.usable for shot in frames])


def _only(usable: Tensor, cameras: Sequence[int]) -> Tensor:
    only, some = torch.zeros_like(usable), list(cameras)
    only[:, some] = usable[:, some]
    return only


def _beside(fit: FittedPoses, other: FittedPoses, rows: Tensor, camera: int) -> FittedPoses:
    """Record the results of a camera that did not contribute to poses (B,)."""
    if not bool(rows.any()):
        return fit
    own = {
        "own_turn": so3.log(other.R_lab_body @ fit.R_lab_body.mT),
        "own_move": other.position_lab_mm - fit.position_lab_mm,
        **{name: getattr(other, name)[:, camera] for name in OWN},
    }
    parts = {name: getattr(fit, name).clone() for name in own}
    for name, value in own.items():
        parts[name][rows, camera] = value[rows]
    return replace(fit, **parts)


def _reason(used: bool, contradicts: bool, sees: bool, shot: Frame, before: Reason) -> Reason:
    if used:
        return Reason.OK
    if not sees:
        return Reason.HIDDEN
    if contradicts:
        return Reason.CONTRADICTS
    if not shot.usable:
        return shot.reason
    return before if before in (Reason.NOT_FOUND, Reason.OUTLINE) else Reason.LOW_SCORE
