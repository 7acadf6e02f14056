from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sphereorient.calibration import targets
from sphereorient.calibration.dots import Dots, as_grey, find_dots
from sphereorient.calibration.lattice import index_dots
from sphereorient.calibration.solve import SIGMA_PX
from sphereorient.calibration.targets import (
    CalibrationTarget,
    Floats,
    Ints,
    PlateView,
    quarter_turned,
    refused_view,
    seen,
)
from sphereorient.errors import refusal

LEAST_CORNERS = 6  # of a ChArUco board: fewer hardly determine a homography
WINDOW = 0.3  # half the window of the sub-pixel step, in distances to the nearest corner, so that it holds no other
SHARP = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY


def see_plate(
    picture: NDArray[np.generic], plate: CalibrationTarget, name: str = "plate picture", clicked: Floats | None = None
) -> PlateView:
    """Find `plate` in a grey picture (H, W) of any number type; `refused` with a reason if unusable. Or CameraError.
    `clicked`: approximate fiducials of a plate of dots, see `index_dots`.
    """
    if isinstance(plate, targets.Chessboard):
        return _chessboard(picture, plate, name)
    if isinstance(plate, targets.CharucoBoard):
        return _charuco(picture, plate, name)
    if isinstance(plate, targets.CircleGrid):
        return _circles(picture, plate, name)
    assert isinstance(plate, targets.DotPlate)
    return index_dots(find_dots(picture, dark=plate.dark), plate, name, clicked)


def _chessboard(picture: NDArray[np.generic], board: targets.Chessboard, name: str) -> PlateView:
    """Find all inner corners of a chessboard; floating if the board has a rotational symmetry."""
    grey = _eight_bits(picture)
    found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=SHARP)
    if not found:
        expected = f"a chessboard with {board.columns} x {board.rows} inner corners"
        do = "show the whole board, or correct columns and rows (corners between squares are counted)"
        return refused_view(name, expected, "none", do)
    uv_px = _refined(grey, corners.reshape(-1, 2).astype(np.float64))
    index = _seen_from_front(_row_by_row(board.columns, board.rows), uv_px)
    turns = _turns(board.extent)
    dark = [_lower_left_is_dark(grey, quarter_turned(index, int(p[0])) + p[1:], uv_px) for p in turns]
    view = seen(board, index, uv_px, np.full(len(uv_px), SIGMA_PX))
    return _placed_one_of(turns[dark] if any(dark) else turns, view, board, name)


def _charuco(picture: NDArray[np.generic], board: targets.CharucoBoard, name: str) -> PlateView:
    """Find the corners of a ChArUco board or a part of it."""
    detector, grey = cv2.aruco.CharucoDetector(board.opencv()), _eight_bits(picture)
    corners, ids, _, markers = detector.detectBoard(grey)
    numbers = np.array([] if ids is None else ids, dtype=np.int64).reshape(-1)
    count, across = len(numbers), board.columns - 1
    index = np.stack([numbers % across, board.rows - 2 - numbers // across], axis=1)
    if count < LEAST_CORNERS or (np.ptp(index, axis=0) < 1).any():
        expected = f"{LEAST_CORNERS} corners or more of a {board.columns} x {board.rows} ChArUco board"
        got = f"{count} corners, {0 if markers is None else len(markers)} markers of {board.dictionary}"
        do = "show more of the board, or correct columns, rows, dictionary or legacy_pattern"
        return refused_view(name, expected, got, do)
    # OpenCV 4's corners are off by half a pixel. The windows exclude the markers.
    clear = min(WINDOW, (1 - board.marker_mm / board.pitch_mm) / 2)
    uv_px = _refined(grey, np.asarray(corners).reshape(-1, 2).astype(np.float64), clear)
    return seen(board, index, uv_px, np.full(count, SIGMA_PX))


def _circles(picture: NDArray[np.generic], grid: targets.CircleGrid, name: str) -> PlateView:
    """Find and measure all circles by `find_dots`; OpenCV gives only their order."""
    dots = find_dots(picture, dark=grid.dark)
    order = _circles_in_order(dots, grid)
    if order is None:
        kind = "an asymmetric grid" if grid.asymmetric else "a grid"
        expected, got = f"{kind} of {grid.columns} x {grid.rows} circles", f"none among {len(dots)} dots"
        do = "show the whole grid, or correct columns, rows, asymmetric or dots of the plate"
        return refused_view(name, expected, got, do)
    uv_px = dots.uv_px[order]
    index = _row_by_row(grid.columns, grid.rows)
    if grid.asymmetric:  # OpenCV's own points: the top row is not shifted
        index[:, 0] = 2 * index[:, 0] + (grid.rows - 1 - index[:, 1]) % 2
    view = seen(grid, _seen_from_front(index, uv_px), uv_px, dots.sigma_px[order])
    return _placed_one_of(_turns(grid.extent)[: 1 if grid.asymmetric else None], view, grid, name)


def _placed_one_of(turns: Ints, view: PlateView, plate: CalibrationTarget, name: str) -> PlateView:
    expected, got = "a plate without rotational symmetry", f"{len(turns)} possible rotations"
    do = "show the same pose to a camera that identifies it, or use a plate with marks"
    return view.settled(plate, turns, refusal(name, expected=expected, got=got, do=do))


def _eight_bits(picture: NDArray[np.generic]) -> NDArray[np.uint8]:
    grey = as_grey(picture)
    if picture.dtype == np.uint8:
        return picture.astype(np.uint8)
    low, high = np.percentile(grey, [0.1, 99.9])
    return np.asarray(np.clip((grey - low) * (255.0 / max(high - low, 1e-9)), 0, 255), dtype=np.uint8)


def _refined(grey: NDArray[np.uint8], uv_px: Floats, window: float = WINDOW) -> Floats:
    away = np.linalg.norm(uv_px[:, None] - uv_px[None], axis=-1) + np.diag(np.full(len(uv_px), np.inf))
    half = int(np.clip(window * away.min(), 2, 15))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    better = cv2.cornerSubPix(grey, uv_px.astype(np.float32).reshape(-1, 1, 2), (half, half), (-1, -1), stop)
    return np.asarray(better, dtype=np.float64).reshape(-1, 2)


def _row_by_row(columns: int, rows: int) -> Ints:
    """Return grid indices (columns * rows, 2) in OpenCV's order: from the left, the highest row first."""
    j, i = np.divmod(np.arange(columns * rows), columns)
    return np.stack([i, rows - 1 - j], axis=1).astype(np.int64)


def _homography(index: Floats | Ints, uv_px: Floats) -> Floats:
    return np.asarray(cv2.findHomography(index.astype(np.float64), uv_px, 0)[0], dtype=np.float64)


def _seen_from_front(index: Ints, uv_px: Floats) -> Ints:
    """Reverse the rows if OpenCV numbers the target as seen from behind."""
    h = _homography(index - index.mean(axis=0), uv_px)
    # Determinant of the Jacobian: v runs down, so from the front it is negative.
    slope = h[:2, :2] / h[2, 2] - np.outer(h[:2, 2], h[2, :2]) / h[2, 2] ** 2
    if np.linalg.det(slope) < 0:
        return index
    return np.stack([index[:, 0], index[:, 1].max() - index[:, 1]], axis=1)


def _turns(extent: tuple[int, int]) -> Ints:
    """Return the placements (m, 3) that map a grid with indices 0 .. extent onto itself."""
    across, up = extent
    of_square = [(1, up, 0), (3, 0, across)] if across == up else []
    return np.array([(0, 0, 0), (2, across, up), *of_square], dtype=np.int64)


def _lower_left_is_dark(grey: NDArray[np.uint8], index: Ints, uv_px: Floats) -> bool:
    homography = _homography(index, uv_px)
    across, up = index.max(axis=0)
    i, j = targets.indices((0, 0), (across - 1, up - 1)).T
    middle = np.column_stack([i + 0.5, j + 0.5, np.ones(len(i))]) @ homography.T
    u, v = np.rint(middle[:, :2] / middle[:, 2:]).astype(int).T
    value = grey[v.clip(0, grey.shape[0] - 1), u.clip(0, grey.shape[1] - 1)].astype(np.float64)
    like_corner = (i + j) % 2 == 0  # the colour of the square to the upper right of corner (0, 0)
    return bool(value[like_corner].mean() < value[~like_corner].mean())


def _circles_in_order(dots: Dots, grid: targets.CircleGrid) -> Ints | None:
    if len(dots) < grid.columns * grid.rows:
        return None
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if grid.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    points = dots.uv_px.astype(np.float32).reshape(-1, 1, 2)
    find: Any = cv2.findCirclesGrid  # without a blob detector it takes points, missing in its types
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        found, centres = find(points, (grid.columns, grid.rows), flags, None, cv2.CirclesGridFinderParameters())
        if found:
            tree: Any = cKDTree(dots.uv_px)
            away, order = tree.query(centres.reshape(-1, 2))
            if len(set(order.tolist())) == len(order) and float(away.max()) < 0.5:
                return np.asarray(order, dtype=np.int64)
    return None
