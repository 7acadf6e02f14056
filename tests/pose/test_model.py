"""The sphere as its pixels see it, against renders by brute force; how that changes, against finite differences."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from conftest import assert_close
from refine_examples import (
    BLUR_PX,
    DISTANCE_MM,
    LOOKS,
    RADIUS_MM,
    Rig,
    balls,
    f64,
    model_of,
    paint_of,
    rig_of,
    scene_of,
    table_of,
)
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Camera
from sphereorient.cameras.model import TelecentricCamera
from sphereorient.pose.model import SphereView
from sphereorient.pose.pixels import LinesOfSight, Pixels, cut_pixels, disk_stencil, stacked
from sphereorient.pose.view import sphere_view
from sphereorient.sphere import sample_texture
from sphereorient.sphere.texture_table import TextureTable, texture_table

MODELS = ["pinhole", "tsai", "telecentric"]
PITCH_MM = 2 * RADIUS_MM / 40
SAMPLES, REACH = 41, 4.0  # of a pixel's aperture, per axis, and how many deviations away they go


@cache
def rig(model: str, diameter_px: float) -> Rig:
    if model != "telecentric":
        return rig_of(diameter_px, (model,))
    side = round(2.5 * diameter_px)
    camera = TelecentricCamera(
        image_size=(side, side),
        R_cam_lab=f64(LOOKS[0]),
        T_cam_lab_mm=f64([0, 0, DISTANCE_MM]),
        centre_px=f64([0.5 * (side - 1)] * 2),
        scale_mm_px=f64(2 * RADIUS_MM / diameter_px),
    )
    return Rig((camera,), (LinesOfSight(camera),), diameter_px)


@cache
def ball(reach_mm: float = 4.0) -> tuple[Tensor, Tensor]:
    """One place off the axis, one attitude."""
    X, R = balls(1, 5, reach_mm)
    return X + f64([[3.0, 0.0, -4.0]]), R


def empty(rig: Rig, X: Tensor, shift: tuple[int, int] = (0, 0)) -> Pixels:
    """The pixels about places, of empty pictures."""
    (camera,), (sight,) = rig.cameras, rig.sights
    stencil = disk_stencil(1.06 * rig.diameter_px / 2 + 2.5 * BLUR_PX)
    nothing = np.zeros((sight.size[1], sight.size[0]), np.float32)
    middles = [(u + shift[0], v + shift[1]) for u, v in camera.project(X).tolist()]
    return stacked([cut_pixels(nothing, scene_of(nothing), sight, middle, stencil) for middle in middles])


def places(rig: Rig, X: Tensor) -> Tensor:
    """Pixels (P, 2) of the disk about one place."""
    stencil = disk_stencil(1.06 * rig.diameter_px / 2 + 2.5 * BLUR_PX)
    middle = rig.cameras[0].project(X[0]).round()
    return middle + torch.from_numpy(np.stack([stencil.right, stencil.down], axis=-1))


def seen_by_force(camera: Camera, paint: Tensor, uv: Tensor, X: Tensor, R: Tensor) -> tuple[Tensor, Tensor]:
    """Share of each pixel's Gaussian aperture that the ball fills, and that its white paint fills, (P,) each."""
    at = torch.linspace(-REACH, REACH, SAMPLES, dtype=torch.float64)
    a, b = torch.meshgrid(at, at, indexing="ij")
    share = torch.exp(-0.5 * (a * a + b * b)).reshape(-1)
    offset = BLUR_PX * torch.stack([a, b], dim=-1).reshape(-1, 2)
    filled, white = [], []
    for part in torch.split(uv, 64):
        rays = camera.rays(part[:, None] + offset)
        to_centre = X - rays.origin_lab_mm
        along = (to_centre * rays.direction_lab).sum(-1)
        aside = torch.linalg.cross(rays.direction_lab.expand_as(to_centre), to_centre).norm(dim=-1)
        # The limb as wide as the step between samples.
        at_ball = (rays.origin_lab_mm + along[..., None] * rays.direction_lab)[:, :2]
        step = (at_ball[:, 1] - at_ball[:, 0]).norm(dim=-1, keepdim=True)
        hit = ((RADIUS_MM - aside) / step + 0.5).clamp(0, 1)
        depth = along - (RADIUS_MM**2 - aside**2).clamp_min(0).sqrt()
        normal = rays.origin_lab_mm + depth[..., None] * rays.direction_lab - X
        filled.append(hit @ share)
        white.append((hit * sample_texture(paint, normal @ R)) @ share)
    return torch.cat(filled) / share.sum(), torch.cat(white) / share.sum()


def regions(view: SphereView) -> dict[str, Tensor]:
    """Places far from the limb, near it, and on it."""
    coverage, inner = view.coverage[0], view.across[0].norm(dim=0) < 0.75
    on = (coverage > 0.01) & (coverage < 0.99)
    return {"inner": inner & ~on, "near": ~inner & ~on & (coverage > 0.5), "on": on}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("kind", ["patches", "blobs"])
def test_pixels_see_what_a_render_by_force_shows(model, kind):
    one, (X, R) = rig(model, 40.0), ball()
    pixels, uv = empty(one, X), places(one, X)
    view = sphere_view(pixels, X, R, model_of(one.table(kind)))
    filled, white = seen_by_force(one.cameras[0], paint_of(kind).double(), uv, X[0], R[0])
    error = view.coverage[0].double() - filled
    assert error.square().mean().sqrt() < 0.003
    assert error.abs().max() < 0.01  # the limb of 40 px is not straight across a pixel
    error = (view.coverage * view.paint)[0].double() - white
    for name, (rms, most) in {"inner": (0.008, 0.05), "near": (0.016, 0.08), "on": (0.02, 0.08)}.items():
        where = regions(view)[name]
        assert where.sum() > 100
        assert error[where].square().mean().sqrt() < rms
        assert error[where].abs().max() < most
    # A tenth of a pixel aside is another picture.
    beside = sphere_view(pixels, X + 0.1 * one.px_mm * f64([1, 0, 0]), R, model_of(one.table(kind)))
    assert (beside.coverage[0].double() - filled).square().mean().sqrt() > 0.008


@pytest.mark.parametrize("kind", ["patches", "blobs"])
def test_the_paint_is_as_large_as_the_ball(kind):
    """Paint blurred over the surface lies nearer to the middle than paint blurred in the picture: by blur^2."""
    one, pulls, sizes = rig("pinhole", 40.0), 0.0, 0.0
    for seed in range(6):
        X, R = balls(1, seed, 4.0)
        pixels, uv = empty(one, X), places(one, X)
        view = sphere_view(pixels, X, R, model_of(one.table(kind)))
        _, white = seen_by_force(one.cameras[0], paint_of(kind).double(), uv, X[0], R[0])
        larger = RADIUS_MM * ((pixels.axes.mT @ view.across) * view.paint_by_position).sum(1)[0]
        inside = view.coverage[0] > 0.99
        pulls += float(((view.paint[0] - white) * larger)[inside].sum())
        sizes += float(larger[inside].square().sum())
    assert abs(pulls / sizes) < 0.3 * (BLUR_PX / 20) ** 2


def test_a_ball_that_looks_to_the_camera_shows_the_maps_middle_in_the_middle_with_east_to_the_right():
    # The camera looks along lab +y: docs/conventions.md, the check of all signs.
    one, X = rig("pinhole", 40.0), torch.zeros(1, 3, dtype=torch.float64)
    R = so3.exp(f64([[0.0, 0.0, -math.pi / 2]]))
    column = torch.arange(512.0).expand(256, 512) / 511
    row = torch.arange(256.0)[:, None].expand(256, 512) / 255
    pixels = empty(one, X)
    for texture, axis, sign in ((column, 0, 1), (row, 1, 1)):
        view = sphere_view(pixels, X, R, model_of(texture_table(texture, 0.05, 128)))
        within = view.across[0].norm(dim=0) < 0.5
        assert view.paint[0][within].mean().item() == pytest.approx(0.5, abs=0.01)
        ahead = sign * view.across[0, axis] > 0.3
        assert (view.paint[0][within & ahead] > 0.53).all()


def test_places_on_the_disk_are_those_of_the_picture_in_radii():
    one, X = rig("telecentric", 40.0), torch.zeros(1, 3, dtype=torch.float64)
    view = sphere_view(empty(one, X), X, torch.eye(3, dtype=torch.float64)[None], model_of(table()))
    expected = (places(one, X) - one.cameras[0].project(X[0])) / 20.0
    within = regions(view)["inner"]
    assert_close(view.across[0].T[within].double(), expected[within], atol=1e-4)
    assert view.across.norm(dim=1).max() <= 1.0 + 1e-6


def test_a_nearer_ball_is_larger_as_the_cone_about_it_gives():
    one = rig("pinhole", 40.0)
    camera = one.cameras[0]
    for y in (-60.0, 0.0, 80.0):
        X = f64([[0.0, y, 0.0]])
        view = sphere_view(empty(one, X), X, torch.eye(3, dtype=torch.float64)[None], model_of(table()))
        distance = DISTANCE_MM + y
        # The limb is seen at the angle asin(r / distance), not atan.
        radius_px = float(camera.f_px) * RADIUS_MM / math.sqrt(distance**2 - RADIUS_MM**2)
        inside = view.coverage[0].sum().item()
        if radius_px + 2 < 1.06 * 20 + 2.5 * BLUR_PX:
            assert inside == pytest.approx(math.pi * radius_px**2, rel=2e-3)
        on_limb = (view.coverage[0] - 0.5).abs() < 0.1
        if on_limb.any():
            off_axis = (places(one, X) - camera.project(X[0])).norm(dim=-1)[on_limb]
            assert off_axis.mean().item() == pytest.approx(radius_px, abs=0.1)


@cache
def table(blur_rad: float = 2 * BLUR_PX / 40) -> TextureTable:
    return table_of("patches", blur_rad)


@cache
def smooth_table() -> TextureTable:
    row, column = torch.meshgrid(torch.arange(128.0), torch.arange(256.0), indexing="ij")
    longitude, latitude = math.pi * ((column + 0.5) / 128 - 1), math.pi * (0.5 - (row + 0.5) / 128)
    x, y, z = latitude.cos() * longitude.cos(), latitude.cos() * longitude.sin(), latitude.sin()
    return texture_table(0.5 + 0.2 * x * y + 0.15 * z - 0.1 * x * x * z, 2 * BLUR_PX / 40)


def looked(pixels: Pixels, X: Tensor, R: Tensor) -> SphereView:
    return sphere_view(pixels, X, R, model_of(smooth_table()))


def difference(one: SphereView, other: SphereView, name: str) -> Tensor:
    return (getattr(one, name)[0] - getattr(other, name)[0]).double()


@pytest.mark.parametrize("model", MODELS)
def test_paint_changes_with_rotation_as_its_derivative_gives(model):
    one, (X, R) = rig(model, 40.0), ball()
    pixels, h = empty(one, X), 0.02
    view = looked(pixels, X, R)
    covered = view.coverage[0] > 0.01
    for i, axis in enumerate(torch.eye(3, dtype=torch.float64)):
        turned = [looked(pixels, X, so3.exp(s * h * axis)[None] @ R) for s in (1, -1)]
        change = difference(*turned, "paint") / (2 * h)
        error = (view.paint_by_rotation[0, i].double() - change)[covered]
        assert change.abs().max() > 0.1
        assert error.square().mean().sqrt() < 0.01 * change[covered].square().mean().sqrt()
        assert error.abs().max() < 0.01
        for s in turned:
            assert s.coverage.equal(view.coverage)


@pytest.mark.parametrize("model", MODELS)
def test_coverage_changes_with_the_position_as_its_derivative_gives(model):
    one, (X, R) = rig(model, 40.0), ball()
    pixels, h = empty(one, X), 0.1 * PITCH_MM
    view = looked(pixels, X, R)
    for i, axis in enumerate(torch.eye(3, dtype=torch.float64)):
        moved = [looked(pixels, X + s * h * axis, R) for s in (1, -1)]
        change = difference(*moved, "coverage") / (2 * h)
        # Along the line of sight the picture grows, by a thirtieth: there the blur in radii changes too.
        limit = 0.015 / PITCH_MM if i != 1 else 0.001 / PITCH_MM
        assert (view.coverage_by_position[0, i].double() - change).abs().max() < limit
        assert i == 1 or change.abs().max() > 0.4 / PITCH_MM


@pytest.mark.parametrize("model", MODELS)
def test_paint_changes_with_the_position_as_its_derivative_gives(model):
    one, (X, R) = rig(model, 40.0), ball()
    pixels, h = empty(one, X), 0.2 * PITCH_MM
    view = looked(pixels, X, R)
    where = regions(view)
    for i, axis in enumerate(torch.eye(3, dtype=torch.float64)):
        change = difference(*(looked(pixels, X + s * h * axis, R) for s in (1, -1)), "paint") / (2 * h)
        error = view.paint_by_position[0, i].double() - change
        across = 1 / RADIUS_MM  # the size of a change: one radius aside is another paint
        # Near the limb the spread of the look-ups, which is held fixed, changes as well, and the slope is steep.
        for name, share in {"inner": 0.006, "near": 0.05, "on": 0.15}.items():
            assert error[where[name]].square().mean().sqrt() < share * across
        if i != 1:
            assert change[where["inner"]].abs().max() > 0.15 * across


@pytest.mark.parametrize("model", MODELS)
def test_sharp_paint_changes_as_its_derivatives_give_on_the_whole(model):
    # For Gauss-Newton: the projection of a finite change on the derivatives is the change's size.
    one, (X, R) = rig(model, 40.0), ball()
    pixels = empty(one, X)
    assert exposed(sphere_view(pixels, X, R, model_of(table()))).max() > 0.9
    changes_by_its_derivatives(pixels, X, R, table())


def changes_by_its_derivatives(pixels: Pixels, X: Tensor, R: Tensor, paint: TextureTable) -> None:
    view = sphere_view(pixels, X, R, model_of(paint))
    by_place = view.coverage * view.paint_by_position[0] + view.paint * view.coverage_by_position[0]
    by_pose = torch.cat([view.coverage * view.paint_by_rotation[0], by_place])
    for i, size in enumerate([0.3 * PITCH_MM / RADIUS_MM] * 3 + [0.3 * PITCH_MM] * 3):
        if i == 4:  # along the line of sight
            continue
        step = torch.zeros(6, dtype=torch.float64)
        step[i] = 0.5 * size
        both = [
            exposed(sphere_view(pixels, X + s * step[3:], so3.exp(s * step[:3])[None] @ R, model_of(paint)))
            for s in (1, -1)
        ]
        assert float(((both[0] - both[1]) @ by_pose[i]) / (by_pose[i] @ by_pose[i])) == pytest.approx(size, rel=0.06)


MOVED = f64([[0.04, -0.06, 0.08, 2.0 * PITCH_MM, 0.0, -1.5 * PITCH_MM]])  # rotation, rad, and move, mm


def exposed(view: SphereView) -> Tensor:
    return (view.coverage * view.paint)[0]


@pytest.mark.parametrize("model", MODELS)
def test_a_moving_sphere_is_the_mean_over_the_exposure(model):
    one, (X, R) = rig(model, 40.0), ball()
    pixels = empty(one, X)
    shares = (torch.arange(40) + 0.5) / 40 - 0.5
    instants = [looked(pixels, X + s * MOVED[:, 3:], so3.exp(s * MOVED[:, :3]) @ R) for s in shares]
    mean = torch.stack([exposed(view) for view in instants]).mean(0)
    moving = looked(replace(pixels, moved=MOVED, instants=4), X, R)
    still = (exposed(looked(pixels, X, R)) - mean).square().mean().sqrt()
    assert (exposed(moving) - mean).square().mean().sqrt() < 0.03 * still
    cover = torch.stack([view.coverage[0] for view in instants]).mean(0)
    assert (moving.coverage[0] - cover).abs().max() < 0.02
    at_rest = looked(replace(pixels, instants=3), X, R)
    assert torch.allclose(exposed(at_rest), exposed(looked(pixels, X, R)), atol=1e-6)


def test_paint_that_turns_in_the_exposure_is_smeared():
    one, (X, R) = rig("pinhole", 40.0), ball()
    pixels, turned = empty(one, X), f64([[0.3, -0.2, 0.4, 0.0, 0.0, 0.0]])
    shares = (torch.arange(40) + 0.5) / 40 - 0.5
    mean = torch.stack([exposed(looked(pixels, X, so3.exp(s * turned[:, :3]) @ R)) for s in shares]).mean(0)
    still, turning = (
        (exposed(looked(some, X, R)) - mean).square().mean().sqrt()
        for some in (pixels, replace(pixels, moved=turned, instants=8))
    )
    assert turning < 0.05 * still


def test_a_moving_sphere_changes_as_its_derivatives_give():
    one, (X, R) = rig("pinhole", 40.0), ball()
    changes_by_its_derivatives(replace(empty(one, X), moved=MOVED, instants=3), X, R, smooth_table())


def test_the_pixel_in_the_very_middle_is_as_any_other():
    one, X = rig("telecentric", 40.0), f64([[0.5 * PITCH_MM, 0.0, 0.5 * PITCH_MM]])
    R = ball()[1]
    pixels = empty(one, X)
    middle = (places(one, X) - one.cameras[0].project(X[0])).norm(dim=-1).argmin()
    view = looked(pixels, X, R)
    for name in ("paint", "coverage", "across", "paint_by_rotation", "paint_by_position", "coverage_by_position"):
        assert getattr(view, name).isfinite().all()
    assert (places(one, X)[middle] - one.cameras[0].project(X[0])).norm() < 1e-9
    h = 0.3 * PITCH_MM
    for i, axis in enumerate(torch.eye(3, dtype=torch.float64)):
        change = difference(*(looked(pixels, X + s * h * axis, R) for s in (1, -1)), "paint")[middle] / (2 * h)
        assert view.paint_by_position[0, i, middle].item() == pytest.approx(float(change), abs=0.01 / RADIUS_MM)


def test_pixels_that_do_not_see_the_ball_show_none_of_it():
    one, (X, R) = rig("pinhole", 40.0), ball()
    view = looked(empty(one, X, (60, 0)), X, R)
    assert view.coverage.max() < 1e-6
    for name in ("paint", "paint_by_rotation", "paint_by_position", "coverage_by_position"):
        assert getattr(view, name).isfinite().all()
    assert view.coverage_by_position.abs().max() < 1e-3


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_disk_is_seen_as_if_it_were_alone(count):
    one, (X, R) = rig("tsai", 40.0), balls(3, 7)
    pixels = empty(one, X)
    chosen = torch.arange(count)
    some = sphere_view(pixels.where(chosen), X[:count], R[:count], model_of(table()))
    assert some.paint.shape == (count, pixels.grey.shape[1])
    for k in range(count):
        alone = sphere_view(pixels.where(chosen[k : k + 1]), X[k : k + 1], R[k : k + 1], model_of(table()))
        for name in ("paint", "coverage", "across", "paint_by_rotation", "paint_by_position", "coverage_by_position"):
            assert getattr(alone, name)[0].equal(getattr(some, name)[k])


def test_all_places_in_the_manner_of_the_rim_are_nearly_the_same():
    # The two ways to place the look-ups meet: where one ends and the other begins there is no step.
    one, (X, R) = rig("pinhole", 64.0), ball()
    pixels = empty(one, X)
    paint = one.table("blobs")
    mixed = sphere_view(pixels, X, R, model_of(paint))
    rim = sphere_view(replace(pixels, inner=0), X, R, model_of(paint))
    assert (mixed.paint - rim.paint).square().mean().sqrt() < 0.01
    assert (mixed.paint_by_rotation - rim.paint_by_rotation).square().mean().sqrt() < 0.25
    assert mixed.coverage.equal(rim.coverage)
