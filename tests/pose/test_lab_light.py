"""One light in the lab for all cameras: its functions, its look-up, and planted light, gloss and cover found again."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from conftest import assert_close
from refine_examples import (
    Rig,
    balls,
    cut,
    fitted,
    fitter_of,
    flat_light,
    model_of,
    refined,
    rig_of,
)
from torch import Tensor

from sphereorient import so3
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.lights import kinds
from sphereorient.pose.lights.kinds import light_of, lit_in_the_lab
from sphereorient.pose.lights.lab import (
    KNOTS,
    MIRRORED,
    SCATTERED,
    LabLight,
    directions,
    harmonics,
    knot_shares,
    lab_light,
)
from sphereorient.pose.model import FIRST, LATER, SphereModel, even_light, scene_beside, stray_basis
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses, PoseStart
from sphereorient.pose.residuals import residuals
from sphereorient.pose.view import sphere_view
from sphereorient.sphere.texture_table import octahedral_directions

SIGMA = 2.0  # grey levels
LAMP, WINDOW = torch.tensor([0.3, -0.8, 0.52]), torch.tensor([-0.2, 0.1, 0.97])  # directions, lab


def test_harmonics_are_orthonormal_over_the_sphere():
    directions = octahedral_directions(128)
    side = 128
    # Cells of the octahedron's square cover the sphere unevenly: weight by |sum of components|^3.
    weight = (directions.abs().sum(-1) ** 3) / side**2
    weight = weight / weight.sum()
    values = harmonics(directions, 5)
    assert values.shape == (side**2, 36)
    gram = (values * weight[:, None]).mT @ values
    assert_close(gram, torch.eye(36, dtype=torch.float64), atol=2e-3)


def test_low_harmonics_are_constant_and_components():
    direction = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    values = harmonics(direction, 1)
    assert_close(values[:, 0], torch.ones(50, dtype=torch.float64))
    x, y, z = (3**0.5 * direction.double()).unbind(-1)
    for column, component in zip(values[:, 1:].unbind(-1), (y, z, x), strict=True):
        assert_close(column.abs(), component.abs(), atol=1e-6)


@pytest.mark.parametrize("shape", [(), (0,), (3, 2)])
def test_harmonics_and_knots_at_any_leading_shape(shape):
    assert harmonics(torch.ones(*shape, 3) / 3**0.5, 4).shape == (*shape, 25)
    assert knot_shares(torch.rand(shape)).shape == (*shape, len(KNOTS))


def test_knots_make_functions_that_are_linear_between_them():
    depth = torch.linspace(0, 1, 101)
    shares = knot_shares(depth)
    assert_close(shares.sum(-1), torch.ones(101), atol=1e-6)
    assert (shares >= 0).all()
    assert_close(shares @ torch.tensor(KNOTS), depth, atol=1e-6)


def planted(cameras: int) -> LabLight:
    """A lamp, a window that the gloss mirrors, a cover that dims the limb; the second camera has less gain."""
    scattered = torch.zeros((SCATTERED + 1) ** 2)
    scattered[0] = 1.0
    lamp = harmonics(LAMP / LAMP.norm(), 2)[1:4].float() / 3
    difference, black = 110 * scattered, 25 * scattered
    difference[1:4], black[1:4] = 60 * lamp, 10 * lamp
    window = harmonics(WINDOW / WINDOW.norm(), MIRRORED).float()
    degree = torch.tensor([n for n in range(MIRRORED + 1) for _ in range(2 * n + 1)])
    depth = torch.tensor(KNOTS)
    return LabLight(
        difference=difference,
        black=black,
        gloss=4.0 * window * torch.exp(-0.02 * degree * (degree + 1)),
        through=1 - 0.2 * (1 - depth) ** 2,
        mirrored=0.04 + 0.15 * (1 - depth) ** 2,
        gain=torch.tensor([1.0, 0.7])[:cameras],
        noise=torch.tensor([[SIGMA**2, 0.0, 0.0, 0.0]]).repeat(cameras, 1),
        **even_light(cameras),
    )


@cache
def pictures(count: int = 12, cameras: int = 2, seed: int = 4) -> tuple[Rig, Pixels, Tensor, Tensor, SphereModel]:
    """Disks under the planted light, with noise, their poses, and the model without light."""
    rig = rig_of(48.0, ("pinhole", "tsai")[:cameras])
    X, R = balls(count, seed)
    pixels = cut(rig, torch.zeros(count, cameras, 120, 120), X)
    model = replace(model_of(rig.table("patches"), SIGMA, FIRST), light=flat_light(cameras, SIGMA))
    view = sphere_view(pixels, X.repeat_interleave(cameras, 0), R.repeat_interleave(cameras, 0), model)
    difference, black = planted(cameras).at(view, pixels)
    grey = view.coverage * (view.paint * difference + black) + (1 - view.coverage) * pixels.behind
    grey = grey + SIGMA * torch.randn(grey.shape, generator=torch.Generator().manual_seed(seed))
    return rig, replace(pixels, grey=grey), X, R, model


@cache
def learnt(count: int = 12, cameras: int = 2) -> tuple[LabLight, FittedPoses]:
    rig, pixels, X, R, model = pictures(count, cameras)
    use = torch.ones(count, cameras, dtype=torch.bool)
    fit = fitted(rig, "patches", pixels, X, R, SIGMA, shading=FIRST)
    model = replace(model, light=model.light.learnt(pixels, fit, use, model), shading=LATER)
    return lab_light(pixels, fit, use, model), fit


@pytest.mark.parametrize("cameras", [1, 2])
def test_a_planted_light_is_found_again(cameras):
    light, _ = learnt(12, cameras)
    # Other poses than those that it is learnt from.
    _, pixels, X, R, model = pictures(6, cameras, 9)
    view = sphere_view(pixels, X.repeat_interleave(cameras, 0), R.repeat_interleave(cameras, 0), model)
    within = view.aside < 0.95
    # A slope over all frames of few cameras is nearly one of their own light: its prior share stays unknown.
    for got, expected in zip(light.at(view, pixels), planted(cameras).at(view, pixels), strict=True):
        error = (got - expected)[within]
        assert error.square().mean().sqrt() < 2.5
    at = residuals(pixels, X, R, None, replace(model, light=light, shading=LATER))
    assert float(at.residual[at.inside].square().mean()) == pytest.approx(SIGMA**2, rel=0.05)
    at = torch.tensor([1.0, 80.0, 80.0**2, 80.0**3])
    for noise in light.noise:
        assert float(noise @ at) == pytest.approx(SIGMA**2, rel=0.25)


def test_gloss_is_found_where_it_is_planted():
    light, _ = learnt()
    at = octahedral_directions(32)
    values = harmonics(at, MIRRORED).float() @ light.gloss
    brightest = at[values.argmax()].float()
    assert float(brightest @ (WINDOW / WINDOW.norm())) > 0.97  # 14 degrees


def test_flicker_of_each_frame_bends_no_light():
    rig, pixels, X, R, model = pictures()
    view = sphere_view(pixels, X.repeat_interleave(2, 0), R.repeat_interleave(2, 0), model)
    beside = (1 - view.coverage) * pixels.behind
    own = torch.tensor([0.1, 0.06, 0.06]) * torch.randn(24, 3, generator=torch.Generator().manual_seed(1))
    even, across, down = own.unbind(1)
    flicker = even[:, None] + across[:, None] * view.across[:, 0] + down[:, None] * view.across[:, 1]
    pixels = replace(pixels, grey=(pixels.grey - beside) * (1 + flicker) + beside)
    use = torch.ones(12, 2, dtype=torch.bool)
    fit = fitted(rig, "patches", pixels, X, R, SIGMA, shading=FIRST)
    light = lab_light(
        pixels, fit, use, replace(model, light=model.light.learnt(pixels, fit, use, model), shading=LATER)
    )
    _, pixels, X, R, model = pictures(6, 2, 9)
    view = sphere_view(pixels, X.repeat_interleave(2, 0), R.repeat_interleave(2, 0), model)
    within = view.aside < 0.95
    for got, expected in zip(light.at(view, pixels), planted(2).at(view, pixels), strict=True):
        assert (got - expected)[within].square().mean().sqrt() < 0.04 * expected[within].mean()


def test_it_explains_other_frames_better_than_maps_of_each_disk():
    light, fit = learnt()
    _, pixels, X, R, model = pictures(6, 2, 9)
    _, shown, *_, without = pictures()
    maps = without.light.learnt(shown, fit, torch.ones(12, 2, dtype=torch.bool), without)
    left = []
    for lit in (light, maps):
        at = residuals(pixels, X, R, None, replace(model, light=lit, shading=LATER))
        left.append(float((at.residual * at.inside).square().mean()))
    assert left[0] < left[1]


def with_glare(pixels: Pixels, X: Tensor, R: Tensor, model: SphereModel) -> tuple[Pixels, Tensor]:
    """The same disks with light beside the sphere, below it to the right in the first camera; a bubble covers some."""
    stray = even_light(2)["stray"]
    stray[0, :4] = torch.tensor([6.0, 3.0, 4.0, 1.0])
    view = sphere_view(pixels, X.repeat_interleave(2, 0), R.repeat_interleave(2, 0), model)
    more = (1 - view.coverage) * (scene_beside(view, pixels, stray) - pixels.behind)
    grey = pixels.grey + more
    bubble = (view.across - torch.tensor([0.0, -1.0])[:, None]).norm(dim=1) < 0.3
    grey[4:6] = torch.where(bubble[4:6], 200.0, grey[4:6])
    return replace(pixels, grey=grey), stray


def test_light_beside_the_sphere_is_found_and_moves_no_pose():
    rig, pixels, X, R, model = pictures()
    pixels, planted_stray = with_glare(pixels, X, R, model)
    use = torch.ones(12, 2, dtype=torch.bool)
    fit = fitted(rig, "patches", pixels, X, R, SIGMA, shading=FIRST)
    maps = model.light.learnt(pixels, fit, use, model)
    lab = lab_light(pixels, fit, use, replace(model, light=maps, shading=LATER))
    round_it = torch.linspace(0, 6.28, 50)
    basis = stray_basis(torch.stack([round_it.cos(), round_it.sin()]))
    for light in (maps, lab):
        assert ((light.stray - planted_stray) @ basis).abs().max() < 1.0
    off, stated = [], []
    for light in (lab, replace(lab, stray=even_light(2)["stray"])):
        model = replace(model, light=light, shading=LATER)
        fit = refined(pixels, PoseStart(X, R, use), model)
        off.append(float((fit.position_lab_mm - X).mean(0).norm()))
        stated.append(float(fit.covariance[:, 3:, 3:].diagonal(dim1=1, dim2=2).mean().sqrt()))
    assert off[0] < 0.5 * off[1]
    assert stated[0] > 1.1 * stated[1]  # light that does not end at the limb is undetermined there


def test_no_light_beside_the_sphere_is_invented():
    light, _ = learnt()
    assert light.stray.abs().max() < 0.5


def test_files_without_stray_light_are_read():
    parts = {name: part for name, part in planted(2).parts().items() if name != "stray"}
    assert light_of(parts, True).stray.equal(even_light(2)["stray"])


def test_rows_not_in_use_change_nothing():
    _, pixels, _, _, model = pictures()
    use = torch.ones(12, 2, dtype=torch.bool)
    use[3:, 1] = False
    _, fit = learnt()
    model = replace(model, light=model.light.learnt(pixels, fit, use, model), shading=LATER)
    spoilt = pixels.grey.clone()
    spoilt[7::2] = torch.nan
    one, other = (lab_light(part, fit, use, model) for part in (pixels, replace(pixels, grey=spoilt)))
    for name in LabLight.names():
        assert getattr(one, name).equal(getattr(other, name))
        assert getattr(one, name).isfinite().all()


def test_poses_without_a_camera_may_have_no_place():
    _, pixels, _, _, model = pictures()
    use = torch.ones(12, 2, dtype=torch.bool)
    use[5] = False
    _, fit = learnt()
    X = fit.position_lab_mm.clone()
    X[5] = torch.nan
    model = replace(model, light=model.light.learnt(pixels, fit, use, model), shading=LATER)
    light = lab_light(pixels, replace(fit, position_lab_mm=X), use, model)
    for name in LabLight.names():
        assert getattr(light, name).isfinite().all()
    one = use.clone()
    one[:, 0] = False  # a camera that never sees the ball has no light of its own
    alone = lab_light(pixels, fit, one, model)
    assert float(alone.gain[0]) == 1
    assert alone.gloss.isfinite().all()


def test_a_disk_alone_is_lit_as_in_a_batch():
    light, _ = learnt()
    _, pixels, X, R, model = pictures(6, 2, 9)
    whole = light.at(sphere_view(pixels, X.repeat_interleave(2, 0), R.repeat_interleave(2, 0), model), pixels)
    for k in range(3):
        some = pixels.where(torch.arange(2 * k, 2 * k + 2))
        view = sphere_view(some, X[k : k + 1].repeat_interleave(2, 0), R[k : k + 1].repeat_interleave(2, 0), model)
        for part, alone in zip(whole, light.at(view, some), strict=True):
            assert part[2 * k : 2 * k + 2].equal(alone)


def test_one_camera_of_two_sees_its_own_gain_and_noise():
    light, _ = learnt()
    _, pixels, X, R, model = pictures(6, 2, 9)
    second = pixels.where(torch.arange(1, 12, 2))
    both = light.at(sphere_view(pixels, X.repeat_interleave(2, 0), R.repeat_interleave(2, 0), model), pixels)
    one = light.of(1).at(sphere_view(second, X, R, model), second)
    for part, alone in zip(both, one, strict=True):
        assert part[1::2].equal(alone)
    assert light.of(1).noise.equal(light.noise[1:])


def test_normals_look_at_the_camera_and_mirrored_rays_leave_the_sphere():
    _, pixels, X, R, model = pictures(6, 2, 9)
    view = sphere_view(pixels, X.repeat_interleave(2, 0), R.repeat_interleave(2, 0), model)
    normal, mirror, depth = directions(view, pixels)
    assert_close(normal.norm(dim=1), torch.ones_like(depth), atol=1e-4)
    assert_close(mirror.norm(dim=1), torch.ones_like(depth), atol=1e-4)
    assert_close(-(normal * pixels.direction).sum(1), depth, atol=1e-4)
    assert_close((mirror * normal).sum(1), depth, atol=1e-4)
    assert_close(
        mirror - (mirror * normal).sum(1, keepdim=True) * normal, pixels.direction + depth[:, None] * normal, 1e-3
    )


def of_maps(rig: Rig, pixels: Pixels, X: Tensor, R: Tensor) -> tuple[Fitter, FittedPoses, Tensor]:
    """A fitter with maps of the disks of 12 poses, the poses' fit without light, and which pictures are used: all."""
    use = torch.ones(12, 2, dtype=torch.bool)
    first = fitter_of(rig)
    fit = first.fit(pixels, PoseStart(X, R, use), first.optics.fine, 4)
    return first.with_light_of(pixels, fit, use), fit, use


def test_a_light_that_both_cameras_see_is_learnt_in_the_lab():
    rig, pixels, X, R, _ = pictures()
    maps, fit, use = of_maps(rig, pixels, X, R)
    lit, again, _ = lit_in_the_lab(maps, pixels, fit, use)
    assert isinstance(lit.light, LabLight)
    first = fitter_of(rig)
    smooth = first.with_light_of(pixels, fit, use, glints=False)
    assert again.score.mean() > smooth.fit(pixels, PoseStart(X, R, use), first.optics.fine, 3).score.mean()


def test_lamps_that_only_one_camera_sees_stay_maps_of_the_disk():
    rig, pixels, X, R, model = pictures()
    view = sphere_view(pixels, X.repeat_interleave(2, 0), R.repeat_interleave(2, 0), model)
    side = torch.where(torch.arange(24) % 2 == 0, 0.9, -0.9)[:, None] * (view.across[:, 0] + view.across[:, 1])
    lit = view.coverage * (view.paint * (100 + 50 * side) + 20 + 10 * side)
    noise = SIGMA * torch.randn(lit.shape, generator=torch.Generator().manual_seed(2))
    pixels = replace(pixels, grey=lit + (1 - view.coverage) * pixels.behind + noise)
    maps, fit, use = of_maps(rig, pixels, X, R)
    assert lit_in_the_lab(maps, pixels, fit, use)[:2] == (maps, fit)


def test_two_lights_that_explain_as_much_are_both_reported(monkeypatch):
    rig, pixels, X, R, _ = pictures()
    maps, fit, use = of_maps(rig, pixels, X, R)
    monkeypatch.setattr(kinds, "ALIKE", math.inf)
    lit, _, rivals = lit_in_the_lab(maps, pixels, fit, use)
    assert isinstance(lit.light, LabLight)
    one, other, held = rivals
    assert held.shape == (6, 2)
    assert not one.R_lab_body.equal(other.R_lab_body)
    off = [so3.geodesic_distance(part.R_lab_body, R[1::2]).max() for part in (one, other)]
    assert max(off) < 0.01


def test_few_poses_stay_with_maps():
    rig, pixels, _, _, _ = pictures()
    some = pixels.where(torch.arange(12))
    _, fit = learnt()
    maps = fitter_of(rig)
    assert lit_in_the_lab(maps, some, fit.of(torch.arange(6)), torch.ones(6, 2, dtype=torch.bool))[0] is maps
