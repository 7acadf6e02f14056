"""All signs between map and picture: docs/conventions.md, handedness, sense of the perspective (docs/errata.md A1)."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from sphere_examples import R_CAM_LAB_ALONG_Y, f64, map_with_three_dots, template_score

from sphereorient import so3
from sphereorient.cameras import PinholeCamera, R_cam_view
from sphereorient.search import crop_disk
from sphereorient.sphere import orthographic_view, perspective_view, sample_texture, sphere_normals
from sphereorient.synth import random_texture

SIZE = 101
# Rz(-90 degrees): lab x is body y, lab y is body -x.
R_LAB_BODY = f64([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])


def grey_at(picture: torch.Tensor, right: float, down: float) -> float:
    """Grey at a place in radii from the disk's middle."""
    return float(picture[round((down + 1) * SIZE / 2 - 0.5), round((right + 1) * SIZE / 2 - 0.5)])


def test_the_map_faces_the_camera_with_north_up_and_east_to_the_right():
    render = partial(orthographic_view(SIZE, torch.float64).render, map_with_three_dots())
    picture = render(R_CAM_LAB_ALONG_Y @ R_LAB_BODY)
    aside = math.sin(math.radians(50))
    assert grey_at(picture, 0, 0) == pytest.approx(1.0)
    assert grey_at(picture, 0, -aside) == pytest.approx(0.7)  # north is up
    assert grey_at(picture, aside, 0) == pytest.approx(0.4)  # east is to the right
    assert grey_at(picture, 0, aside) == grey_at(picture, -aside, 0) == 0.0


def test_each_other_reading_of_the_signs_shows_something_else():
    render = partial(orthographic_view(SIZE, torch.float64).render, map_with_three_dots())
    right = render(R_CAM_LAB_ALONG_Y @ R_LAB_BODY)
    half_turn_about_x = f64([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    for wrong in (
        R_CAM_LAB_ALONG_Y @ R_LAB_BODY.T,  # lab to body
        (R_CAM_LAB_ALONG_Y @ R_LAB_BODY).T,  # body from view
        R_CAM_LAB_ALONG_Y.T @ R_LAB_BODY,  # R_lab_cam
        half_turn_about_x @ R_CAM_LAB_ALONG_Y @ R_LAB_BODY,  # y up, looking along -z: OpenGL's axes
    ):
        assert (render(wrong) - right).abs().max() > 0.9


@pytest.mark.parametrize(("kind", "seed"), [("blobs", 1), ("patches", 2), ("dots", 3)])
def test_a_mirrored_map_and_a_mirrored_picture_agree_worse_than_the_right_one(rng, kind, seed):
    view, texture = orthographic_view(48), random_texture(kind, seed, 128)
    R_view_body = so3.random_rotations(12, generator=rng, dtype=torch.float32)
    right = view.render(texture, R_view_body)
    mirrored_map = view.render(texture.flip(1), R_view_body)
    for picture, mirrored in zip(right, mirrored_map, strict=True):
        assert template_score(picture, picture, view.inside) == 1.0
        assert template_score(picture, mirrored, view.inside) < 0.9
        assert template_score(picture, picture.flip(1), view.inside) < 0.9
    # Together they are one mirror: the map's about the plane y = 0, the picture's about x = 0.
    plane_y, plane_x = torch.diag(f64([1, -1, 1])).float(), torch.diag(f64([-1, 1, 1])).float()
    both = view.render(texture.flip(1), plane_x @ R_view_body @ plane_y).flip(-1)
    assert (both - right).abs().mean() < 1e-3


# --- perspective

AWAY = [(15.0, 0.0), (-12.0, 10.0), (0.0, -16.0), (9.0, 14.0)]  # degrees right and down of the optical axis
RADIUS_MM = 9.0


def photograph(
    R_lab_body: torch.Tensor, right_deg: float, down_deg: float
) -> tuple[np.ndarray, PinholeCamera, torch.Tensor]:
    """A picture of the sphere through a real camera: every pixel's ray is met with the sphere in the lab."""
    R_cam_lab = so3.exp(f64([0.4, -1.1, 0.7]))
    camera = PinholeCamera(
        image_size=(480, 480),
        R_cam_lab=R_cam_lab,
        T_cam_lab_mm=f64([3, -8, 20]),
        centre_px=f64([239.5, 239.5]),
        f_px=f64(600.0),
    )
    slope = f64([math.tan(math.radians(right_deg)), math.tan(math.radians(down_deg)), 1.0])
    centre_lab = R_cam_lab.T @ (160.0 * slope - camera.T_cam_lab_mm)
    v, u = torch.meshgrid(*(torch.arange(480, dtype=torch.float64),) * 2, indexing="ij")
    rays = camera.rays(torch.stack([u, v], dim=-1))
    normal_lab, depth2 = sphere_normals(rays.origin_lab_mm, rays.direction_lab, centre_lab, RADIUS_MM)
    paint = sample_texture(TEXTURE, normal_lab @ R_lab_body)
    return torch.where(depth2 > 0, paint, 0.0).numpy(), camera, centre_lab


TEXTURE = random_texture("blobs", 1, 128).double()


@pytest.mark.parametrize(("right_deg", "down_deg"), AWAY)
def test_off_the_axis_the_sphere_shows_the_side_that_R_cam_view_gives(rng, right_deg, down_deg):
    R_lab_body = so3.random_rotations((), generator=rng)
    picture, camera, centre_lab = photograph(R_lab_body, right_deg, down_deg)
    centre_cam = camera.R_cam_lab @ centre_lab + camera.T_cam_lab_mm
    distance = float(centre_cam.norm())
    u, v = camera.project(centre_lab).tolist()
    limb_px = 600.0 * float(distance / centre_cam[2]) * RADIUS_MM / math.sqrt(distance**2 - RADIUS_MM**2)
    disk = torch.from_numpy(crop_disk(picture, u, v, limb_px, 64))
    view = perspective_view(64, distance / RADIUS_MM, torch.float64)
    render = partial(view.render, TEXTURE)
    R_persp = R_cam_view(centre_cam)
    R_cam_body = camera.R_cam_lab @ R_lab_body

    right = template_score(disk, render(R_persp.T @ R_cam_body), view.inside)
    as_printed = template_score(disk, render(R_persp @ R_cam_body), view.inside)
    neglected = template_score(disk, render(R_cam_body), view.inside)
    assert right > 0.95  # the rest is the ellipse that a circle was cropped from
    assert as_printed < neglected < right
    assert as_printed < right - 0.1
