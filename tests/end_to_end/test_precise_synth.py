"""The precise method from movies to track, on movies with exact truth: faults are found and marked."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from conftest import REPO
from precise_examples import (
    CAMERAS,
    Movies,
    Pictures,
    angle_deg,
    in_sigmas,
    mean_turn,
    render,
    rotation_error,
    settings,
    tracked,
    turned_off,
    write,
)

from sphereorient import so3
from sphereorient.bench import score_track
from sphereorient.errors import ExperimentError
from sphereorient.follow import Poses, Tracker
from sphereorient.follow.ball import BallTracker
from sphereorient.locate import Frame
from sphereorient.methods import precise
from sphereorient.run.stages import track_movies
from sphereorient.trajectory import Flag, Reason, Trajectory

EXCERPT = REPO / "synthetic_data" / "excerpt"
Rendered = Callable[..., Movies]
NONE = np.zeros(0, np.int64)
SHORT = {"omega_rms": mean_turn(4.5), "frames": 48, "image_size": (200, 200), "diameter_px": 44.0, "seed": 4}


@pytest.fixture(scope="session")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Rendered:
    """Render a movie once a session; changed: settings of synth."""
    known: dict[tuple[object, ...], Movies] = {}

    def movies(**changed: object) -> Movies:
        key = tuple(sorted(changed.items()))
        if key not in known:
            known[key] = render(tmp_path_factory.mktemp("rendered"), **changed)
        return known[key]

    return movies


@pytest.fixture
def brisk(rendered: Rendered) -> Movies:
    """120 frames, 4.5 degrees from each to the next."""
    return rendered(omega_rms=mean_turn(4.5), velocity_rms=0.15, seed=3)


@pytest.fixture
def held(rendered: Rendered) -> Movies:
    """120 frames of a fixed ball: frames left out make its orientation jump and nothing else."""
    return rendered(omega_rms=mean_turn(3.0), velocity_rms=0.0, seed=9)


@pytest.fixture
def short(rendered: Rendered) -> Movies:
    return rendered(**SHORT)


def rest(movies: Movies, lost: np.ndarray) -> np.ndarray:
    return np.setdiff1d(np.arange(len(movies)), lost)


def check_right(track: Trajectory, movies: Movies, rows: np.ndarray, within_deg: float = 0.4) -> None:
    """All these frames have an orientation, and it is the right one."""
    assert track.valid[rows].all(), np.flatnonzero(~track.valid)
    off = turned_off(track, movies)[rows]
    assert off.max() < within_deg, (rows[off.argmax()], off.max())


def followed(
    movies: Movies, folder: Path, *changed: str, lost: np.ndarray = NONE, cameras: tuple[str, ...] | None = None
) -> Trajectory:
    """Track, and check that all frames but the lost ones have an orientation, the right one."""
    track = tracked(movies, folder, *changed, cameras=cameras)
    check_right(track, movies, rest(movies, lost))
    return track


def rms(z: np.ndarray) -> float:
    return float(np.sqrt((z**2).mean()))


def check_nothing(track: Trajectory, rows: np.ndarray) -> None:
    """None of these frames has a measurement, and each camera has a reason."""
    assert not track.valid[rows].any()
    for name in ("position", "position_cov", "orientation", "orientation_cov", "confidence"):
        assert np.isnan(getattr(track, name)[rows]).all(), name
    for camera in track.cameras.values():
        assert np.isnan(camera.orientation[rows]).all()
        assert {camera.reason[k] for k in rows} <= {Reason.NOT_FOUND, Reason.OUTLINE, Reason.LOW_SCORE}


# The normal run: the bundled excerpt.


@pytest.fixture(scope="module")
def excerpt() -> Trajectory:
    return track_movies(EXCERPT / "experiment.yaml")


def test_the_excerpt_is_tracked_to_hundredths_of_a_degree(excerpt):
    score = score_track(excerpt, EXCERPT / "truth.h5")
    assert score.valid.all()
    assert np.median(score.orientation_deg) < 0.08
    assert score.orientation_deg.max() < 0.3
    assert np.median(score.position_mm) < 0.015
    assert score.relative_rms["omega_lab"] < 0.03
    assert score.coverage["omega_lab"] == 1.0
    assert not excerpt.flags.any()
    assert (excerpt.confidence > 0.99).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_the_excerpt_is_tracked_by_each_camera_alone(name):
    score = score_track(track_movies(EXCERPT / "experiment.yaml", cameras=(name,)), EXCERPT / "truth.h5")
    assert score.valid.all()
    assert np.median(score.orientation_deg) < 0.2
    assert score.orientation_deg.max() < 0.6
    assert np.median(score.position_mm) < 1.0  # along the line of sight, from the size


@pytest.mark.parametrize("name", CAMERAS)
def test_each_camera_also_gives_the_pose_that_it_measures_alone(excerpt, name):
    score = score_track(excerpt, EXCERPT / "truth.h5")
    assert np.median(score.camera_orientation_deg[name]) < 0.2
    assert set(excerpt.cameras[name].reason) == {Reason.OK}


# Fast rotation.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mean_deg", "changed"),
    [
        (22.0, {"omega_rms": mean_turn(22.0)}),
        (45.0, {"omega_rms": mean_turn(55.0), "seed": 1}),
        (45.0, {"omega_rms": mean_turn(51.5), "seed": 2, "omega_time": 0.012}),
    ],
    ids=["22", "45", "45, soon about another axis"],
)
def test_no_frame_is_lost_however_fast_the_ball_turns(rendered, tmp_path, mean_deg, changed):
    movies = rendered(**changed)
    turn = angle_deg(movies.R_lab_body[1:], movies.R_lab_body[:-1])
    assert turn.mean() >= mean_deg
    track = followed(movies, tmp_path)
    assert not track.flags.any()
    assert set(track.segment) == {0}


# Frames without the ball.


@pytest.mark.slow
def test_after_a_gap_of_12_frames_and_44_degrees_the_track_goes_on(brisk, tmp_path):
    turn = angle_deg(brisk.R_lab_body[13:], brisk.R_lab_body[:-13])
    first = int(np.argmin(np.abs(turn[20:90] - 44.0))) + 21
    assert abs(turn[first - 1] - 44.0) < 2.0
    gap = np.arange(first, first + 12)
    track = followed(brisk.without_ball(gap), tmp_path, lost=gap)
    check_nothing(track, gap)
    assert np.flatnonzero(track.flags & Flag.RECOVERED).tolist() == [first + 12]
    assert np.flatnonzero(track.flags & Flag.EXTRAPOLATED).tolist() == gap.tolist()
    # One motion, so the smoother fills the gap, with its covariance.
    assert set(track.segment) == {0}
    assert angle_deg(track.orientation_smooth, brisk.R_lab_body)[gap].max() < 1.0
    sigma = np.sqrt(np.trace(track.orientation_smooth_cov, axis1=1, axis2=2))
    assert sigma[gap[5]] > 1.1 * np.median(sigma[rest(brisk, gap)])  # errors that last are in both
    turn = torch.from_numpy(brisk.R_lab_body @ track.orientation_smooth.swapaxes(1, 2))
    assert 0.3 < rms(in_sigmas(so3.log(turn).numpy(), track.orientation_smooth_cov)[gap]) < 2.0


@pytest.mark.slow
def test_when_both_cameras_are_blind_for_20_frames_nothing_is_invented(brisk, tmp_path):
    blind = np.arange(50, 70)
    track = followed(brisk.without_ball(blind), tmp_path, lost=blind)
    check_nothing(track, blind)
    assert np.isnan(track.orientation_smooth[blind]).all()
    assert np.isnan(track.omega_lab[blind]).all()
    assert track.segment[[49, 50, 69, 70]].tolist() == [0, -1, -1, 1]
    assert track.flags[70] & Flag.RECOVERED


@pytest.mark.slow
@pytest.mark.parametrize(("name", "along"), [("cam1", 2), ("cam2", 1)])
def test_when_one_camera_is_blind_the_other_goes_on_and_the_flag_is_set(brisk, tmp_path, name, along):
    """`along`: the lab axis along which the camera that is left looks."""
    blind = np.arange(50, 70)
    track = followed(brisk.without_ball(blind, (name,)), tmp_path)
    assert np.flatnonzero(track.flags & Flag.ONE_CAMERA).tolist() == blind.tolist()
    assert np.flatnonzero(track.flags & Flag.DOUBTFUL_FIT).tolist() == blind.tolist()  # the ball should be seen there
    reasons = track.cameras[name].reason
    assert {reasons[k] for k in blind} <= {Reason.NOT_FOUND, Reason.LOW_SCORE}
    assert {reasons[k] for k in rest(brisk, blind)} == {Reason.OK}
    # The distance comes from the size alone: its error is larger, and the covariance states it.
    sigma = np.sqrt(np.diagonal(track.position_cov, axis1=1, axis2=2))
    across = [axis for axis in range(3) if axis != along]
    assert np.median(sigma[blind][:, along]) > 8 * np.median(sigma[blind][:, across])
    assert np.median(sigma[blind][:, along]) > 8 * np.median(sigma[rest(brisk, blind)][:, along])
    z = in_sigmas(track.position - brisk.position_mm, track.position_cov)[blind]
    assert 0.3 < rms(z) < 1.7
    assert np.abs(z).max() < 4.5
    assert rms(in_sigmas(rotation_error(track, brisk), track.orientation_cov)[blind]) < 1.9


@pytest.mark.slow
def test_30_percent_of_the_frames_dropped_cost_no_other_frame(brisk, tmp_path):
    dropped = np.random.default_rng(0).choice(len(brisk), 36, replace=False)
    track = followed(brisk.without_ball(dropped), tmp_path, lost=dropped)
    check_nothing(track, dropped)
    assert set(track.segment[4:]) == {0}


@pytest.mark.slow
def test_30_percent_dropped_in_each_camera_by_itself(brisk, tmp_path):
    """A camera that sees the ball again is used at once, with or without the other one."""
    rng = np.random.default_rng(0)
    one, other = (rng.choice(len(brisk), 36, replace=False) for _ in CAMERAS)
    neither = np.intersect1d(one, other)
    movies = brisk.without_ball(one, ("cam1",)).without_ball(other, ("cam2",))
    track = followed(movies, tmp_path, lost=neither)
    check_nothing(track, neither)
    alone = np.flatnonzero(track.flags & Flag.ONE_CAMERA)
    expected = np.setxor1d(one, other)
    assert set(expected) <= set(alone)
    assert len(alone) <= len(expected) + 3  # an outline may be missed where the ball is searched for


# Predictions that go wrong.


@pytest.mark.slow
def test_a_jump_between_two_frames_is_found_out_at_once(held, tmp_path):
    turn = angle_deg(held.R_lab_body[30:31], held.R_lab_body)
    after = 31 + int(np.argmin(np.abs(turn[31:60] - 40.0)))
    assert turn[after] > 30.0
    movies = held.frames(np.r_[0:31, after : len(held)])
    track = followed(movies, tmp_path)
    assert np.flatnonzero(track.flags & Flag.SPIKE).tolist() == [31]
    assert track.segment[31] == track.segment[30] + 1


@pytest.mark.slow
def test_frames_of_another_attitude_do_not_draw_the_track_away(held, tmp_path):
    movies = held.frames(np.r_[0:30, 90:93, 33:80, 105, 81:90])
    spliced = np.array([30, 31, 32, 80])
    track = followed(movies, tmp_path, lost=spliced)
    # These pictures may pass for a measurement or for a fault, but not for a smooth motion.
    off = turned_off(track, movies)[spliced]
    assert (np.isnan(off) | (off < 0.4)).all()
    assert (~track.valid[spliced] | (track.flags[spliced] & (Flag.SPIKE | Flag.RECOVERED | Flag.AMBIGUOUS) > 0)).all()


def with_more_noise(movie: np.ndarray) -> np.ndarray:
    """Make each picture different: a repeated picture counts as a fault."""
    more = np.random.default_rng(4).integers(0, 3, movie.shape, dtype=np.uint8)
    return np.clip(movie.astype(np.int16) + more - 1, 0, 255).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize(
    "order",
    [np.r_[0:40, 39:-1:-1], np.r_[0:40, [40] * 20, 40:80], np.r_[0:40, 40:120:3]],
    ids=["turns back", "stands still for 20 frames", "three times as fast"],
)
def test_sudden_changes_of_the_motion_cost_no_frame(held, tmp_path, order):
    followed(held.frames(order).spoilt(with_more_noise), tmp_path)


# Other paint, other light.


@pytest.mark.slow
@pytest.mark.parametrize(
    "changed",
    [
        {"texture": "dots", "seed": 5},
        {"white": 60.0, "black": 12.0, "seed": 6},
        {"ambient": 0.1, "seed": 7},
        {"texture": "dots", "white": 80.0, "ambient": 0.2, "seed": 8},
    ],
    ids=["sparse dots", "dim", "uneven light", "sparse dots, dim, uneven light"],
)
def test_no_frame_is_lost_with_other_paint_and_light(rendered, tmp_path, changed):
    movies = rendered(omega_rms=mean_turn(4.5), **changed)
    track = followed(movies, tmp_path)
    assert np.median(turned_off(track, movies)) < 0.12


def soft(movies: Movies, blur_px: float) -> Movies:
    """The same, out of focus, the last bits noisy as a sensor makes them."""

    def filmed(movie: Pictures) -> Pictures:
        blurred = np.stack([cv2.GaussianBlur(one.astype(np.float32), (0, 0), blur_px) for one in movie])
        noise = np.random.default_rng(0).normal(0, 1.5, movie.shape)
        return np.clip(np.rint(blurred + noise), 0, 255).astype(np.uint8)

    return movies.spoilt(filmed)


@pytest.mark.slow
def test_pictures_out_of_focus_by_a_seventh_of_the_radius_are_tracked(brisk, tmp_path):
    track = tracked(soft(brisk.frames(slice(0, 40)), 0.14 * 25.0), tmp_path)
    assert track.valid.all()
    off = turned_off(track, brisk.frames(slice(0, 40)))
    assert np.median(off) < 2.0
    assert off.max() < 5.0


@pytest.mark.slow
def test_the_blur_of_soft_pictures_is_learnt_and_a_given_one_is_used(brisk, tmp_path):
    movies = soft(brisk, 0.95)
    options = [() if blur is None else (f"refine.blur_px={blur}",) for blur in (None, 1.13, 0.625)]
    folders = [tmp_path / str(k) for k in range(len(options))]
    for folder in folders:
        folder.mkdir()
    found = [tracked(movies, folder, *given) for folder, given in zip(folders, options, strict=True)]
    learnt, right, wrong = (np.median(turned_off(track, movies)) for track in found)
    print(f"learnt {learnt:.4f}, given {right:.4f}, given wrongly {wrong:.4f} degrees")
    assert learnt < 1.15 * right
    assert wrong > 1.5 * right
    assert 0.6 < rms(in_sigmas(rotation_error(found[0], movies), found[0].orientation_cov)) < 1.4


@pytest.mark.slow
def test_a_mirrored_map_is_refused_of_soft_pictures_too(brisk, tmp_path):
    """Any pose explains most of a blurred disk: only the surplus of the best one counts."""
    path = write(soft(brisk.frames(slice(0, 40)), 0.14 * 25.0), tmp_path)
    texture = path.with_name("texture.png")
    cv2.imwrite(str(texture), np.ascontiguousarray(cv2.imread(str(texture), cv2.IMREAD_GRAYSCALE)[:, ::-1]))
    with pytest.raises(ExperimentError, match="mirrored"):
        track_movies(path, method="precise")


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_one_camera_alone_loses_no_frame_and_its_covariance_shows_the_unseen_direction(brisk, tmp_path, name):
    track = followed(brisk, tmp_path, cameras=(name,))
    assert list(track.cameras) == [name]
    assert 0.5 < rms(in_sigmas(track.position - brisk.position_mm, track.position_cov)) < 1.8
    assert 0.6 < rms(in_sigmas(rotation_error(track, brisk), track.orientation_cov)) < 1.7


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_one_camera_finds_every_frame_without_history(brisk, tmp_path, name):
    """Where half of the rim is dark, an outline's distance is centimetres off: the fit must come all the way back."""
    followed(brisk, tmp_path, "refine.chunk_frames=2", cameras=(name,))


# Short movies and parts of movies.


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_movies_of_a_few_frames_are_tracked(short, tmp_path, count):
    movies = short.frames(slice(20, 20 + count))
    track = tracked(movies, tmp_path)
    check_right(track, movies, np.arange(count))
    assert np.isfinite(track.position).all()
    for name in ("orientation_cov", "position_cov"):
        assert (np.linalg.eigvalsh(getattr(track, name)) > 0).all(), name
    if count == 1:
        assert np.isnan(track.omega_lab).all()
        assert np.isnan(track.velocity).all()
    # The few derivatives are right: 4.5 degrees a frame are 47 rad/s.
    assert not (np.abs(track.omega_lab) > 300).any()


def test_one_frame_with_the_ball_among_many_without(rendered, tmp_path):
    without = np.r_[0:5, 6:12]
    movies = rendered(**SHORT | {"frames": 12}).without_ball(without)
    track = tracked(movies, tmp_path)
    check_right(track, movies, np.array([5]))
    check_nothing(track, without)


@pytest.mark.slow
@pytest.mark.parametrize("frames", [(0, 1), (15, 17), (16, 18), (10, 40), (47, 48)], ids=str)
def test_a_part_of_the_movie_keeps_the_clock(short, tmp_path, frames):
    experiment = write(short, tmp_path, frames=list(frames))
    track = track_movies(experiment, settings=settings("refine.chunk_frames=16"))
    assert np.allclose(track.time * 600, np.arange(*frames))
    check_right(track, short.frames(slice(*frames)), np.arange(frames[1] - frames[0]))


# The same bytes.

FINGERPRINT = """
import hashlib, sys
import h5py
from sphereorient.locate import Frame
from sphereorient import track_movies
track_movies(sys.argv[1]).save(sys.argv[2])
digest = hashlib.sha256()
def add(name, item):
    if isinstance(item, h5py.Dataset):
        digest.update(name.encode() + item[()].tobytes())
with h5py.File(sys.argv[2]) as file:
    file.visititems(add)
print(digest.hexdigest())
"""


@pytest.mark.slow
def test_two_runs_give_the_same_bytes_with_one_thread_or_two(short, tmp_path):
    experiment = write(short.without_ball(np.arange(20, 24), ("cam2",)), tmp_path)
    prints = set()
    for threads in ("1", "2", "2"):
        environment = os.environ | {"OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
        command = [sys.executable, "-c", FINGERPRINT, str(experiment), str(tmp_path / "track.h5")]
        run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
        assert run.returncode == 0, run.stderr
        prints.add(run.stdout)
    assert len(prints) == 1


@pytest.mark.slow
def test_measurements_of_a_block_do_not_depend_on_the_blocks_beside_it(short, tmp_path, monkeypatch):
    """Chunks, workers and a resumed run are all windows of other blocks."""
    made: list[BallTracker] = []

    class Kept(BallTracker):
        def __init__(self, *parts: object) -> None:
            super().__init__(*parts)
            made.append(self)

    monkeypatch.setattr(precise, "BallTracker", Kept)
    experiment = write(short.without_ball(np.arange(37, 39), ("cam1",)), tmp_path)
    track_movies(experiment, settings=settings("refine.chunk_frames=16"))
    (ball,) = made
    tracker = Tracker({"": ball})
    pictures = [np.load(tmp_path / f"{name}.npy") for name in CAMERAS]

    def poses_of(*blocks: int) -> list[str]:
        """Follow blocks, by number, in one window."""
        rows = np.concatenate([np.arange(16 * block, 16 * block + 16) for block in blocks])
        frames = [[Frame(shown=picture) for picture in movie[rows]] for movie in pictures]
        return [_digest(row[""]) for row in tracker.track(frames, [16] * len(blocks), (rows / 600.0).tolist())]

    each = [poses_of(block) for block in range(3)]
    assert [poses_of(block) for block in (2, 0, 1)] == [each[2], each[0], each[1]]
    ball.settings = ball.settings.model_copy(update={"chunks": 3})
    together = poses_of(0, 1, 2)
    assert poses_of(2, 1) == together[32:] + together[16:32]
    assert poses_of(1) == together[16:32]


def _digest(poses: Poses) -> str:
    digest = hashlib.sha256()
    for value in vars(poses).values():
        digest.update(value.numpy().tobytes() if isinstance(value, torch.Tensor) else repr(value).encode())
    return digest.hexdigest()


@pytest.mark.slow
def test_frames_of_the_first_blocks_do_not_depend_on_how_the_movie_is_decoded(short, tmp_path):
    """The same pictures from FFV1 and from .npy, read by any thread."""
    from_npy = track_movies(write(short, tmp_path))
    from_video = track_movies(short.folder / "experiment.yaml")
    for name in ("position", "orientation", "orientation_cov", "omega_lab", "segment", "flags", "confidence"):
        np.testing.assert_array_equal(getattr(from_video, name), getattr(from_npy, name))
