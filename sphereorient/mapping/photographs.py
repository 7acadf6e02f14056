"""Orientations of unordered photographs: compare all pairs over all rotations, join consistent sets."""

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
    EVERY,
    ITERATIONS,
    OVERLAP_MIN,
    SEARCH_STEP_DEG,
    SMALLER,
    PairwiseAttitudes,
    check_turned,
)
from sphereorient.mapping.disks import Disks, reduced
from sphereorient.mapping.pairs import Closure, RelativeRotations, refine_pairs, search_views, solve_graph
from sphereorient.mapping.settings import MapSettings
from sphereorient.search.candidates import distinct

TILT_DEG = 75.0  # between lines of sight in the body; beyond, two disks share too little
MODES, PEAKS = 96, 3  # best rotations of a pair, and distinct ones to refine
PEAK_DEG = 18.0  # least angle between distinct ones
FINER = 2.7  # finer detail, window and pixels of the disks in the last comparison, if resolved
DISK_PX_MAX = 128  # side of these disks, px: bounds time and memory
CHANCE_PAIRS = 500  # pairs at random rotations, for the correlation of different patches
CHI2_MEDIAN = 0.4549  # of the square of a normal number
FEWEST = 3  # pictures: each pair of the smallest set is confirmed by the two others
LIKE_MAX = 0.98  # largest correlation that counts
# Log-odds above which two sets are joined; the best wrong of 5 million rotations of 30 pictures has about 20.
SURE = 25.0
REACH_RAD = math.radians(10.0)  # largest difference of a pair from the orientations of the others
SCALE_RAD = math.radians(2.0)  # scatter of pairs with only slanted places in common, by errors of the outlines
OTHER_SHARE, OTHER_LEAST = 0.5, 4  # of the largest set, and pictures: such a second set is another ball


def finer_settings(settings: MapSettings, diameter_px: float) -> MapSettings:
    """Return settings of finer disks, up to the pictures' resolution: coarse ones err by 2 degrees at slants."""
    factor = min(max(diameter_px / settings.disk_px, 1.0), FINER, DISK_PX_MAX / settings.disk_px)
    finer = {"detail": settings.detail / factor, "window": settings.window / factor}
    return settings.model_copy(update={"disk_px": 2 * round(factor * settings.disk_px / 2), **finer})


@dataclass(frozen=True, kw_only=True, eq=False)
class Evidence:
    """Odds of the same patch against different patches in two disks."""

    disks: Disks
    cells: float  # independent places of a disk, by the correlation of different patches
    score_min: float

    def log_odds(self, pairs: RelativeRotations) -> Tensor:
        """Return the log-odds (E,) of pairs, from Fisher's z of their correlations over n independent places.
        Its mean is 0 for different patches, about twice that of `score_min` for the same; the variance is 1 / n.
        Source: Fisher 1921, On the probable error of a coefficient of correlation.
        """
        middle = math.atanh(self.score_min)
        z = pairs.score.clamp(-LIKE_MAX, LIKE_MAX).atanh()
        return 2 * middle * self.cells * pairs.overlap * (z - middle)


def find_photographs(disks: Disks, finer: Disks, settings: MapSettings) -> PairwiseAttitudes:
    """Find orientations of N unordered photographs in disks, finally in `finer` ones, for the largest set only.
    Raises PaintError (fewer than three pictures, no common patch, also in fine detail, a sphere that does not rotate,
    or two spheres).
    """
    if len(disks) < FEWEST:
        do = "take more pictures of the ball, from all sides"
        expected = f"at least {FEWEST} with the ball"
        raise PaintError(refusal("photographs", expected=expected, got=f"{len(disks)}", do=do))
    rough = measured_evidence(disks, settings)
    label, joined_R = joined_sets(rough, all_pairs(disks))
    rows, R, pairs = _settled(rough, _largest(label), joined_R)
    fine = measured_evidence(finer, settings)
    for _ in range(2):  # compare in fine detail, each time from the joint orientations
        rows, R, pairs = _settled(fine, rows, R)
    if len(rows) < FEWEST:
        do = "take sharper or less noisy pictures, or raise paint.detail"
        expected, got = f"{FEWEST} that agree in fine detail", f"{len(rows) if len(rows) > 1 else 'none'}"
        raise PaintError(refusal("photographs", expected=expected, got=got, do=do))
    before, after = (so3.nearest_rotation(attitudes[rows] @ attitudes[rows[0]].mT) for attitudes in (joined_R, R))
    place = torch.full((len(R),), -1).index_put((rows,), torch.arange(len(rows)))
    own = replace(pairs, first=place[pairs.first], second=place[pairs.second])
    check_turned(after, settings)
    closure = Closure.of(own, before, after, pairs=len(rows) - 1, loops=len(disks) * (len(disks) - 1) // 2)
    return PairwiseAttitudes(rows=rows, R_lab_body=after, closure=closure)


def measured_evidence(disks: Disks, settings: MapSettings) -> Evidence:
    """Measure the correlation of different patches at random rotations."""
    rng = torch.Generator().manual_seed(0)
    first = torch.randint(len(disks), (CHANCE_PAIRS,), generator=rng)
    second = (first + 1 + torch.randint(len(disks) - 1, (CHANCE_PAIRS,), generator=rng)) % len(disks)
    pairs = refine_pairs(disks, first, second, so3.random_rotations(CHANCE_PAIRS, generator=rng), 0, EVERY)
    used = pairs.where(pairs.overlap > OVERLAP_MIN)
    scatter = (used.score.square() * used.overlap).median() / CHI2_MEDIAN
    return Evidence(disks=disks, cells=1 / max(float(scatter), 1e-6), score_min=settings.score_min)


def all_pairs(disks: Disks) -> RelativeRotations:
    """Compare all pairs of disks over all rotations, and refine the best few rotations of each pair."""
    small = reduced(disks, SMALLER)
    grid = so3.lattman_grid(math.radians(SEARCH_STEP_DEG))
    grid = grid[grid[:, 2, 2] > math.cos(math.radians(TILT_DEG))]
    first, second, R_ji = (torch.cat(part) for part in zip(*_starts(small, grid), strict=True))
    return refine_pairs(disks, first, second, R_ji, ITERATIONS, EVERY)


def _starts(small: Disks, grid: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield pairs (first, second) and their best rotations R_ji (E, 3, 3), disk by disk."""
    cameras = range(small.layers.shape[1])
    R_lab_view = small.R_lab_view.double()
    for second in range(len(small)):
        for a, b in ((a, b) for a in cameras for b in cameras if small.seen[second, b]):
            scores = search_views(small, (a, b), second, grid)
            top = scores.topk(min(MODES, len(grid)), dim=1).indices
            peak = distinct(grid[top], math.radians(PEAK_DEG))
            peak &= (peak.cumsum(1) <= PEAKS) & small.seen[:, a, None]
            peak[second] = False
            first, which = torch.nonzero(peak).T
            turn = R_lab_view[second, b] @ grid[top[first, which]] @ R_lab_view[first, a].mT
            yield first, torch.full_like(first, second), turn


def joined_sets(evidence: Evidence, found: RelativeRotations) -> tuple[Tensor, Tensor]:
    """Join pictures, then sets whose pairs all agree; return sets (N,) int64 and orientations (N, 3, 3) within them."""
    count = len(evidence.disks)
    label, R = torch.arange(count), torch.eye(3, dtype=torch.float64).repeat(count, 1, 1)
    odds = evidence.log_odds(found)
    order = odds.argsort(descending=True, stable=True)
    order = order[odds[order] > 0]
    pairs, before = found.where(order[:0]), label + 1
    while not torch.equal(label, before):  # larger sets may join where smaller ones could not
        before = label
        for i, j, R_ji in zip(found.first[order], found.second[order], found.R_ji[order], strict=True):
            if label[i] == label[j]:
                continue
            one, other = label == label[i], label == label[j]
            placed = torch.where(other[:, None, None], R @ (R[j].mT @ R_ji @ R[i]), R)
            # Starts of the refinement of pairs between two sets.
            between, gained = _compared_at(evidence, placed, one[:, None] & other, 4)
            if float(gained.sum()) > SURE:
                pairs = RelativeRotations.joined([pairs, between.where(gained > 0)])
                label = torch.where(other, label[i], label)
                R = _solved(placed, pairs, one | other)
    return label, R


def _compared_at(
    evidence: Evidence, R_lab_body: Tensor, wanted: Tensor, iterations: int
) -> tuple[RelativeRotations, Tensor]:
    """Compare pairs `wanted` (N, N) at given orientations; return rotations and log-odds (E,), low if far away."""
    near = evidence.disks.sight_cosines(R_lab_body, torch.arange(len(R_lab_body)))
    first, second = torch.nonzero(wanted & (near > math.cos(math.radians(TILT_DEG)))).T
    about = R_lab_body[second] @ R_lab_body[first].mT
    pairs = refine_pairs(evidence.disks, first, second, about, iterations, EVERY)
    close = so3.geodesic_distance(pairs.R_ji, about) < REACH_RAD
    return pairs, evidence.log_odds(replace(pairs, score=torch.where(close, pairs.score, 0.0)))


def _solved(R_lab_body: Tensor, pairs: RelativeRotations, chosen: Tensor) -> Tensor:
    """Fit the chosen orientations (N,) bool to the pairs among them; return all, (N, 3, 3)."""
    own = pairs.where(chosen[pairs.first] & chosen[pairs.second])
    place = chosen.cumsum(0) - 1
    R = R_lab_body.clone()
    R[chosen], _ = solve_graph(R[chosen], replace(own, first=place[own.first], second=place[own.second]), SCALE_RAD)
    return R


def _settled(evidence: Evidence, rows: Tensor, R_lab_body: Tensor) -> tuple[Tensor, Tensor, RelativeRotations]:
    """Fit orientations (N, 3, 3) to all matching pairs of a set (M,); return confirmed rows, orientations and pairs."""
    inside = torch.zeros(len(R_lab_body), dtype=torch.bool)
    inside[rows] = True
    pairs, odds = _compared_at(evidence, R_lab_body, (inside[:, None] & inside).triu(1), ITERATIONS)
    total = torch.zeros(len(R_lab_body), dtype=odds.dtype)
    total = total.index_add(0, pairs.first, odds).index_add(0, pairs.second, odds)
    pairs = pairs.where((odds > 0) & (total[pairs.first] > 0) & (total[pairs.second] > 0))
    graph = coo_matrix((np.ones(len(pairs)), (pairs.first.numpy(), pairs.second.numpy())), shape=(len(inside),) * 2)
    label = torch.from_numpy(connected_components(graph, directed=False)[1].astype(np.int64))
    chosen = label == int(label.bincount().argmax())
    pairs = pairs.where(chosen[pairs.first])
    return torch.nonzero(chosen)[:, 0], _solved(R_lab_body, pairs, chosen), pairs


def _largest(label: Tensor) -> Tensor:
    """Return the pictures (M,) of the largest set; raise PaintError if it is too small, or another nearly as large."""
    size, order = label.bincount().sort(descending=True, stable=True)
    if int(size[0]) < FEWEST:
        got = f"{int(size[0]) if int(size[0]) > 1 else 'none'} among {len(label)}"
        do = "take pictures of the same side, at most 45 degrees apart"
        raise PaintError(refusal("photographs", expected=f"{FEWEST} with a common patch", got=got, do=do))
    second = int(size[1]) if len(size) > 1 else 0
    if second >= max(OTHER_LEAST, OTHER_SHARE * int(size[0])):
        got = f"{int(size[0])} pictures and {second} others without a common patch"
        do = "check that all show one ball, or take pictures of the sides between"
        raise PaintError(refusal("photographs", expected="one ball", got=got, do=do))
    return torch.nonzero(label == order[0])[:, 0]
