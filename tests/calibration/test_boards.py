"""Chessboards, ChArUco boards and circle grids: the same record as of a dot plate."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sphereorient.calibration.boards import see_plate
from sphereorient.calibration.targets import CharucoBoard, Chessboard, CircleGrid, PlateView, placed, plate_from_entry
from sphereorient.errors import CameraError

SIZE = (640, 480)
FINER = 4  # pictures are drawn so many times finer, then averaged
CORNERS = [[120, 60], [520, 110], [560, 400], [90, 430]]  # corners of the drawing in the picture, px
PARTLY = [[-200, -60], [520, 110], [560, 400], [-250, 430]]

Board = Chessboard | CharucoBoard | CircleGrid


def seen(drawing: NDArray[np.uint8], corners: list[list[int]]) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return a picture of a flat drawing, and the homography from the drawing's pixels to the picture's."""
    height, width = drawing.shape
    source = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
    homography = cv2.getPerspectiveTransform(source, np.array(corners, dtype=np.float32))
    fine = np.array([[FINER, 0, (FINER - 1) / 2], [0, FINER, (FINER - 1) / 2], [0, 0, 1.0]])
    size = (SIZE[0] * FINER, SIZE[1] * FINER)
    big = cv2.warpPerspective(drawing, fine @ homography, size, flags=cv2.INTER_LINEAR, borderValue=255)
    grey = cv2.GaussianBlur(cv2.resize(big, SIZE, interpolation=cv2.INTER_AREA).astype(np.float64), (0, 0), 0.6)
    noise = np.random.default_rng(0).normal(0, 2, grey.shape)
    return (grey * 0.7 + 20 + noise).clip(0, 255).astype(np.uint8), homography


def through(homography: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    h = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return h[:, :2] / h[:, 2:]


def miss(view: PlateView, expected: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean((view.uv_px - expected) ** 2)))


def chess_drawing(board: Chessboard, side: int = 40) -> NDArray[np.uint8]:
    """Draw, lower left square dark, white border one square wide."""
    drawing = np.full(((board.rows + 3) * side, (board.columns + 3) * side), 255, dtype=np.uint8)
    for j in range(board.rows + 1):
        for i in range(board.columns + 1):
            if (i + board.rows - j) % 2 == 0:
                drawing[(j + 1) * side : (j + 2) * side, (i + 1) * side : (i + 2) * side] = 0
    return drawing


def chess_corners(board: Chessboard, index: NDArray[np.int64], side: int = 40) -> NDArray[np.float64]:
    return np.column_stack([(index[:, 0] + 2) * side - 0.5, (board.rows + 1 - index[:, 1]) * side - 0.5])


def chess(columns: int, rows: int) -> Chessboard:
    return Chessboard(columns=columns, rows=rows, pitch_mm=10.0)


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_a_chessboard_that_differs_from_its_turn_is_tied_by_its_colours(quarters: int) -> None:
    board = chess(7, 6)
    picture, homography = seen(chess_drawing(board), CORNERS)
    view = see_plate(np.rot90(picture, quarters).copy(), board)
    assert view.state == "tied"
    assert len(view) == 42
    expected = through(homography, chess_corners(board, view.index))
    for turn in range(quarters):  # counter-clockwise: (u, v) -> (v, W - 1 - u), W of the picture before the turn
        width = SIZE[0] if turn % 2 == 0 else SIZE[1]
        expected = np.column_stack([expected[:, 1], width - 1 - expected[:, 0]])
    assert miss(view, expected) < 0.04
    assert np.array_equal(view.points_plate_mm, np.column_stack([10.0 * view.index, np.zeros(42)]))
    assert not view.diameter_mm.any()


@pytest.mark.parametrize(("columns", "rows", "readings"), [(7, 5, 2), (6, 6, 4), (5, 5, 2), (6, 4, 2)])
def test_a_chessboard_that_is_as_its_turn_floats_between_all_of_them(columns: int, rows: int, readings: int) -> None:
    board = chess(columns, rows)
    picture, homography = seen(chess_drawing(board), CORNERS)
    view = see_plate(np.rot90(picture, 2).copy(), board, "a.png")
    assert view.state == "floating"
    assert view.reason.startswith("a.png: ")
    assert len(view.placements) == readings
    read = [placed(view, board, p) for p in view.placements]
    misses = [miss(r, SIZE - np.array([1, 1]) - through(homography, chess_corners(board, r.index))) for r in read]
    assert sum(m < 0.04 for m in misses) == 1
    assert all({tuple(at) for at in r.index.tolist()} == {tuple(at) for at in view.index.tolist()} for r in read)


def charuco_drawing(board: CharucoBoard) -> NDArray[np.uint8]:
    drawing = board.opencv().generateImage((board.columns * 100, board.rows * 100), marginSize=0)
    return cv2.copyMakeBorder(drawing, 50, 50, 50, 50, cv2.BORDER_CONSTANT, value=255)


CHARUCO = CharucoBoard(columns=8, rows=6, pitch_mm=10.0, marker_mm=7.0)


@pytest.mark.parametrize(("corners", "least"), [(CORNERS, 35), (PARTLY, 20)])
@pytest.mark.parametrize("turn", [0, 2])
def test_a_charuco_board_is_recognised_by_a_part_of_it_and_from_any_side(
    corners: list[list[int]], least: int, turn: int
) -> None:
    picture, homography = seen(charuco_drawing(CHARUCO), corners)
    view = see_plate(np.rot90(picture, turn).copy(), CHARUCO)
    assert view.state == "tied"
    assert least <= len(view) <= 35
    index = view.index
    drawn = np.column_stack([(index[:, 0] + 1) * 100 + 49.5, (5 - index[:, 1]) * 100 + 49.5])
    expected = through(homography, drawn)
    assert miss(view, expected if turn == 0 else SIZE - np.array([1, 1]) - expected) < 0.1
    assert np.array_equal(view.points_plate_mm, np.column_stack([10.0 * index, np.zeros(len(index))]))


def circle_drawing(grid: CircleGrid, pitch: int = 60) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Draw by sampling; return the drawing and the grid indices on it."""
    across, up = grid.extent
    v, u = np.mgrid[: (up + 2) * pitch, : (across + 2) * pitch] / pitch - 1
    i, j = np.rint(u).astype(int), up - np.rint(v).astype(int)
    there = (i >= 0) & (i <= across) & (j >= 0) & (j <= up)
    # Highest row not shifted.
    there &= ((i - (up - j)) % 2 == 0) | (not grid.asymmetric)
    away = np.hypot(u - i, v - (up - j))
    if grid.asymmetric:
        # Circles reach into the cells of their neighbours.
        away = np.full(u.shape, 9.0)
        for a in range(across + 1):
            for b in range(a % 2, up + 1, 2):
                away = np.minimum(away, np.hypot(u - a, v - b))
        there = np.ones_like(there)
    soft = ((away - grid.dot_diameter_mm / grid.pitch_mm / 2) * pitch + 0.5).clip(0, 1)
    drawing = np.where(there, 255 * soft, 255).astype(np.uint8)
    index = np.array([(a, b) for a in range(across + 1) for b in range(up + 1)])
    return drawing, index[((index[:, 0] - (up - index[:, 1])) % 2 == 0) | (not grid.asymmetric)]


def circle_centres(grid: CircleGrid, index: NDArray[np.int64], pitch: int = 60) -> NDArray[np.float64]:
    return np.column_stack([(index[:, 0] + 1) * pitch, (grid.extent[1] + 1 - index[:, 1]) * pitch]).astype(np.float64)


def ellipse_centres(
    homography: NDArray[np.float64], centres: NDArray[np.float64], radius: float
) -> NDArray[np.float64]:
    """The centres of the pictures of circles: poles of the line at infinity in the conics H^-T C H^-1."""
    out = []
    for x, y in centres:
        conic = np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - radius**2]])
        pole = homography @ np.linalg.inv(conic) @ homography.T @ np.array([0, 0, 1.0])
        out.append(pole[:2] / pole[2])
    return np.array(out)


SYMMETRIC = CircleGrid(columns=7, rows=5, pitch_mm=10.0, dot_diameter_mm=4.0)
ASYMMETRIC = CircleGrid(columns=4, rows=11, pitch_mm=10.0, dot_diameter_mm=6.0, asymmetric=True)


def circle_truth(grid: CircleGrid, homography: NDArray[np.float64], view: PlateView) -> NDArray[np.float64]:
    radius = 60 * grid.dot_diameter_mm / grid.pitch_mm / 2
    return ellipse_centres(homography, circle_centres(grid, view.index), radius)


@pytest.mark.parametrize("quarters", [0, 2])
def test_an_asymmetric_grid_of_circles_is_tied(quarters: int) -> None:
    drawing, index = circle_drawing(ASYMMETRIC)
    picture, homography = seen(drawing, CORNERS)
    view = see_plate(np.rot90(picture, quarters).copy(), ASYMMETRIC)
    assert view.state == "tied"
    assert {tuple(at) for at in view.index.tolist()} == {tuple(at) for at in index.tolist()}
    expected = circle_truth(ASYMMETRIC, homography, view)
    assert miss(view, expected if quarters == 0 else SIZE - np.array([1, 1]) - expected) < 0.04
    assert np.array_equal(view.diameter_mm, np.full(44, 6.0))


@pytest.mark.parametrize(("grid", "readings"), [(SYMMETRIC, 2), (replace(SYMMETRIC, columns=6, rows=6), 4)])
def test_a_symmetric_grid_of_circles_floats_between_its_turns(grid: CircleGrid, readings: int) -> None:
    drawing, _ = circle_drawing(grid)
    picture, homography = seen(drawing, CORNERS)
    view = see_plate(picture, grid)
    assert view.state == "floating"
    assert len(view.placements) == readings
    read = [placed(view, grid, p) for p in view.placements]
    assert sum(miss(r, circle_truth(grid, homography, r)) < 0.04 for r in read) == 1


def test_bright_circles_are_found_as_well() -> None:
    picture, _ = seen(circle_drawing(SYMMETRIC)[0], CORNERS)
    assert see_plate(255 - picture, replace(SYMMETRIC, dark=False)).state == "floating"


@pytest.mark.parametrize("board", [chess(7, 6), CHARUCO, SYMMETRIC, ASYMMETRIC], ids=lambda b: type(b).__name__)
def test_points_are_right_handed_with_z_towards_the_viewer(board: Board) -> None:
    if isinstance(board, Chessboard):
        drawing = chess_drawing(board)
    elif isinstance(board, CharucoBoard):
        drawing = charuco_drawing(board)
    else:
        drawing = circle_drawing(board)[0]
    view = see_plate(seen(drawing, CORNERS)[0], board)
    slope, *_ = np.linalg.lstsq(np.column_stack([view.points_plate_mm[:, :2], np.ones(len(view))]), view.uv_px)
    # x to the right and y up give det < 0 in (u, v), v down.
    assert np.linalg.det(slope[:2]) < 0
    assert not view.points_plate_mm[:, 2].any()


@pytest.mark.parametrize("board", [chess(7, 6), CHARUCO, SYMMETRIC, ASYMMETRIC], ids=lambda b: type(b).__name__)
def test_a_picture_without_the_board_is_refused_in_one_line(board: Board) -> None:
    view = see_plate(np.full((200, 300), 90, np.uint8), board, "cam1_02.png")
    assert view.state == "refused"
    assert len(view) == 0
    assert view.reason.startswith("cam1_02.png: expected ")
    assert "\n" not in view.reason


def test_sixteen_bits_are_read_too() -> None:
    board = chess(7, 6)
    picture, _ = seen(chess_drawing(board), CORNERS)
    assert len(see_plate(picture.astype(np.uint16) * 16, board)) == 42


def test_boards_are_read_as_calibration_yaml_defines_them() -> None:
    assert plate_from_entry({"type": "chessboard", "columns": 7, "rows": 6, "pitch": 10.0}) == chess(7, 6)
    charuco = {"type": "charuco", "columns": 8, "rows": 6, "pitch": 10.0, "marker": 7.0, "dictionary": "DICT_4X4_50"}
    assert plate_from_entry(charuco) == CHARUCO
    circles = {"type": "circles", "columns": 4, "rows": 11, "pitch": 10.0, "dot_diameter": 6.0, "asymmetric": True}
    assert plate_from_entry(circles) == ASYMMETRIC


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"type": "chessboard", "columns": 2, "rows": 6, "pitch": 10.0}, "3 x 3 inner corners or more"),
        ({"type": "charuco", "columns": 8, "rows": 6, "pitch": 10.0, "marker": 12.0}, "smaller than its square"),
        ({"type": "charuco", "columns": 80, "rows": 6, "pitch": 10.0, "marker": 7.0}, "240 markers or more"),
        (
            {"type": "charuco", "columns": 8, "rows": 6, "pitch": 9.0, "marker": 7.0, "dictionary": "DICT_ODD"},
            "a name of OpenCV's",
        ),
        ({"type": "circles", "columns": 4, "rows": 4, "pitch": 4.0, "dot_diameter": 4.0}, "do not touch"),
        (
            {"type": "circles", "columns": 4, "rows": 10, "pitch": 4.0, "dot_diameter": 2.0, "asymmetric": True},
            "expected an odd number",
        ),
        (
            {"type": "circles", "columns": 4, "rows": 11, "pitch": 4.0, "dot_diameter": 2.0, "asymmetric": "yes"},
            "true or false",
        ),
    ],
)
def test_an_impossible_board_is_refused(entry: dict[str, object], words: str) -> None:
    with pytest.raises(CameraError, match=words):
        plate_from_entry(entry)
