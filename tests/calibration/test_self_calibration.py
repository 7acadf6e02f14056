from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from calibration_examples import bumped, cameras, vector
from conftest import assert_close

from sphereorient import so3
from sphereorient.calibration.comparison import Seen
from sphereorient.calibration.self_calibration import MOVED, self_calibrate
from sphereorient.cameras import ParameterCovariance
from sphereorient.errors import CameraError
from sphereorient.synth import SynthSettings
from sphereorient.synth.write import default_cameras

FRAMES = 160
NOISE_PX, NOISE_DEG = 0.03, 0.08


def observations(calibrated, truly, rng, frames=FRAMES, noise=1.0, bias_deg=0.0):
    """Centres and attitudes of a ball by cameras `calibrated`, from pictures that cameras `truly` filmed."""
    places = 45 * (2 * torch.rand(frames, 3, generator=rng, dtype=torch.float64) - 1)
    R_lab_body = so3.exp(2 * torch.randn(frames, 3, generator=rng, dtype=torch.float64))
    centres, attitudes = [], []
    for k, (name, camera) in enumerate(calibrated.items()):
        true = truly[name]
        centre = true.project(places) + noise * NOISE_PX * torch.randn(frames, 2, generator=rng, dtype=torch.float64)
        # The picture gives the pose before the camera; the calibration takes it to the lab.
        turn = frame(camera, centre) @ frame(true, true.project(places)).mT
        wobble = torch.deg2rad(noise * NOISE_DEG * torch.randn(frames, 3, generator=rng, dtype=torch.float64))
        bias = torch.deg2rad(bias_deg * k * vector(0.6, -0.3, 0.7))
        centres.append(centre)
        attitudes.append(so3.exp(bias) @ so3.exp(wobble) @ turn @ R_lab_body)
    sizes = torch.full((frames, len(calibrated)), torch.nan, dtype=torch.float64)
    return Seen(
        cameras=calibrated, centre_px=torch.stack(centres, 1), radius_px=sizes, R_lab_body=torch.stack(attitudes, 1)
    )


def frame(camera, uv_px):
    """Axes at pixels of a camera, in the lab: the line of sight, and two across it."""
    forward = camera.rays(uv_px).direction_lab
    down = camera.rays(uv_px + vector(0.0, 1.0)).direction_lab - camera.rays(uv_px - vector(0.0, 1.0)).direction_lab
    down = torch.nn.functional.normalize(down - (down * forward).sum(-1, keepdim=True) * forward, dim=-1)
    return torch.stack([torch.linalg.cross(down, forward), down, forward], dim=-1)


def relative_deg(found, true):
    """Error of the rotation between the cameras, degrees."""
    between = [rig["cam2"].R_cam_lab @ rig["cam1"].R_cam_lab.mT for rig in (found, true)]
    return float(torch.rad2deg(so3.geodesic_distance(*between)))


def bump(rng):
    """0.3 degrees and 0.5 mm, in a random direction."""
    turn, move = (torch.nn.functional.normalize(torch.randn(3, generator=rng).double(), dim=0) for _ in range(2))
    return torch.deg2rad(torch.tensor(0.3)).double() * turn, 0.5 * move


@pytest.mark.slow
@pytest.mark.parametrize("walls", [False, True], ids=["air", "port"])
@pytest.mark.parametrize("seed", range(3))
def test_a_bumped_camera_is_put_right(walls, seed):
    rng = torch.Generator().manual_seed(seed)
    calibrated = cameras(walls=walls)
    truly = calibrated | {"cam2": bumped(calibrated["cam2"], *bump(rng))}
    result = self_calibrate(observations(calibrated, truly, rng, bias_deg=0.03))
    assert relative_deg(calibrated, truly) > 0.25
    assert relative_deg(result.cameras, truly) < 0.05
    assert result.gap_before_mm > 0.1
    noise_alone = self_calibrate(observations(truly, truly, rng)).gap_before_mm
    assert result.gap_after_mm < 1.5 * noise_alone
    assert result.frames == FRAMES


@pytest.mark.slow
def test_the_first_camera_stays_and_the_change_is_as_with_parameters_has_it(rng):
    calibrated = cameras()
    turn, move = bump(rng)
    truly = calibrated | {"cam2": bumped(calibrated["cam2"], turn, move)}
    result = self_calibrate(observations(calibrated, truly, rng))
    assert result.cameras["cam1"] is calibrated["cam1"]
    assert list(result.moved) == ["cam2"]
    applied = bumped(calibrated["cam2"], result.moved["cam2"][:3], result.moved["cam2"][3:])
    assert_close(result.cameras["cam2"].R_cam_lab, applied.R_cam_lab)
    assert float((result.moved["cam2"][:3] - turn).norm()) < 0.2 * float(turn.norm())


@pytest.mark.slow
def test_cameras_that_stand_right_stay(rng):
    calibrated = cameras()
    result = self_calibrate(observations(calibrated, calibrated, rng))
    assert relative_deg(result.cameras, calibrated) < 0.03
    assert result.gap_after_mm <= result.gap_before_mm * 1.01


@pytest.mark.slow
def test_parameters_that_the_sphere_does_not_determine_are_named(rng):
    """A distance along the second camera's own axis hardly moves its lines of sight."""
    calibrated = cameras()
    truly = calibrated | {"cam2": bumped(calibrated["cam2"], *bump(rng))}
    result = self_calibrate(observations(calibrated, truly, rng))
    assert result.held[0].startswith("cam1: all")
    named = set(result.held[1:])
    assert "cam2.T_z" in named
    assert not {"cam2.rotation_x", "cam2.rotation_y", "cam2.rotation_z"} & named
    assert len(named) < 4


@pytest.mark.slow
def test_covariances_take_the_new_spread(rng):
    calibrated = cameras()
    names = ("f", *MOVED)
    known = ParameterCovariance(names=names, matrix=1e-8 * torch.eye(7, dtype=torch.float64))
    calibrated["cam2"] = replace(calibrated["cam2"], covariance=known)
    result = self_calibrate(observations(calibrated, calibrated, rng))
    sigmas = result.cameras["cam2"].covariance.sigmas
    assert sigmas["f"] == pytest.approx(1e-4)
    for part, sigma in zip(MOVED, result.sigma["cam2"].tolist(), strict=True):
        assert sigmas[part] == pytest.approx(sigma)


@pytest.mark.slow
def test_frames_that_one_camera_missed_and_wild_ones_do_no_harm(rng):
    calibrated = cameras()
    truly = calibrated | {"cam2": bumped(calibrated["cam2"], *bump(rng))}
    seen = observations(calibrated, truly, rng)
    centre, turned = seen.centre_px[:, 1], seen.R_lab_body[:, 1]
    centre[:30] = torch.nan
    centre[30:34] += 40.0
    turned[40:44] = turned[60:64]
    result = self_calibrate(seen)
    assert result.frames == FRAMES - 30
    assert relative_deg(result.cameras, truly) < 0.05


def test_too_few_frames_and_one_camera_are_refused(rng):
    calibrated = cameras()
    seen = observations(calibrated, calibrated, rng, frames=12)
    with pytest.raises(CameraError, match="20 frames or more"):
        self_calibrate(seen)
    with pytest.raises(CameraError, match="two or more"):
        self_calibrate(replace(seen, cameras={"cam1": calibrated["cam1"]}))


def test_frames_of_three_cameras_are_counted_once(rng):
    calibrated = default_cameras(SynthSettings(cameras=3))
    assert self_calibrate(observations(calibrated, calibrated, rng, frames=24)).frames == 24
    with pytest.raises(CameraError, match=r"20 frames or more in which cam2 and another camera .*, got 12"):
        self_calibrate(observations(calibrated, calibrated, rng, frames=12))
    seen = observations(calibrated, calibrated, rng, frames=36)
    seen.centre_px[12:, 2] = torch.nan  # twelve frames in common with each of two cameras are twelve frames
    with pytest.raises(CameraError, match=r"20 frames or more in which cam3 and another camera .*, got 12"):
        self_calibrate(seen)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cam1", "cam3"])
def test_the_bumped_one_of_three_cameras_is_put_right_and_the_others_stay(rng, name):
    calibrated = default_cameras(SynthSettings(cameras=3))
    turn, move = bump(rng)
    truly = calibrated | {name: bumped(calibrated[name], 3 * turn, 3 * move)}
    result = self_calibrate(observations(calibrated, truly, rng))
    for one, camera in result.cameras.items():
        assert float(torch.rad2deg(so3.geodesic_distance(camera.R_cam_lab, truly[one].R_cam_lab))) < 0.06, one
    assert name in result.moved
    assert result.gap_after_mm < 0.5 * result.gap_before_mm
