"""Clean pictures: the same as the scene's far away and near, their light, noise and truth, and the bound's model."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from conftest import assert_close

from sphereorient import so3
from sphereorient.cameras import PinholeCamera, R_cam_view
from sphereorient.errors import CameraError
from sphereorient.evaluate.bound import DiskPicture
from sphereorient.synth import random_texture
from sphereorient.synth.clean import CleanOptics, CleanSet, clean_set, render_clean
from sphereorient.synth.textures import map_directions


@pytest.fixture(scope="module")
def texture() -> torch.Tensor:
    return random_texture("blobs", 2, 256)


@pytest.fixture(scope="module")
def seen(texture: torch.Tensor) -> CleanSet:
    return clean_set(texture, 6, seed=3, diameter_px=40.0)


def noiseless(texture: torch.Tensor, seen: CleanSet, **changes: object) -> torch.Tensor:
    seen = replace(seen, **changes)
    return render_clean(
        texture,
        seen.camera,
        seen.position_lab_mm,
        seen.R_lab_body,
        diameter_mm=seen.diameter_mm,
        optics=seen.optics,
    )


def test_from_far_away_a_clean_picture_is_the_one_the_bound_is_computed_for(texture):  # oracle
    far_mm, diameter_px = 1e6, 40.0
    camera = PinholeCamera(
        image_size=(80, 80),
        R_cam_lab=torch.eye(3).double(),
        T_cam_lab_mm=torch.tensor([0.0, 0.0, far_mm]).double(),
        centre_px=torch.tensor([39.5, 39.5]).double(),
        f_px=torch.tensor(diameter_px / 18.0 * far_mm).double(),
    )
    R = so3.random_rotations(2, generator=torch.Generator().manual_seed(4))
    optics = CleanOptics(black=0.0, white=1.0)
    clean = render_clean(texture, camera, torch.zeros(2, 3).double(), R, diameter_mm=18.0, optics=optics)
    disk = DiskPicture(
        texture=texture.double(), radius_px=diameter_px / 2, optics_sigma_px=0.55, background=0.0, supersampling=6
    )
    expected = disk(R, torch.zeros(2, 2).double(), torch.full((2,), diameter_px / 2).double())
    margin = (80 - disk.size_px) // 2
    cut = clean[:, margin:-margin, margin:-margin].double()
    # Slivers of paint on the limb, where 4 rays a pixel miss some, differ by a few per cent of the step.
    assert float((cut - expected).square().mean().sqrt()) < 4e-3
    assert float((cut - expected).abs().max()) < 0.08
    mirrored = (cut.flip(-1) - expected).square().mean().sqrt()
    assert float(mirrored) > 0.1


def test_the_middle_of_the_disk_shows_what_faces_the_camera():  # convention
    # One white spot about body +x, turned to the camera in its direct line of sight, not along its axis.
    spot = (map_directions(256)[..., 0] > 0.97).float()
    seen = clean_set(spot, 4, seed=5, diameter_px=40.0)
    x_cam_mm = seen.position_lab_mm @ seen.camera.R_cam_lab.mT + seen.camera.T_cam_lab_mm
    facing = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]).double()
    R_lab_body = seen.camera.R_cam_lab.mT @ R_cam_view(x_cam_mm) @ facing
    pictures = noiseless(spot, seen, R_lab_body=R_lab_body).double() - seen.optics.black
    v, u = torch.meshgrid(torch.arange(160.0).double(), torch.arange(160.0).double(), indexing="ij")
    weight = pictures / pictures.sum((-2, -1), keepdim=True)
    middle = torch.stack([(weight * u).sum((-2, -1)), (weight * v).sum((-2, -1))], dim=-1)
    assert_close(middle, seen.camera.project(seen.position_lab_mm), atol=0.03)


def test_paint_and_background_have_the_levels_asked_for(texture, seen):
    white = noiseless(torch.ones(8, 16), seen)
    black = noiseless(torch.zeros(8, 16), seen)
    middle = seen.camera.project(seen.position_lab_mm).round().long()
    for picture, (u, v) in zip(white, middle.tolist(), strict=True):
        assert float(picture[v, u]) == pytest.approx(200, abs=0.01)
    assert_close(black, torch.full_like(black, 40.0), atol=1e-4)
    # A sphere of slope s off the axis covers 1 / (cos of the angle)^3 of its area on the axis, in the limit of far.
    area = (white - 40).sum((-2, -1)).double() / 160
    x_cam_mm = seen.position_lab_mm @ seen.camera.R_cam_lab.mT + seen.camera.T_cam_lab_mm
    near = (1 - (9.0 / x_cam_mm.norm(dim=-1)) ** 2).rsqrt()  # the cone's tangent for its sine
    cosine = x_cam_mm[:, 2] / x_cam_mm.norm(dim=-1)
    expected = torch.pi * 20.0**2 * near**2 * (x_cam_mm[:, 2] / x_cam_mm.norm(dim=-1)) ** 2 / cosine**3
    assert_close(area / expected, torch.ones(6).double(), atol=2e-3)


def test_noise_is_white_of_the_share_asked_for_and_not_rounded(texture, seen):
    noise = (seen.pictures - noiseless(texture, seen)).double()
    assert float(noise.std()) == pytest.approx(0.05 * 160, rel=0.01)
    neighbours = (noise[..., 1:] * noise[..., :-1]).mean() / noise.square().mean()
    assert abs(float(neighbours)) < 0.01
    assert not torch.equal(seen.pictures, seen.pictures.round())


def test_balls_lie_anywhere_in_the_picture_and_wholly_inside(texture):
    seen = clean_set(torch.ones(8, 16), 200, seed=6, diameter_px=10.0)
    middle = seen.camera.project(seen.position_lab_mm)
    assert float(middle.min()) < 13 < 26 < float(middle.max())  # of 0 .. 39; the ball and its blur need 12
    border = torch.cat([seen.pictures[:, [0, -1]].flatten(), seen.pictures[:, :, [0, -1]].flatten()])
    assert float(border.mean()) == pytest.approx(40, abs=0.5)


def test_the_same_seed_gives_the_same_pictures(texture, seen):
    assert torch.equal(clean_set(texture, 6, seed=3, diameter_px=40.0).pictures, seen.pictures)
    assert not torch.equal(clean_set(texture, 6, seed=4, diameter_px=40.0).R_lab_body, seen.R_lab_body)


def test_pictures_of_a_batch_are_those_of_each_ball_alone(texture, seen):
    whole = noiseless(texture, seen)
    for k in range(3):
        one = slice(k, k + 1)
        alone = noiseless(texture, seen, position_lab_mm=seen.position_lab_mm[one], R_lab_body=seen.R_lab_body[one])
        # The window is the largest ball's and the map is reduced to it: a little of another size alone.
        assert_close(whole[one], alone, atol=0.05)


def test_a_ball_across_the_border_is_refused(texture, seen):
    with pytest.raises(CameraError, match="a ball inside the picture"):
        noiseless(texture, seen, position_lab_mm=seen.position_lab_mm + 100.0)


def test_no_balls_make_no_pictures(texture, seen):
    none = noiseless(texture, seen, position_lab_mm=seen.position_lab_mm[:0], R_lab_body=seen.R_lab_body[:0])
    assert none.shape == (0, 160, 160)
