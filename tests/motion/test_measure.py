"""The whole measurement: on the truth of the synthetic experiment with noise, with frames missing, in segments."""

from dataclasses import fields

import h5py
import pytest
import torch
from conftest import SHARED, assert_close
from pydantic import ValidationError
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import ShapeError
from sphereorient.motion import Motion, MotionSettings, measure_motion

RATE = 600.0


def steady(frames: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Tensor]:
    """Return position, orientation, segment of a body on a parabola with a spin that grows about lab z."""
    t = torch.arange(frames, dtype=torch.float64)[:, None] / RATE
    position_mm = 1000 * torch.cat([0.5 * t, 2.0 * t**2, 0 * t], dim=-1)
    turn = torch.cat([0 * t, 0 * t, 10.0 * t + 100.0 * t**2], dim=-1)
    R = so3.exp(turn) @ so3.exp(torch.tensor([torch.pi / 2, 0, 0], dtype=torch.float64))
    return position_mm.to(dtype), R.to(dtype), torch.zeros(frames, dtype=torch.long)


def rel_rms(got: Tensor, true: Tensor) -> tuple[float, float]:
    """Return relative rms error and coverage as the scoring script defines them."""
    seen = got.isfinite().all(-1)
    error = ((got - true)[seen].square().sum() / true[seen].square().sum()).sqrt()
    return float(error), float(seen.double().mean())


# convention: units and frames by hand


def test_units_are_si_and_frames_are_those_of_the_names() -> None:
    motion = measure_motion(*steady(60), RATE, MotionSettings())
    t = 30 / RATE
    by_hand = {
        "velocity_m_s": [0.5, 4.0 * t, 0.0],
        "acceleration_m_s2": [0.0, 4.0, 0.0],
        "omega_lab_rad_s": [0.0, 0.0, 10 + 200 * t],
        "omega_body_rad_s": [0.0, 10 + 200 * t, 0.0],  # body y lies along lab z
        "alpha_lab_rad_s2": [0.0, 0.0, 200.0],
        "alpha_body_rad_s2": [0.0, 200.0, 0.0],
    }
    for name, expected in by_hand.items():
        assert_close(getattr(motion, name)[30], torch.tensor(expected, dtype=torch.float64), atol=1e-6)


# oracle: exact truth of a turbulence-like motion, with the noise of a real measurement


@pytest.mark.shared
@pytest.mark.parametrize("lost", [(), (60, 61, 150), (40, 120, 180)], ids=str)
def test_the_defaults_serve_one_degree_of_attitude_noise_even_with_lost_frames(
    lost: tuple[int, ...], rng: torch.Generator
) -> None:
    with h5py.File(SHARED / "experiment" / "truth.h5") as file:
        truth = {name: torch.from_numpy(file[name][()]) for name in file if isinstance(file[name], h5py.Dataset)}
    frames = len(truth["time"])
    drawn = torch.randn(frames + 2, 3, generator=rng, dtype=torch.float64)
    correlated = (drawn[:-2] + drawn[1:-1] + drawn[2:]) / 3**0.5
    position = truth["position"] + 0.1 * correlated
    attitude = torch.deg2rad(0.7 * torch.randn(frames, 3, generator=rng, dtype=torch.float64))
    R = so3.exp(attitude) @ truth["orientation"]
    position[list(lost)], R[list(lost)] = torch.nan, torch.nan
    motion = measure_motion(position, R, torch.zeros(frames, dtype=torch.long), RATE, MotionSettings())
    limits = {
        "velocity": (motion.velocity_m_s, 0.05),
        "omega_lab": (motion.omega_lab_rad_s, 0.12),
        "omega_body": (motion.omega_body_rad_s, 0.12),
        "acceleration": (motion.acceleration_m_s2, 0.4),
        "alpha_lab": (motion.alpha_lab_rad_s2, 0.65),
    }
    for name, (got, limit) in limits.items():
        error, coverage = rel_rms(got, truth[name])
        assert error <= limit, name
        assert coverage >= 0.9, name


@pytest.mark.slow
def test_each_sigma_is_the_scatter_that_white_noise_causes(rng: torch.Generator) -> None:
    draws, frames = 3000, 41
    position_mm, R, segment = steady(frames)
    position_sigma, orientation_sigma = (
        torch.tensor([0.1, 0.2, 0.3]).double(),
        torch.tensor([0.002, 0.004, 0.006]).double(),
    )
    R[18] = torch.nan
    noise = torch.randn(2, draws, frames, 3, generator=rng, dtype=torch.float64)
    motion = measure_motion(
        position_mm + position_sigma * noise[0],
        so3.exp(orientation_sigma * noise[1]) @ R,
        segment.expand(draws, frames),
        RATE,
        MotionSettings(),
        (position_sigma.expand(draws, frames, 3), orientation_sigma.expand(draws, frames, 3)),
    )
    for quantity, unit in (
        ("velocity", "m_s"),
        ("acceleration", "m_s2"),
        ("omega_lab", "rad_s"),
        ("omega_body", "rad_s"),
        ("alpha_lab", "rad_s2"),
        ("alpha_body", "rad_s2"),
    ):
        for k in (6, 17, 20):
            found = getattr(motion, f"{quantity}_{unit}")[:, k].std(dim=0)
            claimed = getattr(motion, f"{quantity}_sigma_{unit}")[0, k]
            assert ((found / claimed - 1).abs() < 0.06).all(), (quantity, k, found, claimed)


def test_a_sigma_is_nan_where_a_sigma_that_goes_into_it_is_unknown() -> None:
    position_mm, R, segment = steady(60)
    sigma = torch.full((60,), 0.1, dtype=torch.float64)
    sigma[30] = torch.nan
    motion = measure_motion(position_mm, R, segment, RATE, MotionSettings(), (sigma, None))
    assert motion.velocity_m_s[25:35].isfinite().all()
    assert motion.velocity_sigma_m_s[25].isnan().all()
    assert motion.velocity_sigma_m_s[15].isfinite().all()
    assert motion.omega_lab_sigma_rad_s.isnan().all()


def test_smooth_poses_are_the_means_that_their_kernels_make_and_bridge_a_lost_frame(rng: torch.Generator) -> None:
    frames, settings = 41, MotionSettings()
    position_mm, R, segment = steady(frames)
    noise = torch.randn(2, frames, 3, generator=rng, dtype=torch.float64)
    position_mm, R = position_mm + 0.1 * noise[0], so3.exp(0.02 * noise[1]) @ R
    position_mm[18], R[18] = torch.nan, torch.nan
    sigma = torch.tensor([0.1, 0.2, 0.3]).double().expand(frames, 3)
    motion = measure_motion(position_mm, R, segment, RATE, settings, (sigma, 0.1 * sigma))
    for k in (15, 18, 20):
        j = torch.arange(-11, 12)
        used = position_mm[k + j].isfinite().all(-1) & position_mm[k - j].isfinite().all(-1)
        for width, reach in ((settings.velocity_sigma_frames, 11), (settings.alpha_sigma_frames, 6)):
            weight = torch.exp(-0.5 * (j.double() / width) ** 2) * used * (j.abs() <= reach)
            weight = weight / weight.sum()
            if reach == 11:
                mean = (weight[:, None] * position_mm[k + j].nan_to_num()).sum(0)
                assert_close(motion.position_lab_mm[k], mean, atol=1e-12)
                variance, found = sigma[0].square(), motion.position_cov_mm2[k]
            else:
                mean = so3.weighted_mean(R[k + j], weight)  # Karcher's, which differs in the third order
                assert float(so3.geodesic_distance(motion.R_lab_body[k], mean)) < 2e-5
                assert float(so3.geodesic_distance(R[20], mean)) > 1e-3
                variance, found = (0.1 * sigma[0]).square(), motion.orientation_cov_rad2[k]
            assert_close(found, torch.diag(weight.square().sum() * variance), atol=1e-12)


# property


def test_nothing_is_measured_across_segments_or_outside_them() -> None:
    position_mm, R, segment = steady(80)
    segment[40:] = 1
    segment[38:42] = -1
    position_mm[40:] += 50.0
    motion = measure_motion(position_mm, R, segment, RATE, MotionSettings())
    for entry in fields(Motion):
        values = getattr(motion, entry.name)
        assert values[38:42].isnan().all(), entry.name
        smooth = entry.name in ("R_lab_body", "orientation_cov_rad2")  # its kernel is narrow
        assert values[36 + smooth : 44 - smooth].isnan().all(), entry.name
    assert_close(motion.velocity_m_s[20:30, 0], torch.full((10,), 0.5, dtype=torch.float64), atol=1e-9)
    seen = motion.velocity_m_s.isfinite().all(-1)
    assert_close(motion.velocity_m_s[seen, 0], torch.full((int(seen.sum()),), 0.5, dtype=torch.float64), atol=1e-9)


def test_a_lost_frame_has_lab_but_no_body_components() -> None:
    position_mm, R, segment = steady(40)
    position_mm[20], R[20] = torch.nan, torch.nan
    motion = measure_motion(position_mm, R, segment, RATE, MotionSettings())
    assert motion.velocity_m_s[10:30].isfinite().all()
    assert motion.omega_lab_rad_s[10:30].isfinite().all()
    assert motion.alpha_lab_rad_s2[10:30].isfinite().all()
    assert motion.omega_body_rad_s[:, 0].isnan()[10:30].nonzero().flatten().tolist() == [10]
    assert motion.alpha_body_rad_s2[20].isnan().all()


@pytest.mark.parametrize("frames", [0, 1, 5])
def test_too_few_frames_give_nan_and_no_error(frames: int) -> None:
    motion = measure_motion(*steady(frames), RATE, MotionSettings())
    assert motion.velocity_m_s.shape == motion.alpha_body_sigma_rad_s2.shape == (frames, 3)
    assert motion.acceleration_m_s2.isnan().all()


def test_a_batch_is_the_stack_of_its_singles(batch: tuple[int, ...], dtype: torch.dtype) -> None:
    position_mm, R, segment = steady(30, dtype)
    many = (position_mm.expand(*batch, 30, 3), R.expand(*batch, 30, 3, 3), segment.expand(*batch, 30))
    sigma = torch.full((*batch, 30), 0.01, dtype=dtype)
    got = measure_motion(*many, RATE, MotionSettings(), (sigma, sigma))
    one_sigma = torch.full((30,), 0.01, dtype=dtype)
    one = measure_motion(position_mm, R, segment, RATE, MotionSettings(), (one_sigma, one_sigma))
    for entry in fields(Motion):
        values, single = getattr(got, entry.name), getattr(one, entry.name)
        assert values.dtype == dtype
        torch.testing.assert_close(values, single.expand(*batch, *single.shape), rtol=1e-5, atol=1e-5, equal_nan=True)


def test_gradients_are_finite_with_missing_frames() -> None:
    position_mm, R, segment = steady(30)
    position_mm[12], R[12] = torch.nan, torch.nan
    position_mm.requires_grad_()
    R.requires_grad_()
    motion = measure_motion(position_mm, R, segment, RATE, MotionSettings())
    parts = [motion.velocity_m_s, motion.acceleration_m_s2, motion.omega_body_rad_s, motion.alpha_body_rad_s2]
    parts += [motion.position_lab_mm, motion.R_lab_body]
    torch.stack([part[part.isfinite()].sum() for part in parts]).sum().backward()
    for leaf in (position_mm, R):
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()


def test_inputs_are_left_as_they_were() -> None:
    position_mm, R, segment = steady(30)
    copies = position_mm.clone(), R.clone(), segment.clone()
    measure_motion(position_mm, R, segment, RATE, MotionSettings())
    for before, after in zip(copies, (position_mm, R, segment), strict=True):
        assert torch.equal(before, after)


def test_unequal_numbers_of_frames_are_refused() -> None:
    position_mm, R, segment = steady(30)
    with pytest.raises(ShapeError, match="same frames"):
        measure_motion(position_mm[:-1], R, segment, RATE, MotionSettings())


@pytest.mark.parametrize(
    "wrong",
    [{"separations": (0, 1)}, {"separations": (1, 2)}, {"min_share": 0.0}, {"velocity_sigma_frames": -1.0}, {"a": 1}],
)
def test_impossible_settings_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        MotionSettings(**wrong)  # type: ignore[arg-type]
