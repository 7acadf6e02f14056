from __future__ import annotations

import pytest
import torch
from calibration_examples import bumped, planted, problem, vector, view, views
from conftest import assert_close

from sphereorient import so3
from sphereorient.calibration.bundle import POSE_PARTS, fitted_parameters, gathered
from sphereorient.calibration.solve import slopes_along

OF_PORT = ("port_offset", "port_thickness", "port_n_glass", "port_n_fluid", "port_tilt_x", "port_tilt_z")


def by_differences(made, change, shifts, step=1e-5):
    columns = []
    for unit in torch.eye(made.size, dtype=torch.float64):
        there, back = (made.residuals(change + sign * step * unit, shifts) for sign in (1, -1))
        columns.append((there - back) / (2 * step))
    return torch.stack(columns, dim=-1)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["tsai", "pinhole", "brown"])
@pytest.mark.parametrize("walls", [False, True], ids=["air", "port"])
def test_slopes_are_those_of_central_differences(model, walls, rng):
    rig = planted(rng, model, walls, count=3)
    made = problem(rig, views(rig, rng), OF_PORT if walls else ())
    change = 1e-3 * torch.randn(made.size, generator=rng, dtype=torch.float64)
    expected = by_differences(made, change, made.shifts(made.applied(change)))
    scale = expected.abs().amax(0).clamp_min(1e-6)
    assert ((made.slopes(change) - expected) / scale).abs().max() < 1e-5  # kappa1 is strongly curved over the step


def test_slopes_of_a_camera_are_zero_where_another_sees(rng):
    rig = planted(rng, count=3)
    made = problem(rig, views(rig, rng))
    slopes = made.slopes(torch.zeros(made.size, dtype=torch.float64))
    first, own = 2 * len(made.seen["cam1"].pose), len(made.names["cam1"])
    assert not slopes[first:, :own].any()
    assert slopes[:first, :own].any()


def test_the_true_rig_leaves_the_noise_alone(rng):
    rig = planted(rng, walls=True)
    made = problem(rig, views(rig, rng, noise_px=0.03))
    zero = torch.zeros(made.size, dtype=torch.float64)
    residuals = made.residuals(zero, made.shifts(rig))
    assert 0.95 < float(residuals.square().mean().sqrt()) < 1.05


def test_a_change_turns_cameras_in_their_own_frame_and_plates_in_the_lab(rng):
    rig = planted(rng, count=3)
    made = problem(rig, views(rig, rng))
    change = torch.zeros(made.size, dtype=torch.float64)
    names = made.names["cam2"]
    begin = len(made.names["cam1"])
    change[begin + names.index("rotation_x")] = 0.02
    change[begin + names.index("T_z")] = 1.5
    pose = sum(len(some) for some in made.names.values()) + POSE_PARTS  # row 2: row 0 is fixed, row 1 comes first
    change[pose : pose + 6] = vector(0.0, 0.0, 0.03, 0.0, 2.0, 0.0)
    moved = made.applied(change)
    expected = bumped(rig.cameras["cam2"], vector(0.02, 0, 0), vector(0, 0, 1.5))
    assert_close(moved.cameras["cam2"].R_cam_lab, expected.R_cam_lab)
    assert_close(moved.cameras["cam2"].T_cam_lab_mm, expected.T_cam_lab_mm)
    assert_close(moved.R_lab_plate[2], so3.exp(vector(0.0, 0.0, 0.03)) @ rig.R_lab_plate[2])
    assert_close(moved.T_lab_plate_mm[2], rig.T_lab_plate_mm[2] + vector(0.0, 2.0, 0.0))
    for same in (0, 1):
        assert_close(moved.R_lab_plate[same], rig.R_lab_plate[same])
    assert_close(moved.cameras["cam1"].R_cam_lab, rig.cameras["cam1"].R_cam_lab)
    wrong = rig.R_lab_plate[2] @ so3.exp(vector(0.0, 0.0, 0.03))  # the rotation read in the plate's frame
    assert not torch.allclose(moved.R_lab_plate[2], wrong, atol=1e-4)


def test_poses_that_no_camera_sees_are_no_unknowns(rng):
    rig = planted(rng, count=4)
    seen = {name: {row: view for row, view in rows.items() if row != 2} for name, rows in views(rig, rng).items()}
    assert problem(rig, seen).free == [1, 3]


def test_views_are_gathered_by_pose(rng):
    rig = planted(rng, count=3)
    some = {row: view(rig, "cam1", row, rng) for row in (2, 0)}
    joined = gathered(some)
    assert joined.pose.tolist() == [0] * len(some[0]) + [2] * len(some[2])
    assert_close(joined.uv_px[: len(some[0])], torch.from_numpy(some[0].uv_px))


def test_scales_that_the_focal_length_holds_are_not_fitted(rng):
    rig = planted(rng, walls=True, count=3)
    names = fitted_parameters(rig.cameras["cam1"], ("port_offset",))
    assert "f" in names
    assert "port_offset" in names
    assert not {"sx", "pixel_pitch_u", "pixel_pitch_v", "port_n_fluid"} & set(names)


def test_slopes_along_directions_are_columns_of_the_jacobian(rng):
    at = torch.randn(4, generator=rng, dtype=torch.float64)

    def function(x):
        return torch.stack([x[0] * x[1], x[2].sin(), x[3] ** 3 + x[0]])

    jacobian = torch.autograd.functional.jacobian(function, at)
    assert_close(slopes_along(function, at, torch.eye(4, dtype=torch.float64)), jacobian)
    direction = torch.randn(4, generator=rng, dtype=torch.float64)
    assert_close(slopes_along(function, at, direction[None])[..., 0], jacobian @ direction)


def test_slopes_of_what_does_not_depend_are_zero():
    at = torch.ones(2, dtype=torch.float64)
    assert_close(slopes_along(lambda x: torch.ones(3).double(), at, at[None]), torch.zeros(3, 1).double())
    assert slopes_along(lambda x: x**2, at, []).shape == (2, 0)
