"""Grid indices of the dots of a picture: all right, or refused with a reason."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import SHARED, slow
from hypothesis import given, settings
from hypothesis import strategies as st
from plate_drawing import PLATE, Scene

from sphereorient.calibration.boards import see_plate
from sphereorient.calibration.dots import Dots, find_dots
from sphereorient.calibration.lattice import index_dots
from sphereorient.calibration.targets import DotPlate, PlateView, placed, plate_from_entry
from sphereorient.errors import CameraError


def dots_at(scene: Scene, *, without: tuple[tuple[int, int], ...] = (), jitter_px: float = 0.0, seed: int = 0) -> Dots:
    """Dots as from `find_dots`, by projection alone: quick, for many poses."""
    keep = np.array([tuple(at) in scene.whole() and tuple(at) not in without for at in scene.plate.indices.tolist()])
    index = scene.plate.indices[keep]
    step = 0.5 * scene.plate.diameters(index)[:, None] / scene.plate.pitch_mm
    half = [scene.centres_px(index + e * step) - scene.centres_px(index - e * step) for e in np.eye(2)]
    spread = np.stack(half, axis=-1) / 2  # columns: half diameters of the ellipse, conjugate
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(index))
    uv_px = scene.centres_px(index) + rng.normal(0, 1, (len(index), 2)) * jitter_px
    n = len(index)
    return Dots(
        uv_px=uv_px[order],
        shape=np.linalg.inv(spread @ spread.transpose(0, 2, 1))[order],
        sigma_px=np.full(n, 0.02),
        contrast=np.ones(n),
        misfit=np.full(n, 0.02),
    )


def assert_indexed_right(view: PlateView, scene: Scene, least: int) -> None:
    assert view.state == "tied", view.reason
    assert view.reason == ""
    assert len(view) >= least
    assert np.abs(view.uv_px - scene.centres_px(view.index)).max() < 0.5
    assert np.array_equal(view.points_plate_mm, scene.plate.points(view.index))
    assert np.array_equal(view.diameter_mm, scene.plate.diameters(view.index))


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    tilt=st.floats(0, 68),
    about=st.floats(-180, 180),
    spin=st.floats(-180, 180),
    right=st.floats(-25, 25),
    down=st.floats(-20, 20),
    distance=st.floats(170, 300),
    seed=st.integers(0, 10),
)
def test_every_pose_that_shows_the_fiducials_is_indexed_right(
    tilt: float, about: float, spin: float, right: float, down: float, distance: float, seed: int
) -> None:
    scene = Scene(tilt_deg=tilt, about_deg=about, spin_deg=spin, at_mm=(right, down), distance_mm=distance, f_px=1000)
    dots = dots_at(scene, jitter_px=0.05, seed=seed)
    view = index_dots(dots, PLATE)
    if set(PLATE.fiducials) <= scene.whole() and len(dots) >= 40:
        assert_indexed_right(view, scene, len(dots))
    elif view.state == "tied":
        assert_indexed_right(view, scene, 12)


@pytest.mark.slow
@pytest.mark.parametrize("spin_deg", [slow(0), slow(90), slow(180), slow(270), 37])
def test_pictures_are_indexed_right_at_sixty_degrees_and_partial_view(spin_deg: float) -> None:
    scene = Scene(tilt_deg=60, about_deg=70, spin_deg=spin_deg, at_mm=(16.0, 10.0), distance_mm=190)
    view = see_plate(scene.picture(uneven=0.4), PLATE)
    assert_indexed_right(view, scene, len(scene.whole(0.15)))
    assert len(view) < 99


def test_x_runs_along_columns_y_along_rows_and_z_towards_the_viewer() -> None:
    # Upright and facing the camera: the fiducial [3, 0] right of the origin dot, [0, 2] above it.
    view = see_plate(Scene().picture(), PLATE)
    at = {tuple(k): uv for k, uv in zip(view.index.tolist(), view.uv_px, strict=True)}
    pitch_px = 8.0 * 900 / 260
    assert np.allclose(at[0, 0], [239.5, 199.5], atol=0.2)
    assert np.allclose(at[3, 0] - at[0, 0], [3 * pitch_px, 0], atol=0.3)
    assert np.allclose(at[0, 2] - at[0, 0], [0, -2 * pitch_px], atol=0.3)


@pytest.mark.slow
def test_missing_dots_leave_gaps_but_no_errors() -> None:
    hole = (*((i, j) for i in (-1, -2) for j in range(-4, 4)), (4, 1), (2, -3))
    scene = Scene(tilt_deg=45, about_deg=30)
    view = see_plate(scene.picture(without=hole), PLATE)
    assert_indexed_right(view, scene, 99 - len(hole))


def test_islands_behind_an_obstacle_are_added_by_the_map_of_the_rest() -> None:
    # A rod hides two whole columns but for one dot: steps of one pitch cannot cross it at any other row.
    scene = Scene(tilt_deg=40, about_deg=10)
    ring = ((4, -3), (4, -2), (4, -1), (3, -2), (5, -2))
    without = tuple(at for at in ring if at != (4, -2))
    view = index_dots(dots_at(scene, without=without), PLATE)
    assert_indexed_right(view, scene, 99 - 4)
    assert (4, -2) in {tuple(at) for at in view.index.tolist()}


def test_stray_dots_between_the_rows_are_left_out() -> None:
    scene = Scene(tilt_deg=30, about_deg=60)
    dots = dots_at(scene)
    rng = np.random.default_rng(3)
    stray = rng.uniform([0, 0], [479, 399], (25, 2))
    clear = np.linalg.norm(stray[:, None] - dots.uv_px[None], axis=-1).min(axis=1) > 6
    stray = stray[clear]
    parts = {name: np.concatenate([getattr(dots, name), getattr(dots, name)[: len(stray)]]) for name in vars(dots)}
    parts["uv_px"] = np.concatenate([dots.uv_px, stray])
    assert_indexed_right(index_dots(Dots(**parts), PLATE), scene, 95)


@pytest.mark.slow
def test_a_plate_without_its_fiducials_in_view_floats_and_the_true_place_is_among_the_placements() -> None:
    scene = Scene(at_mm=(75.0, 0.0), spin_deg=180, distance_mm=200)
    view = see_plate(scene.picture(), PLATE, "cam1_07.png")
    assert view.state == "floating"
    assert "3 larger dots in view, got 0" in view.reason
    true = [
        p
        for p in view.placements
        if np.abs(placed(view, PLATE, p).uv_px - scene.centres_px(placed(view, PLATE, p).index)).max() < 0.5
    ]
    assert len(true) == 1
    assert_indexed_right(placed(view, PLATE, true[0]), scene, len(scene.whole(0.15)))


@pytest.mark.slow
def test_fiducials_hidden_on_a_whole_plate_are_where_dots_are_missing_and_replaced_ones_fit_nowhere() -> None:
    scene = Scene(tilt_deg=30)
    view = see_plate(scene.picture(without=PLATE.fiducials), PLATE)
    # With the axes exchanged, small dots would be where fiducials belong.
    assert_indexed_right(view, scene, 96)
    small = see_plate(scene.picture(small=PLATE.fiducials), PLATE)
    assert small.state == "refused"
    assert "larger dots at the grid indices" in small.reason


@pytest.mark.slow
def test_a_mirrored_plate_is_refused() -> None:
    scene = Scene(tilt_deg=35, about_deg=40, spin_deg=20)
    view = see_plate(scene.picture()[:, ::-1].copy(), PLATE, "cam2_03.png")
    assert view.state == "refused"
    assert len(view) == 0
    assert "mirror image" in view.reason
    assert "\n" not in view.reason


@pytest.mark.slow
@pytest.mark.parametrize(("columns", "rows"), [(9, 9), (11, 7), (7, 7)])
def test_a_plate_with_more_dots_than_stated_is_refused(columns: int, rows: int) -> None:
    view = see_plate(Scene(tilt_deg=30).picture(), replace(PLATE, columns=columns, rows=rows))
    assert view.state == "refused"
    assert f"at most {columns} x {rows} dots" in view.reason
    assert "11 x 9" in view.reason or "9 x 11" in view.reason


@pytest.mark.slow
def test_dots_that_stick_out_on_one_side_are_refused_although_their_number_fits() -> None:
    # 11 x 9 stated, but the picture shows a part of a 15 x 9 plate: 11 columns, but reaching to column 7.
    large = replace(PLATE, columns=15)
    scene = Scene(plate=large, tilt_deg=20, at_mm=(-34.0, 0.0), distance_mm=230)
    columns = {i for i, _ in scene.whole()}
    assert max(columns) > 5
    assert len(columns) <= 11
    assert see_plate(scene.picture(), large).state == "tied"
    assert see_plate(scene.picture(), PLATE).state == "refused"


@pytest.mark.slow
def test_dots_of_another_width_than_stated_are_refused() -> None:
    view = see_plate(Scene().picture(), replace(PLATE, dot_diameter_mm=1.6, fiducial_diameter_mm=2.0))
    assert view.state == "refused"
    assert "pitches wide" in view.reason


@pytest.mark.parametrize("scene", [None, Scene(at_mm=(200.0, 0.0))], ids=["black", "beside the picture"])
def test_a_picture_without_a_plate_is_refused_in_one_line(scene: Scene | None) -> None:
    picture = np.zeros((100, 120), np.uint8) if scene is None else scene.picture()
    view = see_plate(picture, PLATE, "cam1_00.png")
    assert view.state == "refused"
    assert view.reason.startswith("cam1_00.png: expected a lattice")


ENTRY = {
    "type": "dots",
    "columns": 11,
    "rows": 9,
    "pitch": 8.0,
    "dot_diameter": 3.2,
    "fiducial_diameter": 5.0,
    "fiducials": [[0, 0], [3, 0], [0, 2]],
    "dots": "dark",
}


def test_a_plate_is_read_as_calibration_yaml_defines_it() -> None:
    plate = plate_from_entry(ENTRY)
    assert plate == PLATE
    assert isinstance(plate, DotPlate)
    assert plate.first == (-5, -4)
    assert plate.last == (5, 4)
    assert np.array_equal(plate.points(np.array([[2, -1]])), [[16.0, -8.0, 0.0]])
    assert np.array_equal(plate.diameters(np.array([[3, 0], [0, 3]])), [5.0, 3.2])
    bright = plate_from_entry({**ENTRY, "dots": "bright"})
    assert isinstance(bright, DotPlate)
    assert not bright.dark


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"columns": 0}, "plate, columns: expected a whole number"),
        ({"rows": 9.5}, "plate, rows: expected a whole number"),
        ({"pitch": float("nan")}, "plate, pitch: expected a length above zero"),
        ({"dot_diameter": 9.0}, "dots that do not touch"),
        ({"fiducial_diameter": 3.3}, "fiducials larger than the dots"),
        ({"fiducials": [[0, 0], [0, 2], [3, 0]]}, "one on [+]x, one on [+]y"),
        ({"fiducials": [[0, 0], [9, 0], [0, 2]]}, "grid indices of this plate"),
        ({"fiducials": [[0, 0]]}, "three grid indices"),
        ({"dots": "grey"}, "dark or bright"),
        ({"type": "stars"}, "`type` one of dots, chessboard"),
        ({"pich": 8.0}, "unknown pich"),
    ],
)
def test_an_impossible_plate_is_refused_in_one_line(change: dict[str, object], words: str) -> None:
    with pytest.raises(CameraError, match=words) as refused:
        plate_from_entry({**ENTRY, **change})
    assert "\n" not in str(refused.value)


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.parametrize("folder", ["experiment", "tank"])
def test_pictures_of_a_laboratory_are_indexed_right_to_the_last_dot(folder: str) -> None:
    import cv2
    import h5py
    import torch
    import yaml

    from sphereorient.calibration.bundle import disk_centre_shift
    from sphereorient.cameras import load_cameras

    place = SHARED / folder / "calibration"
    document = yaml.safe_load((place / "calibration.yaml").read_text())
    plate, cameras = plate_from_entry(document["plate"]), load_cameras(SHARED / folder / "cameras.yaml")
    assert isinstance(plate, DotPlate)
    with h5py.File(place / "truth.h5") as truth:
        R, T = (torch.from_numpy(truth[name][:]) for name in ("R_lab_plate", "T_lab_plate"))
    misses = []
    for entry in document["pictures"][3:14:5]:
        k = entry["pose"]
        for name in (name for name in cameras if name in entry):
            view = see_plate(cv2.imread(str(place / entry[name]), cv2.IMREAD_UNCHANGED), plate, entry[name])
            assert view.state == "tied"
            points = torch.from_numpy(view.points_plate_mm)
            exact = cameras[name].project(points @ R[k].mT + T[k])
            shift = disk_centre_shift(cameras[name], R[k], T[k], points, torch.from_numpy(view.diameter_mm))
            misses.append(view.uv_px - (exact + shift).numpy())
            everywhere = cameras[name].project(torch.from_numpy(plate.points(plate.indices)) @ R[k].mT + T[k])
            far_in = ((everywhere > 12) & (everywhere < 637)).all(-1)
            assert len(view) >= int(far_in.sum())
    miss = np.concatenate(misses)
    assert np.abs(miss).max() < 0.2
    assert np.sqrt(np.mean(miss**2)) < 0.04


def clicks(scene: Scene, *index: tuple[int, int], off_px: float = 3.0) -> np.ndarray:
    """Where a person clicks on dots: near them."""
    return scene.centres_px(np.array(index)) + np.array([off_px, -off_px])


# Covered on both halves, so that the gaps do not show them.
BADLY_SEEN = {"small": PLATE.fiducials, "without": (*PLATE.fiducials, (-3, 0), (0, -2))}


@pytest.mark.slow
@pytest.mark.parametrize("badly", BADLY_SEEN)
@pytest.mark.parametrize("count", [2, 3])
def test_clicked_fiducials_tie_a_picture_in_which_they_are_too_small_or_covered(badly: str, count: int) -> None:
    scene = Scene(tilt_deg=25, about_deg=40, spin_deg=200)
    dots = find_dots(scene.picture(**{badly: BADLY_SEEN[badly]}), dark=True)
    assert index_dots(dots, PLATE).state != "tied"
    view = index_dots(dots, PLATE, clicked=clicks(scene, *PLATE.fiducials[:count]))
    assert_indexed_right(view, scene, len(scene.whole(0.15)) - len(BADLY_SEEN[badly]))
    assert not PLATE.is_fiducial(view.index).any()  # a dot that is too small is not measured as a fiducial
    # A click names a dot: its distance does not matter, and no centre moves.
    other = index_dots(dots, PLATE, clicked=clicks(scene, *PLATE.fiducials[:count], off_px=-5.0))
    assert np.array_equal(other.uv_px, view.uv_px)
    assert np.array_equal(other.index, view.index)


@pytest.mark.parametrize(
    ("index", "words"),
    [
        (((0, 0), (2, 0), (0, 2)), "up to a rotation"),
        (((0, 0), (0, 0)), "up to a rotation"),
        (((0, 0), (3, 0), (0, -2)), "mirror image"),
        (((1, 0), (4, 0), (1, 2)), "dots beyond the plate's edge"),
    ],
)
def test_clicks_that_contradict_the_plate_are_refused(index, words: str) -> None:
    scene = Scene(tilt_deg=20, spin_deg=30, distance_mm=280)
    view = index_dots(dots_at(scene, without=PLATE.fiducials), PLATE, "cam1_03.png", clicks(scene, *index))
    assert view.state == "refused"
    assert view.reason.startswith("cam1_03.png")
    assert re.search(words, view.reason)
    assert "\n" not in view.reason


def test_a_click_between_the_dots_or_beside_the_plate_is_refused_by_name() -> None:
    scene = Scene(tilt_deg=20)
    dots = dots_at(scene)
    at = clicks(scene, *PLATE.fiducials)
    at[1] = scene.centres_px(np.array([[3, 0], [4, 1]])).mean(axis=0)
    assert "clicked +x: expected a dot" in index_dots(dots, PLATE, "a.png", at).reason
    at[1], at[2] = clicks(scene, (3, 0))[0], [3.0, 3.0]
    assert "clicked +y: expected a dot" in index_dots(dots, PLATE, "a.png", at).reason


def test_clicks_beside_larger_dots_that_are_found_are_refused() -> None:
    scene = Scene(spin_deg=180, at_mm=(60.0, 0.0))  # the plate's left is out of the picture
    dots = dots_at(scene)
    assert index_dots(dots, PLATE).state == "tied"
    assert index_dots(dots, PLATE, clicked=clicks(scene, *PLATE.fiducials)).state == "tied"
    view = index_dots(dots, PLATE, clicked=clicks(scene, (1, 0), (4, 0), (1, 2)))
    assert view.state == "refused"
    assert "got other dots" in view.reason
