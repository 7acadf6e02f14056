"""Rotation since the first frame without a map, of a ball that stays in its place: pictures against those before."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import Reason
from sphereorient.locate import Frame
from sphereorient.mapping.chain import EVERY, ITERATIONS, OVERLAP_MIN, SCALE_RAD, SEARCH_EVERY, SEARCH_STEP_DEG, SMALLER
from sphereorient.mapping.disks import Crop, Crops, Disks, disks_of, reduced
from sphereorient.mapping.pairs import RelativeRotations, refine_pairs, search_pairs
from sphereorient.mapping.settings import MapSettings
from sphereorient.pose.poses import Poses, blank_parts, no_pose

NEAREST = 3  # keyframes that a picture is compared with, beside the one before
KEYFRAMES = 200  # at most: a ball has shown its sides by then
ROUNDS = 2  # of the mean of rotations
STILL = torch.zeros(3, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Before:
    """The frame with which the next one is compared."""

    time_s: float
    shots: Sequence[Frame]
    disks: Disks | None  # None: not needed yet
    R_lab_body: Tensor  # (3, 3)
    rate: Tensor = STILL  # (3,), rad/s, lab; zero where it is not known


class RelativeTracker:
    """Compares each picture with the one before and with the keyframes that show most of the same side.

    `place` is an empty record of crops, with the views and one position of the ball. Orientations begin with the
    identity at the first frame; their error grows to about a degree.
    """

    def __init__(self, place: Crops, settings: MapSettings) -> None:
        self._place, self._settings = place, settings
        self._keys: list[tuple[Disks, Tensor]] = []  # with R_lab_body (3, 3)
        self._before: _Before | None = None

    def forget(self) -> None:
        """Forget the keyframes: their orientations have drifted from what is known now."""
        self._keys = []

    def know(self, time_s: float, shots: Sequence[Frame], R_lab_body: Tensor) -> None:
        """Go on from a frame whose orientation (3, 3) is known by a map."""
        disks = self._disks(shots) if self._is_far(R_lab_body) else None
        self._go_on(_Before(time_s=time_s, shots=shots, disks=disks, R_lab_body=R_lab_body))

    def next(self, time_s: float, shots: Sequence[Frame]) -> tuple[Poses, bool]:
        """Return the pose of the frame of a time, and whether it was searched for; no pose where nothing agrees."""
        reason = [shot.reason for shot in shots]
        use = torch.tensor([shot.usable for shot in shots])
        if not bool(use.any()):
            return no_pose(len(shots), reason), False
        now, before = self._disks(shots), self._before
        searched, R, rate = True, torch.eye(3, dtype=torch.float64), STILL
        if before is not None:
            step_s, last = time_s - before.time_s, before.R_lab_body
            disks = self._disks(before.shots) if before.disks is None else before.disks
            found, searched = self._compared(now, (disks, last), so3.exp(max(step_s, 0.0) * before.rate) @ last)
            if found is None:
                return no_pose(len(shots), [Reason.LOW_SCORE if why is Reason.OK else why for why in reason]), True
            R = found
            rate = so3.log(R @ last.mT) / step_s if step_s > 0 and not searched else STILL
        self._go_on(_Before(time_s=time_s, shots=shots, disks=now, R_lab_body=R, rate=rate))
        parts = blank_parts(len(shots), 1)
        parts |= {"R_lab_body": R[None], "position_lab_mm": self._place.position_lab_mm[:1]}
        parts["covariance"][..., :3, :3] = SCALE_RAD**2 / 3 * torch.eye(3)
        return Poses(**parts, use=use, reason=tuple(reason)), searched

    def _go_on(self, now: _Before) -> None:
        """Compare the next frame with this one, and later ones too if it is far from all keyframes."""
        self._before = now
        if now.disks is not None and self._is_far(now.R_lab_body):
            self._keys.append((now.disks, now.R_lab_body))

    def _compared(self, now: Disks, last: tuple[Disks, Tensor], expected: Tensor) -> tuple[Tensor | None, bool]:
        """Return the orientation (3, 3) near the one expected, or else near that of the frame before; and which."""
        members = [*self._nearest(now, expected), last]
        disks, R = Disks.joined([*(one for one, _ in members), now]), torch.stack([R for _, R in members])
        first, second = torch.arange(len(R)), torch.full((len(R),), len(R))
        pairs = self._good(refine_pairs(disks, first, second, expected @ R.mT, ITERATIONS, EVERY))
        searched = not len(pairs)
        if searched:
            grid = so3.local_grid(math.radians(SEARCH_STEP_DEG), math.radians(self._settings.turn_max_deg))
            start = search_pairs(reduced(disks, SMALLER), first, second, R[-1] @ R.mT, grid, SEARCH_EVERY)
            pairs = self._good(refine_pairs(disks, first, second, start, ITERATIONS, EVERY))
        if not len(pairs):
            return None, True
        found = (pairs.R_ji @ R[pairs.first])[int(pairs.score.argmax())]
        for _ in range(ROUNDS):
            off = so3.log(pairs.R_ji @ R[pairs.first] @ found.mT)
            weight = pairs.information / (1 + (off.norm(dim=1) / SCALE_RAD).square()).square()[:, None, None]
            turn = torch.linalg.solve(weight.sum(0), (weight @ off[..., None]).sum(0))[:, 0]
            found = so3.exp(turn) @ found
        return so3.nearest_rotation(found), searched

    def _good(self, pairs: RelativeRotations) -> RelativeRotations:
        return pairs.where((pairs.score > self._settings.score_min) & (pairs.overlap > OVERLAP_MIN))

    def _nearest(self, now: Disks, R: Tensor) -> list[tuple[Disks, Tensor]]:
        """Return the keyframes that show most of what an orientation shows."""
        if not self._keys:
            return []
        there = torch.stack([(key.mT @ disks.sight_lab[0][..., None])[..., 0] for disks, key in self._keys])
        cosine = ((R.mT @ now.sight_lab[0][..., None])[..., 0] @ there.mT).flatten(1).amax(1)
        return [self._keys[k] for k in cosine.topk(min(NEAREST, len(self._keys))).indices.tolist()]

    def _is_far(self, R: Tensor) -> bool:
        """Return whether an orientation is far from those of all keyframes, and there is room for one more."""
        if not self._keys:
            return True
        near = so3.geodesic_distance(torch.stack([key for _, key in self._keys]), R)
        return len(self._keys) < KEYFRAMES and not bool((near < math.radians(self._settings.keyframe_deg)).any())

    def _disks(self, shots: Sequence[Frame]) -> Disks:
        """Return the disks of one frame of the ball in its place."""
        crops = [[Crop(grey=shot.picture, top=0, left=0)] for shot in shots]
        seen = torch.tensor([[shot.usable for shot in shots]])
        return disks_of(replace(self._place, crops=crops, seen=seen), torch.tensor([0]), self._settings)
