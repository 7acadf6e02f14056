"""Behind a flat wall: Snell's law at both faces, pixels to rays and points to pixels inverse to each other."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from camera_examples import MODELS, SIZE, behind_port, f64, pinhole, port, telecentric, tsai, turned, whole_picture
from conftest import assert_close, slow
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from sphereorient.cameras import Camera, PinholeCamera, Port, PortCamera, Rays
from sphereorient.cameras.parameters import ROTATION, TRANSLATION, with_parameters
from sphereorient.errors import CameraError

PORT_NAMES = ("port_offset", "port_thickness", "port_n_glass", "port_n_fluid", "port_tilt_x", "port_tilt_y")


def in_liquid(rng: torch.Generator, *shape: int) -> torch.Tensor:
    return (torch.rand(*shape, 3, generator=rng, dtype=torch.float64) - 0.5) * 150


def overhead(**changes: object) -> PortCamera:
    """A camera 110 mm above the liquid that looks straight down, through 10 mm of glass: numbers for work by hand."""
    camera = PinholeCamera(
        image_size=(401, 401),
        R_cam_lab=f64([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]),
        T_cam_lab_mm=f64((0.0, 0.0, 110.0)),
        centre_px=f64((200.0, 200.0)),
        f_px=100.0,
    )
    numbers: dict[str, object] = {"offset_mm": 0.0, "thickness_mm": 10.0, "n_glass": 1.5, "n_fluid": 1.33}
    return PortCamera(camera=camera, port=Port(normal=f64((0.0, 0.0, 1.0)), **(numbers | changes)))


def slow_ray(camera: Camera, wall: Port, uv_px: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """One pixel's ray by plane trigonometry: angles, arcsines and tangents, one face after the other."""
    air = camera.rays(uv_px)
    point, direction = air.origin_lab_mm.numpy(), air.direction_lab.numpy()
    normal = wall.normal_lab.numpy()
    along = direction - (direction @ normal) * normal
    along = along / max(np.linalg.norm(along), 1e-300)
    angle = math.acos(-direction @ normal)
    point = point + along * (point @ normal - wall.air_side_mm.item()) * math.tan(angle)
    glass = math.asin(math.sin(angle) / wall.n_glass.item())
    point = point + along * wall.thickness_mm.item() * math.tan(glass)
    point = point + (wall.offset_mm.item() - point @ normal) * normal
    fluid = math.asin(math.sin(glass) * wall.n_glass.item() / wall.n_fluid.item())
    return point, math.sin(fluid) * along - math.cos(fluid) * normal


def test_a_ray_at_45_degrees_bends_at_both_faces_as_worked_by_hand():
    rays = overhead().rays(f64((300.0, 200.0)))  # slope 1: 45 degrees, towards lab +x
    # sin 45 = 0.70711; glass: sin 0.47140, tan 0.53452; liquid: sin 0.53166, cos 0.84696
    assert_close(rays.origin_lab_mm, f64((100 + 10 * 0.5345224838, 0.0, 0.0)), atol=1e-8)
    assert_close(rays.direction_lab, f64((0.5316592, 0.0, -0.8469584)), atol=1e-7)
    # With the indices exchanged, the glass would bend the ray as the liquid does.
    swapped = overhead(n_glass=1.33, n_fluid=1.5).rays(f64((300.0, 200.0)))
    assert abs(swapped.direction_lab[0].item() - 0.4714045) < 1e-7


def test_a_point_under_water_appears_higher_than_it_is():
    # Paraxial: 100 mm of air, 10 mm of glass worth 10 / 1.5, 133 mm of water worth 100: 1 mm aside shows 100 / 206.67.
    seen = overhead().project(f64((1e-3, 0.0, -133.0)))
    assert_close((seen - 200) / 1e-3, f64((100 / (100 + 10 / 1.5 + 100), 0.0)), atol=1e-6)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_rays_agree_with_plane_trigonometry(model):
    camera = behind_port(model())
    uv_px = whole_picture(steps=4)
    rays = camera.rays(uv_px)
    for k, uv in enumerate(uv_px):
        origin, direction = slow_ray(camera.camera, camera.port, uv)
        assert_close(rays.origin_lab_mm[k], torch.from_numpy(origin), atol=1e-9)
        assert_close(rays.direction_lab[k], torch.from_numpy(direction), atol=1e-12)


def test_pixels_agree_with_a_bisection_on_the_wall():
    camera = overhead()
    for across, depth in [(0.0, 50.0), (40.0, 1.0), (90.0, 200.0), (300.0, 80.0)]:

        def missed(slope: float, across: float = across, depth: float = depth) -> float:
            sine = math.sin(math.atan(slope))
            inside = sum(d * math.tan(math.asin(sine / n)) for d, n in ((10.0, 1.5), (depth, 1.33)))
            return 100 * slope + inside - across

        slope = brentq(missed, -1e-9, 100, xtol=1e-14)
        seen = camera.project(f64((0.6 * across, -0.8 * across, -depth)))
        assert_close(seen, f64((200 + 60 * slope, 200 + 80 * slope)), atol=1e-8)


@pytest.mark.slow
@settings(max_examples=80, deadline=None)
@given(
    model=st.sampled_from(sorted(MODELS)),
    tilt=st.tuples(st.floats(-0.35, 0.35), st.floats(-0.35, 0.35)),
    offset_mm=st.floats(-200, 350),
    thickness_mm=st.floats(0, 60),
    n_glass=st.floats(1, 2.4),
    n_fluid=st.floats(1, 2),
    distance_mm=st.floats(0, 3000),
)
def test_project_undoes_rays_over_the_whole_picture(
    model, tilt, offset_mm, thickness_mm, n_glass, n_fluid, distance_mm
):
    turn = torch.from_numpy(Rotation.from_rotvec((*tilt, 0.0)).as_matrix())
    wall = Port(
        normal=-(turn @ turned()[2]),
        offset_mm=offset_mm,
        thickness_mm=thickness_mm,
        n_glass=n_glass,
        n_fluid=n_fluid,
    )
    camera = PortCamera(camera=MODELS[model](), port=wall)
    uv_px = whole_picture()
    rays = camera.rays(uv_px)
    # A hair into the liquid: on the wall itself rounding decides on which side a point lies.
    x_lab_mm = rays.origin_lab_mm + (distance_mm + 1e-6) * rays.direction_lab
    assert_close(rays.direction_lab.norm(dim=-1), torch.ones(len(uv_px), dtype=torch.float64))
    assert_close(camera.project(x_lab_mm), uv_px, atol=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 45.0, 80.0, 89.0])
@pytest.mark.parametrize("height_mm", [1.0, 1000.0])
@pytest.mark.parametrize("depth_mm", [0.0, 1.0, 1000.0])
def test_grazing_rays_are_found_too(degrees, height_mm, depth_mm):
    wall = Port(normal=f64((0.0, 0.0, 1.0)), offset_mm=0.0, thickness_mm=12.0, n_glass=1.49, n_fluid=1.36)
    sine = math.sin(math.radians(degrees))
    way = height_mm * math.tan(math.radians(degrees))
    inside = sum(d * sine / math.sqrt(n * n - sine * sine) for d, n in ((12.0, 1.49), (depth_mm, 1.36)))
    point = wall.entry_point(f64((way + inside, 0.0, -depth_mm)), f64((0.0, 0.0, 12 + height_mm)))
    assert_close(point, f64((way, 0.0, 12.0)), atol=1e-10 * (1 + way))


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_a_wall_of_air_is_no_wall(model, rng):
    bare, behind = model(), behind_port(model(), n_glass=1.0, n_fluid=1.0)
    x_lab_mm, uv_px = in_liquid(rng, 300), whole_picture()
    assert_close(behind.project(x_lab_mm), bare.project(x_lab_mm), atol=1e-9)
    one, other = behind.rays(uv_px), bare.rays(uv_px)
    assert_close(one.direction_lab, other.direction_lab, atol=1e-15)
    between = one.origin_lab_mm - other.origin_lab_mm  # further along the same line
    aside = between - (between * other.direction_lab).sum(-1, keepdim=True) * other.direction_lab
    assert_close(aside, torch.zeros_like(aside), atol=1e-9)


def test_glass_as_dense_as_the_liquid_is_more_liquid(rng):
    x_lab_mm = in_liquid(rng, 100)
    thick = behind_port(tsai(), n_glass=1.36)
    none = behind_port(tsai(), n_glass=2.0, thickness_mm=0.0, offset_mm=132.0)
    assert_close(thick.project(x_lab_mm), none.project(x_lab_mm), atol=1e-9)


class Disguised:
    """A camera of the protocol without a known perspective centre."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera

    def __getattr__(self, name: str) -> object:
        return getattr(self.camera, name)


def test_a_camera_whose_centre_is_not_known_has_the_same_lines_of_sight(rng):
    known = behind_port(tsai())
    unknown = PortCamera(camera=Disguised(tsai()), port=known.port)
    x_lab_mm = in_liquid(rng, 50)
    assert_close(unknown.project(x_lab_mm), known.project(x_lab_mm), atol=1e-6)
    assert torch.isnan(unknown.project(known.port.normal_lab * 125)).all()


def test_points_on_the_wrong_side_have_no_picture_and_no_gradient():
    for camera in (behind_port(tsai()), behind_port(telecentric())):
        normal = camera.port.normal_lab
        x_lab_mm = torch.stack([119.9 * normal, 120.1 * normal, 131 * normal, 200 * normal, 9e3 * normal])
        x_lab_mm.requires_grad_()
        uv_px = camera.project(x_lab_mm)
        assert torch.isnan(uv_px).all(-1).tolist() == [False, True, True, True, True]
        (gradient,) = torch.autograd.grad(torch.nan_to_num(uv_px).sum(), x_lab_mm)
        assert torch.isfinite(gradient).all()
        assert (gradient[1:] == 0).all()
        assert (gradient[0] != 0).any()


def test_a_pixel_that_looks_past_the_wall_has_no_ray_and_no_gradient():
    # The wall's edge-on direction is 80 degrees from the axis; slope 20 points beyond it, slope -20 at it.
    tilted = Rotation.from_rotvec((0.0, math.radians(80), 0.0)).as_matrix() @ (0.0, 0.0, 1.0)
    camera = PortCamera(camera=overhead().camera, port=replace(overhead().port, normal=f64(tilted), offset_mm=5.0))
    uv_px = f64([[2200.0, 200.0], [-1800.0, 200.0], [200.0, 200.0]]).requires_grad_()
    rays = camera.rays(uv_px)
    assert torch.isnan(rays.direction_lab).all(-1).tolist() == [True, False, False]
    assert torch.isnan(rays.origin_lab_mm).all(-1).tolist() == [True, False, False]
    (gradient,) = torch.autograd.grad(torch.nan_to_num(rays.direction_lab).sum(), uv_px)
    assert torch.isfinite(gradient).all()
    assert (gradient[0] == 0).all()
    assert (gradient[1:] != 0).any(-1).all()


def test_second_derivatives_are_right_too(rng):
    camera = behind_port(tsai())
    assert torch.autograd.gradgradcheck(camera.project, in_liquid(rng, 2).requires_grad_(), atol=1e-6)


@pytest.mark.parametrize(
    "model", [tsai, telecentric, *(slow(MODELS[name]) for name in ("brown", "fisheye", "openptv"))]
)
def test_gradients_with_respect_to_all_parameters_are_right(model, rng):
    camera, x_lab_mm, uv_px = behind_port(model()), in_liquid(rng, 3), whole_picture(steps=2)
    names = (*camera.camera.parameter_fields(), *ROTATION, *TRANSLATION, *PORT_NAMES)
    scale = f64([1e-3 if "pixel_pitch" in name or name.startswith("k") else 1.0 for name in names])

    def seen(delta: torch.Tensor) -> tuple[torch.Tensor, ...]:
        changed = with_parameters(camera, names, delta * scale)
        rays = changed.rays(uv_px)
        return changed.project(x_lab_mm), rays.origin_lab_mm, rays.direction_lab

    zero = torch.zeros(len(names), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(seen, zero, eps=1e-7, atol=1e-3, rtol=1e-4)
    (gradient,) = torch.autograd.grad(seen(zero)[0].sum(), zero)
    still = {"T_z"} if model is telecentric else set()
    assert {name for name, part in zip(names, gradient.tolist(), strict=True) if abs(part) < 1e-12} == still


def test_straight_below_the_camera_gradients_are_finite_even_of_second_order(dtype):
    x_lab_mm = torch.tensor([0.0, 0.0, -50.0], dtype=dtype, requires_grad=True)
    (first,) = torch.autograd.grad(overhead().project(x_lab_mm).sum(), x_lab_mm, create_graph=True)
    (second,) = torch.autograd.grad(first.sum(), x_lab_mm)
    # Paraxial magnification: 100 px over 100 + 10 / 1.5 + 50 / 1.33 mm; lab y points up in the picture.
    expected = 100 / (100 + 10 / 1.5 + 50 / 1.33)
    assert_close(first, torch.tensor([expected, -expected, 0.0], dtype=dtype), atol=1e-6)
    assert torch.isfinite(second).all()


def test_properties_of_the_camera_in_air_pass_through():
    camera = behind_port(tsai())
    assert camera.image_size == SIZE
    assert camera.R_cam_lab is camera.camera.R_cam_lab
    assert camera.T_cam_lab_mm is camera.camera.T_cam_lab_mm
    uv_px = whole_picture()
    assert_close(camera.undistort(uv_px), tsai().undistort(uv_px))
    assert_close(camera.distort(uv_px), tsai().distort(uv_px))


def test_a_normal_of_three_digits_counts_as_a_direction_only(rng):
    exact, rough = f64((0.6, 0.0, 0.8)), f64((0.6003, 0.0, 0.8004))
    rays = Rays(origin_lab_mm=f64((0.0, 0.0, 300.0)), direction_lab=f64((0.0, 0.0, -1.0)))
    one, other = (port(normal=normal).refract(rays) for normal in (exact, rough))
    assert_close(one.origin_lab_mm, other.origin_lab_mm, atol=1e-10)
    assert_close(one.direction_lab, other.direction_lab, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"normal": (0.0, 0.0, 2.0)}, "port, normal: .* length 1"),
        ({"normal": (0.0, 1.0)}, "port, normal: expected shape"),
        ({"offset_mm": math.nan}, "port, offset_mm: expected finite"),
        ({"thickness_mm": -1.0}, "port, thickness_mm: expected 0 or more"),
        ({"n_glass": 0.67}, "port, n_glass: expected 1 or more"),
        ({"n_fluid": 0.0}, "port, n_fluid: expected 1 or more"),
        ({"offset_mm": 513.0}, "port: expected a camera before the wall"),  # in it
        ({"normal": turned()[2]}, "port: expected a camera before the wall"),
    ],
)
def test_an_impossible_wall_is_refused_in_one_line(changes, message):
    with pytest.raises(CameraError, match=message) as refused:
        behind_port(tsai(), **changes)
    assert "\n" not in str(refused.value)


def test_a_camera_that_looks_away_from_its_wall_is_refused():
    with pytest.raises(CameraError, match="a wall that the camera looks at"):
        behind_port(telecentric(), normal=turned()[2])
    backwards = pinhole(R_cam_lab=f64([[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]]) @ turned(), T_cam_lab_mm=f64((0, 0, -520)))
    with pytest.raises(CameraError, match="a wall that the camera looks at"):
        behind_port(backwards)
