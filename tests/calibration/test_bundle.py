from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from calibration_examples import calibrated, change_of, planted, port, problem, triangulated_error_mm, vector, views

from sphereorient.calibration.bundle import adjust

WALLS = {name: port(name) for name in ("cam1", "cam2")}


def errors_in_sigmas(fitted, rig):
    """Error of the cameras, whitened by the joint covariance of all."""
    parts = []
    for name, camera in fitted.rig.cameras.items():
        names = camera.covariance.names
        parts.append(change_of(camera, rig.cameras[name], names))
    missing = torch.cat(parts)
    covariance = fitted.covariance[: len(missing), : len(missing)]
    return torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), missing[:, None], upper=False)[:, 0]


@pytest.mark.slow
@pytest.mark.parametrize("model", ["tsai", "brown", "pinhole"])
def test_planted_cameras_are_found_to_the_digits_without_noise(model, rng):
    rig = planted(rng, model, count=6)
    fitted = calibrated(rig, views(rig, rng, noise_px=0.0), model)
    assert triangulated_error_mm(fitted.rig.cameras, rig.cameras, 60.0) < 1e-5


@pytest.mark.parametrize("walls", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["air", "port"])
def test_planted_cameras_are_found_through_noise(walls, rng):
    rig = planted(rng, walls=walls)
    fitted = calibrated(rig, views(rig, rng), ports=WALLS if walls else None)
    assert 0.9 < fitted.scale < 1.1
    assert triangulated_error_mm(fitted.rig.cameras, rig.cameras, 60.0) < 0.03
    sigmas = errors_in_sigmas(fitted, rig)
    assert 0.5 < float(sigmas.square().mean().sqrt()) < 1.6
    for row in range(1, 8):
        assert torch.allclose(fitted.rig.T_lab_plate_mm[row], rig.T_lab_plate_mm[row], atol=0.05)


@pytest.mark.slow
def test_outliers_are_named_and_do_no_harm(rng):
    rig = planted(rng)
    seen = views(rig, rng)
    uv = seen["cam2"][3].uv_px.copy()
    uv[[4, 20]] += np.array([[1.5, 0.0], [0.0, -8.0]])
    seen["cam2"][3] = replace(seen["cam2"][3], uv_px=uv)
    fitted = calibrated(rig, seen)
    assert bool(fitted.used["cam1"].all())
    begin = sum(len(seen["cam2"][row]) for row in range(3))
    assert torch.nonzero(~fitted.used["cam2"])[:, 0].tolist() == [begin + 4, begin + 20]
    assert torch.allclose(fitted.residual_px["cam2"][begin + 20], vector(0.0, -8.0), atol=0.2)
    assert triangulated_error_mm(fitted.rig.cameras, rig.cameras, 60.0) < 0.03


@pytest.mark.slow
def test_a_camera_that_never_saw_the_surveyed_pose_is_tied_by_the_others(rng):
    rig = planted(rng)
    seen = views(rig, rng)
    del seen["cam2"][0]
    fitted = calibrated(rig, seen)
    assert triangulated_error_mm(fitted.rig.cameras, rig.cameras, 60.0) < 0.05


@pytest.mark.slow
def test_a_port_can_be_fitted_and_the_covariance_states_its_error(rng):
    rig = planted(rng, walls=True, count=10, tilt_deg=35.0, shift_mm=25.0)
    seen = views(rig, rng)
    made = problem(rig, seen, ("port_n_fluid",))
    start = torch.zeros(made.size, dtype=torch.float64)
    start[made.labels.index("cam1.port_n_fluid")] = 0.01
    fitted = adjust(replace(made, rig=made.applied(start)))
    found = fitted.rig.cameras["cam1"]
    sigma = found.covariance.sigmas["port_n_fluid"]
    assert sigma < 0.05  # the focal length takes most of it
    assert abs(float(found.port.n_fluid) - 1.36) < 4 * sigma


@pytest.mark.slow
def test_a_parameter_that_nothing_determines_gets_a_huge_sigma(rng):
    rig = planted(rng, walls=True, count=5)
    fitted = adjust(problem(rig, views(rig, rng), ("port_tilt_y",)))  # cam1's normal is along y
    assert fitted.rig.cameras["cam1"].covariance.sigmas["port_tilt_y"] > 10


@pytest.mark.slow  # 200 calibrations: a minute or two
def test_covariances_cover_the_errors_of_200_calibrations(rng):
    rig, squares = planted(rng, count=5), []
    for _ in range(200):
        fitted = adjust(problem(rig, views(rig, rng)))  # begins at the truth: the result does not depend on the start
        squares.append(errors_in_sigmas(fitted, rig).square())
    squares = torch.stack(squares)
    assert 0.93 < float(squares.mean().sqrt()) < 1.07
    each = squares.mean(0).sqrt()
    assert float(each.min()) > 0.85
    assert float(each.max()) < 1.15


@pytest.mark.slow
def test_the_residuals_give_the_scale_of_the_covariance_not_the_sigmas_given(rng):
    rig = planted(rng, count=4)
    seen = views(rig, rng)
    triple = {
        name: {row: replace(one, sigma_px=3 * one.sigma_px) for row, one in rows.items()} for name, rows in seen.items()
    }
    one, other = (adjust(problem(rig, some)) for some in (seen, triple))
    assert other.scale == pytest.approx(one.scale / 3, rel=0.02)
    sigmas = [fitted.rig.cameras["cam1"].covariance.sigmas["f"] for fitted in (one, other)]
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.05)


@pytest.mark.slow
def test_the_start_does_not_matter(rng):
    rig = planted(rng, count=5)
    seen = views(rig, rng)
    one, other = adjust(problem(rig, seen)), calibrated(rig, seen)
    sigma = one.rig.cameras["cam1"].covariance.sigmas["f"]
    found = [float(fitted.rig.cameras["cam1"].f_mm) for fitted in (one, other)]
    assert abs(found[0] - found[1]) < 0.02 * sigma
