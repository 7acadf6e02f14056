"""The refinement against planted poses: errors of the start, bubbles, light, neighbours in the batch, honest sigmas."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from refine_examples import (
    balls,
    cut,
    fitted,
    flat_light,
    model_of,
    moved,
    noisy,
    pictures_of,
    rig_of,
    share_pictures,
    turn_errors,
    turned,
)
from scipy.stats import chi2

from sphereorient import so3
from sphereorient.pose.fit import FittedPoses
from sphereorient.pose.model import sphere_view

SIGMA = 4.0  # grey levels; 2.5 % of the step from black to white paint


def degrees(fit: FittedPoses, R: torch.Tensor) -> np.ndarray:
    return np.rad2deg(turn_errors(fit, R).norm(dim=-1).numpy())


@pytest.fixture(scope="module")
def seen():
    """24 balls before two cameras, with noise."""
    rig = rig_of()
    X, R = balls(24, seed=1)
    return rig, X, R, noisy(pictures_of(rig, "blobs", X, R), SIGMA, seed=2)


@pytest.mark.parametrize(("turn_deg", "move_mm"), [(0.0, 0.0), (1.0, 0.1), (3.0, 0.3), (5.0, 0.6)])
def test_planted_errors_of_rotation_and_place_are_taken_back(seen, turn_deg, move_mm):
    rig, X, R, pictures = seen
    start_X, start_R = moved(X, move_mm, seed=3), turned(R, turn_deg, seed=4)
    fit = fitted(rig, "blobs", cut(rig, pictures, start_X), start_X, start_R, SIGMA, iterations=8)
    assert degrees(fit, R).max() < 0.12
    assert (fit.position_lab_mm - X).norm(dim=-1).max() < 0.03
    assert fit.step[:, :3].norm(dim=-1).max() < 1e-4


def test_one_camera_finds_a_distance_that_was_ten_percent_off():
    """The picture of a ball that is nearer is only larger: along the line of sight steps may be long."""
    rig = rig_of(models=("pinhole",))
    X, R = balls(12, seed=5)
    pictures = noisy(pictures_of(rig, "patches", X, R), SIGMA, seed=6)
    camera = rig.cameras[0]
    centre = -(camera.R_cam_lab.mT @ camera.T_cam_lab_mm)
    start = centre + 0.95 * (X - centre)
    fit = fitted(rig, "patches", cut(rig, pictures, start), start, turned(R, 1.0, 7), SIGMA, iterations=10)
    sight = torch.nn.functional.normalize(X - centre, dim=-1)
    off = fit.position_lab_mm - X
    assert (off * sight).sum(-1).abs().max() < 0.7  # of 260 mm; the start was 13 mm off
    assert (off - (off * sight).sum(-1, keepdim=True) * sight).norm(dim=-1).max() < 0.05
    assert degrees(fit, R).max() < 0.3


def test_the_slopes_are_those_of_the_view(seen):
    rig, X, R, pictures = seen
    pixels = cut(rig, pictures[:4], X[:4])
    table = rig.table("blobs")

    def view(X_at: torch.Tensor, R_at: torch.Tensor):
        return sphere_view(pixels, X_at.repeat_interleave(2, 0), R_at.repeat_interleave(2, 0), model_of(table))

    at, h = view(X[:4], R[:4]), 2e-3
    for k, axis in enumerate(torch.eye(3, dtype=torch.float64)):
        by_turn = view(X[:4], so3.exp(h * axis) @ R[:4]).paint - view(X[:4], so3.exp(-h * axis) @ R[:4]).paint
        by_move = view(X[:4] + h * axis, R[:4]), view(X[:4] - h * axis, R[:4])
        pairs = [
            (by_turn / (2 * h), at.paint_by_rotation[:, k]),
            ((by_move[0].coverage - by_move[1].coverage) / (2 * h), at.coverage_by_position[:, k]),
        ]
        for measured, stated in pairs:
            # A table of cells is not smooth in itself, so all pixels together are compared.
            cosine = (measured * stated).sum() / (measured.norm() * stated.norm())
            assert cosine > 0.98
            assert abs(float(measured.norm() / stated.norm()) - 1) < 0.06


def test_brightness_contrast_and_slanting_light_do_not_move_the_pose(seen):
    rig, X, R, _ = seen
    paint, ball = share_pictures(rig, "blobs", X, R)
    plain = 15.0 + 25.0 * ball + 160.0 * paint
    u = torch.linspace(-1, 1, plain.shape[-1], dtype=torch.float64)
    lit = 15.0 + (10.0 + 15.0 * ball * 0 + 0.55 * (25.0 * ball + 160.0 * paint) * (1 + 0.3 * u)) - 10.0
    poses = []
    for picture in (plain, lit):
        pixels = cut(rig, picture, X)
        poses.append(fitted(rig, "blobs", pixels, X, turned(R, 1.0, 8), 1.0, iterations=8))
    apart = so3.geodesic_distance(poses[0].R_lab_body, poses[1].R_lab_body)
    assert math.degrees(float(apart.max())) < 0.05
    assert degrees(poses[1], R).max() < 0.06


def test_a_bubble_does_not_move_the_pose(seen):
    rig, X, R, pictures = seen
    spoilt = pictures.clone()
    middle = spoilt.shape[-1] // 2
    spoilt[..., middle - 6 : middle + 7, middle + 4 : middle + 17] = 250.0
    start = turned(R, 1.0, 9)
    clean, bubbly = (
        fitted(rig, "blobs", cut(rig, one, X), X, start, SIGMA, iterations=8) for one in (pictures, spoilt)
    )
    assert degrees(bubbly, R).max() < 0.2
    assert (bubbly.position_lab_mm - X).norm(dim=-1).max() < 0.05
    assert (bubbly.score < clean.score).all()


def test_a_wrong_pose_scores_less_and_is_less_likely(seen):
    rig, X, R, pictures = seen
    pixels = cut(rig, pictures, X)
    right, wrong = (fitted(rig, "blobs", pixels, X, start, SIGMA) for start in (R, turned(R, 60.0, 10)))
    assert (right.score.amin(1) > 0.9).all()
    assert (wrong.score.amax(1) < right.score.amin(1)).all()
    assert (wrong.nll > right.nll + 50).all()


def test_a_pose_that_no_camera_sees_stays_where_it_is(seen):
    rig, X, R, pictures = seen
    use = torch.ones(len(X), 2, dtype=torch.bool)
    use[3] = False
    fit = fitted(rig, "blobs", cut(rig, pictures, X), X, turned(R, 1.0, 11), SIGMA, use=use)
    assert torch.equal(fit.position_lab_mm[3], X[3])
    assert float(so3.geodesic_distance(fit.R_lab_body[3], turned(R, 1.0, 11)[3])) < 1e-9
    assert degrees(fit, R)[[0, 1, 2, 4]].max() < 0.12


def test_what_is_known_of_the_place_holds_it(seen):
    rig, X, R, pictures = seen
    wrong = moved(X, 0.5, seed=12)
    held = torch.eye(3, dtype=torch.float64).expand(len(X), 3, 3) * 1e12
    fit = fitted(rig, "blobs", cut(rig, pictures, X), wrong, R, SIGMA, place_precision=held)
    assert (fit.position_lab_mm - wrong).norm(dim=-1).max() < 1e-3
    free = fitted(rig, "blobs", cut(rig, pictures, X), wrong, R, SIGMA, place_precision=0 * held)
    assert (free.position_lab_mm - X).norm(dim=-1).max() < 0.03


def test_a_pose_does_not_depend_on_its_neighbours(seen):
    rig, X, R, pictures = seen
    start = turned(R, 1.0, 13)

    def poses(rows: list[int]) -> FittedPoses:
        pixels = cut(rig, pictures[rows], X[rows])
        whole = pixels.thinned(1)  # whole vectors, as the tracker cuts them
        return fitted(rig, "blobs", whole, X[rows], start[rows], SIGMA)

    one, other = poses([0, 1, 2, 3]), poses([3, 7, 0, 9])
    for name in ("position_lab_mm", "R_lab_body", "covariance", "own_turn", "nll", "score"):
        assert torch.equal(getattr(one, name)[[0, 3]], getattr(other, name)[[2, 0]]), name


def test_each_camera_alone_is_told_beside_the_joint_pose(seen):
    rig, X, R, pictures = seen
    fit = fitted(rig, "blobs", cut(rig, pictures, X), X, R, SIGMA, iterations=6)
    own = torch.linalg.solve(torch.linalg.cholesky(fit.own_covariance), fit.own_turn[..., None])[..., 0]
    # Each camera is half of the joint pose, so it lies nearer to it than to the truth.
    assert 0.3 < float(own.square().mean().sqrt()) < 1.1
    for camera in range(2):
        use = torch.zeros(len(X), 2, dtype=torch.bool)
        use[:, camera] = True
        alone = fitted(rig, "blobs", cut(rig, pictures, X), X, R, SIGMA, iterations=8, use=use)
        told = fit.position_lab_mm + fit.own_move[:, camera]
        seen_at, told_at = (rig.cameras[camera].project(place) for place in (alone.position_lab_mm, told))
        assert (seen_at - told_at).norm(dim=-1).max() < 0.02  # px


def whitened(error: torch.Tensor, covariance: torch.Tensor) -> np.ndarray:
    return torch.linalg.solve(torch.linalg.cholesky(covariance), error[..., None])[..., 0].numpy()


@pytest.mark.slow
@pytest.mark.parametrize("models", [("pinhole", "tsai"), ("pinhole",)], ids=["two cameras", "one camera"])
def test_the_covariance_is_honest_on_2000_noisy_renders(models):
    """5 % noise. What the model itself is off, the same in all draws of an attitude, is counted as well."""
    rig, noise = rig_of(64.0, models), 8.0
    X, R = balls(200, seed=20)
    clean = pictures_of(rig, "blobs", X, R)
    z = []
    for draw in range(10):
        pictures = noisy(clean, noise, seed=100 + draw)
        fit = fitted(rig, "blobs", cut(rig, pictures, X), X, R, noise, light=flat_light(len(models), noise))
        error = torch.cat([turn_errors(fit, R), X - fit.position_lab_mm], dim=-1)
        z.append(whitened(error, fit.covariance))
    z = np.concatenate(z)
    assert len(z) == 2000
    assert 0.9 < np.sqrt((z**2).mean()) < 1.2
    assert 0.85 < ((z**2).sum(1) < chi2.ppf(0.95, 6)).mean() < 0.98
    assert (np.sqrt((z**2).mean(0)) < 1.3).all()
