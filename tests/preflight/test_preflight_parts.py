"""The measures of the check against oracles: outlines, blur, gaps, the value of start:."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from conftest import assert_close
from hypothesis import given
from hypothesis import strategies as st
from locate_examples import looking_along_y, looking_down

from sphereorient.calibration.comparison import LATEST, gaps_between
from sphereorient.cameras import Port, PortCamera, holds_disk, triangulate
from sphereorient.cameras.model import TelecentricCamera
from sphereorient.experiment.recording import pictures_of
from sphereorient.locate import Background, sightings_of
from sphereorient.locate.outline import Outline
from sphereorient.preflight import Severity
from sphereorient.preflight.cameras import expected_outline_px
from sphereorient.preflight.finding import FAULT, OK, Finding
from sphereorient.preflight.in_step import OffsetScan, in_step, liveliest_stretches, scan_offsets, starts_in_step
from sphereorient.preflight.movies import exposure, limb_blur_px, motion_blur
from sphereorient.preflight.sample import frames_to_sample, pair_starts
from sphereorient.preflight.texture_map import match_texture
from sphereorient.trajectory import Reason


def f64(value: object) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


LENS = {"f_px": f64(1400.0), "centre_px": f64((149.5, 149.5)), "T_cam_lab_mm": f64((0.0, 0.0, 400.0))}
ALONG_Y, DOWN_Z = (look(image_size=(300, 300), **LENS) for look in (looking_along_y, looking_down))
WALL = Port(
    normal=f64((0.0, -1.0, 0.0)),
    offset_mm=f64(120.0),
    thickness_mm=f64(12.0),
    n_glass=f64(1.49),
    n_fluid=f64(1.36),
)
PORT = PortCamera(camera=ALONG_Y, port=WALL)


@pytest.mark.parametrize("camera", [ALONG_Y, DOWN_Z, PORT], ids=["pinhole", "other pinhole", "port"])
def test_the_expected_outline_encloses_the_spheres_picture_and_touches_it(camera):
    """Oracle: the picture of many points of the sphere; its hull is the outline."""
    centre, radius_mm = f64([8.0, -12.0, 5.0]), 9.0
    normal = torch.nn.functional.normalize(torch.randn(200_000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    dots = camera.project(centre + radius_mm * normal.double()).numpy().astype(np.float32)
    hull = cv2.convexHull(dots)[:, 0].astype(np.float64)
    outline = expected_outline_px(camera, centre, radius_mm).numpy()
    middle = outline.mean(0)
    got = np.linalg.norm(outline - middle, axis=1).mean()
    assert got == pytest.approx(np.linalg.norm(hull - middle, axis=1).mean(), abs=0.03)


def test_the_gap_is_that_of_triangulation_and_its_sign_gives_the_side():
    uv = [f64([[150.0, 140.0], [160.0, 150.0]]), f64([[153.0, 120.0], [157.0, 170.0]])]
    gaps = gaps_between([ALONG_Y, DOWN_Z], uv)
    _, expected = triangulate(ALONG_Y.rays(uv[0]), DOWN_Z.rays(uv[1]))
    assert_close(gaps.signed_mm.abs(), expected)
    assert float(gaps.signed_mm[0] * gaps.signed_mm[1]) < 0  # one to the left, one to the right


def test_a_gap_in_px_is_how_far_the_first_picture_must_move():
    centre = f64([[3.0, 2.0, -4.0]])
    first, second = ALONG_Y.project(centre), DOWN_Z.project(centre)
    gaps = gaps_between([ALONG_Y, DOWN_Z], [first + f64([2.0, 0.0]), second])
    assert float(gaps.signed_px.abs()) == pytest.approx(2.0, rel=0.01)


def places(count: int, moving: float = 0.8) -> torch.Tensor:
    """A ball that swings through the volume, (count, 3), mm."""
    t = torch.arange(count, dtype=torch.float64)
    return torch.stack([8 * torch.sin(moving * t / 8), 5 * torch.cos(t / 11), 4 * torch.sin(t / 9)], dim=-1)


def steps_of(late: int, knock_px: float = 0.0, moving: float = 0.8) -> OffsetScan:
    """OffsetScan of two stretches, the second movie `late` frames behind and the first camera knocked."""
    path = places(80, moving)
    stretches = []
    for begin in (10, 40):
        here = ALONG_Y.project(path[begin : begin + 20]) + f64([knock_px, 0.0])
        stretches.append((here, DOWN_Z.project(path[begin - late : begin - late + 20])))
    return scan_offsets(("one", "two"), (ALONG_Y, DOWN_Z), stretches)


@pytest.mark.parametrize("late", range(-7, 8))
def test_the_least_gap_is_at_the_planted_offset(late):
    steps = steps_of(late)
    assert steps.shift == late
    assert steps.best == pytest.approx(late, abs=0.1)
    assert float(steps.gap_px[LATEST + late]) < 1e-6


@pytest.mark.parametrize("late", [-3, 0, 2])
def test_a_knock_does_not_hide_the_offset_where_the_motion_varies(late):
    steps = steps_of(late, knock_px=40.0)
    assert steps.shift == late
    assert steps.in_step_px > 30  # and the error of the knock stays visible


def test_a_ball_that_hardly_moves_gives_no_step():
    assert math.isnan(steps_of(2, moving=0.02).best)


@given(st.integers(0, 30), st.integers(0, 30), st.integers(-LATEST, LATEST))
def test_the_start_advised_shifts_by_the_offset_and_is_never_negative(first, second, shift):
    new_first, new_second = starts_in_step({"a": first, "b": second}, {"a": 0.0, "b": float(shift)}).values()
    assert new_second - new_first == second - first + shift
    assert min(new_first, new_second) >= 0
    assert new_first == first or new_second == 0  # no frame more is lost than must be


@pytest.mark.parametrize("blur_px", [0.7, 1.2, 2.0])
def test_the_blur_of_the_limb_is_that_of_the_lens(blur_px):
    """A white disk over black, supersampled, blurred by a known Gaussian; the pixel's own width comes on top."""
    row, column = np.mgrid[:800, :800] / 8 - 0.5 + 1 / 16
    fine = 180.0 * ((row - 49.3) ** 2 + (column - 50.1) ** 2 < 30.0**2)
    fine = cv2.GaussianBlur(fine, (0, 0), 8 * blur_px)
    picture = fine.reshape(100, 8, 100, 8).mean((1, 3))
    noisy = np.rint(picture + 20 + np.random.default_rng(0).normal(0, 1.5, picture.shape)).astype(np.uint8)
    background = Background(
        mean=np.full((100, 100), 20, np.float32), noise=np.full((100, 100), 1.5, np.float32), full_scale=255.0
    )
    outline = Outline(u_px=50.1, v_px=49.3, radius_px=30.0, rms_px=0.1, coverage=1.0)
    look = SimpleNamespace(balls=[(noisy, outline)] * 3, background=background)
    assert limb_blur_px(look) == pytest.approx(math.hypot(blur_px, 12**-0.5), rel=0.08)


def sample_of(*u_px: float, v_px: float = 150.0, radius_px: float = 30.0) -> SimpleNamespace:
    """Sample of consecutive frames with outlines in these columns; picture k is of grey k throughout."""
    outlines = [Outline(u_px=u, v_px=v_px, radius_px=radius_px, rms_px=0.1, coverage=1.0) for u in u_px]
    found = [(one, Reason.OK) for one in outlines]
    seen = sightings_of(found)
    return SimpleNamespace(
        name="cam1",
        frame=np.arange(len(u_px)),
        picture=[np.full((300, 300), k, np.uint8) for k in range(len(u_px))],
        found=found,
        sightings=seen,
        whole=holds_disk(ALONG_Y, seen.centre_px, seen.radius_px),
    )


def test_a_picture_holds_a_disk_that_touches_its_border_and_none_that_passes_it():
    centre = f64([[30.0, 150.0], [29.9, 150.0], [150.0, 269.9], [150.0, 270.0], [math.nan, math.nan]])
    assert holds_disk(ALONG_Y, centre, f64([30.0] * 5)).tolist() == [True, False, True, False, False]


def test_disks_that_the_border_cuts_give_no_motion_blur():
    still = motion_blur(sample_of(150.0, 152.0, 5.0, 290.0, 100.0, 101.0), 0.5, 1.0)
    assert still.severity is OK
    assert "1.50 px a frame" in still.measured
    fast = motion_blur(sample_of(150.0, 160.0), 0.5, 1.0)
    assert fast.severity is Severity.WARNING
    assert "unknown" in motion_blur(sample_of(5.0, 290.0), 0.5, 1.0).measured


class Greys:
    """A search that scores each disk by its grey."""

    size_px = 8

    def propose(self, disks: torch.Tensor, least: float | None = None) -> SimpleNamespace:
        return SimpleNamespace(best_score=disks.mean((1, 2)).double())


def test_the_map_is_compared_with_whole_disks_where_there_are_any():
    (match,) = match_texture(Greys(), [sample_of(5.0, 150.0, 290.0, 200.0)])
    assert match.score.tolist() == [1, 3]
    (cut,) = match_texture(Greys(), [sample_of(5.0, 290.0)])
    assert cut.score.tolist() == [0, 1]


@given(st.integers(0, 5000))
def test_the_frames_looked_at_are_few_in_order_and_have_their_neighbours(count):
    frames = frames_to_sample(count)
    assert frames == sorted(set(frames))
    assert len(frames) <= 40
    assert all(0 <= k < count for k in frames)
    assert all(k in frames and k + 1 in frames for k in pair_starts(count))
    if count:
        assert {0, count - 1} <= set(frames)


class Sevens:
    """A movie of which each seventh frame cannot be decoded."""

    path = Path("sevens.npy")
    frame_shape, dtype = (2, 2), np.dtype(np.uint8)

    def __len__(self) -> int:
        return 40

    def readable(self, first: int, last: int) -> object:
        return iter([None if k % 7 == 0 else np.full((2, 2), k, np.uint8) for k in range(first, last)])


def test_rows_are_read_in_order_with_gaps_where_there_is_no_picture():
    rows = np.array([3, 4, 5, -1, 7, 8, 20, -1, -1, 30])
    read = [None if one is None else int(one[0, 0]) for one in pictures_of(Sevens(), rows)]
    assert read == [3, 4, 5, None, None, 8, 20, None, None, 30]


def test_a_telecentric_camera_expects_a_disk_at_its_own_scale():
    camera = TelecentricCamera(
        image_size=(300, 300),
        scale_mm_px=f64(0.25),
        centre_px=f64((149.5, 149.5)),
        R_cam_lab=ALONG_Y.R_cam_lab,
        T_cam_lab_mm=ALONG_Y.T_cam_lab_mm,
    )
    outline = expected_outline_px(camera, f64([5.0, 1.0, 2.0]), 9.0)
    radius = (outline - outline.mean(0)).norm(dim=-1)
    assert_close(radius, torch.full_like(radius, 9.0 / 0.25), atol=0.02)


def scans_of(best: dict[str, float]) -> list[OffsetScan]:
    """Scans of other movies against the first; the gap is least at the offsets given."""
    first, *others = best
    offset = torch.arange(-LATEST, LATEST + 1, dtype=torch.float64)
    return [
        OffsetScan(
            gap_px=0.1 + (offset - best[name]).abs(),
            varying_px=offset,
            moved_px=1.0,
            best=best[name],
            names=(first, name),
        )
        for name in others
    ]


@pytest.mark.parametrize(
    ("late", "start"),
    [
        ({"cam1": 0.0, "cam2": 0.02, "cam3": 1.01}, "set start: {cam1: 0, cam2: 0, cam3: 1}"),
        ({"cam1": 0.0, "cam2": -1.02, "cam3": -1.01}, "set start: {cam1: 1, cam2: 0, cam3: 0}"),
        ({"cam1": 0.0, "cam2": -2.0, "cam3": 0.01}, "set start: {cam1: 2, cam2: 0, cam3: 2}"),
    ],
    ids=["the last", "the first", "one that is early"],
)
def test_the_one_of_three_movies_out_of_step_is_named(late, start):
    found = in_step(scans_of(late), {})
    assert found.severity is FAULT
    wrong = {"cam3: 1}": "cam3", "cam1: 1,": "cam1"}
    assert found.measured.startswith(next((name for part, name in wrong.items() if part in start), "cam2"))
    assert found.advice == start


def test_three_movies_in_step_get_no_finding():
    assert in_step(scans_of({"cam1": 0.0, "cam2": 0.03, "cam3": -0.02}), {}).severity is OK


def test_a_movie_whose_lag_is_unknown_is_named_and_begins_with_the_first_one():
    """Before: the advised start: left it where it was, late on the others by as much as they moved."""
    still = scans_of({"cam1": 0.0, "cam3": math.nan})[0]
    scans = [*scans_of({"cam1": 0.0, "cam2": -2.0}), replace(still, moved_px=0.1)]
    found = in_step(scans, {})
    assert found.severity is FAULT
    assert "cam3: unknown" in found.measured
    assert found.advice == "set start: {cam1: 2, cam2: 0, cam3: 2}"
    assert in_step([*scans_of({"cam1": 0.0, "cam2": 0.02}), scans[1]], {}).severity is OK


def test_stretches_lie_where_the_ball_moves_most_in_one_frame():
    """Before: pairs of consecutive frames of a usual sample, also of one that was sampled more closely without them."""
    count = 1000
    frame = np.array(frames_to_sample(count, 100))
    burst = int(frame[:-1][(np.diff(frame) == 1)][20])
    x_mm = 0.02 * np.arange(count) + 6.0 * (np.arange(count) > burst)
    path = torch.stack([f64(x_mm - 13.0), torch.zeros(count).double(), torch.zeros(count).double()], dim=-1)
    samples = [
        SimpleNamespace(
            stream=range(count),
            frame=frame,
            camera=camera,
            sightings=SimpleNamespace(centre_px=camera.project(path)[frame]),
        )
        for camera in (ALONG_Y, DOWN_Z)
    ]
    first = liveliest_stretches(samples)[0]
    assert {burst, burst + 1} <= set(first)


def test_masked_pixels_are_no_paint():
    """Before: a lit post before the ball was saturated paint."""
    outline = Outline(u_px=50.0, v_px=50.0, radius_px=30.0, rms_px=0.1, coverage=1.0)
    picture = np.random.default_rng(0).integers(20, 200, (100, 100)).astype(np.uint8)
    picture[:, 45:55] = 255
    background = Background(
        mean=np.full((100, 100), 20, np.float32), noise=np.full((100, 100), 1.5, np.float32), full_scale=255.0
    )

    def judged_by(shown: np.ndarray | None) -> Finding:
        stream = SimpleNamespace(shown=shown)
        return exposure(SimpleNamespace(name="cam1", balls=[(picture, outline)], background=background, stream=stream))

    mask = np.ones((100, 100), bool)
    mask[:, 45:55] = False
    assert judged_by(None).severity is FAULT
    assert judged_by(mask).severity is OK
    assert "0.0 % of the ball saturated" in judged_by(mask).measured
    assert "unknown" in judged_by(np.zeros((100, 100), bool)).measured
