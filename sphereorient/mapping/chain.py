"""Orientations without a map. Of a movie's frames: compare neighbours, chain the rotations, close loops. Live, of a
ball that stays in its place: pictures against those before.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import PaintError, Reason, refusal
from sphereorient.locate import Frame
from sphereorient.mapping.disks import Crop, Crops, Disks, disks_of, evenly_spread, reduced, too_few, without_static
from sphereorient.mapping.pairs import Closure, RelativeRotations, refine_pairs, search_pairs, solve_graph
from sphereorient.mapping.settings import MapSettings
from sphereorient.pose.poses import Poses, blank_parts, no_pose

SEARCH_STEP_DEG = 8.0  # of the grid of relative rotations
SMALLER = 2  # factor by which disks are reduced for a search
ITERATIONS = 6  # of a pair's refinement
EVERY = 2  # pixels of the disks in it, and of the small ones in a search
NEAR = 0.5  # cosine between lines of sight in the body, above which two disks share enough for a comparison
OVERLAP_MIN = 0.25  # of a disk, shared by a loop's pictures
SCALE_RAD = math.radians(1.0)  # scatter of single frames by errors of their outlines
APART_RAD = math.radians(3.0)  # larger median differences of two cameras' rotations mean two balls
APART_SHARE = 0.3  # and this share of the rotation, where that is larger
ENOUGH_TURN_RAD = math.radians(4.0)  # of a pair that can show whether cameras agree
FEWEST = 4  # such pairs
NEAREST = 3  # keyframes that a picture is compared with, beside the one before
KEYFRAMES = 200  # at most: a ball has shown its sides by then
ROUNDS = 2  # of the mean of rotations
STILL = torch.zeros(3, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class PairwiseAttitudes:
    """Orientations of N instants from pairs of pictures alone."""

    rows: Tensor  # (N,) int64, rising, of the instants among the disks given; the others have no orientation
    R_lab_body: Tensor  # (N, 3, 3) float64; identity at the first one
    closure: Closure


def find_chain(disks: Disks, settings: MapSettings) -> PairwiseAttitudes:
    """Find the orientations of N instants from disks, each seen by at least one camera.
    Raises PaintError (the sphere does not rotate, the cameras see different rotations, or no patch is seen twice).
    """
    if len(disks) < 2:
        raise too_few(len(disks))
    R, pairs = chained_pairs(disks, settings)
    check_turned(R, settings)
    cleaned = without_static(disks, R)
    if cleaned is not disks:
        disks = cleaned
        R, pairs = chained_pairs(disks, settings)
    _check_one_ball(disks, R)
    return close_loops(disks, R, pairs, settings)


def check_turned(R_lab_body: Tensor, settings: MapSettings) -> None:
    """Raise PaintError if orientations (N, 3, 3) rotate by less than the setting."""
    turned = float(so3.geodesic_distance(R_lab_body[:1], R_lab_body).max())
    if turned < math.radians(settings.turned_min_deg):
        got = f"{math.degrees(turned):.2g} degrees in all frames together"
        do = "use a movie in which the ball turns"
        raise PaintError(refusal("movies", expected="a ball that turns", got=got, do=do))


def chained_pairs(disks: Disks, settings: MapSettings) -> tuple[Tensor, RelativeRotations]:
    """Compare neighbours, then, from the resulting orientations, frames further apart."""
    count = len(disks)
    grid = so3.local_grid(math.radians(SEARCH_STEP_DEG), math.radians(settings.turn_max_deg))
    first = torch.arange(count - 1)
    still = torch.eye(3, dtype=torch.float64).expand(count - 1, 3, 3)
    start = search_pairs(reduced(disks, SMALLER), first, first + 1, still, grid, EVERY)
    # Keep all neighbours: nothing else connects the frames before and after.
    parts = [refine_pairs(disks, first, first + 1, start, ITERATIONS, EVERY)]
    R = chained(parts[0].R_ji)
    for step in settings.baselines:
        if 1 < step < count:
            i = torch.arange(count - step)
            pairs = refine_pairs(disks, i, i + step, R[i + step] @ R[i].mT, ITERATIONS, EVERY)
            parts.append(pairs.where(pairs.score > settings.score_min))
    pairs = RelativeRotations.joined(parts)
    return solve_graph(R, pairs, SCALE_RAD)[0], pairs


def chained(R_next: Tensor) -> Tensor:
    """Return orientations (N, 3, 3) from rotations (N - 1, 3, 3) between neighbours, the first one the identity."""
    R = accumulate(R_next, lambda before, turn: turn @ before, initial=torch.eye(3, dtype=R_next.dtype))
    return so3.nearest_rotation(torch.stack(list(R)))


def close_loops(disks: Disks, R_lab_body: Tensor, pairs: RelativeRotations, settings: MapSettings) -> PairwiseAttitudes:
    """Match distant keyframes, and remove the drift of orientations (N, 3, 3); raise PaintError without a match."""
    first, second = _candidates(disks, R_lab_body, settings)
    about = R_lab_body[second] @ R_lab_body[first].mT
    reach = math.radians(settings.loop_reach_deg)
    if len(first):
        step = math.radians(SEARCH_STEP_DEG)
        rough = math.radians(SEARCH_STEP_DEG + 4)
        grid = so3.local_grid(step, reach) if reach < math.pi else so3.lattman_grid(rough)
        about = search_pairs(reduced(disks, SMALLER), first, second, about, grid, EVERY)
    found = refine_pairs(disks, first, second, about, ITERATIONS, EVERY)
    good = found.where((found.score > settings.score_min) & (found.overlap > OVERLAP_MIN))
    if len(first) and not len(good):
        got = f"none among {len(first)} pairs of frames"
        do = "film until the ball has shown its sides again, or use more frames"
        raise PaintError(refusal("movies", expected="patches of the ball that are seen twice", got=got, do=do))
    R, residual = solve_graph(R_lab_body, RelativeRotations.joined([pairs, good]), SCALE_RAD)
    closed = good.where(residual[len(pairs) :].norm(dim=-1) < 3 * SCALE_RAD)
    closure = Closure.of(closed, R_lab_body, R, pairs=len(pairs), loops=len(first))
    return PairwiseAttitudes(rows=torch.arange(len(R)), R_lab_body=R, closure=closure)


def _keyframes(R_lab_body: Tensor, step_rad: float) -> Tensor:
    keys, last = [0], len(R_lab_body) - 1
    for k in range(1, last + 1):
        if k == last or float(so3.geodesic_distance(R_lab_body[keys[-1]], R_lab_body[k])) >= step_rad:
            keys.append(k)
    return torch.tensor(keys)


def _candidates(disks: Disks, R_lab_body: Tensor, settings: MapSettings) -> tuple[Tensor, Tensor]:
    """Return distant pairs of keyframes that should share a patch; of too many, evenly spread ones."""
    keys = _keyframes(R_lab_body, math.radians(settings.keyframe_deg))
    near = disks.sight_cosines(R_lab_body, keys)
    a, b = torch.triu_indices(len(keys), len(keys), offset=2)
    chosen = evenly_spread(torch.nonzero(near[a, b] > NEAR)[:, 0], settings.loop_pairs)
    return keys[a[chosen]], keys[b[chosen]]


def _check_one_ball(disks: Disks, R_lab_body: Tensor) -> None:
    cameras = disks.layers.shape[1]
    keys = _keyframes(R_lab_body, 2 * ENOUGH_TURN_RAD)
    keys = keys[disks.seen[keys].all(1)]
    if cameras < 2 or len(keys) < FEWEST + 1:
        return
    first, second = keys[:-1], keys[1:]
    start = R_lab_body[second] @ R_lab_body[first].mT
    alone = (disks.where(slice(None), slice(k, k + 1)) for k in (0, 1))
    one, other = (refine_pairs(own, first, second, start, ITERATIONS, EVERY).R_ji for own in alone)
    apart, turn = float(so3.geodesic_distance(one, other).median()), float(so3.log(one).norm(dim=-1).median())
    if apart > max(APART_RAD, APART_SHARE * turn):
        got = f"rotations that differ by {math.degrees(apart):.2g} of {math.degrees(turn):.2g} degrees"
        do = "check which movie belongs to which camera, and that they begin at the same instant"
        raise PaintError(refusal("movies", expected="one ball in both movies", got=got, do=do))


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
            start = search_pairs(reduced(disks, SMALLER), first, second, R[-1] @ R.mT, grid, EVERY)
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
