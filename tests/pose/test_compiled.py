"""The compiled fit against torch's, which defines it: same poses, covariances and scores, everywhere."""

import gc
import weakref
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
from sphereorient.pose import compiled, residuals
from sphereorient.pose.compiled import COMPILED, IN_TORCH
from sphereorient.pose.fit import FIRST_EVERY
from sphereorient.pose.lights.lab import lab_light
from sphereorient.pose.model import FIRST, LATER, SphereModel
from sphereorient.pose.pixels import Pixels, thinned_stencil
from sphereorient.pose.pose_fitter import PoseFitter
from sphereorient.pose.poses import POSE_PARTS, PoseStart
from sphereorient.sphere.texture import map_directions
from sphereorient.sphere.texture_table import texture_table

RIG, SIGMA = rig_of(), 3.0
X, R = balls(10, 4)
pytestmark = pytest.mark.skipif(
    compiled.refine_library() is None, reason="needs the compiled fit: `make setup` with a compiler"
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
    precision = 50.0 * torch.eye(3, dtype=torch.float64).expand(10, 3, 3)
    return PoseStart(moved(X, 0.05, 1), turned(R, 0.5, 1), torch.arange(20).reshape(10, 2) != 5, precision)


def unseen_model(pixels) -> SphereModel:
    unseen = map_directions(len(paint_of("blobs")))[..., 2] > 0.7
    # A frame's light of high order would be extrapolated to the unknown paint.
    paint = texture_table(paint_of("blobs"), 2 * BLUR_PX / RIG.diameter_px, unseen=unseen)
    return model_of(paint=paint, shading=LATER)


def learnt(pixels, *, lab: bool = False) -> SphereModel:
    model = model_of()
    given = pixels, COMPILED.refine(pixels, begin(), model, 6), torch.ones(10, 2, dtype=torch.bool), model
    light = lab_light(*given) if lab else model.light.learnt(*given)
    stray = torch.tensor([[3.0, 1, -1, 0.5, 0, 0, 0, 0.2, 0], [0.0] * 9])
    return model_of(light=replace(light, stray=stray), shading=LATER, limb_px=torch.tensor([0.02, -0.01]))


MODELS = {
    "first": lambda pixels: model_of(),
    "light on the disk": learnt,
    "light in the lab": lambda pixels: learnt(pixels, lab=True),
    "unseen paint": unseen_model,
}


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
        change = (a / b - 1).abs()
        own = name.startswith("own")
        assert float((change[seen] if own else change).max()) < 0.01, name
        assert not own or float(change.max()) < 0.02, name  # a picture that is not used has no last step of its own
    assert float((found.limb_coverage - expected.limb_coverage).abs().max()) < 0.01
    assert float((found.own_turn - expected.own_turn)[seen].abs().max()) < 1e-4


def assert_as_torch(pixels, model, iterations=4, most_hidden=0.0, nll=1e-3):
    found, expected = (body.refine(pixels, begin(), model, iterations, most_hidden) for body in (COMPILED, IN_TORCH))
    assert_same(found, expected, nll)


@pytest.fixture(params=[*MODELS, "moving", "behind a wall"])
def case(request, pixels) -> tuple[Pixels, SphereModel, str]:
    """Pixels, the model of them, and its name."""
    kind = request.param
    model = MODELS.get(kind, learnt)(pixels)
    if kind == "moving":
        moves = torch.randn(10, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.03
        pixels = pixels.exposed(moves, 3)
    if kind == "behind a wall":  # lines of sight start at different places
        origin = pixels.origin + pixels.direction * torch.linspace(-3, 3, pixels.grey.shape[1])
        pixels = replace(pixels, origin=origin, pitch_mm=pixels.pitch_mm + 0.01)
    return pixels, model, kind


def test_poses_covariances_and_scores_are_those_of_torch(case):
    pixels, model, kind = case
    nll = 5e-3 if kind == "unseen paint" else 1e-3  # light is extrapolated to unknown paint
    for iterations in (1, 4) if kind in MODELS else (4,):
        assert_as_torch(pixels, model, iterations, nll=nll)


def test_residuals_and_their_parts_are_those_of_torch(case):
    pixels, model, _ = case
    start = begin()
    given = pixels, start.position_lab_mm, start.R_lab_body
    first = residuals.residuals(*given, None, model)
    for state in (None, (first.model, first.weight)):
        found, expected = (body(*given, state, model) for body in (compiled.residuals_compiled, residuals.residuals))
        counts = expected.inside & (expected.view.coverage > 1e-3)
        assert float((found.inside != expected.inside).float().mean()) < 1e-3  # at the threshold rounding decides
        assert (found.view.known is None) == (expected.view.known is None)
        pairs = {name: (getattr(found, name), part) for name, part in vars(expected).items()}
        pairs |= {name: (getattr(found.view, name), part) for name, part in vars(expected.view).items()}
        for name, (one, other) in pairs.items():
            if name in ("view", "known", "inside"):
                continue
            assert (one.shape, one.dtype) == (other.shape, other.dtype), name
            apart = (one - other).abs()
            if apart.shape[-1] == counts.shape[-1]:
                apart = apart.movedim(-1, 1)[counts]
            size = float(other.abs().max())
            assert float((apart > 2e-3 * size).float().mean()) < 1e-3, name  # look-ups on the border of two cells
            assert float(apart.square().mean().sqrt()) < 1e-3 * size, name


@pytest.mark.parametrize("kind", ["light in the lab", "unseen paint"])
def test_occluders_are_those_of_torch(pixels, kind):
    covered = pixels.grey.clone()
    near = ((pixels.place - torch.tensor([[4], [-6]])).abs() <= 4).all(0)
    covered[::3, near] += 90.0
    covered[1, :] = covered[1].flip(0)  # too many pixels differ for an occluder
    hidden, model = replace(pixels, grey=covered), MODELS[kind](pixels)
    for most in (0.4, 1e-4):
        inside = COMPILED.kept(hidden, begin(), model, most)
        other = inside != IN_TORCH.kept(hidden, begin(), model, most)
        assert int(other.sum()) <= 1e-3 * int((pixels.inside & ~inside).sum())  # at the threshold rounding decides
        assert bool((pixels.inside & ~inside)[0, near].any()) == (most == 0.4)
        assert torch.equal(inside[1], pixels.inside[1])
        assert_as_torch(hidden, model, 2, most, nll=5e-3)
        past = COMPILED.refine(hidden, begin(), model, 2, most)
        without = COMPILED.refine(replace(hidden, inside=inside), begin(), model, 2)
        for name in POSE_PARTS:
            assert torch.equal(getattr(past, name), getattr(without, name)), name


def test_a_disk_does_not_depend_on_batch_threads_or_the_width_of_vectors(pixels, monkeypatch):
    model, start = learnt(pixels), begin()
    whole = COMPILED.refine(pixels, start, model, most_hidden=0.4)
    some = COMPILED.refine(pixels.where(torch.arange(6, 10)), start.of(torch.tensor([3, 4])), model, most_hidden=0.4)
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    threaded = COMPILED.refine(pixels, start, model, most_hidden=0.4)
    torch.set_num_threads(threads)
    plain = built_for(compiled.SOURCE, compiled.Near, "default")
    assert plain is not None
    monkeypatch.setattr(compiled, "refine_library", lambda: plain)
    narrow = COMPILED.refine(pixels, start, model, most_hidden=0.4)
    for name in POSE_PARTS:
        assert torch.equal(getattr(whole, name), getattr(threaded, name)), name
        assert torch.equal(getattr(whole, name), getattr(narrow, name)), name
        assert torch.equal(getattr(whole, name)[3:5], getattr(some, name)), name


def test_the_record_of_a_single_pose_holds_all_that_it_points_to():
    fitter = PoseFitter(RIG.cameras, paint_of("blobs"), radius_mm=RADIUS_MM, diameter_px=RIG.diameter_px).fitter
    fitter = replace(fitter, widest_px=RIG.diameter_px / 2)
    frames = [[one.numpy() for one in pictures_of(RIG, "blobs", X[:1], R[:1])[0]]]
    fitter.settled(frames, PoseStart(X[:1], R[:1], torch.ones(1, 2, dtype=torch.bool)))
    some = weakref.ref(thinned_stencil(fitter.stencil(fitter.optics.fine, fitter.widest_px), FIRST_EVERY))
    thinned_stencil.cache_clear()  # as many other stencils would
    compiled._of_stencil.cache_clear()
    gc.collect()
    assert some() is not None
