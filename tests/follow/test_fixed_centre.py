"""A fixed ball: one position for all frames, found from a few, held in all, with its error."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch
import yaml
from conftest import assert_close
from refine_examples import RADIUS_MM, balls, cut, f64, fitted, pictures_of, rig_of, turn_errors
from torch import Tensor

from sphereorient import so3
from sphereorient.experiment import load_experiment
from sphereorient.experiment.recording import open_recording
from sphereorient.files.threads import silent
from sphereorient.follow.ball import BallTracker
from sphereorient.follow.fixed_centre import FixedCentre, find_fixed_centre, follows_place, mean_place
from sphereorient.follow.follower import sample_frames
from sphereorient.follow.tracker import Tracker
from sphereorient.locate import Frame, screened_frames
from sphereorient.methods.method import Job
from sphereorient.methods.precise import learn
from sphereorient.methods.settings import Settings
from sphereorient.pose import Fitter
from sphereorient.pose.poses import FittedPoses, Poses, PoseStart
from sphereorient.run import MemoryStore, Request, run
from sphereorient.run.stages import track_movies
from sphereorient.synth import SynthSettings, write_synthetic_experiment


def scattered(trials: int, count: int, seed: int = 4) -> tuple[Tensor, Tensor]:
    """Measurements (trials, count, 3) of the origin and their covariances (count, 3, 3), all different."""
    rng = torch.Generator().manual_seed(seed)
    root = torch.randn(count, 3, 3, generator=rng, dtype=torch.float64) + torch.diag(f64([1.0, 1.0, 4.0]))
    errors = torch.randn(trials, count, 3, 1, generator=rng, dtype=torch.float64)
    return (root @ errors)[..., 0], root @ root.mT


def test_the_mean_position_errs_as_its_covariance_states():
    X, covariance = scattered(trials=400, count=12)
    found = [mean_place(one, covariance) for one in X]
    away = torch.stack([place @ torch.linalg.solve(C, place) for place, C in found])
    assert float(away.mean()) == pytest.approx(3.0, rel=0.25), "chi squared of three coordinates"


def test_frames_that_are_far_off_hardly_move_the_mean_position():
    X, covariance = scattered(trials=1, count=12)
    good, _ = mean_place(X[0], covariance)
    spoilt = X[0].clone()
    spoilt[:2] += 200.0
    place, C = mean_place(spoilt, covariance)
    plain = torch.linalg.solve(
        torch.linalg.inv(covariance).sum(0), (torch.linalg.inv(covariance) @ spoilt[..., None]).sum(0)[:, 0]
    )
    sigma = C.diagonal().sqrt()
    assert ((place - good).abs() < 2 * sigma).all()
    assert ((plain - good).abs() > 4 * sigma).any(), "a plain mean is far off"


def test_measurements_that_scatter_by_more_than_they_state_weigh_less():
    X, covariance = scattered(trials=1, count=12)
    _, stated = mean_place(X[0], covariance)
    _, wider = mean_place(5 * X[0], covariance)
    assert float(wider.diagonal().sum() / stated.diagonal().sum()) > 5


def test_a_single_frame_gives_the_position_with_its_own_error():
    X, covariance = scattered(trials=1, count=1)
    place, C = mean_place(X[0], covariance)
    assert_close(place, X[0, 0], 1e-9)
    assert_close(C, covariance[0], 1e-9)


def test_attitudes_err_with_the_position_as_follows_states():
    rig, (X, R) = rig_of(40.0, ("pinhole",)), balls(4, 1, reach_mm=0.0)
    pixels, use = cut(rig, pictures_of(rig, "patches", X, R), X), torch.ones(4, 1, dtype=torch.bool)

    def held(X: Tensor, R: Tensor, precision: Tensor) -> FittedPoses:
        return fitted(rig, "patches", pixels, X, R, 2.0, use=use, iterations=3, place_precision=precision)

    class Held:
        radius_mm, optics = RADIUS_MM, SimpleNamespace(fine=None)

        def fit(self, pixels, begin, level, iterations):
            return held(begin.position_lab_mm, begin.R_lab_body, begin.place_precision)

    follows = follows_place(Held(), pixels, X[0], R, use)
    firm = 1e14 * torch.eye(3, dtype=torch.float64).expand(4, 3, 3)
    for aside in f64([[0.05, 0.0, 0.0], [0.0, 0.0, 0.05]]):
        # Held at the true position + aside, the error of the position is -aside: true less measured, as for delta.
        error = turn_errors(held(X + aside, R, firm), R) - turn_errors(held(X, R, firm), R)
        assert_close(error.median(0).values, -follows @ aside, 0.1 * float((follows @ aside).norm()))


@cache
def in_its_place(folder: Path) -> Path:
    """A fixed ball before two cameras."""
    settings = SynthSettings(
        frames=40, image_size=(150, 150), diameter_px=56.0, volume_mm=8.0, velocity_rms=0.0, exposure=1e-4,
        exposure_samples=1, omega_rms=40.0, seed=5,
    )  # fmt: skip
    return write_synthetic_experiment(folder, settings)


def truth(path: Path) -> tuple[Tensor, Tensor]:
    """Places (N, 3), mm, and attitudes (N, 3, 3)."""
    with h5py.File(path.parent / "truth.h5") as file:
        return torch.from_numpy(file["position"][()]), torch.from_numpy(file["orientation"][()])


def beside(fitter: Fitter, frames: Sequence[Frame], pose: Poses, place: FixedCentre, error_mm: Tensor) -> Tensor:
    """Delta of a frame's attitude where the ball is held beside its position; brute force."""
    fine, use = fitter.optics.fine, pose.use[None]
    pixels = fitter.pixels([[frame.picture for frame in frames]], place.position_lab_mm[None], fine)
    firm = 1e14 * torch.eye(3, dtype=torch.float64)[None]
    R = [
        fitter.fit(pixels, PoseStart(X[None], pose.R_lab_body[:1], use, firm), fine, 6).R_lab_body
        for X in (place.position_lab_mm, place.position_lab_mm + error_mm)
    ]
    return so3.log(R[1] @ R[0].mT)[0]


def followed_poses(
    path: Path, cameras: list[str] | None
) -> tuple[FixedCentre, list[Poses], list[Poses], Tensor, Tensor]:
    """Position from a few frames; poses of all frames with a position each; poses at that one position.

    And two errors of the place, (2, 3), mm, with the turns that they do to some frames, (frames, 2, 3).
    """
    settings = Settings()
    with open_recording(load_experiment(path), cameras) as recording:
        begun = learn(Job(recording=recording, settings=settings, device=torch.device("cpu")), silent)
        known, search = begun.appearance, begun.tracker.balls[""].search
        views = known.fitter.views
        frames, _ = sample_frames(recording, views, settings.refine.appearance_frames)
        place = find_fixed_centre(search, frames, known.score_min)
        assert place is not None
        movies = [
            list(screened_frames(stream, view.background))
            for stream, view in zip(recording.streams, views, strict=True)
        ]
        times = recording.timeline.time_s.tolist()
        found = []
        for where in (None, place):
            ball = BallTracker(known, search, settings.refine, centre=where)
            tracker = Tracker({"": ball})
            poses: list[Poses] = []
            for window in tracker.batches(recording.frames):
                n = len(poses)
                some = slice(n, n + sum(window))
                poses += [row[""] for row in tracker.track([movie[some] for movie in movies], window, times[some])]
            found.append(poses)
        errors = 0.01 * f64([[1.0, 0.0, 0.0], [0.3, 1.0, -0.6]])
        turns = torch.stack(
            [
                torch.stack([beside(known.fitter, [m[k] for m in movies], found[1][k], place, by) for by in errors])
                for k in range(0, 40, 2)
            ]
        )
    return place, found[0], found[1], errors, turns


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [["cam1"], None], ids=["one camera", "two"])
def test_all_frames_are_measured_in_one_place_and_better(tmp_path_factory, cameras):
    path = in_its_place(tmp_path_factory.getbasetemp() / "in_its_place")
    X, R = truth(path)
    assert float((X - X[0]).norm(dim=1).max()) == 0.0
    place, free, held, beside_mm, turns = followed_poses(path, cameras)
    assert all(len(poses) for poses in held)
    at = torch.stack([poses.position_lab_mm[0] for poses in held])
    sigma = place.covariance_mm2.diagonal().sqrt()
    assert ((at - place.position_lab_mm).abs() < 0.1 * sigma).all(), "one place"
    off = place.position_lab_mm - X[0]
    assert float(off @ torch.linalg.solve(place.covariance_mm2, off)) < 16, "within its stated error"
    errors = [so3.log(R @ torch.stack([poses.R_lab_body[0] for poses in some]).mT) for some in (free, held)]
    steps = [torch.diff(error, dim=0).norm(dim=1).median() for error in errors]
    assert float(errors[1].norm(dim=1).median()) < 0.92 * float(errors[0].norm(dim=1).median())
    assert float(steps[1]) < 0.92 * float(steps[0])
    expected = beside_mm @ place.follows_rad_mm.mT
    assert float((turns.mean(0) - expected).norm()) < 0.12 * float(expected.norm())
    covariance = torch.stack([poses.covariance[0, :3, :3] for poses in held])
    away = (errors[1][:, None] @ torch.linalg.solve(covariance, errors[1][..., None]))[:, 0, 0]
    assert 0.3 < float(away.mean()) / 3 < 4, "the attitudes' errors are as stated"


def declared(folder: Path) -> tuple[Path, Path]:
    """Tracks of the same movie: of a moving ball, and declared fixed."""
    path = in_its_place(folder)
    document = yaml.safe_load(path.read_text())
    document["sphere"]["fixed"] = True
    fixed = path.with_name("fixed.yaml")
    fixed.write_text(yaml.safe_dump(document, sort_keys=False))
    return path, fixed


@pytest.mark.slow
def test_a_ball_declared_fixed_has_one_place_in_its_track(tmp_path_factory):
    path, fixed = declared(tmp_path_factory.getbasetemp() / "in_its_place")
    free = track_movies(path, cameras=["cam1"])
    held = track_movies(fixed, cameras=["cam1"])
    assert held.valid.all()
    spread = [float(np.linalg.norm(track.position - track.position[0], axis=1).max()) for track in (free, held)]
    assert spread[1] < 1e-3 * spread[0], "one place"


@pytest.mark.slow
def test_the_appearance_of_another_run_measures_at_the_same_position_to_the_last_bit(tmp_path_factory, tmp_path):
    _, fixed = declared(tmp_path_factory.getbasetemp() / "in_its_place")
    known = tmp_path / "learnt.h5"
    first = run(Request(experiment=fixed, cameras=("cam1",), save_learnt=known), MemoryStore())
    again = run(Request(experiment=fixed, cameras=("cam1",), learnt=known), MemoryStore())
    for name in ("position", "orientation"):
        assert np.array_equal(getattr(first, name), getattr(again, name)), name
