"""Poses of all frames: a full search where a block of frames begins, then each frame from the one before it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.locate import LocateSettings
from sphereorient.orient.cold import Poses, cold_start, poses_of
from sphereorient.orient.eye import Fitter, Picture
from sphereorient.orient.proposer import Proposer
from sphereorient.orient.settings import RefineSettings
from sphereorient.orient.study import Study
from sphereorient.trajectory import Reason

CLOSE_STEP_RAD = 0.02  # a fit whose last step is longer has not arrived


@dataclass(eq=False)
class _Lane:
    """One block on its way: the last poses, in the order of their frames."""

    first: int
    last: int  # + 1
    past: deque[tuple[int, Tensor, Tensor]] = field(default_factory=lambda: deque(maxlen=3))

    def predicted(self, frame: int) -> tuple[Tensor, Tensor] | None:
        """Pose expected in a frame: place and turn go on, the turn's change too where three frames tell it."""
        if len(self.past) < 2 or self.past[-1][0] != frame - 1 or self.past[-2][0] != frame - 2:
            return None
        (_, X1, R1), (_, X0, R0) = self.past[-1], self.past[-2]
        turn, move = so3.log(R1 @ R0.mT), X1 - X0
        if len(self.past) == 3 and self.past[0][0] == frame - 3:
            turn = 2 * turn - so3.log(R0 @ self.past[0][2].mT)
            move = 2 * move - (X0 - self.past[0][1])
        return X1 + move, so3.exp(turn) @ R1

    def saw(self, frame: int, poses: Poses) -> None:
        """Remember the best pose of a frame, if it has one and only one that matters."""
        if len(poses):
            self.past.append((frame, poses.position_lab_mm[0], poses.R_lab_body[0]))


class BlockTracker:
    """Follows the ball through blocks of frames, each block by itself.

    A block begins with a search that knows nothing, and ends with its last frame: where blocks begin is a matter of
    frame numbers alone, so no chunk, worker or restart can change a result, and a pose gone wrong ends there at last.

    Args:
        learnt: blur, light and scores of the movies.
        proposers: by name of eye.
        locating: how outlines are found.
        settings: blocks and lanes.
    """

    def __init__(
        self,
        learnt: Study,
        proposers: Mapping[str, Proposer],
        locating: LocateSettings,
        settings: RefineSettings,
    ) -> None:
        self.fitter: Fitter = learnt.fitter
        self.score_min = learnt.score_min
        self.proposers = proposers
        self.locating = locating
        self.settings = settings

    def windows(self, frames: range) -> list[list[int]]:
        """Return the lengths of the blocks that are followed side by side, window by window.

        Args:
            frames: the experiment's frame numbers; those that are multiples of the setting begin a block.
        """
        length = self.settings.block_frames
        firsts = [frames.start, *range((frames.start // length + 1) * length, frames.stop, length)] if frames else []
        lengths = [last - first for first, last in pairwise([*firsts, frames.stop])]
        return [lengths[k : k + self.settings.lanes] for k in range(0, len(lengths), self.settings.lanes)]

    def track(self, pictures: Sequence[Sequence[Picture]], window: Sequence[int]) -> Iterator[Poses]:
        """Follow the blocks of one window.

        Args:
            pictures: of each eye, the frames of these blocks in order.
            window: lengths of the blocks.

        Yields:
            The poses of each frame, in order.
        """
        firsts = list(accumulate([0, *window[:-1]]))
        lanes = [_Lane(first, first + length) for first, length in zip(firsts, window, strict=True)]
        found: dict[int, Poses] = {}
        for k in range(max(window)):
            now = [lane for lane in lanes if lane.first + k < lane.last]
            frames = {lane.first: [movie[lane.first + k] for movie in pictures] for lane in now}
            for lane, poses in zip(now, self._step(now, k, frames), strict=True):
                lane.saw(lane.first + k, poses)
                found[lane.first + k] = poses
        yield from (found[k] for k in range(sum(window)))

    def _step(self, lanes: Sequence[_Lane], k: int, frames: Mapping[int, Sequence[Picture]]) -> Iterator[Poses]:
        """Measure one frame of each lane: predicted where that holds, searched for where not."""
        expected = [lane.predicted(lane.first + k) for lane in lanes]
        ahead = [n for n, pose in enumerate(expected) if pose is not None]
        followed = dict(
            zip(ahead, self._follow([expected[n] for n in ahead], [frames[lanes[n].first] for n in ahead]), strict=True)
        )
        for n, lane in enumerate(lanes):
            poses = followed.get(n)
            if poses is None:
                poses = cold_start(
                    self.fitter,
                    self.proposers,
                    frames[lane.first],
                    self.locating,
                    candidates=self.settings.candidates,
                )
                poses = self._believable(poses)
            yield poses

    def _follow(
        self, expected: Sequence[tuple[Tensor, Tensor]], frames: Sequence[Sequence[Picture]]
    ) -> list[Poses | None]:
        """Fit expected poses, all in one batch of fixed size; None where the pictures do not bear one out."""
        if not expected:
            return []
        asked = len(expected)
        filled = [*expected, *[expected[-1]] * (self.settings.lanes - asked)]
        frames = [*frames, *[frames[-1]] * (self.settings.lanes - asked)]
        X, R = (torch.stack(parts) for parts in zip(*filled, strict=True))
        fitter, fine = self.fitter, self.fitter.optics.fine
        use = torch.ones(len(X), len(fitter.eyes), dtype=torch.bool)
        pixels = fitter.pixels(frames, X, fine)
        half = pixels.every(torch.arange(0, pixels.grey.shape[1], 2))
        fit = fitter.fit(half, X, R, use, fine, 1)
        fit = fitter.fit(pixels, fit.position_lab_mm, fit.R_lab_body, use, fine, 1)
        seen = fit.score >= self.score_min
        if not bool(seen[:asked].all()):
            again = fitter.fit(pixels, X, R, seen, fine, 2)
            part = ~seen.all(1)
            fit = replace(
                fit,
                **{
                    name: torch.where(_tall(part, getattr(fit, name)), getattr(again, name), getattr(fit, name))
                    for name in fit.__dataclass_fields__
                },
            )
        arrived = (fit.step[:, :3].norm(dim=-1) < CLOSE_STEP_RAD) & seen.any(1)
        reasons = [[Reason.OK if ok else Reason.LOW_SCORE for ok in row] for row in seen.tolist()]
        return [poses_of(fit, torch.tensor([n]), seen[n], reasons[n]) if arrived[n] else None for n in range(asked)]

    def _believable(self, poses: Poses) -> Poses:
        """Say which cameras' pictures the best pose explains; nothing is thrown away, the path decides."""
        if not len(poses):
            return poses
        use = poses.use & (poses.score[0] >= self.score_min)
        reason = [
            Reason.LOW_SCORE if was and not now else why
            for was, now, why in zip(poses.use.tolist(), use.tolist(), poses.reason, strict=True)
        ]
        return replace(poses, use=use, reason=tuple(reason))


def _tall(rows: Tensor, like: Tensor) -> Tensor:
    """Stretch a mask (B,) over the trailing axes of another tensor."""
    return rows.reshape(-1, *[1] * (like.ndim - 1))
