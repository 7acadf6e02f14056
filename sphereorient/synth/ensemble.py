"""Ensembles of six-dimensional tracks without pictures, whose true statistics are those of the paper's Table I."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.synth.intermittent import Draw, Law

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Three = tuple[float, float, float]

REST = 10  # steps between the end of a segment and the start of the next
BOX_MM = 40.0  # segments start within this distance of the origin, by component


@dataclass(frozen=True, kw_only=True)
class EnsembleSpec:
    """What an ensemble is like; the defaults are Table I's. Components in `frame` are independent."""

    segments: int = 300
    shortest_frames: int = 50
    mean_frames: float = 150.0  # shortest_frames plus an exponentially distributed number
    frame_rate_hz: float = 600.0
    velocity_rms: Three = (0.28, 0.40, 0.37)  # m/s, lab
    acceleration_rms: Three = (5.5, 5.6, 6.0)  # m/s^2, lab
    omega_rms: Three = (7.1, 8.2, 8.1)  # rad/s, components in `frame`
    alpha_rms: Three = (560.0, 560.0, 560.0)  # rad/s^2
    omega_flatness: float = 4.0
    alpha_flatness: float = 7.6
    frame: Literal["lab", "body"] = "lab"  # where omega's components are independent; in the other they are isotropic

    def velocity_laws(self) -> list[Law]:
        """Return the laws of the velocity's components, Gaussian ones."""
        return [Law.of(rms, slope) for rms, slope in zip(self.velocity_rms, self.acceleration_rms, strict=True)]

    def omega_laws(self) -> list[Law]:
        """Return the laws of omega's components in `frame`."""
        pairs = zip(self.omega_rms, self.alpha_rms, strict=True)
        return [Law.of(rms, slope, self.omega_flatness, self.alpha_flatness) for rms, slope in pairs]


@dataclass(frozen=True, kw_only=True, eq=False)
class Nominal:
    """True rms and flatness of each component of a quantity, (3,) each."""

    rms: Floats
    flatness: Floats


def nominal(spec: EnsembleSpec) -> dict[str, Nominal]:
    """Return the true moments of every quantity, closed forms.

    In the frame where the components are not independent, the vector points anywhere alike: with R uniform and
    independent of it, <(n x)^2> = |x|^2 / 3 and <(n x)^4> = |x|^4 / 5.
    """
    turning, other = spec.frame, {"lab": "body", "body": "lab"}[spec.frame]
    out = {
        "velocity": _law(spec.velocity_rms, 3.0),
        "acceleration": _law(spec.acceleration_rms, 3.0),
        f"omega_{turning}": _law(spec.omega_rms, spec.omega_flatness),
        f"alpha_{turning}": _law(spec.alpha_rms, spec.alpha_flatness),
    }
    return out | {f"{name}_{other}": _turned(out[f"{name}_{turning}"]) for name in ("omega", "alpha")}


def _law(rms: Three, flatness: float) -> Nominal:
    return Nominal(rms=np.array(rms), flatness=np.full(3, flatness))


def _turned(x: Nominal) -> Nominal:
    """Return the moments of a vector seen from a frame that points anywhere alike."""
    var = x.rms**2
    square = var.sum()
    fourth = (x.flatness * var**2).sum() + square**2 - (var**2).sum()
    return Nominal(rms=np.full(3, math.sqrt(square / 3)), flatness=np.full(3, fourth / 5 / (square / 3) ** 2))


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueTracks:
    """Exact motion at M frames of S segments; made by `draw_ensemble`."""

    spec: EnsembleSpec
    time_s: Floats  # (M,)
    segment: Rows  # (M,)
    position_mm: Floats  # (M, 3)
    R_lab_body: Floats  # (M, 3, 3)
    velocity: Floats  # (M, 3), m/s
    acceleration: Floats  # m/s^2
    omega_lab: Floats  # rad/s
    omega_body: Floats
    alpha_lab: Floats  # rad/s^2
    alpha_body: Floats


def draw_ensemble(spec: EnsembleSpec, seed: int) -> TrueTracks:
    """Draw independent segments with exponentially distributed durations.

    Args:
        spec: what they are like.
        seed: same seed, same ensemble.

    Returns:
        The motion without noise; orientations by a fourth-order Magnus step per frame, exact to 1e-6 rad per segment.
    """
    rng = np.random.default_rng(seed)
    extra = rng.exponential(spec.mean_frames - spec.shortest_frames, spec.segments)
    frames = spec.shortest_frames + np.floor(extra).astype(np.int64)
    segment = np.repeat(np.arange(spec.segments), frames)
    start = np.concatenate([[0], np.cumsum(frames)[:-1]])
    since_s = (np.arange(len(segment)) - start[segment]) / spec.frame_rate_hz
    moves = [law.draw(spec.segments, rng) for law in spec.velocity_laws()]
    turns = [law.draw(spec.segments, rng) for law in spec.omega_laws()]
    velocity, acceleration = _rates(moves, since_s, segment)
    omega, alpha = _rates(turns, since_s, segment)
    origin = rng.uniform(-BOX_MM, BOX_MM, (spec.segments, 3))
    path = np.stack([draw.integral(since_s, segment) for draw in moves], axis=1)
    R_start = so3.random_rotations(spec.segments, generator=torch.Generator().manual_seed(int(rng.integers(2**31))))
    R = _orientations(turns, frames, since_s, segment, R_start.numpy(), spec)
    by_frame = {spec.frame: (omega, alpha)}
    if spec.frame == "lab":
        by_frame["body"] = _seen(R.swapaxes(1, 2), omega), _seen(R.swapaxes(1, 2), alpha)
    else:
        by_frame["lab"] = _seen(R, omega), _seen(R, alpha)
    return TrueTracks(
        spec=spec,
        time_s=(np.arange(len(segment)) + REST * segment) / spec.frame_rate_hz,
        segment=segment,
        position_mm=origin[segment] + 1000 * path,
        R_lab_body=R,
        velocity=velocity,
        acceleration=acceleration,
        omega_lab=by_frame["lab"][0],
        omega_body=by_frame["body"][0],
        alpha_lab=by_frame["lab"][1],
        alpha_body=by_frame["body"][1],
    )


def _seen(R: Floats, x: Floats) -> Floats:
    return np.asarray(np.einsum("nij,nj->ni", R, x))


def _rates(draws: list[Draw], since_s: Floats, segment: Rows) -> tuple[Floats, Floats]:
    """Return the rates and their derivatives, (M, 3) each."""
    rate, slope = zip(*(draw.at(since_s, segment) for draw in draws), strict=True)
    return np.stack(rate, axis=1), np.stack(slope, axis=1)


def _orientations(
    turns: list[Draw], frames: Rows, since_s: Floats, segment: Rows, R_start: Floats, spec: EnsembleSpec
) -> Floats:
    """Integrate omega from random starts, all segments side by side.

    Source: Magnus expansion of fourth order at the two Gauss nodes (Iserles and Norsett 1999).
    """
    h = 1 / spec.frame_rate_hz
    early, late = (_rates(turns, since_s + h * (0.5 + sign * math.sqrt(3) / 6), segment)[0] for sign in (-1, 1))
    # in the body dR^T/dt = -[omega_body]x R^T: the same equation for the transpose
    sign = 1.0 if spec.frame == "lab" else -1.0
    twist = sign * h * (early + late) / 2 - math.sqrt(3) / 12 * h**2 * np.cross(early, late)
    step = so3.exp(torch.from_numpy(twist)).numpy()
    R = np.empty((len(segment), 3, 3))
    start = np.concatenate([[0], np.cumsum(frames)[:-1]])
    now = R_start if spec.frame == "lab" else R_start.swapaxes(1, 2)
    for k in range(int(frames.max())):  # a product in order: nothing to batch but the segments
        alive = frames > k
        rows = start[alive] + k
        R[rows] = now[alive]
        now = now.copy()
        now[alive] = step[rows] @ now[alive]
    return R if spec.frame == "lab" else R.swapaxes(1, 2)
