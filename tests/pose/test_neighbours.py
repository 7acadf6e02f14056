"""Other spheres in the picture: places of a disk that do not count, and fits without them."""

from dataclasses import replace

import pytest
import torch
from refine_examples import (
    BEHIND,
    BLUR_PX,
    RADIUS_MM,
    balls,
    base_of,
    f64,
    noisy,
    pictures_of,
    rig_of,
    scene_of,
    turned,
)

from sphereorient import so3
from sphereorient.cameras import centre_lab_mm
from sphereorient.locate import CameraScene
from sphereorient.pose import compiled
from sphereorient.pose.camera_view import CameraView
from sphereorient.pose.fitter import first_fitter
from sphereorient.pose.neighbours import Neighbours, spoilt
from sphereorient.pose.poses import PoseStart
from sphereorient.pose.view import sphere_view

RIG, COUNT = rig_of(), 4


@pytest.fixture(scope="module")
def scene():
    """Balls with another one of the same paint halfway before them in the first camera, but for the last ball."""
    X, R = balls(COUNT, 4)
    sight = RIG.cameras[0].rays(RIG.cameras[0].project(X))
    across = RIG.cameras[0].R_cam_lab[0] * 1.1 * RADIUS_MM
    other = X - 2.5 * RADIUS_MM * sight.direction_lab + across
    other[-1] = torch.nan
    alone = pictures_of(RIG, "patches", X, R)
    there = pictures_of(RIG, "patches", torch.where(other.isnan(), X, other), R)
    # In both cameras the other ball is the nearer one where they overlap.
    pictures = torch.where((there != BEHIND) & ~other.isnan().any(1)[:, None, None, None], there, alone)
    frames = [list(row) for row in noisy(pictures, 1.0, 3).round().clamp(0, 255).to(torch.uint8).numpy()]
    views = []
    for k, camera in enumerate(RIG.cameras):
        height, width = pictures.shape[-2:]
        background = scene_of(torch.full((height, width), BEHIND).numpy(), None)
        known = CameraScene(background=background, diameter_px=RIG.diameter_px)
        views.append(CameraView.of(f"cam{k + 1}", camera, known))
    fitter = replace(first_fitter(views, RADIUS_MM, base_of("patches"), BLUR_PX), widest_px=0.55 * RIG.diameter_px)
    still = torch.zeros(COUNT, 1, 3, dtype=torch.float64)
    others = Neighbours(position_lab_mm=other[:, None], radius_mm=f64([[RADIUS_MM]] * COUNT), move_mm=still)
    return fitter, frames, X, R, others


def test_places_do_not_count_where_the_rendered_other_ball_covers_them_or_shows_behind_the_limb(scene):
    fitter, frames, X, R, others = scene
    level = fitter.optics.fine
    every = fitter.pixels(frames, X, level, fitter.widest_px)
    left = fitter.pixels(frames, X, level, fitter.widest_px, neighbours=others)
    there = others.position_lab_mm[:, 0]
    there = torch.where(there.isnan(), X + f64([100.0, 0.0, 0.0]), there)
    own, other = (
        sphere_view(every, place.repeat_interleave(2, 0), R.repeat_interleave(2, 0), fitter.model(level)).coverage
        for place in (X, there)
    )
    eyes = torch.stack([centre_lab_mm(view.camera) for view in fitter.views])
    away = [(place[:, None] - eyes).norm(dim=-1).reshape(-1) for place in (X, there)]
    nearer = (away[1] < away[0])[:, None]
    spoilt = (other > 0.0042) & (nearer | (own < 0.9958))
    assert bool((spoilt <= ~left.inside).all())
    surely_not = (other < 0.0038) | (~nearer & (own > 0.9962))
    assert bool((left.inside | ~surely_not).all())
    assert not bool(left.inside[0].all())
    assert bool(left.inside[-2:].all())


def test_the_share_that_is_left_is_that_of_the_two_circles(scene):
    fitter, _, X, _, others = scene
    middle_px, *_ = fitter.disks_px(X)
    level = fitter.optics.fine
    places = fitter.places(X, level, fitter.stencil(level, fitter.widest_px), middle_px)
    share = spoilt(places, others).left
    assert 0.3 < float(share[0, 0]) < 0.8
    assert share[-1].tolist() == [1.0, 1.0]


def test_a_nearer_ball_that_moves_covers_what_it_covers_at_both_ends_of_the_exposure(scene):
    fitter, _, X, _, others = scene
    middle_px, *_ = fitter.disks_px(X)
    level, still = fitter.optics.fine, torch.zeros(len(X), 3, dtype=torch.float64)
    at_rest = fitter.places(X, level, fitter.stencil(level, fitter.widest_px), middle_px)
    move = torch.tensor([0.4, -0.3, 0.2], dtype=torch.float64) * RADIUS_MM
    ends = [
        spoilt(at_rest, replace(others, position_lab_mm=others.position_lab_mm + half * move)).hidden
        for half in (-0.5, 0.5)
    ]
    moving = replace(others, move_mm=move.expand_as(others.position_lab_mm))
    other = spoilt(replace(at_rest, move_mm=still), moving).hidden != (ends[0] | ends[1])
    assert int(other.sum()) < 0.02 * int((ends[0] != ends[1]).sum())  # the blur is that of the middle


def test_fits_look_past_the_other_ball_compiled_or_not_and_without_one_keep_their_bytes(scene, monkeypatch):
    fitter, frames, X, R, others = scene
    begin = PoseStart(
        position_lab_mm=X,
        R_lab_body=torch.cat([turned(R[k : k + 1], 0.3, k) for k in range(COUNT)]),
        use=torch.ones(COUNT, 2, dtype=torch.bool),
        place_precision=4.0 * torch.eye(3, dtype=torch.float64).expand(COUNT, 3, 3),
        moved=torch.zeros(COUNT, 6, dtype=torch.float64),
        held=False,
    )
    plain, past = fitter.settled(frames, begin), fitter.settled(frames, replace(begin, among=others))
    off = [torch.rad2deg(so3.geodesic_distance(fit.R_lab_body, R)) for fit in (plain, past)]
    assert float(off[1].max()) < 0.3
    assert float(off[1][:-1].max()) < 0.7 * float(off[0][:-1].max())
    assert torch.equal(past.R_lab_body[-1], plain.R_lab_body[-1])
    assert torch.equal(past.covariance[-1], plain.covariance[-1])
    monkeypatch.setattr(compiled, "refine_library", lambda: None)
    slow = fitter.settled(frames, replace(begin, among=others))
    assert float(torch.rad2deg(so3.geodesic_distance(slow.R_lab_body, past.R_lab_body)).max()) < 2e-3
