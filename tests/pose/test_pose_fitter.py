"""PoseFitter: poses from pictures without the pipeline, of any leading shape."""

from __future__ import annotations

import math

import pytest
import torch
from conftest import assert_close
from refine_examples import BEHIND, BLUR_PX, RADIUS_MM, balls, noisy, paint_of, pictures_of, rig_of, turned

from sphereorient import so3
from sphereorient.errors import ShapeError
from sphereorient.pose import camera_view
from sphereorient.pose.pose_fitter import PoseFitter

RIG = rig_of(64.0)


@pytest.fixture(scope="module")
def seen():
    X, R = balls(4, 3)
    pictures = noisy(pictures_of(RIG, "patches", X, R), 1.0, seed=2)
    background = torch.full((2, *pictures.shape[-2:]), BEHIND)
    made = {"radius_mm": RADIUS_MM, "diameter_px": 64.0, "blur_px": BLUR_PX, "background": background}
    return PoseFitter(RIG.cameras, paint_of("patches"), **made), X, R, pictures


def test_poses_are_found_from_five_degrees_away_within_their_errors(seen):
    fitter, X, R, pictures = seen
    R_found, X_found, covariance = fitter(pictures, turned(R, 5.0, 1), X + 0.1)
    error = so3.geodesic_distance(R_found, R)
    assert math.degrees(float(error.max())) < 0.1
    assert float((X_found - X).norm(dim=-1).max()) < 0.02
    sigma = covariance[..., :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    assert float((error / sigma).max()) < 4


def test_leading_shapes_numpy_and_single_precision_are_accepted(seen):
    fitter, X, R, pictures = seen
    start = turned(R, 2.0, 1)
    flat = fitter(pictures, start, X)
    shaped = fitter(
        pictures.float().numpy().reshape(2, 2, *pictures.shape[1:]),
        start.reshape(2, 2, 3, 3).numpy(),
        X.reshape(2, 2, 3),
    )
    for one, other in zip(flat, shaped, strict=True):
        assert other.shape[:2] == (2, 2)
        assert_close(other.reshape(one.shape), one, atol=1e-5)
    none = fitter(pictures[:0], start[:0], X[:0])
    assert [part.shape[0] for part in none] == [0, 0, 0]


def test_pictures_of_another_size_are_refused(seen):
    fitter, X, R, pictures = seen
    with pytest.raises(ShapeError, match=r"expected \(\.\.\., 2, 160, 160\) with 4 poses, got \(4, 2, 160, 159\)"):
        fitter(pictures[..., 1:], R, X)


TABLES = [(80, 0.4, 512), (100, 0.4, 512), (160, 0.4, 1024), (400, 0.8, 1024)]


@pytest.mark.parametrize(("diameter_px", "blur_px", "side"), TABLES)
def test_large_disks_have_a_finer_table(monkeypatch, diameter_px, blur_px, side):
    """At 250 px the usual table alone cost 0.009 degrees for 0.0025."""
    monkeypatch.setattr(camera_view, "texture_table", lambda texture, blur_rad, side, unseen: (blur_rad, side))
    blur_rad, cells = camera_view.base_table(torch.zeros(4, 8), diameter_px)
    assert blur_rad * diameter_px / 2 == pytest.approx(blur_px)
    assert cells == side
