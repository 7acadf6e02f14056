from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from calibration_examples import (
    calibrated,
    cameras,
    document,
    planted,
    port,
    vector,
    views,
)

from sphereorient import so3
from sphereorient.calibration.tsai_method import guess_from_points, guess_rig
from sphereorient.cameras import PinholeCamera, TsaiCamera
from sphereorient.cameras.brown import BrownCamera
from sphereorient.errors import CameraError

WALLS = {name: port(name) for name in ("cam1", "cam2")}


def guessed(rig, seen, model="tsai", ports=None):
    return guess_rig(document(rig, model, ports), seen)


def missed_px(found, rig, seen):
    worst = 0.0
    for name, rows in seen.items():
        for row, one in rows.items():
            points = torch.from_numpy(one.points_plate_mm) @ found.R_lab_plate[row].mT + found.T_lab_plate_mm[row]
            missed = (found.cameras[name].project(points) - torch.from_numpy(one.uv_px)).norm(dim=-1)
            worst = max(worst, float(missed.max()))
    return worst


@pytest.mark.parametrize("model", ["tsai", "pinhole", "brown"])
@pytest.mark.parametrize("walls", [False, True], ids=["air", "port"])
def test_a_guess_puts_points_nearer_to_their_pictures_than_to_their_neighbours(model, walls, rng):
    rig = planted(rng, "tsai", walls)
    seen = views(rig, rng)
    found = guessed(rig, seen, model, WALLS if walls else None)
    assert missed_px(found, rig, seen) < 20  # neighbours are 60 px apart
    kind = {"tsai": TsaiCamera, "pinhole": PinholeCamera, "brown": BrownCamera}[model]
    inner = found.cameras["cam1"].camera if walls else found.cameras["cam1"]
    assert type(inner) is kind


def test_a_guess_behind_a_wall_finds_focal_length_and_place_of_the_camera_in_air(rng):
    rig = planted(rng, walls=True)
    found = guessed(rig, views(rig, rng), ports=WALLS).cameras["cam1"]
    true = rig.cameras["cam1"]
    assert abs(float(found.camera.f_mm) / float(true.camera.f_mm) - 1) < 0.05
    apart = (found.camera.centre_lab_mm - true.camera.centre_lab_mm).norm()
    assert float(apart) < 0.05 * 520  # taken for a camera in the liquid it would stand a third farther away


def test_a_camera_that_looks_aslant_through_its_wall_looks_more_aslant_in_air(rng):
    """By Snell: 12 degrees in air are 8.8 in the liquid, by which a camera without wall would be rotated."""
    aslant = so3.exp(torch.deg2rad(vector(12.0, 0.0, 0.0)))
    true = cameras(walls=True, turned_deg=0.0)["cam1"]
    R = aslant @ true.camera.R_cam_lab
    true = replace(true, camera=replace(true.camera, R_cam_lab=R, T_cam_lab_mm=vector(0.0, 108.0, 510.0)))
    points = 30 * (2 * torch.rand(80, 3, generator=rng, dtype=torch.float64) - 1)
    found = guess_from_points(document(planted(rng), ports=WALLS), "cam1", points, true.project(points))
    assert float(torch.rad2deg(so3.geodesic_distance(found.R_cam_lab, R))) < 1.2


def test_pixels_that_are_not_square_are_of_the_sensor(rng):
    rig = planted(rng, "brown")
    found = guess_rig(document(rig, "brown", pitch=(0.01, 0.02)), views(rig, rng))
    f_u, f_v = found.cameras["cam1"].f_px.tolist()
    assert abs(f_u / f_v - 2) < 1e-6
    with pytest.raises(CameraError, match="square pixels"):
        guess_rig(document(rig, "pinhole", pitch=(0.01, 0.02)), views(rig, rng))


def test_two_pictures_are_refused_as_too_few(rng):
    rig = planted(rng)
    seen = views(rig, rng)
    seen["cam2"] = {row: seen["cam2"][row] for row in (0, 1)}
    with pytest.raises(CameraError, match=r"cam2.*3 pictures or more.*got 2; take"):
        guessed(rig, seen)


def test_a_camera_that_shares_no_pose_with_the_surveyed_one_is_refused(rng):
    rig = planted(rng)
    seen = views(rig, rng)
    seen["cam1"] = {row: one for row, one in seen["cam1"].items() if row < 4}
    seen["cam2"] = {row: one for row, one in seen["cam2"].items() if row >= 4}
    with pytest.raises(CameraError, match=r"cam2.*known pose"):
        guessed(rig, seen)


def test_poses_are_handed_on_from_camera_to_camera(rng):
    rig = planted(rng)
    seen = views(rig, rng)
    seen["cam2"] = {row: one for row, one in seen["cam2"].items() if row >= 3}
    seen["cam1"] = {row: one for row, one in seen["cam1"].items() if row < 5}
    found = guessed(rig, seen)
    assert torch.allclose(found.T_lab_plate_mm, rig.T_lab_plate_mm, atol=8.0)
    assert missed_px(found, rig, seen) < 20


@pytest.mark.slow
def test_the_pose_of_a_picture_with_too_few_points_is_not_known(rng):
    rig = planted(rng)
    seen = views(rig, rng)
    del seen["cam2"][4]
    few = seen["cam1"][4]
    parts = ("points_plate_mm", "uv_px", "sigma_px", "diameter_mm", "index")
    seen["cam1"][4] = replace(few, **{part: getattr(few, part)[:4] for part in parts})
    found = guessed(rig, seen)
    assert torch.isnan(found.T_lab_plate_mm).any(-1).tolist() == [row == 4 for row in range(8)]
    del seen["cam1"][4]
    assert calibrated(rig, seen).scale < 1.2


@pytest.mark.parametrize("walls", [False, True], ids=["air", "port"])
def test_a_guess_from_points_in_the_lab_is_near_the_camera(walls, rng):
    true = cameras(walls=walls)["cam1"]
    points = 40 * (2 * torch.rand(60, 3, generator=rng, dtype=torch.float64) - 1)
    found = guess_from_points(
        document(planted(rng), ports=WALLS if walls else None), "cam1", points, true.project(points)
    )
    missed = (found.project(points) - true.project(points)).norm(dim=-1)
    assert float(missed.max()) < 15
