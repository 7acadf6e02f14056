"""Grid indices of the dots of a plate: the fiducials tell origin, axes and handedness."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sphereorient.calibration.dots import Dots
from sphereorient.calibration.lattice import Lattice, find_lattice
from sphereorient.calibration.placing import placed, turned
from sphereorient.calibration.plate import DotPlate, Ints
from sphereorient.calibration.view import PlateView, nothing_seen
from sphereorient.errors import refusal

LEAST_DOTS = 12  # below it a homography (8 numbers) has too little left over to contradict it
WIDTH_MISS = 0.25  # by which a dot's width may differ from what calibration.yaml says, as part of it
MIRROR = np.array([1, -1])


def index_dots(dots: Dots, plate: DotPlate, name: str = "plate picture") -> PlateView:
    """Tell which dots of the plate the dots of a picture are.

    A lattice is found first (`find_lattice`). Then all places of that lattice on the plate are tried, turned by
    quarters and shifted: dots must lie on the plate, and the larger ones must be just those of the fiducials that are
    seen. One place left: `tied`. Several: `floating`, all of them are in `placements`. None: `refused`.

    Args:
        dots: as of `find_dots`.
        plate: what is known of the plate.
        name: the picture's name, for the reason.

    Returns:
        PlateView, whose points are those dots that belong to the lattice.
    """
    lattice = find_lattice(dots)
    if lattice is None or len(lattice.index) < LEAST_DOTS:
        got = f"{len(dots)} dots" + ("" if lattice is None else f", {len(lattice.index)} of them in a lattice")
        do = "look at the picture: is the plate in it, sharp, and dark or bright as stated"
        return nothing_seen(
            refusal(name, expected=f"a lattice of {LEAST_DOTS} dots or more, 3 x 3 of them whole", got=got, do=do)
        )
    large, odd = _sizes(lattice, plate)
    if odd.mean() > 0.2:
        pitches = float(np.median(lattice.width))
        expected = f"dots {plate.dot_diameter_mm / plate.pitch_mm:.2f} pitches wide"
        do = "correct pitch and dot_diameter of the plate"
        return nothing_seen(refusal(name, expected=expected, got=f"{pitches:.2f} pitches", do=do))
    which, index, large = lattice.which[~odd], lattice.index[~odd], large[~odd]
    seen = np.ptp(index, axis=0) + 1
    if (np.sort(seen) > np.sort([plate.columns, plate.rows])).any():
        expected, got = f"at most {plate.columns} x {plate.rows} dots", f"a lattice of {seen[0]} x {seen[1]}"
        do = "correct columns and rows of the plate"
        return nothing_seen(refusal(name, expected=expected, got=got, do=do))
    placements = places_on_plate(index, large, plate)
    if len(placements) == 0:
        return nothing_seen(_why_nowhere(index, large, plate, name))
    view = PlateView(
        points_plate_mm=plate.points(index),
        uv_px=dots.uv_px[which],
        sigma_px=dots.sigma_px[which],
        diameter_mm=np.where(large, plate.fiducial_diameter_mm, plate.dot_diameter_mm),
        index=index,
        state="floating",
        reason=_why_floating(placements, large, name),
        placements=placements,
    )
    return placed(view, plate, placements[0]) if len(placements) == 1 else view


def places_on_plate(index: Ints, large: NDArray[np.bool_], plate: DotPlate) -> Ints:
    """Return all places of a lattice on the plate that its larger dots allow.

    Args:
        index: (n, 2), grid indices up to a turn and a shift.
        large: (n,), which dots are as large as fiducials.
        plate: what is known of the plate.

    Returns:
        (m, 3): turn by quarters, then shift along columns and along rows (`turned`).
    """
    found: list[tuple[int, int, int]] = []
    for quarters in range(4):
        at = turned(index, quarters)
        for shift in _shifts(at, large, plate):
            there = at + shift
            if plate.holds(there).all() and (plate.is_fiducial(there) == large).all():
                found.append((quarters, int(shift[0]), int(shift[1])))
    return np.array(found, dtype=np.int64).reshape(-1, 3)


def _shifts(at: Ints, large: NDArray[np.bool_], plate: DotPlate) -> Ints:
    if large.any():
        # One larger dot must be one of the three fiducials.
        onto: Ints = np.array(plate.fiducials, dtype=np.int64) - at[large][0]
        return onto
    low, high = np.array(plate.first) - at.min(axis=0), np.array(plate.last) - at.max(axis=0)
    i, j = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    return np.stack([i.ravel(), j.ravel()], axis=1).astype(np.int64)


def _sizes(lattice: Lattice, plate: DotPlate) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which dots are as large as fiducials, and which are as large as neither."""
    dot, fiducial = plate.dot_diameter_mm / plate.pitch_mm, plate.fiducial_diameter_mm / plate.pitch_mm
    large = lattice.width > np.sqrt(dot * fiducial)
    stated = np.where(large, fiducial, dot)
    return large, np.abs(lattice.width / stated - 1) > WIDTH_MISS


def _why_nowhere(index: Ints, large: NDArray[np.bool_], plate: DotPlate, name: str) -> str:
    if len(places_on_plate(index * MIRROR, large, plate)):
        expected, got = "the plate from its front, z towards the camera", "its mirror image"
        do = "turn the picture round, or correct the fiducials: x to the right of the origin, y above it"
        return refusal(name, expected=expected, got=got, do=do)
    expected = f"larger dots at the grid indices {[list(f) for f in plate.fiducials]}"
    got = f"{int(large.sum())} larger dots that fit there nowhere on {plate.columns} x {plate.rows}"
    return refusal(name, expected=expected, got=got, do="correct columns, rows and fiducials of the plate")


def _why_floating(placements: Ints, large: NDArray[np.bool_], name: str) -> str:
    got = f"{int(large.sum())}, which leave {len(placements)} places of its dots on the plate"
    do = "show the fiducials, or have the other camera see them at the same instant"
    return refusal(name, expected="3 larger dots in view", got=got, do=do)
