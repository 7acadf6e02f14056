"""Small changes of named parameters: the meaning of the names, and the covariance of the parameters."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from camera_examples import MODELS, behind_port, f64, tsai
from conftest import assert_close
from scipy.spatial.transform import Rotation

from sphereorient.cameras.camera import ParameterCovariance
from sphereorient.cameras.parameters import parameter_names, with_parameters
from sphereorient.errors import CameraError, ShapeError


def test_each_name_moves_its_own_number():
    camera = behind_port(tsai())
    names = ("f", "pixel_pitch_v", "sx", "centre_u", "centre_v", "kappa1", "T_z", "port_offset", "port_thickness")
    names += ("port_n_glass", "port_n_fluid")
    delta = f64([0.1, 1e-3, 0.01, 2.0, -3.0, 1e-5, 7.0, 0.5, -0.25, 0.02, 0.03])
    moved = with_parameters(camera, names, delta)
    inner, wall = moved.camera, moved.port
    got = [inner.f_mm, *inner.pixel_pitch_mm, inner.sx, *inner.centre_px, inner.kappa1, *inner.T_cam_lab_mm]
    assert_close(torch.stack(got), f64([45.1, 0.02, 0.022, 1.04, 333.0, 225.5, 2.3e-4, 4.0, -3.0, 527.0]))
    numbers = torch.stack([wall.offset_mm, wall.thickness_mm, wall.n_glass, wall.n_fluid])
    assert_close(numbers, f64([120.5, 11.75, 1.51, 1.39]))
    assert torch.equal(inner.R_cam_lab, camera.R_cam_lab)
    assert torch.equal(wall.normal, camera.port.normal)


def test_rotations_multiply_on_the_left_in_camera_components():
    camera = tsai()
    delta = f64([0.01, -0.02, 0.03])
    moved = with_parameters(camera, ("rotation_x", "rotation_y", "rotation_z"), delta)
    turn = torch.from_numpy(Rotation.from_rotvec(delta.numpy()).as_matrix())
    assert_close(moved.R_cam_lab, turn @ camera.R_cam_lab)
    assert (moved.R_cam_lab - camera.R_cam_lab @ turn).abs().max() > 1e-3  # lab components: another camera
    assert torch.equal(moved.T_cam_lab_mm, camera.T_cam_lab_mm)


def test_a_tilt_turns_the_wall_about_the_axes_of_the_lab():
    wall = behind_port(tsai(), normal=f64((0.0, 0.0, -1.0)), offset_mm=-100.0)
    moved = with_parameters(wall, ("port_tilt_x",), f64([0.1])).port
    assert_close(moved.normal, torch.from_numpy(Rotation.from_rotvec((0.1, 0, 0)).apply((0.0, 0.0, -1.0))))
    assert torch.equal(moved.offset_mm, wall.port.offset_mm)
    about_itself = with_parameters(wall, ("port_tilt_z",), f64([0.1])).port
    assert_close(about_itself.normal, wall.port.normal)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_every_name_of_every_model_can_be_changed_and_nothing_else_is(model):
    camera = behind_port(model())
    names = parameter_names(camera)
    assert len(set(names)) == len(names)
    still = with_parameters(camera, names, torch.zeros(len(names), dtype=torch.float64))
    x_lab_mm = f64((10.0, -20.0, 30.0))
    assert_close(still.project(x_lab_mm), camera.project(x_lab_mm), atol=1e-10)
    assert type(still.camera) is type(camera.camera)


def test_the_camera_is_differentiable_in_the_changes_and_keeps_its_covariance():
    covariance = ParameterCovariance(names=("f",), matrix=f64([[0.01]]))
    camera = replace(tsai(), covariance=covariance)
    delta = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    moved = with_parameters(camera, ("f", "rotation_z"), delta)
    assert moved.covariance is covariance
    (gradient,) = torch.autograd.grad(moved.project(f64((10.0, 20.0, 30.0)))[0], delta)
    assert torch.isfinite(gradient).all()
    assert (gradient != 0).all()
    assert behind_port(camera).covariance is covariance


def test_a_sample_of_the_covariance_moves_the_camera_by_its_own_size(rng):
    # u = sx f X / (pitch Z) + c_u: a sigma of 0.02 mm of 45 mm moves a point 40 px from the centre by 0.018 px.
    camera = tsai(0.0, R_cam_lab=torch.eye(3, dtype=torch.float64), T_cam_lab_mm=f64((0.0, 0.0, 500.0)))
    covariance = ParameterCovariance(names=("f", "centre_u"), matrix=f64([[4e-4, 0.0], [0.0, 0.0]]))
    root = torch.linalg.cholesky(covariance.matrix + 1e-18 * torch.eye(2, dtype=torch.float64))
    x_lab_mm = f64((8.630, 0.0, 0.0))
    moves = []
    for draw in torch.randn(400, 2, generator=rng, dtype=torch.float64):
        moves.append(with_parameters(camera, covariance.names, root @ draw).project(x_lab_mm)[0])
    assert torch.stack(moves).std().item() == pytest.approx(0.02 / 45 * 40.0, rel=0.1)
    assert covariance.sigmas == {"f": pytest.approx(0.02), "centre_u": 0.0}


def test_unknown_and_repeated_names_are_refused_in_one_line():
    one, two = f64([0.1]), f64([0.1, 0.2])
    with pytest.raises(CameraError, match="write 'kappa1'"):
        with_parameters(tsai(), ("kapa1",), one)
    with pytest.raises(CameraError, match="got 'port_offset'"):
        with_parameters(tsai(), ("port_offset",), one)
    with pytest.raises(CameraError, match="different names"):
        with_parameters(tsai(), ("f", "f"), two)
    with pytest.raises(ShapeError, match="delta: expected shape"):
        with_parameters(tsai(), ("f",), two)
    with pytest.raises(CameraError, match="f_mm: expected above zero"):
        with_parameters(tsai(), ("f",), f64([-50.0]))
    with pytest.raises(CameraError, match="got object"):
        parameter_names(object())


def test_a_covariance_that_is_none_is_refused():
    with pytest.raises(CameraError, match="2 rows of 2"):
        ParameterCovariance(names=("f", "sx"), matrix=f64([[1.0]]))
    with pytest.raises(CameraError, match="different names"):
        ParameterCovariance(names=(), matrix=torch.zeros(0, 0))
    with pytest.raises(CameraError, match="finite numbers"):
        ParameterCovariance(names=("f",), matrix=f64([[float("nan")]]))
