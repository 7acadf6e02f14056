"""The renderer: pictures of cameras and disks, gradients, batches; smooth pictures for derivatives of fits."""

from dataclasses import replace

import pytest
import torch
from conftest import assert_close
from sphere_examples import f64, random_map
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import PinholeCamera, R_cam_view, Rays
from sphereorient.errors import CameraError, SettingsError, ShapeError
from sphereorient.pose.implicit import moved_by
from sphereorient.sphere import Sampling, SphereRenderer, sample_texture, sphere_normals
from sphereorient.sphere.renderer import (
    SHADE,
    PaintedBall,
    aperture_matrix,
    expected_grey,
    lambert,
    orthographic_camera,
    smooth_positive,
)
from sphereorient.sphere.texture import map_directions, sample_spline
from sphereorient.synth import SynthSettings, random_texture
from sphereorient.synth.scene import LAMPS, expose, make_scene

POSITIONS = ((0.0, 0.0, 0.0), (4.0, 0.0, -9.0), (-12.0, 0.0, 7.0))


def near_camera(side: int = 160, diameter_px: float = 40.0, distance_mm: float = 260.0) -> PinholeCamera:
    return PinholeCamera(
        image_size=(side, side),
        R_cam_lab=f64([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
        T_cam_lab_mm=f64([0, 0, distance_mm]),
        centre_px=f64([0.5 * (side - 1)] * 2),
        f_px=f64(diameter_px / 18.0 * distance_mm),
    )


@pytest.fixture(scope="module")
def texture() -> Tensor:
    return random_texture("blobs", 2, 256).double()


@pytest.fixture
def R(rng) -> Tensor:
    return so3.random_rotations(3, generator=rng)


def test_a_disk_is_the_mean_over_its_pixels(texture, R):  # oracle: one line of sight at a time, no aperture matrix
    size, fine = 16, 9
    got = SphereRenderer(texture, size_px=size, sampling=Sampling(blur_px=0.0, outside=0.3, supersampling=fine))(R)
    at = (torch.arange(size * fine, dtype=torch.float64) + 0.5) * (2.0 / (size * fine)) - 1.0
    y, x = torch.meshgrid(at, at, indexing="ij")
    inside = x.square() + y.square() < 1
    normal = torch.stack([x, y, -(1 - x.square() - y.square()).clamp_min(0).sqrt()], -1)
    paint = torch.where(inside, sample_texture(texture, normal @ R[:, None]), 0.3)
    expected = paint.unflatten(1, (size, fine)).unflatten(3, (size, fine)).mean((2, 4))
    assert float((got - expected).square().mean().sqrt()) < 3e-3
    assert float((got.flip(-1) - expected).square().mean().sqrt()) > 0.1


def test_from_far_away_a_cameras_picture_is_the_orthographic_one(texture, R):
    camera = near_camera(81, 40.0, 1e6)
    there = SphereRenderer(texture, radius_mm=9.0, camera=camera)(R)
    view = SphereRenderer(texture, radius_mm=9.0, camera=orthographic_camera(81, 18.0 / 40.0))
    assert_close(view(camera.R_cam_lab @ R), there, atol=1e-4)


def test_paint_and_background_have_their_given_levels_and_area():
    camera, position = near_camera(), f64(POSITIONS)
    R = torch.eye(3, dtype=torch.float64)
    render = SphereRenderer(torch.ones(8, 16), radius_mm=9.0, camera=camera)
    white = render(R, position)
    u, v = camera.project(position).round().long().unbind(-1)
    assert_close(white[torch.arange(3), v, u], torch.ones(3).double(), atol=1e-4)
    black = SphereRenderer(torch.zeros(8, 16), radius_mm=9.0, camera=camera)(R, position)
    assert_close(black, torch.zeros_like(black))
    # A sphere of slope s off the axis covers 1 / (cos of the angle)^3 of its area on the axis, in the limit of far.
    x_cam_mm = position @ camera.R_cam_lab.mT + camera.T_cam_lab_mm
    distance_mm = x_cam_mm.norm(dim=-1)
    expected = torch.pi * (20.0 * 260.0 / distance_mm) ** 2 / (1 - (9.0 / distance_mm) ** 2)
    expected = expected * (distance_mm / x_cam_mm[:, 2]) ** 3
    assert_close(white.sum((-2, -1)) / expected, torch.ones(3).double(), atol=2e-3)


def test_the_middle_of_the_disk_shows_what_faces_the_camera():  # convention
    # One white spot about body +x, rotated to the camera in its direct line of sight, not along its axis.
    spot = (map_directions(256)[..., 0] > 0.97).double()
    camera, position = near_camera(), f64(POSITIONS)
    x_cam_mm = position @ camera.R_cam_lab.mT + camera.T_cam_lab_mm
    facing = f64([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    pictures = SphereRenderer(spot, radius_mm=9.0, camera=camera)(
        camera.R_cam_lab.mT @ R_cam_view(x_cam_mm) @ facing, position
    )
    v, u = torch.meshgrid(torch.arange(160.0).double(), torch.arange(160.0).double(), indexing="ij")
    weight = pictures / pictures.sum((-2, -1), keepdim=True)
    middle = torch.stack([(weight * u).sum((-2, -1)), (weight * v).sum((-2, -1))], dim=-1)
    assert_close(middle, camera.project(position), atol=0.03)


@pytest.mark.parametrize("camera", [None, near_camera(24, 14.0)], ids=["disk", "camera"])
def test_gradients_are_right_in_orientation_position_and_texture(rng, camera):
    texture = random_map(rng, 4).requires_grad_()
    size = None if camera else 12
    R = so3.random_rotations((), generator=rng)
    pose = f64([0.0, 0.0, 0.0, 0.3, 0.2, -0.4]).requires_grad_()

    def picture(texture: Tensor, pose: Tensor) -> Tensor:
        sampling = Sampling(supersampling=3, outside=0.4)
        render = SphereRenderer(texture, radius_mm=9.0, camera=camera, size_px=size, sampling=sampling)
        return render(so3.exp(pose[:3]) @ R, pose[3:])

    assert torch.autograd.gradcheck(picture, (texture, pose), atol=1e-4, fast_mode=True)
    learnt = SphereRenderer(torch.nn.Parameter(texture.detach()), size_px=8)
    learnt(R).sum().backward()
    assert float(learnt.texture.grad.sum()) > 0


def test_a_batch_is_the_stack_of_its_singles(rng, dtype, batch):
    render = SphereRenderer(random_map(rng, 8).to(dtype), radius_mm=2.0, size_px=9)
    R = so3.random_rotations(batch, generator=rng, dtype=dtype)
    position = torch.randn(*batch, 3, generator=rng, dtype=dtype)
    picture = render(R, position)
    assert picture.shape == (*batch, 9, 9)
    assert picture.dtype == dtype
    flat = (R.reshape(-1, 3, 3), position.reshape(-1, 3), picture.reshape(-1, 9, 9))
    for one, place, expected in zip(*flat, strict=True):
        assert_close(render(one, place), expected, atol={torch.float32: 2e-4, torch.float64: 1e-10}[dtype])
    assert_close(render(R.numpy(), position.numpy()), picture)


def test_a_sphere_beyond_the_edge_is_cut_off_there(texture):
    camera, R = near_camera(48), torch.eye(3, dtype=torch.float64)
    wide = replace(camera, image_size=(248, 248), centre_px=camera.centre_px + 100)
    for x in (-9.0, 12.0, 60.0):
        place = f64([x, 0.0, -5.0])
        here, there = (SphereRenderer(texture, radius_mm=9.0, camera=one)(R, place) for one in (camera, wide))
        assert_close(here, there[100:148, 100:148], atol=1e-9)


def test_a_map_with_unknown_paint_is_trained_too(texture, R):
    spoilt = torch.nn.Parameter(texture.clone().index_fill_(0, torch.arange(20), torch.nan))
    renderer = SphereRenderer(spoilt, size_px=12)
    assert [name for name, _ in renderer.named_parameters()] == ["texture"]
    renderer(R).sum().backward()
    assert bool(renderer.texture.grad.isfinite().all())


def test_impossible_scenes_are_refused(texture, R):
    with pytest.raises(SettingsError, match="got neither"):
        SphereRenderer(texture)
    with pytest.raises(SettingsError, match="got both"):
        SphereRenderer(texture, camera=near_camera(), size_px=8)
    with pytest.raises(SettingsError, match="radius_mm"):
        SphereRenderer(texture, radius_mm=0.0, size_px=8)
    with pytest.raises(ShapeError, match="texture"):
        SphereRenderer(texture[:, :8], size_px=8)
    with pytest.raises(ShapeError, match="R_lab_body"):
        SphereRenderer(texture, size_px=8)(R[..., :2])
    with pytest.raises(ShapeError, match="position_mm"):
        SphereRenderer(texture, size_px=8)(R, torch.zeros(2))
    with pytest.raises(ShapeError, match=r"leading shapes that agree .* got \(3,\), \(5,\), \(\)"):
        SphereRenderer(texture, size_px=8)(R, torch.zeros(5, 3))
    with pytest.raises(CameraError, match="visible ball"):
        SphereRenderer(texture, radius_mm=9.0, camera=near_camera())(R, f64([0, -260.0, 0]))


def test_aperture_keeps_light_and_has_the_width_of_optics_and_pixel():
    A = aperture_matrix(15, 12, 0.55)
    at = (torch.arange(15 * 12, dtype=torch.float64) + 0.5) / 12 - 0.5
    middle = A[7]
    assert float(middle.sum()) == pytest.approx(1, abs=1e-4)
    assert float((middle * at).sum()) == pytest.approx(7, abs=1e-9)
    assert float((middle * (at - 7) ** 2).sum()) == pytest.approx(0.55**2 + 1 / 12, rel=0.01)
    box = aperture_matrix(3, 4, 0.0)
    assert_close(box[1], f64([0, 0, 0, 0, 1, 1, 1, 1, 0, 0, 0, 0]) / 4)


# --- smooth pictures


def a_ball(texture: Tensor, edge_mm: float = 0.4) -> PaintedBall:
    lamps = f64([[-0.4, -0.5, 0.3], [0.3, -0.2, 0.2]])
    return PaintedBall(
        texture=texture,
        radius_mm=9.0,
        edge_mm=edge_mm,
        ambient=f64(0.5),
        lamps_lab=lamps,
        black=f64(20.0),
        white=f64(170.0),
        behind=f64(15.0),
    )


def sight(side: int = 25) -> tuple[PinholeCamera, Rays]:
    camera = PinholeCamera(
        image_size=(side, side),
        R_cam_lab=f64([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
        T_cam_lab_mm=f64([0, 0, 300.0]),
        centre_px=f64([0.5 * (side - 1)] * 2),
        f_px=f64(side / 25 * 350.0),
    )
    v, u = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    return camera, camera.rays(torch.stack([u, v], dim=-1).reshape(-1, 2).double())


def test_inside_the_ball_the_picture_is_the_renderers(rng):
    # A map linear in the latitude is reproduced by the spline and by the bilinear look-up alike.
    texture = torch.linspace(1, 0, 16, dtype=torch.float64)[:, None].expand(16, 32)
    _, rays = sight()
    R, place = so3.random_rotations(4, generator=rng).double(), f64([[0.5, 3.0, -0.4]])
    normal, depth2 = sphere_normals(rays.origin_lab_mm, rays.direction_lab, place[:, None], 9.0)
    inner = (depth2 > 0) & ((normal * rays.direction_lab).sum(-1) < -0.6)
    body = normal @ R
    flat = (body[..., 2].abs() < 0.9) & inner  # beyond, the map is continued over the pole
    lamps = a_ball(texture).lamps_lab
    strength = lamps.norm(dim=-1)
    light = 0.5 + lambert(normal, lamps / strength[:, None], strength, SHADE)
    expected = (20.0 + 150.0 * sample_texture(texture, body)) * light
    got = expected_grey(rays, place, R, a_ball(texture))
    assert int(flat.sum()) > 300
    assert_close(got[flat], expected[flat], 0.1)  # grey levels; the rim's rounding reaches in by so much


def test_the_picture_is_the_synthetic_movies_one():
    settings = SynthSettings(diameter_px=60.0, image_size=(75, 75), blur_px=0.8)
    texture = random_texture("blobs", 3, 48)
    camera = replace(sight(75)[0], f_px=f64(1000.0))
    v, u = torch.meshgrid(torch.arange(75), torch.arange(75), indexing="ij")
    rays = camera.rays(torch.stack([u, v], dim=-1).reshape(-1, 2).double())
    R, place = so3.exp(f64([0.4, -0.8, 0.5])), f64([0.5, 3.0, -0.4])
    lamps = f64(LAMPS)
    unit = lamps[:, :3] / lamps[:, :3].norm(dim=-1, keepdim=True)
    ball = replace(a_ball(texture.double(), 0.25), lamps_lab=unit * lamps[:, 3:] * (0.5 / 0.75))
    got = expected_grey(rays, place, R, ball).reshape(75, 75)
    exposure = expose([make_scene(texture, settings)], camera, place[None, None], R[None, None])
    expected, cover = exposure.before(settings.background), exposure.covered
    miss = got - torch.from_numpy(expected)
    full = torch.from_numpy(cover) > 0.99
    assert miss.square().mean().sqrt() < 4.0  # of 150 grey levels from black to white
    assert miss[full].mean().abs() < 0.5
    # East for west, or a rotation by the inverse, is another picture.
    for other in (
        expected_grey(rays, place, R.mT, ball),
        expected_grey(rays, place, R, replace(ball, texture=ball.texture.flip(1))),
    ):
        assert (other.reshape(75, 75) - torch.from_numpy(expected)).square().mean().sqrt() > 20.0


def test_coverage_is_the_gaussian_share_of_a_straight_edge():
    _, rays = sight()
    place, ball = f64([0.0, 0.0, 0.0]), a_ball(torch.ones(4, 8).double())
    dark = replace(ball, ambient=f64(1.0), lamps_lab=1e-9 * ball.lamps_lab, white=f64(1.0), behind=f64(0.0))
    coverage = expected_grey(rays, place, torch.eye(3).double(), dark)
    off = torch.linalg.cross(place - rays.origin_lab_mm, rays.direction_lab).norm(dim=-1)  # of the line of sight
    near = (off - 9.0).abs() < 1.0
    assert int(near.sum()) > 40
    assert_close(coverage[near], torch.special.ndtr((9.0 - off) / 0.4)[near], 0.02)
    assert coverage[off < 7].min() > 0.999
    assert coverage[off > 11].max() < 0.001


def test_smooth_light_is_lamberts_but_at_the_terminator(rng):
    normal = torch.nn.functional.normalize(torch.randn(100, 3, generator=rng, dtype=torch.float64), dim=-1)
    up, strength = f64([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), f64([0.5, 0.25])
    expected = 0.5 * normal[:, 2].clamp_min(0) + 0.25 * normal[:, 0].clamp_min(0)
    assert_close(lambert(normal, up, strength), expected)
    assert_close(lambert(normal, up, strength, 0.02), expected, 0.0076)


def test_the_picture_is_smooth_to_the_second_order_limb_included(rng):
    texture = torch.rand(4, 8, generator=rng, dtype=torch.float64)
    _, rays = sight(7)
    R = so3.exp(f64([0.4, -0.8, 0.5]))

    def picture(delta: Tensor, texture: Tensor) -> Tensor:
        turned, place = moved_by(R, f64([0.3, 0.1, -0.2]), delta)
        return expected_grey(rays, place, turned, a_ball(texture, 0.8))

    still = torch.zeros(6, dtype=torch.float64).requires_grad_()
    texture.requires_grad_()
    assert torch.autograd.gradcheck(picture, (still, texture), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(lambda delta: picture(delta, texture.detach())[::5], (still,), rtol=1e-2)


def test_any_leading_shape_and_both_types(rng, dtype):
    texture = torch.rand(4, 8, generator=rng, dtype=torch.float64)
    _, rays = sight(5)
    R, place = (
        so3.random_rotations((2, 3), generator=rng).double(),
        torch.randn(2, 3, 3, generator=rng, dtype=torch.float64),
    )
    whole = expected_grey(rays, place, R, a_ball(texture))
    assert whole.shape == (2, 3, 25)
    assert_close(expected_grey(rays, place[1, 2], R[1, 2], a_ball(texture)), whole[1, 2])
    looked = sample_spline(texture.to(dtype), place.to(dtype))
    assert looked.dtype == dtype
    assert_close(looked.double(), sample_spline(texture, place), {torch.float32: 1e-5, torch.float64: 0.0}[dtype])
    with pytest.raises(ShapeError, match="position_lab_mm"):
        expected_grey(rays, place[..., :2], R, a_ball(texture))


def test_a_positive_part_has_a_round_corner_and_is_never_0(dtype):
    x = torch.tensor([-1e4, -1.0, 0.0, 1.0, 1e4], dtype=dtype)
    got = smooth_positive(x, 0.02)
    assert (got > 0).all()
    assert_close(
        got, torch.tensor([0.0, 1e-4, 0.01, 1.0001, 1e4], dtype=dtype), 2e-8 if dtype == torch.float64 else 1e-3
    )
