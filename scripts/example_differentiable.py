"""Recover a camera's angle and a spot of wrong paint from a movie by gradient descent; draw docs/differentiable.png.

    scripts/example_differentiable.py [--steps 80] [--out docs/differentiable.png]

Ten frames of two cameras are rendered by synth (bilinear paint, nine rays a pixel, optics, noise, 8 bits). The second
camera is then told 0.3 degrees turned, and the map has black and white exchanged within 20 degrees of one point. Each
step fits four candidates a frame (each camera by itself, from near and from 60 degrees away), weighs them by the soft
path, compares both pictures with the expected pose, and goes down the gradient in the camera's rotation and in all
texels of the map. docs/differentiable.md walks through it.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import PinholeCamera, Rays
from sphereorient.cameras.parameters import ROTATION, with_parameters
from sphereorient.differentiable import SoftTrack, soft_track
from sphereorient.orient.implicit import ImplicitPose, implicit_pose
from sphereorient.orient.soft_picture import PaintedBall, expected_grey
from sphereorient.synth import random_texture
from sphereorient.synth.scene import LAMPS, make_scene, render_frame
from sphereorient.synth.settings import SynthSettings
from sphereorient.synth.textures import map_directions

mpl.use("Agg")
import matplotlib.pyplot as plt

REPO = Path(__file__).resolve().parents[1]
FRAMES, MAP_HEIGHT = 10, 32
SCENE = SynthSettings(diameter_px=60.0, image_size=(74, 74), blur_px=1.0, read_noise=2.0)
NOISE, RIM_NOISE = 3.5, 15.0  # grey levels; near the limb the paint is squeezed together, and the model too simple
RIM = (0.85, 1.05)  # radii
TOLD_WRONG_DEG = (0.12, 0.25, -0.11)  # of the second camera, about its own x, y, z: 0.3 in all
SPOT_AT, SPOT_DEG = (0.2, -0.9, 0.4), 20.0  # body; in sight of both cameras in many frames
TURN_DEG = (3.0, -2.0, 7.0)  # from frame to frame, lab
EVERY_PX = 2  # every second pixel across and down is compared
PLACE_MM = 0.05  # standard deviation of the place that both cameras together gave
LOOKS = ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 1, 0], [0, 0, -1], [-1, 0, 0]])  # along lab +y, along lab -x
UNIT_DEG = 2.0
OWN = (0, 1, 0, 1)  # which camera each candidate of a frame is fitted to


def f64(value: object) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Movie:
    """What was filmed, and how it really was."""

    grey: Tensor  # (N, 2, P), grey levels of the pixels compared
    noise: Tensor  # (N, 2, P), grey levels, by which the model may miss them
    uv_px: Tensor  # (P, 2), which these are
    cameras: tuple[PinholeCamera, PinholeCamera]  # true
    texture: Tensor  # (H, 2 H), true
    R_lab_body: Tensor  # (N, 3, 3), true
    position_lab_mm: Tensor  # (N, 3), true


def film() -> Movie:
    """Render the movie."""
    rng, noise = torch.Generator().manual_seed(4), np.random.default_rng(4)
    focal = SCENE.diameter_px / SCENE.diameter_mm * SCENE.distance_mm
    middle = [0.5 * (side - 1) for side in SCENE.image_size]
    cameras = tuple(
        PinholeCamera(
            image_size=SCENE.image_size,
            R_cam_lab=f64(look),
            T_cam_lab_mm=f64([0.0, 0.0, SCENE.distance_mm]),
            centre_px=f64(middle),
            f_px=f64(focal),
        )
        for look in LOOKS
    )
    texture = random_texture("blobs", 3, MAP_HEIGHT).double()
    turn = torch.deg2rad(f64(TURN_DEG))
    R = so3.exp(torch.arange(FRAMES, dtype=torch.float64)[:, None] * turn) @ so3.exp(f64([0.4, -0.8, 0.5]))
    position = torch.randn(FRAMES, 3, generator=rng, dtype=torch.float64).clamp(-1.0, 1.0)
    scene = make_scene(texture.float(), SCENE)
    pictures = [
        [render_frame(scene, camera, x[None], r[None], noise) for camera in cameras]
        for x, r in zip(position, R, strict=True)
    ]
    v, u = torch.meshgrid(*(torch.arange(0, side, EVERY_PX) for side in SCENE.image_size[::-1]), indexing="ij")
    grey = torch.from_numpy(np.array(pictures))[:, :, v, u].flatten(2).double()
    uv_px = torch.stack([u, v], dim=-1).reshape(-1, 2).double()
    middle_px = torch.stack([camera.project(position) for camera in cameras], dim=1)
    radii = (uv_px - middle_px[:, :, None]).norm(dim=-1) / (SCENE.diameter_px / 2)
    return Movie(
        grey=grey,
        noise=torch.where((radii > RIM[0]) & (radii < RIM[1]), RIM_NOISE, NOISE).double(),
        uv_px=uv_px,
        cameras=(cameras[0], cameras[1]),
        texture=texture,
        R_lab_body=R,
        position_lab_mm=position,
    )


def ball_of(texture: Tensor) -> PaintedBall:
    """Describe synth's ball and lamps to the model."""
    lamps = f64(LAMPS)
    towards = lamps[:, :3] / lamps[:, :3].norm(dim=-1, keepdim=True)
    edge_px = math.hypot(SCENE.blur_px, math.sqrt(1 / 12))
    return PaintedBall(
        texture=texture,
        radius_mm=SCENE.diameter_mm / 2,
        edge_mm=edge_px * SCENE.diameter_mm / SCENE.diameter_px,
        ambient=f64(SCENE.ambient),
        lamps_lab=towards * lamps[:, 3:] * ((1 - SCENE.ambient) / 0.75),
        black=f64(SCENE.black),
        white=f64(SCENE.white),
        behind=f64(SCENE.background),
    )


def sight_lines(movie: Movie, cameras: tuple[PinholeCamera, PinholeCamera]) -> Rays:
    """Lines of sight of all pixels compared, (2, P, 3)."""
    both = [camera.rays(movie.uv_px) for camera in cameras]
    return Rays(
        origin_lab_mm=torch.stack([rays.origin_lab_mm for rays in both]),
        direction_lab=torch.stack([rays.direction_lab for rays in both]),
    )


def misfit(movie: Movie, sight: Rays, ball: PaintedBall, position_lab_mm: Tensor, R_lab_body: Tensor) -> Tensor:
    """Residuals of both pictures at poses (N, ...), in units of the noise, (N, 2, P)."""
    return (expected_grey(sight, position_lab_mm[:, None], R_lab_body[:, None], ball) - movie.grey) / movie.noise


def fit_candidates(
    movie: Movie, sight: Rays, ball: PaintedBall, start: tuple[Tensor, Tensor], place: Tensor, iterations: int
) -> ImplicitPose:
    """Fit every candidate (N * C) to its own camera's pictures, and to the place within its error."""
    own = torch.tensor(OWN)
    rays = Rays(origin_lab_mm=sight.origin_lab_mm[own], direction_lab=sight.direction_lab[own])
    seen, noise, known = movie.grey[:, own], movie.noise[:, own], place[:, None]

    def residual(R_lab_body: Tensor, position_lab_mm: Tensor) -> Tensor:
        R, X = R_lab_body.unflatten(0, seen.shape[:2]), position_lab_mm.unflatten(0, seen.shape[:2])
        picture = (expected_grey(rays, X, R, ball) - seen) / noise
        return torch.cat([picture, (X - known) / PLACE_MM], dim=-1).flatten(0, 1)

    return implicit_pose(residual, start[0], start[1], iterations=iterations)


def track_of(movie: Movie, fitted: ImplicitPose) -> SoftTrack:
    """Weigh the candidates: half the mean squared residual each, and the turns between the frames."""
    shape = (FRAMES, len(OWN))
    pixels = movie.grey.shape[-1]
    return soft_track(
        fitted.R_lab_body.unflatten(0, shape),
        fitted.position_lab_mm.unflatten(0, shape),
        (fitted.cost / pixels).unflatten(0, shape),
        fitted.arrived.unflatten(0, shape),
        turn_rad=math.radians(15),
        temperature=0.2,
    )


def starts(movie: Movie, sight: Rays, ball: PaintedBall) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Return where the candidates begin, as a search would leave them, and the places that both cameras give."""
    rng = torch.Generator().manual_seed(5)

    def off(degrees: float) -> Tensor:
        axis = torch.nn.functional.normalize(torch.randn(FRAMES, 3, generator=rng, dtype=torch.float64), dim=-1)
        return so3.exp(math.radians(degrees) * axis) @ movie.R_lab_body

    near = off(1.5)
    rough = movie.position_lab_mm + 0.2 * torch.randn(FRAMES, 3, generator=rng, dtype=torch.float64)
    with torch.no_grad():
        joint = implicit_pose(lambda R, X: misfit(movie, sight, ball, X, R).flatten(1), near, rough)
    place = joint.position_lab_mm
    R = torch.stack([near, near, off(60.0), off(60.0)], dim=1).flatten(0, 1)
    return (R, place.repeat_interleave(len(OWN), 0)), place


def picture_loss(movie: Movie, sight: Rays, ball: PaintedBall, track: SoftTrack) -> Tensor:
    """Half the mean squared residual of both cameras' pictures at the expected poses; lost frames left out."""
    there = track.marginals.detach().sum(-1) > 0
    seen = replace(movie, grey=movie.grey[there], noise=movie.noise[there])
    r = misfit(seen, sight, ball, track.position_lab_mm[there], track.R_lab_body[there])
    return 0.5 * r.square().mean()


class Descent:
    """What is known of the second camera and of the paint, and the loss of it; each call goes on from the last fit."""

    def __init__(self, movie: Movie) -> None:
        self.movie = movie
        at = map_directions(MAP_HEIGHT) @ torch.nn.functional.normalize(f64(SPOT_AT), dim=0)
        self.spot = at > math.cos(math.radians(SPOT_DEG))
        self.texture = torch.where(self.spot, 1.0 - movie.texture, movie.texture).requires_grad_()
        # Of the second camera, on top of the truth, so it must become 0; in units in which a step is like a texel's.
        self.turn = (f64(TOLD_WRONG_DEG) / UNIT_DEG).requires_grad_()
        self.start: tuple[Tensor, Tensor] | None = None
        self.place = movie.position_lab_mm
        self.seen: list[tuple[float, float, float, float]] = []  # loss, degrees, texels, degrees of the track

    def loss(self) -> Tensor:
        """Fit, weigh, compare."""
        movie = self.movie
        told = with_parameters(movie.cameras[1], ROTATION, torch.deg2rad(UNIT_DEG * self.turn))
        sight, ball = sight_lines(movie, (movie.cameras[0], told)), ball_of(self.texture)
        iterations = 8 if self.start else 30
        if self.start is None:
            self.start, self.place = starts(movie, sight, ball)
        fitted = fit_candidates(movie, sight, ball, self.start, self.place, iterations)
        self.start = fitted.R_lab_body.detach(), fitted.position_lab_mm.detach()
        track = track_of(movie, fitted)
        loss = picture_loss(movie, sight, ball, track)
        self._note(loss.detach(), track)
        return loss

    def _note(self, loss: Tensor, track: SoftTrack) -> None:
        turn_deg = UNIT_DEG * self.turn.detach().norm()
        texel = (self.texture.detach() - self.movie.texture)[self.spot].square().mean().sqrt()
        wrong = torch.rad2deg(so3.geodesic_distance(track.R_lab_body.detach(), self.movie.R_lab_body))
        rms = wrong[wrong.isfinite()].square().mean().sqrt()
        self.seen.append((float(loss), float(turn_deg), float(texel), float(rms)))


def recover(steps: int = 40) -> Descent:
    """Go down the gradient: L-BFGS, which asks for nothing but losses and gradients."""
    descent = Descent(film())
    optimiser = torch.optim.LBFGS(
        [descent.texture, descent.turn],
        max_iter=steps,
        max_eval=steps,
        history_size=20,
        tolerance_change=0.0,
        line_search_fn="strong_wolfe",
    )

    def closure() -> Tensor:
        optimiser.zero_grad()
        loss = descent.loss()
        loss.backward()
        return loss.detach()

    optimiser.step(closure)
    return descent
