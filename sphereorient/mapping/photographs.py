"""Attitudes of photographs in any order: all compared with all over all rotations, sets that agree joined."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import PaintError, refusal
from sphereorient.mapping.chain import (
    CLIMB_EVERY,
    CLIMBS,
    OVERLAP_MIN,
    SMALLER,
    Chain,
    check_turned,
    likeness,
    moved,
    rms,
)
from sphereorient.mapping.disks import Disks, reduced
from sphereorient.mapping.graph import solve_graph
from sphereorient.mapping.pairs import Turns, climb_pairs, joined, search_views
from sphereorient.mapping.record import Closure
from sphereorient.mapping.settings import PaintSettings
from sphereorient.search.peaks import distinct

STEP_DEG = 8.0  # of the grid of rotations
TILT_DEG = 75.0  # between lines of sight in the body, beyond which two disks share too little to be told from chance
EVERY = 1  # pixels of the small disks
TOPS, PEAKS = 96, 3  # best rotations of a pair, and distinct ones among them that are climbed from
FINER = 2.7  # detail, window and pixels of the disks in which pairs are measured at last, where the pictures have it
DISK_PX_MAX = 128
PEAK_DEG = 18.0  # between distinct ones
CHANCE_PAIRS = 500  # pairs at random rotations, which tell how well other paint correlates
CHANCE_SEED = 0
CHI2_MEDIAN = 0.4549  # of the square of a normal number
JOIN_STEPS = 4  # of the climb of a pair between two sets
FEWEST = 3  # pictures: each pair of the smallest set is confirmed by the two others
LIKE_MAX = 0.98  # correlation beyond which paint is not any more the same
# Log of the odds by which two sets must rather show the same paint than chance to be joined. Among 5 million rotations
# tried for 30 pictures, the best wrong ones have about 20 (measured); to be wrong here costs more than a picture.
SURE = 25.0
REACH_RAD = math.radians(10.0)  # by which a pair may differ from where the others say that it is
SCALE_RAD = math.radians(2.0)  # by which outlines' errors turn pairs that share only slanted places
SETTLE = 2  # times that pairs are compared in fine detail, each from where all together say
OTHER_SHARE, OTHER_LEAST = 0.5, 4  # of the largest set, and pictures: a second set so large is another ball


def finer_settings(settings: PaintSettings, diameter_px: float) -> PaintSettings:
    """Return settings of finer disks: with all that pictures of a ball so wide have, up to a factor.

    Coarse disks have a view of a place that leans with its slant, by degrees at 60 degrees of it; in fine ones,
    compared with their nearest neighbourhood, that is less: 0.4 degrees instead of 2 (30 pictures of 200 px).
    """
    factor = min(max(diameter_px / settings.disk_px, 1.0), FINER, DISK_PX_MAX / settings.disk_px)
    size = 2 * round(factor * settings.disk_px / 2)
    return settings.model_copy(
        update={"disk_px": size, "detail": settings.detail / factor, "window": settings.window / factor}
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Evidence:
    """How much likelier a pair shows the same paint than other paint; made by `measured_evidence`."""

    disks: Disks
    cells: float  # independent places of a whole disk, by how other paint correlates
    score_min: float

    def of(self, turns: Turns) -> Tensor:
        """Return the logarithm of the odds, (E,).

        Fisher's z of a correlation over n independent places is normal with variance 1 / n, about 0 for other paint,
        and about twice that of the setting `score_min` for the same: halfway the odds are even.

        Source: Fisher 1921, On the probable error of a coefficient of correlation.
        """
        middle = math.atanh(self.score_min)
        z = turns.score.clamp(-LIKE_MAX, LIKE_MAX).atanh()
        return 2 * middle * self.cells * turns.overlap * (z - middle)


def find_photographs(disks: Disks, finer: Disks, settings: PaintSettings) -> Chain:
    """Find attitudes of pictures in any order, from them alone.

    Args:
        disks: of N instants, each seen by a camera at least.
        finer: the same with more pixels and detail, in which the pairs that were found are measured.
        settings: of the room.

    Returns:
        Attitudes of the largest set of pictures that are connected by paint they share. The others have none.

    Raises:
        PaintError: fewer than three pictures, none that share paint, a ball that does not turn, or two balls.
    """
    if len(disks) < FEWEST:
        do = "take more pictures of the ball, of all its sides"
        raise PaintError(
            refusal("photographs", expected=f"{FEWEST} with the ball at least", got=f"{len(disks)}", do=do)
        )
    rough = measured_evidence(disks, settings)
    label, joined_R = joined_sets(rough, all_pairs(disks))
    rows, R, turns = settled(rough, _largest(label), joined_R)
    fine = measured_evidence(finer, settings)
    for _ in range(SETTLE):
        rows, R, turns = settled(fine, rows, R)
    chain = _chain(rows, joined_R, R, turns, len(disks) * (len(disks) - 1) // 2)
    check_turned(chain.R_lab_body, settings)
    return chain


def measured_evidence(disks: Disks, settings: PaintSettings) -> Evidence:
    """Learn from pairs at random rotations how well paint correlates that is not the same."""
    rng = torch.Generator().manual_seed(CHANCE_SEED)
    first = torch.randint(len(disks), (CHANCE_PAIRS,), generator=rng)
    second = (first + 1 + torch.randint(len(disks) - 1, (CHANCE_PAIRS,), generator=rng)) % len(disks)
    turns = climb_pairs(disks, first, second, so3.random_rotations(CHANCE_PAIRS, generator=rng), 0, CLIMB_EVERY)
    told = turns.where(turns.overlap > OVERLAP_MIN)
    spread = (told.score.square() * told.overlap).median() / CHI2_MEDIAN
    return Evidence(disks=disks, cells=1 / max(float(spread), 1e-6), score_min=settings.score_min)


def all_pairs(disks: Disks) -> Turns:
    """Compare all disks with all over all rotations, and climb from the best few of each pair."""
    small = reduced(disks, SMALLER)
    grid = so3.lattman_grid(math.radians(STEP_DEG))
    grid = grid[grid[:, 2, 2] > math.cos(math.radians(TILT_DEG))]
    parts = list(_starts(small, grid))
    first, second, R_ji = (torch.cat(part) for part in zip(*parts, strict=True))
    return climb_pairs(disks, first, second, R_ji, CLIMBS, CLIMB_EVERY)


def _starts(small: Disks, grid: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield pairs (first, second) and their best rotations R_ji (E, 3, 3), disk after disk."""
    cameras = small.layers.shape[1]
    for second in range(len(small)):
        for a, b in ((a, b) for a in range(cameras) for b in range(cameras)):
            if not bool(small.seen[second, b]):
                continue
            scores = search_views(small, (a, b), second, grid, EVERY)
            top = scores.topk(min(TOPS, len(grid)), dim=1).indices
            peak = distinct(grid[top], math.radians(PEAK_DEG))
            peak &= (peak.cumsum(1) <= PEAKS) & small.seen[:, a, None]
            peak[second] = False
            first, which = torch.nonzero(peak).T
            R_lab_view = small.R_lab_view.double()
            turn = R_lab_view[second, b] @ grid[top[first, which]] @ R_lab_view[first, a].mT
            yield first, torch.full_like(first, second), turn


def joined_sets(evidence: Evidence, found: Turns) -> tuple[Tensor, Tensor]:
    """Join pictures to sets, and sets to larger ones, where all their pictures together say so, surest pairs first.

    Args:
        evidence: of N pictures.
        found: what pairs may be; several of one pair contradict each other.

    Returns:
        The number of each picture's set (N,) int64, and attitudes (N, 3, 3), comparable within a set.
    """
    count = len(evidence.disks)
    label, R = torch.arange(count), torch.eye(3, dtype=torch.float64).repeat(count, 1, 1)
    odds = evidence.of(found)
    order = odds.argsort(descending=True, stable=True)
    order = order[odds[order] > 0]
    turns, before = found.where(order[:0]), label + 1
    while not torch.equal(label, before):  # what larger sets tell may join what smaller ones could not
        before = label
        for i, j, R_ji in zip(found.first[order], found.second[order], found.R_ji[order], strict=True):
            if label[i] == label[j]:
                continue
            one, other = label == label[i], label == label[j]
            placed = torch.where(other[:, None, None], R @ (R[j].mT @ R_ji @ R[i]), R)
            told, gained = _told(evidence, placed, one[:, None] & other, JOIN_STEPS)
            if float(gained.sum()) > SURE:
                turns = joined([turns, told.where(gained > 0)])
                label = torch.where(other, label[i], label)
                R = _solved(placed, turns, one | other)
    return label, R


def _told(evidence: Evidence, R_lab_body: Tensor, wanted: Tensor, steps: int) -> tuple[Turns, Tensor]:
    """Compare pairs of pictures where attitudes say that they are.

    Args:
        evidence: of N pictures.
        R_lab_body: (N, 3, 3).
        wanted: (N, N) bool, pairs; those that should share too little are left out.
        steps: of the climb.

    Returns:
        Turns, and the log of their odds (E,); pairs that are elsewhere than they should be do not show the same.
    """
    alike = likeness(evidence.disks, R_lab_body, torch.arange(len(R_lab_body)))
    first, second = torch.nonzero(wanted & (alike > math.cos(math.radians(TILT_DEG)))).T
    about = R_lab_body[second] @ R_lab_body[first].mT
    turns = climb_pairs(evidence.disks, first, second, about, steps, CLIMB_EVERY)
    near = so3.geodesic_distance(turns.R_ji, about) < REACH_RAD
    return turns, evidence.of(replace(turns, score=torch.where(near, turns.score, 0.0)))


def _solved(R_lab_body: Tensor, turns: Turns, chosen: Tensor) -> Tensor:
    """Return attitudes (N, 3, 3) of which some, chosen (N,) bool, are fitted to the turns among them."""
    own = turns.where(chosen[turns.first] & chosen[turns.second])
    place = chosen.cumsum(0) - 1
    R = R_lab_body.clone()
    R[chosen], _ = solve_graph(R[chosen], replace(own, first=place[own.first], second=place[own.second]), SCALE_RAD)
    return R


def settled(evidence: Evidence, rows: Tensor, R_lab_body: Tensor) -> tuple[Tensor, Tensor, Turns]:
    """Compare all pairs of a set that should share paint, and fit attitudes to those that do.

    Args:
        evidence: of N pictures.
        rows: (M,) int64, rising, of the set.
        R_lab_body: (N, 3, 3), to a few degrees.

    Returns:
        Rows of the pictures that belong to it by all their pairs together, their attitudes, and the turns, of N.
    """
    inside = torch.zeros(len(R_lab_body), dtype=torch.bool)
    inside[rows] = True
    told, odds = _told(evidence, R_lab_body, (inside[:, None] & inside).triu(1), CLIMBS)
    total = torch.zeros(len(R_lab_body), dtype=odds.dtype)
    total = total.index_add(0, told.first, odds).index_add(0, told.second, odds)
    good = (odds > 0) & (total[told.first] > 0) & (total[told.second] > 0)
    told = told.where(good)
    rows = _connected(told, len(R_lab_body))
    chosen = torch.zeros_like(inside)
    chosen[rows] = True
    told = told.where(chosen[told.first])
    R_lab_body = _solved(R_lab_body, told, chosen)
    return rows, R_lab_body, told


def _connected(turns: Turns, count: int) -> Tensor:
    """Return the instants (M,) of the largest set that turns connect."""
    one = np.ones(len(turns))
    graph = coo_matrix((one, (turns.first.numpy(), turns.second.numpy())), shape=(count, count))
    label = torch.from_numpy(connected_components(graph, directed=False)[1].astype(np.int64))
    return torch.nonzero(label == int(label.bincount().argmax()))[:, 0]


def _largest(label: Tensor) -> Tensor:
    """Return the pictures (M,) of the largest set.

    Raises:
        PaintError: there is none, or another that is nearly as large.
    """
    size, order = label.bincount().sort(descending=True, stable=True)
    if int(size[0]) < FEWEST:
        got = f"{int(size[0]) if int(size[0]) > 1 else 'none'} among {len(label)}"
        do = "take pictures that show the same paint, from 45 degrees apart at most"
        raise PaintError(refusal("photographs", expected=f"{FEWEST} that share paint", got=got, do=do))
    second = int(size[1]) if len(size) > 1 else 0
    if second >= max(OTHER_LEAST, OTHER_SHARE * int(size[0])):
        got = f"{int(size[0])} pictures and {second} others that show no paint of theirs"
        do = "check that all are of one ball, or take pictures of the sides between"
        raise PaintError(refusal("photographs", expected="one ball", got=got, do=do))
    return torch.nonzero(label == order[0])[:, 0]


def _chain(rows: Tensor, joined_R: Tensor, R_lab_body: Tensor, turns: Turns, compared: int) -> Chain:
    """Put it into the noun that comes out: the body frame is the lab's at the first picture of the set."""
    place = torch.full((len(R_lab_body),), -1).index_put((rows,), torch.arange(len(rows)))
    own = replace(turns, first=place[turns.first], second=place[turns.second])
    before, after = (so3.nearest_rotation(R[rows] @ R[rows[0]].mT) for R in (joined_R, R_lab_body))
    drift = [so3.log(own.R_ji @ (R[own.second] @ R[own.first].mT).mT) for R in (before, after)]
    return Chain(
        rows=rows,
        R_lab_body=after,
        turns=own,
        closure=Closure(
            pairs=len(rows) - 1,
            loops=compared,
            closed=len(own),
            drift_before_rad=rms(drift[0]),
            drift_after_rad=rms(drift[1]),
            moved_rad=moved(before, after),
        ),
    )
