"""What a measurement makes of a synthetic ensemble: tracks without noise, smoothed ones, and filtered ones."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.motion import (
    MeasuredPoses,
    MotionSettings,
    ProcessNoise,
    SmoothSettings,
    measure_motion,
    smooth_motion,
)
from sphereorient.synth.ensemble import TrueTracks
from sphereorient.trajectory import Flag, Trajectory

Floats = NDArray[np.float64]

_UNITS = {  # of motion's names
    "velocity": "m_s",
    "acceleration": "m_s2",
    "omega_lab": "rad_s",
    "omega_body": "rad_s",
    "alpha_lab": "rad_s2",
    "alpha_body": "rad_s2",
}


def exact_track(true: TrueTracks) -> Trajectory:
    """Return the track that a perfect measurement would give; its sigmas are zero."""
    blank = _measured(true, true.position_mm, true.R_lab_body, 0.0, 0.0, "precise")
    parts: dict[str, Any] = {"position_smooth": true.position_mm, "orientation_smooth": true.R_lab_body}
    for name in _UNITS:
        parts |= {name: getattr(true, name), f"{name}_sigma": np.zeros((len(true.time_s), 3))}
    return replace(blank, **parts)


def smoothed_track(
    true: TrueTracks,
    noise_deg: float,
    noise_mm: float,
    seed: int,
    known: ProcessNoise | None = None,
    silent: bool = False,
) -> tuple[Trajectory, ProcessNoise]:
    """Measure an ensemble with white noise and smooth it with `motion.smooth_motion`.

    Args:
        true: the motion.
        noise_deg: standard deviation of each component of the orientation's error, degrees.
        noise_mm: of each coordinate of the position.
        seed: of the noise.
        known: what an earlier ensemble taught the smoother; None learns from this one.
        silent: measure without noise, and smooth as if there were noise: what smoothing alone does.

    Returns:
        The track as the precise method writes it, and what the smoother learnt; 0.4 ms a frame.
    """
    track = _noisy(true, noise_deg, noise_mm, seed, "precise")
    if silent:
        track = replace(track, position=true.position_mm, orientation=true.R_lab_body)
    poses = MeasuredPoses(
        time_s=torch.from_numpy(track.time),
        position_lab_mm=torch.from_numpy(track.position),
        position_cov_mm2=torch.from_numpy(track.position_cov),
        R_lab_body=torch.from_numpy(track.orientation),
        orientation_cov_rad2=torch.from_numpy(track.orientation_cov),
        segment=torch.from_numpy(track.segment),
    )
    found = smooth_motion(poses, SmoothSettings(), known)
    parts = {
        "position_smooth": found.position_lab_mm,
        "position_smooth_cov": found.position_cov_mm2,
        "orientation_smooth": found.R_lab_body,
        "orientation_smooth_cov": found.orientation_cov_rad2,
        **{name: getattr(found, f"{name}_{unit}") for name, unit in _UNITS.items()},
        **{f"{name}_sigma": getattr(found, f"{name}_sigma_{unit}") for name, unit in _UNITS.items()},
    }
    flags = np.where(found.extrapolated.numpy(), np.uint32(Flag.EXTRAPOLATED), np.uint32(0))
    arrays = {name: tensor.numpy() for name, tensor in parts.items()}
    return replace(track, **arrays, flags=flags), found.process


def filtered_track(
    true: TrueTracks, noise_deg: float, noise_mm: float, seed: int, settings: MotionSettings | None = None
) -> Trajectory:
    """Measure an ensemble with white noise and differentiate it with Gaussian kernels, `motion.measure_motion`.

    The light path: a microsecond per frame and quantity. The kernels' low-pass bias stays in.

    Args:
        true: the motion.
        noise_deg: standard deviation of each component of the orientation's error, degrees.
        noise_mm: of each coordinate of the position.
        seed: of the noise.
        settings: widths; None takes the paper's.

    Returns:
        The track as the paper's method writes it.
    """
    track = _noisy(true, noise_deg, noise_mm, seed, "paper")
    sigma_mm, sigma_rad = (torch.full((len(track),), x) for x in (noise_mm, math.radians(noise_deg)))
    found = measure_motion(
        torch.from_numpy(track.position),
        torch.from_numpy(track.orientation),
        torch.from_numpy(track.segment),
        true.spec.frame_rate_hz,
        settings or MotionSettings(),
        position_sigma_mm=sigma_mm.double(),
        orientation_sigma_rad=sigma_rad.double(),
    )
    parts = {name: getattr(found, f"{name}_{unit}").numpy() for name, unit in _UNITS.items()}
    parts |= {f"{name}_sigma": getattr(found, f"{name}_sigma_{unit}").numpy() for name, unit in _UNITS.items()}
    return replace(track, position_smooth=track.position, orientation_smooth=track.orientation, **parts)


def _noisy(true: TrueTracks, noise_deg: float, noise_mm: float, seed: int, method: str) -> Trajectory:
    """Return positions and orientations with white noise."""
    rng = np.random.default_rng([seed, 1])
    noise_rad = math.radians(noise_deg)
    delta = torch.from_numpy(noise_rad * rng.standard_normal(true.position_mm.shape))
    R = (so3.exp(delta) @ torch.from_numpy(true.R_lab_body)).numpy()
    position = true.position_mm + noise_mm * rng.standard_normal(true.position_mm.shape)
    return _measured(true, position, R, noise_mm, noise_rad, method)


def _measured(
    true: TrueTracks, position_mm: Floats, R: Floats, noise_mm: float, noise_rad: float, method: str
) -> Trajectory:
    """Return a track with positions and orientations and nothing derived from them."""
    count, unit = len(true.time_s), np.eye(3)
    blank = Trajectory.empty(true.time_s, frame_rate=true.spec.frame_rate_hz, method=method, experiment="synthetic")
    return replace(
        blank,
        valid=np.ones(count, dtype=bool),
        position=position_mm,
        position_cov=np.tile(noise_mm**2 * unit, (count, 1, 1)),
        orientation=R,
        orientation_cov=np.tile(noise_rad**2 * unit, (count, 1, 1)),
        segment=true.segment,
        confidence=np.ones(count),
    )
