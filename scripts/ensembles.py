"""Synthetic ensembles of 6D trajectories without pictures, with the true statistics of the paper's Table I.

A rate is rms (sqrt(1 - b) g1 + sqrt(b / <A^2>) A g2): g1 and g2 are Gaussian processes, ln A is a sum of DEPTH
cos(phase). A is bounded: with log-normal bursts the largest event would set the flatness of 300 segments.
"""

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import i0e, ndtri

from sphereorient import motion, so3
from sphereorient.synth.motion import magnus_rotation
from sphereorient.trajectory import Flag, Trajectory

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Three = tuple[float, float, float]

TURNS = (0.25, 0.4)  # rates of the phases relative to that of g2: a burst holds a few oscillations
DEPTH = 0.66  # amplitude of each phase in ln A; 0.63 would not reach a derivative flatness of 7.6
WAVES = 24  # sines per Gaussian process
GAUSSIAN = 3.0  # flatness of a Gaussian
NODES = 64  # per phase: averages of these smooth periodic functions are then exact to rounding
REST = 10  # frames between two segments
BOX_MM = 40.0  # largest start coordinate


@dataclass(frozen=True, kw_only=True)
class Law:
    """Statistics of one component; made by `Law.of`."""

    rms: float
    share: float  # b, variance share of the bursts
    slow: float  # rms rate of g1, rad/s
    fast: float  # rms rate of g2, rad/s

    @classmethod
    def of(cls, rms: float, derivative_rms: float, flatness: float = 3.0, derivative_flatness: float = 3.0) -> Self:
        """Return the process with these statistics of the rate (any unit) and its derivative (that unit / s).

        A flatness is at least 3; the derivative's is 3 if the rate's is 3, else up to about 9.
        """
        modulation, growth, flat = _burst()
        share = math.sqrt(max(flatness - GAUSSIAN, 0.0) / (modulation - GAUSSIAN))
        steep = math.sqrt(max(derivative_flatness - GAUSSIAN, 0.0) / (flat - GAUSSIAN))
        whole = (derivative_rms / rms) ** 2
        slow = math.sqrt((1 - steep) * whole / (1 - share))
        fast = math.sqrt(steep * whole / (max(share, 1e-12) * growth))
        return cls(rms=rms, share=share, slow=slow, fast=fast)

    def draw(self, segments: int, rng: np.random.Generator) -> "Draw":
        """Draw one independent realisation per segment."""
        coefficients = rng.standard_normal((segments, 2, 2, WAVES)) / math.sqrt(WAVES)
        return Draw(law=self, coefficients=coefficients, phase=rng.uniform(0.0, 2 * np.pi, (segments, len(TURNS))))


@dataclass(frozen=True, kw_only=True, eq=False)
class Draw:
    """Realisations of a `Law` in S segments."""

    law: Law
    coefficients: Floats
    phase: Floats  # (S, 2), burst phases at time 0

    def at(self, time_s: Floats, segment: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """Return the rate and its derivative, (M,) each, at times (M,), s, from the start of each segment."""
        law = self.law
        g1, g1_slope = self._gaussian(0, law.slow, time_s, segment)
        g2, g2_slope = self._gaussian(1, law.fast, time_s, segment)
        turn = law.fast * np.array(TURNS)
        angle = self.phase[segment] + turn * time_s[:, None]
        burst = np.exp(DEPTH * np.cos(angle).sum(1))
        rise = -DEPTH * burst * (np.sin(angle) @ turn)
        calm = law.rms * math.sqrt(1 - law.share)
        strong = law.rms * math.sqrt(law.share) / float(i0e(2 * DEPTH) * math.exp(2 * DEPTH)) ** (len(TURNS) / 2)
        return calm * g1 + strong * burst * g2, calm * g1_slope + strong * (rise * g2 + burst * g2_slope)

    def integral(self, time_s: Floats, segment: NDArray[np.int64]) -> Floats:
        """Return the integral of the rate from each segment's start, (M,); only for laws without bursts."""
        rate = self.law.slow * _spectrum()
        cosine, sine = self.coefficients[segment, 0, 0], self.coefficients[segment, 0, 1]
        angle = rate * time_s[:, None]
        whole = (cosine * np.sin(angle) + sine * (1 - np.cos(angle))) / rate
        return np.asarray(self.law.rms * math.sqrt(1 - self.law.share) * whole.sum(1))

    def _gaussian(self, which: int, rate: float, time_s: Floats, segment: NDArray[np.int64]) -> tuple[Floats, Floats]:
        rates = rate * _spectrum()
        angle = rates * time_s[:, None]
        cosine, sine = self.coefficients[segment, which, 0], self.coefficients[segment, which, 1]
        c, s = np.cos(angle), np.sin(angle)
        return (cosine * c + sine * s).sum(1), ((sine * c - cosine * s) * rates).sum(1)


def _spectrum() -> Floats:
    """Return the rates of the sines, mean square 1; the correlation is close to exp(-t^2 / 2)."""
    rates = ndtri(0.5 + (np.arange(WAVES) + 0.5) / (2 * WAVES))
    return np.asarray(rates / np.sqrt((rates**2).mean()))


@cache
def _burst() -> tuple[float, float, float]:
    """Return the flatness of A g2, the growth of its derivative's mean square by A, and that derivative's flatness."""
    angle = np.linspace(0.0, 2 * np.pi, NODES, endpoint=False)
    phases = np.meshgrid(*(angle for _ in TURNS), indexing="ij")
    var = np.exp(2 * DEPTH * sum(np.cos(phase) for phase in phases))
    own = DEPTH * sum(turn * np.sin(phase) for turn, phase in zip(TURNS, phases, strict=True))  # A' / A
    slope_var = var * (1 + own**2)
    flat, slope_flat = (GAUSSIAN * float((v**2).mean() / v.mean() ** 2) for v in (var, slope_var))
    return flat, float(slope_var.mean() / var.mean()), slope_flat


@dataclass(frozen=True, kw_only=True)
class EnsembleSpec:
    """Parameters of an ensemble; the defaults are those of Table I."""

    segments: int = 300
    shortest_frames: int = 50
    mean_frames: float = 150.0  # shortest_frames plus an exponential number
    frame_rate_hz: float = 600.0
    velocity_rms: Three = (0.28, 0.40, 0.37)  # m/s, lab
    acceleration_rms: Three = (5.5, 5.6, 6.0)  # m/s^2, lab
    omega_rms: Three = (7.1, 8.2, 8.1)  # rad/s, components in `frame`
    alpha_rms: Three = (560.0, 560.0, 560.0)  # rad/s^2
    omega_flatness: float = 4.0
    alpha_flatness: float = 7.6
    frame: Literal["lab", "body"] = "lab"  # frame of independent components; in the other frame they are isotropic

    def omega_laws(self) -> list[Law]:
        """Return the laws of the omega components, rad/s, in `frame`."""
        pairs = zip(self.omega_rms, self.alpha_rms, strict=True)
        return [Law.of(rms, slope, self.omega_flatness, self.alpha_flatness) for rms, slope in pairs]


@dataclass(frozen=True, kw_only=True, eq=False)
class Nominal:
    """True rms and flatness of each component of a quantity, (3,) each."""

    rms: Floats
    flatness: Floats


def nominal(spec: EnsembleSpec) -> dict[str, Nominal]:
    """Return the true moments of every quantity in closed form.

    In the other frame directions are uniform: <(n x)^2> = |x|^2 / 3 and <(n x)^4> = |x|^4 / 5.
    """
    other = {"lab": "body", "body": "lab"}[spec.frame]
    out = {}
    for name, rms, flatness in (
        ("velocity", spec.velocity_rms, GAUSSIAN),
        ("acceleration", spec.acceleration_rms, GAUSSIAN),
        (f"omega_{spec.frame}", spec.omega_rms, spec.omega_flatness),
        (f"alpha_{spec.frame}", spec.alpha_rms, spec.alpha_flatness),
    ):
        out[name] = Nominal(rms=np.array(rms), flatness=np.full(3, flatness))
        if name.endswith(spec.frame):
            var = out[name].rms ** 2
            square = var.sum()
            fourth = flatness * (var**2).sum() + square**2 - (var**2).sum()
            out[f"{name[:5]}_{other}"] = Nominal(
                rms=np.full(3, math.sqrt(square / 3)), flatness=np.full(3, fourth / 5 / (square / 3) ** 2)
            )
    return out


def draw_ensemble(spec: EnsembleSpec, seed: int) -> Trajectory:
    """Draw segments of exponential random length, as a perfect measurement: all sigmas are zero.

    Orientations are exact to 1e-6 rad per segment.
    """
    rng = np.random.default_rng(seed)
    extra = rng.exponential(spec.mean_frames - spec.shortest_frames, spec.segments)
    frames = spec.shortest_frames + np.floor(extra).astype(np.int64)
    segment = np.repeat(np.arange(spec.segments), frames)
    start = np.concatenate([[0], np.cumsum(frames)[:-1]])
    since_s = (np.arange(len(segment)) - start[segment]) / spec.frame_rate_hz
    pairs = zip(spec.velocity_rms, spec.acceleration_rms, strict=True)
    moves = [Law.of(rms, slope).draw(spec.segments, rng) for rms, slope in pairs]
    turns = [law.draw(spec.segments, rng) for law in spec.omega_laws()]
    velocity, acceleration = _rates(moves, since_s, segment)
    omega, alpha = _rates(turns, since_s, segment)
    origin = rng.uniform(-BOX_MM, BOX_MM, (spec.segments, 3))
    path = np.stack([draw.integral(since_s, segment) for draw in moves], axis=1)
    R_start = so3.random_rotations(spec.segments, generator=torch.Generator().manual_seed(int(rng.integers(2**31))))
    R = _orientations(turns, frames, since_s, segment, R_start.numpy(), spec)
    to_other = R.swapaxes(1, 2) if spec.frame == "lab" else R
    seen = [np.asarray(np.einsum("nij,nj->ni", to_other, x)) for x in (omega, alpha)]
    lab, body = ((omega, alpha), seen) if spec.frame == "lab" else (seen, (omega, alpha))
    rates = {"velocity": velocity, "acceleration": acceleration}
    rates |= {"omega_lab": lab[0], "omega_body": body[0], "alpha_lab": lab[1], "alpha_body": body[1]}
    parts: dict[str, Any] = rates | {f"{name}_sigma": np.zeros((len(segment), 3)) for name in rates}
    time_s = (np.arange(len(segment)) + REST * segment) / spec.frame_rate_hz
    blank = Trajectory.empty(time_s, frame_rate=spec.frame_rate_hz, method="precise", experiment="synthetic")
    parts |= {"valid": np.ones(len(segment), dtype=bool), "segment": segment, "confidence": np.ones(len(segment))}
    position = origin[segment] + 1000 * path
    return replace(_posed(blank, position, R, 0.0, 0.0), position_smooth=position, orientation_smooth=R, **parts)


def _rates(draws: list[Draw], since_s: Floats, segment: Rows) -> tuple[Floats, Floats]:
    rate, slope = zip(*(draw.at(since_s, segment) for draw in draws), strict=True)
    return np.stack(rate, axis=1), np.stack(slope, axis=1)


def _orientations(
    turns: list[Draw], frames: Rows, since_s: Floats, segment: Rows, R_start: Floats, spec: EnsembleSpec
) -> Floats:
    """Integrate omega from random starts, all segments in parallel; return (M, 3, 3)."""
    h = 1 / spec.frame_rate_hz
    early, late = (_rates(turns, since_s + h * (0.5 + sign * math.sqrt(3) / 6), segment)[0] for sign in (-1, 1))
    # In the body frame, dR^T/dt = -[omega_body]x R^T: the same equation for the transpose.
    sign = 1.0 if spec.frame == "lab" else -1.0
    step = magnus_rotation(torch.from_numpy(sign * early), torch.from_numpy(sign * late), h).numpy()
    R = np.empty((len(segment), 3, 3))
    start = np.concatenate([[0], np.cumsum(frames)[:-1]])
    now = R_start if spec.frame == "lab" else R_start.swapaxes(1, 2)
    for k in range(int(frames.max())):
        alive = frames > k
        rows = start[alive] + k
        R[rows] = now[alive]
        now = now.copy()
        now[alive] = step[rows] @ now[alive]
    return R if spec.frame == "lab" else R.swapaxes(1, 2)


def smoothed_track(
    true: Trajectory,
    noise_deg: float,
    noise_mm: float,
    seed: int,
    known: motion.ProcessNoise | None = None,
    silent: bool = False,
) -> tuple[Trajectory, motion.ProcessNoise]:
    """Add white noise to an ensemble and smooth it; return the precise method's trajectory and the process noise.

    `known` is an earlier process noise, None estimates it. `silent` smooths exact data: the bias of smoothing alone.
    """
    track = _noisy(true, noise_deg, noise_mm, seed, "precise")
    if silent:
        track = replace(track, position=true.position, orientation=true.orientation)
    poses = motion.MeasuredPoses(
        time_s=torch.from_numpy(track.time),
        position_lab_mm=torch.from_numpy(track.position),
        position_cov_mm2=torch.from_numpy(track.position_cov),
        R_lab_body=torch.from_numpy(track.orientation),
        orientation_cov_rad2=torch.from_numpy(track.orientation_cov),
        segment=torch.from_numpy(track.segment),
    )
    found = motion.smooth_motion(poses, motion.SmoothSettings(), known)
    smooth = replace(
        track,
        **motion.datasets_of(found),
        flags=np.where(found.extrapolated.numpy(), np.uint32(Flag.EXTRAPOLATED), np.uint32(0)),
    )
    return smooth, found.process


def filtered_track(
    true: Trajectory, noise_deg: float, noise_mm: float, seed: int, settings: motion.MotionSettings | None = None
) -> Trajectory:
    """Add white noise to an ensemble and differentiate with Gaussian kernels; return the paper method's trajectory.

    The kernels' low-pass bias stays in. `noise_deg` and `noise_mm` are standard deviations per component; `settings`
    holds the kernel widths, None for the paper's.
    """
    track = _noisy(true, noise_deg, noise_mm, seed, "paper")
    sigma_mm, sigma_rad = (torch.full((len(track),), x) for x in (noise_mm, math.radians(noise_deg)))
    found = motion.measure_motion(
        torch.from_numpy(track.position),
        torch.from_numpy(track.orientation),
        torch.from_numpy(track.segment),
        true.frame_rate,
        settings or motion.MotionSettings(),
        (sigma_mm.double(), sigma_rad.double()),
    )
    return replace(track, **motion.datasets_of(found))


def _noisy(true: Trajectory, noise_deg: float, noise_mm: float, seed: int, method: str) -> Trajectory:
    rng = np.random.default_rng([seed, 1])
    noise_rad = math.radians(noise_deg)
    delta = torch.from_numpy(noise_rad * rng.standard_normal(true.position.shape))
    R = (so3.exp(delta) @ torch.from_numpy(true.orientation)).numpy()
    position = true.position + noise_mm * rng.standard_normal(true.position.shape)
    return _posed(replace(true, method=method), position, R, noise_mm, noise_rad)


def _posed(track: Trajectory, position_mm: Floats, R: Floats, noise_mm: float, noise_rad: float) -> Trajectory:
    cov_mm2, cov_rad2 = (np.tile(noise**2 * np.eye(3), (len(track), 1, 1)) for noise in (noise_mm, noise_rad))
    return replace(track, position=position_mm, position_cov=cov_mm2, orientation=R, orientation_cov=cov_rad2)
