"""The compiled fit against torch's, which defines it: same poses, covariances and scores, everywhere."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from refine_examples import (
    BLUR_PX,
    RADIUS_MM,
    balls,
    cut,
    flat_light,
    moved,
    noisy,
    paint_of,
    pictures_of,
    rig_of,
    turned,
)

from sphereorient import so3
from sphereorient.files.compiled import built_for
from sphereorient.pose import compiled
from sphereorient.pose.fit import POSE_PARTS, learn_light, refine
from sphereorient.pose.lab_light import learn_lab_light
from sphereorient.pose.model import FIRST, LATER, SphereModel
from sphereorient.pose.occluders import unoccluded
from sphereorient.pose.start import PoseStart
from sphereorient.sphere.texture import map_directions
from sphereorient.sphere.texture_table import texture_table

RIG, SIGMA = rig_of(), 3.0
X, R = balls(10, 4)
pytestmark = pytest.mark.skipif(
    compiled.library() is None, reason="needs the compiled fit: `make setup` with a compiler"
)


@pytest.fixture(scope="module")
def pixels():
    found = cut(RIG, noisy(pictures_of(RIG, "blobs", X, R), SIGMA, 2), X, full_scale=203.0)
    inside = found.inside.clone()
    inside[:, 100:300:7] = False
    return replace(found, inside=inside)


def model_of(**changes) -> SphereModel:
    given = {"radius_mm": RADIUS_MM, "paint": RIG.table("blobs"), "blur_px": BLUR_PX, "light": flat_light(2, SIGMA)}
    return SphereModel(**given | {"shading": FIRST} | changes)


def begin() -> PoseStart:
    return PoseStart(
        position_lab_mm=moved(X, 0.05, 1),
        R_lab_body=turned(R, 0.5, 1),
        use=torch.arange(20).reshape(10, 2) != 5,
        place_precision=4.0 * torch.eye(3, dtype=torch.float64).expand(10, 3, 3),
    )


def unseen_model(pixels) -> SphereModel:
    unseen = map_directions(len(paint_of("blobs")))[..., 2] > 0.7
    # A frame's light of high order would be extrapolated to the unknown paint.
    paint = texture_table(paint_of("blobs"), 2 * BLUR_PX / RIG.diameter_px, unseen=unseen)
    return model_of(paint=paint, shading=LATER)


def learnt(pixels, learn) -> SphereModel:
    model = model_of()
    fit = refine(pixels, begin(), model, 6)
    light = learn(pixels, fit, torch.ones(10, 2, dtype=torch.bool), model)
    stray = torch.tensor([[3.0, 1, -1, 0.5, 0, 0, 0, 0.2, 0], [0.0] * 9])
    return model_of(light=replace(light, stray=stray), shading=LATER, limb_px=torch.tensor([0.02, -0.01]))


MODELS = {
    "first": lambda pixels: model_of(),
    "light on the disk": lambda pixels: learnt(pixels, learn_light),
    "light in the lab": lambda pixels: learnt(pixels, learn_lab_light),
    "unseen paint": unseen_model,
}


def by_torch(monkeypatch, pixels, model, iterations):
    with monkeypatch.context() as patch:
        patch.setattr(compiled, "library", lambda: None)
        return refine(pixels, begin(), model, iterations)


def assert_same(found, expected, nll=1e-3):
    seen = begin().use
    assert float(torch.rad2deg(so3.geodesic_distance(found.R_lab_body, expected.R_lab_body)).max()) < 1e-3
    assert float((found.position_lab_mm - expected.position_lab_mm).norm(dim=-1).max()) < 2e-4
    assert float((found.score - expected.score)[seen].abs().max()) < 1e-4
    assert float((found.nll / expected.nll - 1).abs().max()) < nll
    for name in ("covariance", "own_covariance", "own_sigma_mm", "excess"):
        a, b = getattr(found, name), getattr(expected, name)
        if a.ndim > 2 and a.shape[-1] == a.shape[-2]:
            a, b = (part.diagonal(dim1=-2, dim2=-1) for part in (a, b))
        assert float((a / b - 1).abs().max()) < 0.01, name
    assert float((found.own_turn - expected.own_turn)[seen].abs().max()) < 1e-4


@pytest.mark.parametrize("kind", MODELS)
def test_poses_covariances_and_scores_are_those_of_torch(pixels, kind, monkeypatch):
    model = MODELS[kind](pixels)
    nll = 5e-3 if kind == "unseen paint" else 1e-3  # light is extrapolated to where the paint is unknown
    for iterations in (1, 4):
        found, expected = refine(pixels, begin(), model, iterations), by_torch(monkeypatch, pixels, model, iterations)
        assert_same(found, expected, nll=nll)


def test_of_a_ball_that_moves_during_the_exposure(pixels, monkeypatch):
    moves = torch.randn(10, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.03
    moving = replace(pixels, moved=moves.repeat_interleave(2, 0), instants=3)
    model = learnt(pixels, learn_light)
    assert_same(refine(moving, begin(), model), by_torch(monkeypatch, moving, model, 4))


def test_of_lines_of_sight_that_start_at_different_places(pixels, monkeypatch):
    along = torch.linspace(-3, 3, pixels.grey.shape[1])  # as behind a wall
    ported = replace(pixels, origin=pixels.origin + pixels.direction * along, pitch_mm=pixels.pitch_mm + 0.01)
    assert_same(refine(ported, begin(), model_of()), by_torch(monkeypatch, ported, model_of(), 4))


@pytest.mark.parametrize("kind", ["light in the lab", "unseen paint"])
def test_occluders_are_those_of_torch(pixels, kind, monkeypatch):
    covered = pixels.grey.clone()
    near = ((pixels.place - torch.tensor([[4], [-6]])).abs() <= 4).all(0)
    covered[::3, near] += 90.0
    covered[1, :] = covered[1].flip(0)  # so much differs that nothing is taken for an occluder
    hidden, model = replace(pixels, grey=covered), MODELS[kind](pixels)
    every, start = torch.ones(10, 2, dtype=torch.bool), begin()
    for most in (0.4, 1e-4):
        done = compiled.refined(hidden, start.position_lab_mm, start.R_lab_body, model, every, most_hidden=most)
        expected = unoccluded(hidden, start.position_lab_mm, start.R_lab_body, model, 2, most)
        assert done is not None
        assert torch.equal(done[0], expected.inside)
        assert bool((pixels.inside & ~expected.inside)[0, near].any()) == (most == 0.4)
        assert torch.equal(expected.inside[1], pixels.inside[1])
        fit = refine(hidden, start, model, 2, most)
        with monkeypatch.context() as patch:
            patch.setattr(compiled, "library", lambda: None)
            assert_same(fit, refine(hidden, start, model, 2, most), nll=5e-3)
        without = refine(expected, start, model, 2)
        for name in POSE_PARTS:
            assert torch.equal(getattr(fit, name), getattr(without, name)), name


def test_a_disk_does_not_depend_on_batch_threads_or_the_width_of_vectors(pixels, monkeypatch):
    model = learnt(pixels, learn_light)
    whole = refine(pixels, begin(), model, most_hidden=0.4)
    start = begin()
    few = replace(
        start,
        **{name: getattr(start, name)[3:5] for name in ("position_lab_mm", "R_lab_body", "use", "place_precision")},
    )
    some = refine(pixels.where(torch.arange(6, 10)), few, model, most_hidden=0.4)
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    threaded = refine(pixels, start, model, most_hidden=0.4)
    torch.set_num_threads(threads)
    plain = built_for(compiled.SOURCE, compiled._Near, "default")
    assert plain is not None
    monkeypatch.setattr(compiled, "library", lambda: plain)
    narrow = refine(pixels, start, model, most_hidden=0.4)
    for name in POSE_PARTS:
        assert torch.equal(getattr(whole, name), getattr(threaded, name)), name
        assert torch.equal(getattr(whole, name), getattr(narrow, name)), name
        assert torch.equal(getattr(whole, name)[3:5], getattr(some, name)), name


def test_a_disk_without_a_number_gives_none_and_spoils_no_other(pixels):
    start = begin()
    lost = replace(start, position_lab_mm=start.position_lab_mm.index_fill(0, torch.tensor([2]), torch.nan))
    found, whole = refine(pixels, lost, model_of()), refine(pixels, start, model_of())
    others = torch.arange(10) != 2
    assert bool(found.position_lab_mm[2].isnan().all())
    assert torch.equal(found.R_lab_body[others], whole.R_lab_body[others])
