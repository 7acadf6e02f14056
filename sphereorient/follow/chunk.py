"""The last frames of a chunk, and the prediction of the next one."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import Reason
from sphereorient.pose.neighbours import Neighbours
from sphereorient.pose.poses import Poses, supported

Floats = NDArray[np.float64]

LONG_STEP = 3.0  # times the step before; a longer step is not extrapolated, nor is a rate taken from a shorter one
MOVE_SHARE = 0.3  # of the radius: largest displacement of a sphere of unknown motion
ASTRAY_SHARE = 0.01  # of the radius: largest error of an extrapolated position
FARTHEST_TURN = 1.5  # rad, largest rotation extrapolated over a long step
LEAST_CHANGE = 0.5  # least share of a change of rotation that is extrapolated, however much the poses scatter


@dataclass(frozen=True, kw_only=True, eq=False)
class Expected:
    """Prediction of a frame's pose from preceding frames."""

    position_lab_mm: Floats  # (3,)
    R_before: Floats  # (3, 3), R_lab_body of the frame before
    turn: Floats  # (3,), rotation since then, rad, lab
    use: Tensor  # (C,) bool, cameras that saw the sphere
    reason: tuple[Reason, ...]  # C, why the others did not see it
    place_spread: Floats  # (3, 3), mm^2
    rough: bool  # whether from one frame alone, with unknown motion
    moved: Floats  # (6,), rotation (rad) and displacement (mm) during the exposure; 0 if rough
    open_share: float  # exposure over the time from the frame before to this one
    among: Neighbours | None = None  # of this one pose; None: no other sphere is in view


@dataclass(frozen=True, kw_only=True, eq=False)
class Ahead:
    """Predicted pose of a ball."""

    position_lab_mm: Tensor  # (3,)
    R_lab_body: Tensor  # (3, 3)
    covariance: Tensor  # (6, 6), of rotation (rad) and position (mm), lab


@dataclass(eq=False)
class Chunk:
    """One chunk in progress, with its last poses."""

    first: int
    time_s: Sequence[float] | Mapping[int, float]  # of the frames of the batch
    past: deque[tuple[int, Poses]] = field(default_factory=lambda: deque(maxlen=3))
    turns: deque[Floats] = field(default_factory=lambda: deque(maxlen=2))  # (3,), rad, from each of these to the next

    def expected(self, frame: int, radius_mm: float, exposure_s: float = 0.0) -> Expected | None:
        """Extrapolate position and rotation, to second order where three frames are known."""
        rows = [poses for number, poses in self.past if number >= frame - len(self.past)]
        numbers = [number for number, _ in self.past]
        if not rows or numbers[-1] != frame - 1:
            return None
        last, on, before = rows[-1], math.inf, math.inf  # ratio of each step to the one before: 1 for even frames
        if len(rows) > 1 and numbers[-2] == frame - 2:
            t0, t1, t2 = (self.time_s[k] for k in range(frame - 2, frame + 1))
            on, known = (t2 - t1) / (t1 - t0), self.turns[-1]
        if len(rows) == 3:
            before = (t1 - t0) / (t0 - self.time_s[frame - 3])
            if before < 1 / LONG_STEP:  # too short for a rate: use the last two steps together
                on, known, rows = (t2 - t1) / (t1 - self.time_s[frame - 3]), known + self.turns[0], [rows[0], rows[2]]
        places = [one.position_lab_mm[0].numpy() for one in rows]
        covariances = [one.covariance[0].numpy() for one in rows]
        spreads, turn_spreads = ([C[k : k + 3, k : k + 3] for C in covariances] for k in (3, 0))
        X, spread = places[-1], spreads[-1]
        rough, astray_mm = on > LONG_STEP, MOVE_SHARE * radius_mm
        open_share = exposure_s / (self.time_s[frame] - self.time_s[frame - 1])
        turn, moved = np.zeros(3), np.zeros(6)
        if not rough:
            *_, X0, X1 = places
            *_, C0, C1 = spreads
            turn, move, spread = on * known, on * (X1 - X0), (1 + on) ** 2 * C1 + on**2 * C0
            astray_mm = ASTRAY_SHARE * radius_mm
            if 1 / LONG_STEP <= before <= LONG_STEP:
                # The rate changes between the middles of steps as between the two before.
                more = (t2 - t0) / (t1 - self.time_s[frame - 3])
                change = more * (turn - on * before * self.turns[0])
                scatter = sum(w * np.trace(C) for w, C in zip((1, 4, 1), turn_spreads, strict=True))
                turn = turn + max(LEAST_CHANGE, 1 - scatter / (change @ change + scatter)) * change
                a, b = on * (1 + more), on * before * more
                further = (1 + a) ** 2 * C1 + (a + b) ** 2 * C0 + b**2 * spreads[0]
                # Not for distances by one camera: their scatter exceeds the acceleration.
                if float(further.trace()) < astray_mm**2:
                    move, spread = (1 + more) * move - b * (X0 - places[0]), further
            X = X1 + move
            moved = open_share * np.concatenate([turn, move])
        elif math.isfinite(on) and on * np.linalg.norm(known) < FARTHEST_TURN:  # constant rate
            turn, X = on * known, X + on * (X - places[-2])
        return Expected(
            position_lab_mm=X,
            R_before=last.R_lab_body[0].numpy(),
            turn=turn,
            use=last.use,
            reason=last.reason,
            place_spread=spread + astray_mm**2 * np.eye(3),
            rough=rough,
            moved=moved,
            open_share=open_share,
        )

    def extrapolated(self, frame: int) -> Ahead | None:
        """Predict the pose of a later frame by polynomial extrapolation; the covariance includes the difference from
        the next lower order. None from a single pose.
        """
        if len(self.past) < 2:
            return None
        time_s = np.array([self.time_s[number] for number, _ in self.past])
        poses = [one for _, one in self.past]
        weight, lower = (_weights(time_s[k:], self.time_s[frame]) for k in (0, 1))
        last = poses[-1].R_lab_body[0]
        X = torch.stack([one.position_lab_mm[0] for one in poses])
        turn = so3.log(torch.stack([one.R_lab_body[0] for one in poses]) @ last.mT)
        path = torch.cat([turn, X], 1)
        ahead = weight @ path
        other = lower @ path[1:] - ahead
        spread = sum(w * w * one.covariance[0] for w, one in zip(weight.tolist(), poses, strict=True))
        apart = torch.stack([other[:3].square().sum(), other[3:].square().sum()]).repeat_interleave(3)
        return Ahead(
            position_lab_mm=ahead[3:],
            R_lab_body=so3.exp(ahead[:3]) @ last,
            covariance=spread + torch.diag(apart),
        )

    def saw(self, frame: int, poses: Poses, turn: Floats) -> None:
        """Record the best pose of a frame, if a picture supports it, and its rotation (3,), rad, since the last one."""
        if supported(poses):
            if self.past:
                self.turns.append(turn)
            self.past.append((frame, poses))

    def forget(self) -> None:
        """Forget all poses before a new motion."""
        self.past.clear()
        self.turns.clear()


def _weights(time_s: Floats, at_s: float) -> Tensor:
    """Return the weights that extrapolate values at some times to another time, by the polynomial through them."""
    apart = time_s[:, None] - time_s
    np.fill_diagonal(apart, 1.0)
    share = (at_s - time_s[None]) / apart
    np.fill_diagonal(share, 1.0)
    return torch.from_numpy(share.prod(1))


def regained(seen: Sequence[bool]) -> bool:
    """Return whether a ball is seen again after a frame without it."""
    return any(now and not before for before, now in pairwise(seen))


def mirrored(spans: Sequence[range], time_s: Sequence[float]) -> list[Chunk]:
    """Return the chunks of some frames in reverse time; frame n becomes -n."""
    back_s = {-k: -time_s[k] for span in spans for k in span}
    return [Chunk(1 - span.stop, back_s) for span in spans]
