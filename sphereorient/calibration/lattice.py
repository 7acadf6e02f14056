from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sphereorient.calibration import targets
from sphereorient.calibration.dots import Dots
from sphereorient.calibration.targets import FIDUCIALS, DotPlate, Floats, Ints, PlateView, refused_view
from sphereorient.errors import refusal

NEIGHBOURS = 24  # of each dot: at a tilt of 75 degrees the next column is about the 12th nearest
STEP_MISS = 0.28  # largest distance of a step's end from its dot, pitches
MODEL_MISS = 0.06  # largest distance of a dot from the smooth map of the lattice, pitches
CUBIC_FROM = 40  # dots from which the map has cubic terms, for lenses and walls
SEEDS = 12  # starting dots tried
LEAST_DOTS = 12  # fewer hardly test a homography (8 numbers)
WIDTH_MISS = 0.25  # relative difference between a dot's width and that of calibration.yaml
MIRROR = np.array([1, -1])
NEAR = 0.5  # distance of a click from its dot, pitches
CLICK = "click them with `sphereorient mark calibration.yaml`"
AGAIN = "click the fiducials again with `sphereorient mark calibration.yaml`"
STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))


@dataclass(frozen=True, kw_only=True, eq=False)
class Lattice:
    """Dots with grid indices; the axes are right-handed about the viewer."""

    which: Ints  # (n,), indices of these dots in `Dots`
    index: Ints  # (n, 2), grid indices up to quarter turns and a shift
    width: Floats  # (n,), diameters of the dots, in pitches
    steps: Floats  # (n, 2, 2), px: at each dot the steps to the next column (first column) and to the next row (second)


def find_lattice(dots: Dots) -> Lattice | None:
    """Find the largest square lattice among dots; None for fewer than 9 dots or a single row.
    Under any tilt, a dot's four neighbours are equally far, measured in local radii, and at right angles.
    """
    if len(dots) < 9:
        return None
    field = _Field(dots)
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


class _Field:
    """Dots with their neighbours near (n, k), and metric (n, 2, 2): v^T metric v = 1 for v one pitch long."""

    def __init__(self, dots: Dots) -> None:
        self.uv_px = dots.uv_px
        self.tree: cKDTree[None] = cKDTree(dots.uv_px)
        k = min(NEIGHBOURS, len(dots) - 1)
        near = np.asarray(self.tree.query(dots.uv_px, k=k + 1)[1], dtype=np.int64)
        # The median over neighbours removes the effect of fiducials and stray blobs.
        shape = np.median(dots.shape[near[:, : min(k, 8) + 1]], axis=1)
        away = dots.uv_px[near[:, 1:]] - dots.uv_px[:, None]
        radii = np.sqrt(np.einsum("nka,nab,nkb->nk", away, shape, away))
        pitch = np.median(radii.min(axis=1))  # in radii of a dot
        self.near, self.metric = near[:, 1:], shape / pitch**2

    def _pitches(self, k: int, away: Floats) -> Floats:
        return np.asarray(np.sqrt(np.einsum("...a,ab,...b->...", away, self.metric[k], away)))

    def steps_from(self, k: int) -> tuple[Floats, Floats] | None:
        """Return the two steps, px, to the neighbours of dot k, if four of them form a right-angled cross."""
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
        # From the front of the plate the determinant of the steps is negative, as v runs down.
        turned = first[0] * second[1] - first[1] * second[0]
        return (first, second) if turned < 0 else (first, -second)

    def seeds(self) -> list[int]:
        crosses = [k for k in range(len(self.uv_px)) if self.steps_from(k) is not None]
        middle = np.median(self.uv_px, axis=0)
        return sorted(crosses, key=lambda k: float(np.hypot(*(self.uv_px[k] - middle))))

    def grow(self, seed: int) -> dict[int, tuple[int, int]]:
        """Return the grid indices of all dots reached from the seed, (0, 0), by steps of one pitch."""
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
        # Steps to neighbours with an index follow the perspective; otherwise use the parent's step.
        seen: tuple[list[Floats], list[Floats]] = ([], [])
        for di, dj in STEPS:
            m = dot_at.get((at[0] + di, at[1] + dj))
            if m is not None:
                seen[dj != 0].append((di + dj) * (self.uv_px[m] - self.uv_px[k]))
        i, j = (np.mean(found, axis=0) if found else usual for found, usual in zip(seen, guess, strict=True))
        return i, j


@dataclass(frozen=True, eq=False)
class _Map:
    homography: Floats  # (3, 3)
    middle: Floats  # (2,), of the grid indices
    size: float
    bend: Floats  # (10, 2) px

    @classmethod
    def fitted(cls, index: Ints, uv_px: Floats) -> "_Map | None":
        middle = index.mean(axis=0)
        size = max(float(np.abs(index - middle).max()), 1.0)
        near = (index - middle) / size
        found: Any = cv2.findHomography(near, uv_px, 0)[0]
        if found is None or not np.isfinite(found).all():
            return None
        straight = cls(np.asarray(found, dtype=np.float64), middle, size, np.zeros((10, 2)))
        if len(index) < CUBIC_FROM:
            return straight
        bend: Any = np.linalg.lstsq(straight._terms(index), uv_px - straight(index), rcond=1e-9)[0]
        return replace(straight, bend=bend)

    def _terms(self, index: Floats | Ints) -> Floats:
        x, y = ((index - self.middle) / self.size).T
        return np.stack([x**a * y**b for a in range(4) for b in range(4 - a)], axis=1)

    def __call__(self, index: Floats | Ints) -> Floats:
        near = (index - self.middle) / self.size
        h = np.column_stack([near, np.ones(len(near))]) @ self.homography.T
        return np.asarray(h[:, :2] / h[:, 2:] + self._terms(index) @ self.bend)

    def nearest(self, uv_px: Floats) -> Ints:
        """Return the nearest grid indices (n, 2), by the homography: cubic terms do not extrapolate."""
        h = np.column_stack([uv_px, np.ones(len(uv_px))]) @ np.linalg.inv(self.homography).T
        return np.asarray(np.rint(h[:, :2] / h[:, 2:] * self.size + self.middle), dtype=np.int64)

    def steps(self, index: Ints) -> Floats:
        """Return (n, 2, 2) px: the steps to the next column (first column) and to the next row (second)."""
        e = 0.5 * np.eye(2)
        return np.stack([self(index + e[a]) - self(index - e[a]) for a in (0, 1)], axis=-1)

    def misses(self, index: Ints, uv_px: Floats) -> Floats:
        away = np.linalg.solve(self.steps(index), (uv_px - self(index))[..., None])[..., 0]
        return np.asarray(np.hypot(away[:, 0], away[:, 1]))


def _checked(dots: Dots, which: Ints, index: Ints) -> Lattice | None:
    """Drop dots that do not fit the smooth map, and add dots that the steps did not reach."""
    which, index, lattice_map = _agreeing(dots, which, index)
    if lattice_map is None:
        return None
    rest = np.setdiff1d(np.arange(len(dots)), which)
    there = lattice_map.nearest(dots.uv_px[rest])
    taken = (there[:, None] == index).all(axis=2).any(axis=1)
    # Only fill gaps: outside the indexed area a stray blob is likelier than a dot.
    inside = ((there >= index.min(axis=0)) & (there <= index.max(axis=0))).all(axis=1)
    fits = np.flatnonzero(inside & ~taken)
    fits = fits[lattice_map.misses(there[fits], dots.uv_px[rest[fits]]) < MODEL_MISS]
    which, index = np.concatenate([which, rest[fits]]), np.concatenate([index, there[fits]])
    which, index, lattice_map = _agreeing(dots, which, index)
    if lattice_map is None:
        return None
    steps = lattice_map.steps(index)
    width = np.sqrt(4 / np.pi * dots.area_px[which] / np.abs(np.linalg.det(steps)))
    return Lattice(which=which, index=index, width=width, steps=steps)


def _agreeing(dots: Dots, which: Ints, index: Ints) -> tuple[Ints, Ints, _Map | None]:
    """Drop the worst dots, a few at a time, until all are within MODEL_MISS of the map of the others."""
    while True:
        enough = len(which) >= 9 and (np.ptp(index, axis=0) >= 1).all()
        lattice_map = _Map.fitted(index, dots.uv_px[which]) if enough else None
        if lattice_map is None:
            return which[:0], index[:0], None
        miss = lattice_map.misses(index, dots.uv_px[which])
        kept: NDArray[np.bool_] = miss <= max(MODEL_MISS, 0.5 * float(miss.max()))
        if kept.all():
            return which, index, lattice_map
        which, index = which[kept], index[kept]


def index_dots(dots: Dots, plate: DotPlate, name: str = "plate picture", clicked: Floats | None = None) -> PlateView:
    """Identify the dots of a picture on the plate by trying quarter turns and shifts; `name` appears in the reason.
    The larger dots must be exactly the visible fiducials. One placement: `tied`; several: `floating`; none: `refused`.
    `clicked` (2 or 3, 2), px: approximate fiducials, in the plate's order; they fix the lattice instead of the larger
    dots: `tied`, or `refused` if they contradict the plate. Dots of the wrong width are dropped.
    """
    lattice = find_lattice(dots)
    if lattice is None or len(lattice.index) < LEAST_DOTS:
        got = f"{len(dots)} dots" + ("" if lattice is None else f", {len(lattice.index)} of them in a lattice")
        expected = f"a lattice of {LEAST_DOTS} dots or more, 3 x 3 of them whole"
        do = "check that the picture shows the plate, sharp, and with dark or bright dots as stated"
        return refused_view(name, expected, got, do)
    dot, fiducial = plate.dot_diameter_mm / plate.pitch_mm, plate.fiducial_diameter_mm / plate.pitch_mm
    large = lattice.width > np.sqrt(dot * fiducial)
    odd = np.abs(lattice.width / np.where(large, fiducial, dot) - 1) > WIDTH_MISS
    if odd.mean() > 0.2:
        expected, got = f"dots {dot:.2f} pitches wide", f"{np.median(lattice.width):.2f} pitches"
        return refused_view(name, expected, got, "correct pitch and dot_diameter of the plate")
    which, index, large = lattice.which[~odd], lattice.index[~odd], large[~odd]
    across, up = np.ptp(index, axis=0) + 1
    if (np.sort([across, up]) > np.sort([plate.columns, plate.rows])).any():
        expected, got = f"at most {plate.columns} x {plate.rows} dots", f"a lattice of {across} x {up}"
        return refused_view(name, expected, got, "correct columns and rows of the plate")
    placements = _placements(index, large, plate)
    if clicked is not None:
        found = _clicked_placement(dots, lattice, clicked, plate, name)
        if isinstance(found, PlateView):
            return found
        there = targets.quarter_turned(index, int(found[0])) + found[1:]
        if not plate.holds(there).all():
            expected, got = f"an origin with all dots on {plate.columns} x {plate.rows}", "dots beyond the plate's edge"
            return refused_view(f"{name}, clicked", expected, got, AGAIN)
        if large.sum() >= 2 and len(placements) == 1 and (placements[0] != found).any():
            return refused_view(f"{name}, clicked", "the larger dots that are found", "other dots", AGAIN)
        kept = plate.is_fiducial(there) == large
        which, index, placements = which[kept], index[kept], found[None]
    if len(placements) == 0:
        if len(_placements(index * MIRROR, large, plate)):
            return _mirrored(name)
        expected = f"larger dots at the grid indices {[list(f) for f in plate.fiducials]}"
        got = f"{int(large.sum())} larger dots that fit no part of {plate.columns} x {plate.rows}"
        return refused_view(name, expected, got, f"correct columns, rows and fiducials of the plate, or {CLICK}")
    got = f"{int(large.sum())}, which allow {len(placements)} positions of the dots on the plate"
    do = f"show the fiducials, to another camera at the same instant, or {CLICK}"
    view = targets.seen(plate, index, dots.uv_px[which], dots.sigma_px[which])
    return view.settled(plate, placements, refusal(name, expected="3 larger dots in view", got=got, do=do))


def _clicked_placement(dots: Dots, lattice: Lattice, clicked: Floats, plate: DotPlate, name: str) -> Ints | PlateView:
    """Return the placement (3,) of a lattice that puts the fiducials at the clicked points; or the refusal."""
    at = np.zeros((len(clicked), 2), dtype=np.int64)
    for k, uv_px in enumerate(clicked):
        away = uv_px - dots.uv_px[lattice.which]
        near = int(np.argmin((away**2).sum(axis=1)))
        pitches = np.linalg.solve(lattice.steps[near], away[near])
        step = np.rint(pitches)  # not zero: the click is on a covered dot next to this one
        if np.abs(step).max() > 1 or np.hypot(*(pitches - step)) > NEAR:
            got = f"none at {uv_px.round(1).tolist()}"
            return refused_view(f"{name}, clicked {FIDUCIALS[k]}", "a dot of the lattice there", got, AGAIN)
        at[k] = lattice.index[near] + step.astype(np.int64)
    marks = np.array(plate.fiducials)[: len(at)]
    for mirror in (1, MIRROR):
        for quarters in range(4):
            turned = targets.quarter_turned(at * mirror, quarters)
            shift = marks[0] - turned[0]
            if (turned + shift == marks).all():
                return _mirrored(name) if mirror is MIRROR else np.array([quarters, *shift])
    expected, got = f"{marks.tolist()}, columns and rows up to a rotation", f"{(at - at[0]).tolist()}"
    return refused_view(f"{name}, clicked", expected, got, AGAIN)


def _placements(index: Ints, large: NDArray[np.bool_], plate: DotPlate) -> Ints:
    """Return the placements (m, 3) of a lattice on the plate that agree with its larger dots."""
    found = []
    for quarters in range(4):
        at = targets.quarter_turned(index, quarters)
        shifts = targets.indices(plate.first - at.min(axis=0), plate.last - at.max(axis=0))
        for shift in np.asarray(plate.fiducials - at[large][0]) if large.any() else shifts:
            there = at + shift
            if plate.holds(there).all() and (plate.is_fiducial(there) == large).all():
                found.append((quarters, *shift))
    return np.array(found, dtype=np.int64).reshape(-1, 3)


def _mirrored(name: str) -> PlateView:
    expected, got = "the plate from its front, z towards the camera", "its mirror image"
    do = "mirror the picture back, or correct the fiducials: x to the right of the origin, y above it"
    return refused_view(name, expected, got, do)
