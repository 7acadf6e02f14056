import math
from dataclasses import dataclass, replace
from functools import reduce
from itertools import accumulate

import numpy as np
import torch
from torch import Tensor

from sphereorient import so3


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion6D:
    """Exact motion at N instants, (N, ...)."""

    time_s: Tensor
    position_lab_mm: Tensor
    velocity_m_s: Tensor
    acceleration_m_s2: Tensor
    R_lab_body: Tensor
    omega_lab_rad_s: Tensor
    alpha_lab_rad_s2: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class _Waves:
    amplitude: Tensor  # (M, 3)
    rate: Tensor  # (M,) rad/s
    phase: Tensor  # (M, 3)

    def __call__(self, time_s: Tensor, derivative: int = 0) -> Tensor:
        """Return the value or a derivative, (..., 3), at times (...), s; derivative -1 is the integral."""
        angle = self.rate[:, None] * time_s[..., None, None] + self.phase + derivative * math.pi / 2
        return (self.amplitude * self.rate[:, None] ** derivative * torch.sin(angle)).sum(-2)


def _random_waves(rms: float, correlation_time: float, rng: torch.Generator, count: int = 24) -> _Waves:
    """Draw waves of this rms per component; rates reach a few inverse correlation times."""
    share = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    rate = (0.2 + 2.0 * share) / correlation_time
    weight = torch.exp(-0.5 * (rate * correlation_time) ** 2).sqrt()
    draw = torch.randn(count, 3, generator=rng, dtype=torch.float64) * weight[:, None]
    scale = rms * math.sqrt(2) / draw.square().sum(0).sqrt()
    phase = torch.rand(count, 3, generator=rng, dtype=torch.float64) * 2 * math.pi
    return _Waves(amplitude=draw * scale, rate=rate, phase=phase)


@dataclass(frozen=True, kw_only=True, eq=False)
class RandomMotion:
    """Smooth motion, known at any instant."""

    path: _Waves  # velocity, mm/s; its integral is the position
    omega: _Waves  # omega_lab, rad/s
    R_start: Tensor  # (3, 3), R_lab_body at time 0

    def at(self, time_s: Tensor) -> Motion6D:
        """Return the motion at close, increasing times (N,), s, float64; R is exact to 1e-9 rad per frame."""
        return Motion6D(
            time_s=time_s,
            position_lab_mm=self.path(time_s, -1),
            velocity_m_s=self.path(time_s) / 1000,
            acceleration_m_s2=self.path(time_s, 1) / 1000,
            R_lab_body=_integrate(self.omega, time_s, self.R_start),
            omega_lab_rad_s=self.omega(time_s),
            alpha_lab_rad_s2=self.omega(time_s, 1),
        )


def random_motion(
    velocity_rms: float, velocity_time: float, omega_rms: float, omega_time: float, volume_mm: float, seed: int
) -> RandomMotion:
    """Draw a smooth motion from rms values per component, m/s and rad/s (lab), and correlation times, s.
    The velocity is reduced if the rms distance from the origin exceeds half of `volume_mm`.
    """
    rng = torch.Generator().manual_seed(seed)
    path = _random_waves(velocity_rms * 1000, velocity_time, rng)
    omega = _random_waves(omega_rms, omega_time, rng)
    reach = float((path.amplitude / path.rate[:, None]).square().sum().div(2).sqrt())
    squeeze = min(1.0, 0.5 * volume_mm / max(reach, 1e-9))
    R_start = so3.random_rotations(1, generator=rng, dtype=torch.float64)[0]
    return RandomMotion(path=replace(path, amplitude=path.amplitude * squeeze), omega=omega, R_start=R_start)


def without_seam(motion: RandomMotion, period_s: float) -> RandomMotion:
    """Return a periodic motion: whole waves of the path, whole turns about one axis."""
    waves = (motion.path.rate * period_s / (2 * math.pi)).round().clamp_min(1.0)
    path = replace(motion.path, rate=waves * 2 * math.pi / period_s)
    omega = motion.omega.amplitude.square().sum(0).div(2).sqrt()  # rms of its components
    turns = max(1, round(float(omega.norm()) * period_s / (2 * math.pi)))
    even = torch.nn.functional.normalize(omega, dim=0) * (2 * math.pi * turns / period_s)
    still = _Waves(amplitude=even[None], rate=omega.new_zeros(1), phase=torch.full((1, 3), math.pi / 2).double())
    return replace(motion, path=path, omega=still)


def _integrate(omega: _Waves, time_s: Tensor, R_start: Tensor, substeps: int = 8) -> Tensor:
    """Integrate dR/dt = [omega_lab]x R from R_start at time 0; return R at every instant."""
    start = torch.cat([time_s.new_zeros(1), time_s[:-1]])
    step = ((time_s - start) / substeps)[:, None]
    begin = start[:, None] + step * torch.arange(substeps, dtype=time_s.dtype)
    early, late = (begin + step * (0.5 + sign * math.sqrt(3) / 6) for sign in (-1, 1))
    turn = magnus_rotation(omega(early), omega(late), step[..., None])
    steps = reduce(lambda done, k: turn[:, k] @ done, range(1, substeps), turn[:, 0]).numpy()
    R = accumulate(steps, lambda before, step: step @ before, initial=R_start.numpy())
    return so3.nearest_rotation(torch.from_numpy(np.stack(list(R)[1:])))


def magnus_rotation(early: Tensor, late: Tensor, step_s: Tensor | float) -> Tensor:
    """Return step rotations (..., 3, 3) from omega (..., 3), rad/s, at each step's two Gauss nodes.
    Source: fourth-order Magnus expansion (Iserles and Norsett 1999).
    """
    h = step_s
    return so3.exp(h * (early + late) / 2 - math.sqrt(3) / 12 * h**2 * torch.linalg.cross(early, late))
