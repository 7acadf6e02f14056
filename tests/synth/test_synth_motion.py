import math

import pytest
import torch
from conftest import assert_close
from torch import Tensor

from sphereorient import so3
from sphereorient.synth import Motion6D, RandomMotion, SynthSettings, random_motion
from sphereorient.synth.write import motion_of

STEP_S = 1e-4


def motion(seed: int = 3, **changes: float) -> RandomMotion:
    parts = {"velocity_rms": 0.3, "velocity_time": 0.12, "omega_rms": 8.0, "omega_time": 0.03, "volume_mm": 45.0}
    return random_motion(**(parts | changes), seed=seed)


@pytest.fixture
def around() -> tuple[Motion6D, Motion6D, Motion6D]:
    """The motion a step before, at, and a step after 40 instants."""
    middle = 0.01 + 0.005 * torch.arange(40, dtype=torch.float64)
    every = motion().at((middle[:, None] + STEP_S * torch.tensor([-1.0, 0.0, 1.0])).reshape(-1))
    parts = [Motion6D(**{name: value[k::3] for name, value in vars(every).items()}) for k in range(3)]
    return parts[0], parts[1], parts[2]


def slope(before: Tensor, after: Tensor) -> Tensor:
    return (after - before) / (2 * STEP_S)


def in_body(now: Motion6D, vector_lab: Tensor) -> Tensor:
    return (now.R_lab_body.mT @ vector_lab[..., None])[..., 0]


def test_velocity_is_the_derivative_of_position_in_metres(around):
    before, now, after = around
    assert_close(slope(before.position_lab_mm, after.position_lab_mm) / 1000, now.velocity_m_s, atol=1e-5)
    assert now.velocity_m_s.abs().max() > 0.1


def test_acceleration_is_the_derivative_of_velocity(around):
    before, now, after = around
    assert_close(slope(before.velocity_m_s, after.velocity_m_s), now.acceleration_m_s2, atol=1e-4)
    assert now.acceleration_m_s2.abs().max() > 1


def test_omega_rotates_R_in_lab_components(around):
    before, now, after = around
    turn_lab = so3.log(after.R_lab_body @ before.R_lab_body.mT) / (2 * STEP_S)
    assert_close(turn_lab, now.omega_lab_rad_s, atol=2e-3)
    # docs/errata.md E4: R^T R' are the body's components, another vector.
    turn_body = so3.log(before.R_lab_body.mT @ after.R_lab_body) / (2 * STEP_S)
    assert_close(turn_body, in_body(now, now.omega_lab_rad_s), atol=2e-3)
    assert (turn_body - now.omega_lab_rad_s).norm(dim=-1).min() > 0.1


def test_alpha_is_the_derivative_of_omega_in_the_lab_and_in_the_body(around):
    before, now, after = around
    assert_close(slope(before.omega_lab_rad_s, after.omega_lab_rad_s), now.alpha_lab_rad_s2, atol=5e-2)
    omega_body = [in_body(part, part.omega_lab_rad_s) for part in (before, after)]
    assert_close(slope(*omega_body), in_body(now, now.alpha_lab_rad_s2), atol=5e-2)
    assert now.alpha_lab_rad_s2.abs().max() > 100


def test_orientations_are_rotations_and_begin_at_the_start():
    now = motion().at(torch.arange(500, dtype=torch.float64) / 600)
    assert_close(now.R_lab_body @ now.R_lab_body.mT, torch.eye(3, dtype=torch.float64).expand(500, 3, 3))
    assert_close(torch.linalg.det(now.R_lab_body), torch.ones(500, dtype=torch.float64))
    assert_close(now.R_lab_body[0], motion().R_start)


def test_at_other_instants_it_is_the_same_motion():
    time_s = torch.arange(200, dtype=torch.float64) / 600
    every, third = motion().at(time_s), motion().at(time_s[::3])
    assert_close(third.R_lab_body, every.R_lab_body[::3], atol=1e-7)
    for name in ("position_lab_mm", "velocity_m_s", "acceleration_m_s2", "omega_lab_rad_s", "alpha_lab_rad_s2"):
        assert_close(getattr(third, name), getattr(every, name)[::3], atol=1e-9)


def test_it_goes_on_before_time_0_and_back():
    # The exposure of frame 0 begins before time 0; instants of overlapping exposures go back in time.
    time_s = torch.tensor([-2e-3, -1e-3, 0.0, 1e-3, 5e-4, 0.0], dtype=torch.float64)
    now = motion().at(time_s)
    assert_close(now.R_lab_body[2], motion().R_start, atol=1e-9)
    assert_close(now.R_lab_body[5], now.R_lab_body[2], atol=1e-9)
    middle = so3.log(now.R_lab_body[2] @ now.R_lab_body[0].mT) / 2e-3
    assert_close(middle, now.omega_lab_rad_s[1], atol=0.02)


def test_the_same_seed_is_the_same_motion_and_another_another():
    time_s = torch.arange(20, dtype=torch.float64) / 600
    first, again, other = motion(7).at(time_s), motion(7).at(time_s), motion(8).at(time_s)
    for name, value in vars(first).items():
        assert torch.equal(value, getattr(again, name))
        assert name == "time_s" or not torch.allclose(value, getattr(other, name))


@pytest.mark.slow
def test_rms_values_are_those_of_the_settings_where_the_volume_is_large():
    time_s = torch.arange(4000, dtype=torch.float64) / 100  # hundreds of correlation times
    now = motion(volume_mm=1e6).at(time_s)
    assert_close(now.velocity_m_s.square().mean(0).sqrt(), torch.full((3,), 0.3, dtype=torch.float64), atol=0.03)
    assert_close(now.omega_lab_rad_s.square().mean(0).sqrt(), torch.full((3,), 8.0, dtype=torch.float64), atol=0.5)


@pytest.mark.parametrize("seed", range(5))
def test_the_path_stays_in_its_volume_and_slows_down_for_it(seed):
    now = motion(seed, velocity_rms=2.0, volume_mm=20.0).at(torch.arange(300, dtype=torch.float64) / 100)
    distance = now.position_lab_mm.norm(dim=-1)
    assert distance.square().mean().sqrt() < 13
    assert distance.max() < 25  # "about": the rms is half of it
    assert now.velocity_m_s.square().mean().sqrt() < 1.0


def test_without_velocity_and_rotation_it_stands_still():
    now = motion(velocity_rms=0.0, omega_rms=0.0).at(torch.arange(5, dtype=torch.float64))
    assert (now.position_lab_mm == 0).all()
    assert_close(now.R_lab_body, motion().R_start.expand(5, 3, 3))


def test_a_periodic_motion_has_no_seam_and_its_rates_are_those_of_its_poses():
    settings = SynthSettings(frames=50, frame_rate=100.0, periodic=True, omega_rms=9.0, velocity_rms=0.1, seed=4)
    motion = motion_of(settings)
    step = 1e-4
    time_s = torch.tensor([0.0, step, 0.5, 0.5 + step], dtype=torch.float64)
    now = motion.at(time_s)
    assert_close(now.position_lab_mm[:2], now.position_lab_mm[2:], atol=1e-9)
    assert_close(now.R_lab_body[:2], now.R_lab_body[2:], atol=1e-9)
    assert_close(now.omega_lab_rad_s[0], so3.log(now.R_lab_body[1] @ now.R_lab_body[0].mT) / step, atol=1e-6)
    assert_close(now.velocity_m_s[0], (now.position_lab_mm[1] - now.position_lab_mm[0]) / step / 1000, atol=1e-2)
    assert not now.alpha_lab_rad_s2.any()
    turns = now.omega_lab_rad_s[0].norm() * 0.5 / (2 * math.pi)
    assert turns == pytest.approx(round(float(turns)))
    assert 0.5 < float(now.omega_lab_rad_s[0].norm()) / (9.0 * math.sqrt(3)) < 1.5
