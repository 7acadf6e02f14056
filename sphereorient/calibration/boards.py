"""Chessboards, ChArUco boards and circle grids in a picture, through OpenCV."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.calibration.dots import Dots, as_grey, find_dots
from sphereorient.calibration.placing import placed, turned
from sphereorient.calibration.plate import Floats, Ints
from sphereorient.calibration.targets import CharucoBoard, Chessboard, CircleGrid
from sphereorient.calibration.view import PlateView, nothing_seen
from sphereorient.errors import refusal

CORNER_SIGMA_PX = 0.05  # of a corner as OpenCV finds it: it does not say; tests measure 0.03 to 0.07 on drawn boards
LEAST_CORNERS = 6  # of a ChArUco board: fewer hardly make a homography
WINDOW = 0.3  # half a window of the sub-pixel step, in steps to the nearest corner: its rims hold no other corner
SHARP = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY


def see_chessboard(picture: NDArray[np.generic], board: Chessboard, name: str = "plate picture") -> PlateView:
    """Find the inner corners of a chessboard that is wholly in the picture.

    Args:
        picture: (H, W), grey.
        board: what is known of it.
        name: the picture's name, for the reason.

    Returns:
        PlateView; floating where the board looks the same after a turn.
    """
    grey = _eight_bits(picture)
    found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=SHARP)
    if not found:
        expected, got = f"a chessboard with {board.columns} x {board.rows} inner corners", "none"
        do = "show the whole board, or correct columns and rows (corners between squares are counted)"
        return nothing_seen(refusal(name, expected=expected, got=got, do=do))
    uv_px = _refined(grey, corners.reshape(-1, 2).astype(np.float64))
    index = _seen_from_front(_row_by_row(board.columns, board.rows), uv_px)
    standard = [p for p in _turns(board.extent) if _lower_left_is_dark(grey, turned(index, int(p[0])) + p[1:], uv_px)]
    return _settled(board, index, uv_px, np.full(len(uv_px), CORNER_SIGMA_PX), standard or _turns(board.extent), name)


def see_charuco(picture: NDArray[np.generic], board: CharucoBoard, name: str = "plate picture") -> PlateView:
    """Find the corners of a ChArUco board, also of a part of it.

    Args:
        picture: (H, W), grey.
        board: what is known of it.
        name: the picture's name, for the reason.

    Returns:
        PlateView, tied: the markers tell every corner.
    """
    detector = cv2.aruco.CharucoDetector(board.opencv())
    corners, ids, _, markers = detector.detectBoard(_eight_bits(picture))
    count = 0 if ids is None else len(ids)
    across, up = board.columns - 1, board.rows - 1
    index = np.zeros((0, 2), dtype=np.int64)
    if count:
        numbers = np.asarray(ids).reshape(-1).astype(np.int64)
        index = np.stack([numbers % across, up - 1 - numbers // across], axis=1)
    if count < LEAST_CORNERS or (np.ptp(index, axis=0) < 1).any():
        expected = f"{LEAST_CORNERS} corners or more of a {board.columns} x {board.rows} ChArUco board"
        got = f"{count} corners, {0 if markers is None else len(markers)} markers of {board.dictionary}"
        do = "show more of the board, or correct columns, rows, dictionary or legacy_pattern"
        return nothing_seen(refusal(name, expected=expected, got=got, do=do))
    # OpenCV has refined these already, in windows that keep clear of the markers.
    uv_px = np.asarray(corners).reshape(-1, 2).astype(np.float64)
    return _settled(board, index, uv_px, np.full(count, CORNER_SIGMA_PX), [np.zeros(3, dtype=np.int64)], name)


def see_circles(picture: NDArray[np.generic], grid: CircleGrid, name: str = "plate picture") -> PlateView:
    """Find the circles of a grid that is wholly in the picture.

    The circles are found and measured by `find_dots`; OpenCV only says which of them is which.

    Args:
        picture: (H, W), grey.
        grid: what is known of it.
        name: the picture's name, for the reason.

    Returns:
        PlateView; floating where the grid looks the same after a turn.
    """
    dots = find_dots(picture, dark=grid.dark)
    order = _circles_in_order(dots, grid)
    if order is None:
        kind = "an asymmetric grid" if grid.asymmetric else "a grid"
        expected, got = f"{kind} of {grid.columns} x {grid.rows} circles", f"none among {len(dots)} dots"
        do = "show the whole grid, or correct columns, rows, asymmetric or dots of the plate"
        return nothing_seen(refusal(name, expected=expected, got=got, do=do))
    uv_px = dots.uv_px[order]
    index = _row_by_row(grid.columns, grid.rows)
    if grid.asymmetric:
        # OpenCV's own points: the highest row is not shifted.
        index[:, 0] = 2 * index[:, 0] + (grid.rows - 1 - index[:, 1]) % 2
    index = _seen_from_front(index, uv_px)
    turns = _turns(grid.extent)[:1] if grid.asymmetric else _turns(grid.extent)
    return _settled(grid, index, uv_px, dots.sigma_px[order], turns, name)


def _eight_bits(picture: NDArray[np.generic]) -> NDArray[np.uint8]:
    grey = as_grey(picture)
    if picture.dtype == np.uint8:
        return picture.astype(np.uint8)
    low, high = np.percentile(grey, [0.1, 99.9])
    stretched = np.clip((grey - low) * (255.0 / max(high - low, 1e-9)), 0, 255)
    return np.asarray(stretched, dtype=np.uint8)


def _refined(grey: NDArray[np.uint8], uv_px: Floats) -> Floats:
    """Return corners after OpenCV's sub-pixel step, in windows that hold one corner each."""
    away = np.linalg.norm(uv_px[:, None] - uv_px[None], axis=-1) + np.diag(np.full(len(uv_px), np.inf))
    half = int(np.clip(WINDOW * away.min(), 2, 15))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    better = cv2.cornerSubPix(grey, uv_px.astype(np.float32).reshape(-1, 1, 2), (half, half), (-1, -1), stop)
    return np.asarray(better, dtype=np.float64).reshape(-1, 2)


def _row_by_row(columns: int, rows: int) -> Ints:
    """Return grid indices (columns * rows, 2) in OpenCV's order: from the left, the highest row first."""
    j, i = np.divmod(np.arange(columns * rows), columns)
    return np.stack([i, rows - 1 - j], axis=1).astype(np.int64)


def _homography(index: Floats | Ints, uv_px: Floats) -> Floats:
    homography, _ = cv2.findHomography(index.astype(np.float64), uv_px, 0)
    return np.asarray(homography, dtype=np.float64)


def _seen_from_front(index: Ints, uv_px: Floats) -> Ints:
    """Return the indices, rows reversed where OpenCV counts as if from behind: most patterns have no handedness."""
    h = _homography(index - index.mean(axis=0), uv_px)
    # Slope of the picture at the middle of the board; v runs down, so from the front its determinant is negative.
    slope = h[:2, :2] / h[2, 2] - np.outer(h[:2, 2], h[2, :2]) / h[2, 2] ** 2
    if np.linalg.det(slope) < 0:
        return index
    return np.stack([index[:, 0], index[:, 1].max() - index[:, 1]], axis=1)


def _turns(extent: tuple[int, int]) -> list[Ints]:
    """Return the placements (3,) that put a grid with indices 0 .. extent back onto itself."""
    across, up = extent
    turns = [(0, 0, 0), (2, across, up)]
    if across == up:
        turns += [(1, up, 0), (3, 0, across)]
    return [np.array(t, dtype=np.int64) for t in turns]


def _lower_left_is_dark(grey: NDArray[np.uint8], index: Ints, uv_px: Floats) -> bool:
    homography = _homography(index, uv_px)
    across, up = index.max(axis=0)
    i, j = (part.ravel() for part in np.meshgrid(np.arange(across), np.arange(up)))
    middle = np.column_stack([i + 0.5, j + 0.5, np.ones(len(i))]) @ homography.T
    u, v = np.rint(middle[:, :2] / middle[:, 2:]).astype(int).T
    value = grey[v.clip(0, grey.shape[0] - 1), u.clip(0, grey.shape[1] - 1)].astype(np.float64)
    like_corner = (i + j) % 2 == 0  # the square above and right of corner (0, 0) is as the one below and left of it
    return bool(value[like_corner].mean() < value[~like_corner].mean())


def _circles_in_order(dots: Dots, grid: CircleGrid) -> Ints | None:
    """Return the dots in OpenCV's order, row by row, or None."""
    if len(dots) < grid.columns * grid.rows:
        return None
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if grid.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    points = dots.uv_px.astype(np.float32).reshape(-1, 1, 2)
    find: Any = cv2.findCirclesGrid  # without a blob detector it takes points, which its types do not say
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        found, centres = find(points, (grid.columns, grid.rows), flags, None, cv2.CirclesGridFinderParameters())
        if found:
            away = np.linalg.norm(dots.uv_px[None] - centres.reshape(-1, 1, 2), axis=-1)
            order = away.argmin(axis=1)
            if len(set(order.tolist())) == len(order) and float(away.min(axis=1).max()) < 0.5:
                return np.asarray(order, dtype=np.int64)
    return None


def _settled(
    plate: Chessboard | CharucoBoard | CircleGrid,
    index: Ints,
    uv_px: Floats,
    sigma_px: Floats,
    placements: list[Ints],
    name: str,
) -> PlateView:
    """Return the view, tied where one placement is left."""
    expected, got = "a plate that looks the same from one side only", f"{len(placements)} readings of its turn"
    do = "tie it through the other camera, or use a plate with marks"
    view = PlateView(
        points_plate_mm=plate.points(index),
        uv_px=uv_px,
        sigma_px=sigma_px,
        diameter_mm=plate.diameters(index),
        index=index,
        state="floating",
        reason=refusal(name, expected=expected, got=got, do=do),
        placements=np.stack(placements),
    )
    chosen = placed(view, plate, placements[0])
    return chosen if len(placements) == 1 else view
