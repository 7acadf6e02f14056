"""Attitudes of all frames without a map: neighbours compared, chained, and loops closed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import PaintError, refusal
from sphereorient.mapping.disks import Disks, reduced
from sphereorient.mapping.graph import solve_graph
from sphereorient.mapping.pairs import Turns, climb_pairs, joined, search_pairs
from sphereorient.mapping.record import Closure
from sphereorient.mapping.settings import PaintSettings

SEARCH_STEP_DEG = 8.0
SEARCH_EVERY = 2  # pixels of the small disks
SMALLER = 2  # factor by which disks are reduced for a search
CLIMBS = 6
CLIMB_EVERY = 2
NEAR = 0.5  # cosine between lines of sight in the body, above which two disks share enough for a comparison
OVERLAP_MIN = 0.25  # of a disk, that a loop's pictures share
SCALE_RAD = math.radians(1.0)  # by which outlines' errors turn single frames
APART_RAD = math.radians(3.0)  # by which two cameras' own turns of one ball do not usually differ
APART_SHARE = 0.3  # nor by this share of the turn
ENOUGH_TURN_RAD = math.radians(4.0)  # of a pair that tells whether cameras agree
FEWEST = 4  # such pairs


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """Attitudes of N instants from pictures alone; made by `find_chain` and `find_photographs`."""

    rows: Tensor  # (N,) int64, rising, of the instants among the disks given; the others have no attitude
    R_lab_body: Tensor  # (N, 3, 3) float64; identity at the first one
    turns: Turns
    closure: Closure


def find_chain(disks: Disks, settings: PaintSettings) -> Chain:
    """Find attitudes from pictures alone.

    Args:
        disks: of N instants, each seen by a camera at least.
        settings: of the room.

    Raises:
        PaintError: the sphere does not turn, the cameras see different turns, or no patch is seen twice.
    """
    if len(disks) < 2:
        do = "learn from a movie in which the ball turns"
        raise PaintError(refusal("movies", expected="the ball in 2 frames at least", got=f"{len(disks)}", do=do))
    R, turns = _chained(disks, settings)
    check_turned(R, settings)
    check_one_ball(disks, R)
    return close_loops(disks, R, turns, settings)


def check_turned(R_lab_body: Tensor, settings: PaintSettings) -> None:
    """Refuse attitudes (N, 3, 3) of a sphere that does not turn.

    Raises:
        PaintError: it turns by less than the setting.
    """
    turned = float(so3.geodesic_distance(R_lab_body[:1], R_lab_body).max())
    if turned < math.radians(settings.turned_min_deg):
        got = f"{math.degrees(turned):.2g} degrees in all frames together"
        do = "learn from a movie in which the ball turns"
        raise PaintError(refusal("movies", expected="a ball that turns", got=got, do=do))


def _chained(disks: Disks, settings: PaintSettings) -> tuple[Tensor, Turns]:
    """Compare neighbours, then frames further apart from where these say they are."""
    count = len(disks)
    small = reduced(disks, SMALLER)
    grid = so3.local_grid(math.radians(SEARCH_STEP_DEG), math.radians(settings.turn_max_deg))
    first = torch.arange(count - 1)
    still = torch.eye(3, dtype=torch.float64).expand(count - 1, 3, 3)
    start = search_pairs(small, first, first + 1, still, grid, SEARCH_EVERY)
    neighbours = climb_pairs(disks, first, first + 1, start, CLIMBS, CLIMB_EVERY)
    R = chained(neighbours.R_ji)
    parts = [neighbours]
    for step in settings.baselines:
        if 1 < step < count:
            i = torch.arange(count - step)
            parts.append(climb_pairs(disks, i, i + step, R[i + step] @ R[i].mT, CLIMBS, CLIMB_EVERY))
    # Neighbours stay in any case: nobody else connects what is before them with what comes after.
    told = [parts[0], *(part.where(part.score > settings.score_min) for part in parts[1:])]
    turns = joined(told)
    R, _ = solve_graph(R, turns, SCALE_RAD)
    return R, turns


def chained(R_next: Tensor) -> Tensor:
    """Return attitudes (N, 3, 3), the first one the identity, from the turns (N - 1, 3, 3) between neighbours."""
    R = [torch.eye(3, dtype=R_next.dtype)]
    for turn in R_next:
        R.append(turn @ R[-1])
    return so3.nearest_rotation(torch.stack(R))


def close_loops(disks: Disks, R_lab_body: Tensor, turns: Turns, settings: PaintSettings) -> Chain:
    """Find the same patches again after long times and between cameras, and let drift go.

    Args:
        disks: of N instants.
        R_lab_body: (N, 3, 3), with drift.
        turns: of neighbours, that made them.
        settings: of the room.

    Raises:
        PaintError: no two keyframes show the same patch.
    """
    keys = keyframes(R_lab_body, math.radians(settings.keyframe_deg))
    first, second = candidates(disks, R_lab_body, keys, settings.loop_pairs)
    before = R_lab_body
    found = _matched(disks, R_lab_body, first, second, settings)
    good = found.where((found.score > settings.score_min) & (found.overlap > OVERLAP_MIN))
    if len(first) and not len(good):
        got = f"none among {len(first)} pairs of frames"
        do = "film until the ball has shown its sides again, or learn from more frames"
        raise PaintError(refusal("movies", expected="patches of paint that are seen twice", got=got, do=do))
    R, left = solve_graph(R_lab_body, joined([turns, good]), SCALE_RAD)
    loops = left[len(turns) :]
    kept = loops.norm(dim=-1) < 3 * SCALE_RAD
    chosen = good.where(kept)
    was = so3.log(chosen.R_ji @ (before[chosen.second] @ before[chosen.first].mT).mT)
    return Chain(
        rows=torch.arange(len(R)),
        R_lab_body=R,
        turns=joined([turns, chosen]),
        closure=Closure(
            pairs=len(turns),
            loops=len(first),
            closed=len(chosen),
            drift_before_rad=rms(was),
            drift_after_rad=rms(loops[kept]),
            moved_rad=moved(before, R),
        ),
    )


def _matched(disks: Disks, R_lab_body: Tensor, first: Tensor, second: Tensor, settings: PaintSettings) -> Turns:
    about = R_lab_body[second] @ R_lab_body[first].mT
    reach = math.radians(settings.loop_reach_deg)
    if reach >= math.pi:
        grid = so3.lattman_grid(math.radians(SEARCH_STEP_DEG + 4))
    else:
        grid = so3.local_grid(math.radians(SEARCH_STEP_DEG), reach)
    if len(first):
        about = search_pairs(reduced(disks, SMALLER), first, second, about, grid, SEARCH_EVERY)
    return climb_pairs(disks, first, second, about, CLIMBS, CLIMB_EVERY)


def keyframes(R_lab_body: Tensor, step_rad: float) -> Tensor:
    """Return the instants (K,) that are at least a step away from the one before, the first and the last included."""
    keys = [0]
    for k in range(1, len(R_lab_body)):
        if float(so3.geodesic_distance(R_lab_body[keys[-1]], R_lab_body[k])) >= step_rad:
            keys.append(k)
    if keys[-1] != len(R_lab_body) - 1:
        keys.append(len(R_lab_body) - 1)
    return torch.tensor(keys)


def candidates(disks: Disks, R_lab_body: Tensor, keys: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Return pairs of keyframes (first, second) that should show the same patch, neighbours left out.

    Those that share most come first; of too many, every so-many-th is taken, so that all times are among them.
    """
    alike = likeness(disks, R_lab_body, keys)
    a, b = torch.triu_indices(len(keys), len(keys), offset=2)
    wanted = alike[a, b] > NEAR
    a, b = a[wanted], b[wanted]
    if len(a) > most:
        chosen = torch.linspace(0, len(a) - 1, most).round().long() if most else torch.zeros(0, dtype=torch.int64)
        a, b = a[chosen], b[chosen]
    return keys[a], keys[b]


def likeness(disks: Disks, R_lab_body: Tensor, rows: Tensor) -> Tensor:
    """Return the cosine between the nearest lines of sight in the body of some instants (K,), each with each, (K, K).

    Args:
        disks: of N instants.
        R_lab_body: (N, 3, 3).
        rows: (K,) int64.
    """
    sight = -disks.R_lab_view[rows, :, :, 2].double()  # from the ball to the camera
    in_body = (R_lab_body[rows].mT[:, None] @ sight[..., None])[..., 0]
    alike = torch.einsum("acx,bdx->abcd", in_body, in_body)
    both = disks.seen[rows][:, None, :, None] & disks.seen[rows][None, :, None, :]
    return torch.where(both, alike, -1.0).flatten(2).amax(2)


def check_one_ball(disks: Disks, R_lab_body: Tensor) -> None:
    """Refuse cameras that by themselves see different turns.

    Raises:
        PaintError: their turns usually differ.
    """
    cameras = disks.layers.shape[1]
    if cameras < 2:
        return
    keys = keyframes(R_lab_body, 2 * ENOUGH_TURN_RAD)
    both = disks.seen[keys].all(1)
    keys = keys[both]
    if len(keys) < FEWEST + 1:
        return
    first, second = keys[:-1], keys[1:]
    start = R_lab_body[second] @ R_lab_body[first].mT
    own = [climb_pairs(_only(disks, k), first, second, start, CLIMBS, CLIMB_EVERY) for k in range(cameras)]
    apart = so3.geodesic_distance(own[0].R_ji, own[1].R_ji)
    turn = so3.log(own[0].R_ji).norm(dim=-1)
    usual, limit = float(apart.median()), max(APART_RAD, APART_SHARE * float(turn.median()))
    if usual > limit:
        got = f"turns that differ by {math.degrees(usual):.2g} of {math.degrees(float(turn.median())):.2g} degrees"
        do = "check which movie belongs to which camera, and that they begin at the same instant"
        raise PaintError(refusal("movies", expected="one ball in both movies", got=got, do=do))


def _only(disks: Disks, camera: int) -> Disks:
    one = slice(camera, camera + 1)
    return Disks(
        layers=disks.layers[:, one],
        share=disks.share,
        R_lab_view=disks.R_lab_view[:, one],
        distance_radii=disks.distance_radii[:, one],
        seen=disks.seen[:, one],
    )


def moved(before: Tensor, after: Tensor) -> float:
    """Return the rms angle between two sets of attitudes (N, 3, 3), the body frame's own turn taken off, rad."""
    Q = so3.nearest_rotation((before.mT @ after).sum(0))
    return rms(so3.log(after @ (before @ Q).mT))


def rms(vectors: Tensor) -> float:
    """Return the root mean square length of vectors (E, 3), 0 of none."""
    return float(vectors.square().sum(-1).mean().sqrt()) if len(vectors) else 0.0


def spread(rows: Sequence[int] | Tensor, count: int) -> Tensor:
    """Return at most `count` of some rows, evenly spread, ends included."""
    whole = torch.as_tensor(rows)
    if len(whole) <= count:
        return whole
    return whole[torch.linspace(0, len(whole) - 1, count).round().long()]
