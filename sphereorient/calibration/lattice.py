"""A square lattice found among dots: grid indices up to a turn and a shift, whatever the tilt."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sphereorient.calibration.dots import Dots
from sphereorient.calibration.plate import Floats, Ints

NEIGHBOURS = 24  # dots looked at about each dot: under 75 degrees of tilt the next column is the 12th nearest or so
STEP_MISS = 0.28  # pitches by which a step may miss its dot; half a pitch would reach the wrong one
MODEL_MISS = 0.06  # pitches by which a dot may miss the smooth map of the whole lattice
CUBIC_FROM = 40  # dots from which the map has cubic terms, for lenses and walls; fewer cannot hold them
SEEDS = 12  # growths tried, from the most regular dots

STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))


@dataclass(frozen=True, kw_only=True, eq=False)
class Lattice:
    """Dots with their places in a lattice whose axes, as seen by the camera, are right-handed about the viewer."""

    which: Ints  # (n,), places of these dots in the `Dots` they were taken from
    index: Ints  # (n, 2), grid indices up to a turn by quarters and a shift
    width: Floats  # (n,), diameters of the dots, in pitches


def find_lattice(dots: Dots) -> Lattice | None:
    """Find the largest square lattice among dots.

    The shape of a dot tells how the plate is foreshortened there: measured in radii of the dots about it, the four
    neighbours of a dot are equally far and at right angles under any tilt. Steps from dot to dot follow that; a
    smooth map from grid to picture (homography, with cubic terms where enough dots are seen) then has to agree with
    every dot.

    Args:
        dots: as of `find_dots`; may hold others than the plate's.

    Returns:
        The lattice, or None where no 9 dots in 2 or more rows and columns make one.
    """
    if len(dots) < 9:
        return None
    field = _Field.about(dots)
    best: dict[int, tuple[int, int]] = {}
    tried: set[int] = set()
    for seed in field.seeds():
        if seed in tried:
            continue
        grown = field.grow(seed)
        tried |= set(grown)
        best = grown if len(grown) > len(best) else best
        if len(tried) > len(dots) - len(best) or len(tried) > SEEDS * 9:
            break
    which, index = np.array(list(best), dtype=np.int64), np.array(list(best.values()), dtype=np.int64).reshape(-1, 2)
    return _checked(dots, which, index)


@dataclass(frozen=True, eq=False)
class _Field:
    """Dots with the foreshortening about each, and the dots near it."""

    uv_px: Floats  # (n, 2)
    metric: Floats  # (n, 2, 2): v^T metric v = 1 for v one pitch long
    near: Ints  # (n, k)
    tree: cKDTree[None]

    @classmethod
    def about(cls, dots: Dots) -> _Field:
        tree: cKDTree[None] = cKDTree(dots.uv_px)
        k = min(NEIGHBOURS, len(dots) - 1)
        near = np.asarray(tree.query(dots.uv_px, k=k + 1)[1], dtype=np.int64)
        # The median over neighbours keeps a fiducial's or a stray blob's own size out.
        shape = np.median(dots.shape[near[:, : min(k, 8) + 1]], axis=1)
        away = dots.uv_px[near[:, 1:]] - dots.uv_px[:, None]
        radii = np.sqrt(np.einsum("nka,nab,nkb->nk", away, shape, away))
        pitch = np.median(radii.min(axis=1))  # in radii of a dot
        return cls(dots.uv_px, shape / pitch**2, near[:, 1:], tree)

    def _pitches(self, k: int, away: Floats) -> Floats:
        length: Floats = np.sqrt(np.einsum("...a,ab,...b->...", away, self.metric[k], away))
        return length

    def steps_from(self, k: int) -> tuple[Floats, Floats] | None:
        """Return the two steps, px, to neighbours of dot k, if it has four in a right-angled cross."""
        away = self.uv_px[self.near[k]] - self.uv_px[k]
        length = self._pitches(k, away)
        away = away[(length > 0.7) & (length < 1.25)]
        opposite = self._pitches(k, away[:, None] + away[None]) < 2 * STEP_MISS
        pairs = [(a, b) for a, b in zip(*np.nonzero(opposite), strict=True) if a < b]
        if len(pairs) != 2:
            return None
        first, second = ((away[a] - away[b]) / 2 for a, b in pairs)
        cosine = first @ self.metric[k] @ second / (self._pitches(k, first) * self._pitches(k, second))
        if abs(cosine) > 0.35:
            return None
        # The plate's x and y, seen from its front: v runs down, so the determinant of the steps is negative.
        turned = first[0] * second[1] - first[1] * second[0]
        return (first, second) if turned < 0 else (first, -second)

    def seeds(self) -> list[int]:
        """Return the dots in a cross of neighbours, the middle of the crowd first."""
        crosses = [k for k in range(len(self.uv_px)) if self.steps_from(k) is not None]
        middle = np.median(self.uv_px, axis=0)
        return sorted(crosses, key=lambda k: float(np.hypot(*(self.uv_px[k] - middle))))

    def grow(self, seed: int) -> dict[int, tuple[int, int]]:
        """Return the grid indices of all dots that steps of one pitch reach from the seed, which is (0, 0)."""
        steps = self.steps_from(seed)
        assert steps is not None
        place, dot_at = {seed: (0, 0)}, {(0, 0): seed}
        basis = {seed: steps}
        queue = deque([seed])
        while queue:
            k = queue.popleft()
            basis[k] = self._local_basis(k, place[k], dot_at, basis[k])
            for di, dj in STEPS:
                there = (place[k][0] + di, place[k][1] + dj)
                target = self.uv_px[k] + di * basis[k][0] + dj * basis[k][1]
                _, found = self.tree.query(target)
                m = int(found)
                miss = float(self._pitches(k, self.uv_px[m] - target))
                if there in dot_at or m in place or miss > STEP_MISS:
                    continue
                place[m], dot_at[there], basis[m] = there, m, basis[k]
                queue.append(m)
        return place

    def _local_basis(
        self, k: int, at: tuple[int, int], dot_at: dict[tuple[int, int], int], guess: tuple[Floats, Floats]
    ) -> tuple[Floats, Floats]:
        # Steps to neighbours already placed follow the perspective; the parent's step stands in where there are none.
        found: list[Floats] = []
        for axis in (0, 1):
            seen = []
            for sign in (1, -1):
                m = dot_at.get((at[0] + sign * (axis == 0), at[1] + sign * (axis == 1)))
                if m is not None:
                    seen.append(sign * (self.uv_px[m] - self.uv_px[k]))
            found.append(np.mean(seen, axis=0) if seen else guess[axis])
        return found[0], found[1]


@dataclass(frozen=True, eq=False)
class _Map:
    """A smooth map from grid indices to pixels: a homography, then cubic terms in the index."""

    homography: Floats  # (3, 3)
    middle: Floats  # (2,), of the grid indices
    size: float
    bend: Floats  # (10, 2) px

    @classmethod
    def fitted(cls, index: Ints, uv_px: Floats) -> _Map | None:
        middle = index.mean(axis=0)
        size = max(float(np.abs(index - middle).max()), 1.0)
        near = (index - middle) / size
        found: Any = cv2.findHomography(near, uv_px, 0)[0]
        if found is None or not np.isfinite(found).all():
            return None
        homography = np.asarray(found, dtype=np.float64)
        straight = cls(homography, middle, size, np.zeros((10, 2)))
        if len(index) < CUBIC_FROM:
            return straight
        terms = straight._terms(index)
        bend = np.linalg.lstsq(terms, uv_px - straight(index), rcond=1e-9)[0]
        return cls(homography, middle, size, np.asarray(bend, dtype=np.float64))

    def _terms(self, index: Floats | Ints) -> Floats:
        x, y = ((index - self.middle) / self.size).T
        return np.stack([x**a * y**b for a in range(4) for b in range(4 - a)], axis=1)

    def straight(self, index: Floats | Ints) -> Floats:
        near = (index - self.middle) / self.size
        h = np.column_stack([near, np.ones(len(near))]) @ self.homography.T
        uv_px: Floats = h[:, :2] / h[:, 2:]
        return uv_px

    def __call__(self, index: Floats | Ints) -> Floats:
        uv_px: Floats = self.straight(index) + self._terms(index) @ self.bend
        return uv_px

    def nearest(self, uv_px: Floats) -> Ints:
        """Return the grid indices (n, 2) next to pixels, by the homography alone: cubic terms do not extrapolate."""
        h = np.column_stack([uv_px, np.ones(len(uv_px))]) @ np.linalg.inv(self.homography).T
        nearest: Ints = np.rint(h[:, :2] / h[:, 2:] * self.size + self.middle).astype(np.int64)
        return nearest

    def steps(self, index: Ints) -> Floats:
        """Return (n, 2, 2) px: the steps to the next column (first column) and to the next row (second)."""
        e = 0.5 * np.eye(2)
        return np.stack([self(index + e[a]) - self(index - e[a]) for a in (0, 1)], axis=-1)

    def misses(self, index: Ints, uv_px: Floats) -> Floats:
        """Return (n,), how far from their places pixels are, in pitches."""
        away = np.linalg.solve(self.steps(index), (uv_px - self(index))[..., None])[..., 0]
        miss: Floats = np.hypot(away[:, 0], away[:, 1])
        return miss


def _checked(dots: Dots, which: Ints, index: Ints) -> Lattice | None:
    """Drop dots that the smooth map of all others does not explain, and add those that steps could not reach."""
    which, index = _agreeing(dots, which, index)
    lattice_map = _usable_map(dots, which, index)
    if lattice_map is None:
        return None
    rest = np.setdiff1d(np.arange(len(dots)), which)
    there = lattice_map.nearest(dots.uv_px[rest])
    taken = {tuple(at) for at in index.tolist()}
    low, high = index.min(axis=0), index.max(axis=0)
    free = np.array([tuple(at) not in taken for at in there.tolist()], dtype=bool) if len(rest) else np.zeros(0, bool)
    # Only gaps are filled: beyond the rim of what steps have reached a stray blob is more likely than a dot.
    free &= ((there >= low) & (there <= high)).all(axis=1)
    fits = np.flatnonzero(free)
    fits = fits[lattice_map.misses(there[fits], dots.uv_px[rest[fits]]) < MODEL_MISS]
    which, index = np.concatenate([which, rest[fits]]), np.concatenate([index, there[fits]])
    which, index = _agreeing(dots, which, index)
    lattice_map = _usable_map(dots, which, index)
    if lattice_map is None:
        return None
    cell = np.abs(np.linalg.det(lattice_map.steps(index)))
    width = np.sqrt(4 / np.pi * dots.area_px[which] / cell)
    return Lattice(which=which, index=index, width=width)


def _usable_map(dots: Dots, which: Ints, index: Ints) -> _Map | None:
    if len(which) < 9 or (np.ptp(index, axis=0) < 1).any():
        return None
    return _Map.fitted(index, dots.uv_px[which])


def _agreeing(dots: Dots, which: Ints, index: Ints) -> tuple[Ints, Ints]:
    """Drop the worst dots, a few at a time, until all lie within MODEL_MISS of the map of those left."""
    while True:
        lattice_map = _usable_map(dots, which, index)
        if lattice_map is None:
            return which[:0], index[:0]
        miss = lattice_map.misses(index, dots.uv_px[which])
        kept: NDArray[np.bool_] = miss <= max(MODEL_MISS, 0.5 * float(miss.max()))
        if kept.all():
            return which, index
        which, index = which[kept], index[kept]
