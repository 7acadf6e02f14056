"""Orientations of a movie's frames without a map: compare neighbours, chain the rotations, close loops."""

import math
from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import PaintError, refusal
from sphereorient.mapping.disks import Disks, evenly_spread, reduced, too_few, without_static
from sphereorient.mapping.pairs import Closure, RelativeRotations, refine_pairs, search_pairs, solve_graph
from sphereorient.mapping.settings import MapSettings

SEARCH_STEP_DEG = 8.0  # of the grid of relative rotations
SMALLER = 2  # factor of reduction of the disks for a search
ITERATIONS = 6  # of a pair's refinement
EVERY = 2  # each n-th pixel of the disks, and of the small ones in a search
NEAR = 0.5  # cosine between lines of sight in the body; above, two disks share enough for a comparison
OVERLAP_MIN = 0.25  # least share of a disk common to a loop's pictures
SCALE_RAD = math.radians(1.0)  # scatter of single frames by errors of their outlines
APART_RAD = math.radians(3.0)  # larger median differences of two cameras' rotations mean two balls
APART_SHARE = 0.3  # or this share of the rotation, if larger
ENOUGH_TURN_RAD = math.radians(4.0)  # least rotation of a pair that tests agreement of cameras
FEWEST = 4  # such pairs


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
        do = "use a movie in which the ball rotates"
        raise PaintError(refusal("movies", expected="a ball that rotates", got=got, do=do))


def chained_pairs(disks: Disks, settings: MapSettings) -> tuple[Tensor, RelativeRotations]:
    """Compare neighbours, then, by the resulting orientations, more distant frames."""
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
        do = "film until the ball shows the same sides again, or use more frames"
        raise PaintError(refusal("movies", expected="patches of the ball seen twice", got=got, do=do))
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
    """Return distant pairs of keyframes that should share a patch; evenly spread ones if there are too many."""
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
    alone = (disks.where(slice(None), slice(k, k + 1)) for k in range(cameras))
    one, *others = (refine_pairs(own, first, second, start, ITERATIONS, EVERY).R_ji for own in alone)
    apart = max(float(so3.geodesic_distance(one, other).median()) for other in others)
    turn = float(so3.log(one).norm(dim=-1).median())
    if apart > max(APART_RAD, APART_SHARE * turn):
        got = f"rotations that differ by {math.degrees(apart):.2g} of {math.degrees(turn):.2g} degrees"
        do = "check which movie belongs to which camera, and that they begin at the same instant"
        raise PaintError(refusal("movies", expected="one ball in both movies", got=got, do=do))
