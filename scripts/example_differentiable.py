"""Recover a camera's angle and a spot of wrong paint from a movie by gradient descent; draw docs/differentiable.png.

    scripts/example_differentiable.py [--steps 30] [--out docs/differentiable.png]

Sixteen frames of two cameras are rendered by synth (bilinear paint, nine rays a pixel, optics, noise, 8 bits). The
given second camera is rotated by 0.3 degrees; the given map has black and white exchanged within 20 degrees of a point.
Each evaluation fits four candidates a frame (each camera by itself, from near and from 60 degrees away), weights them
by the soft path, and compares both pictures with the expected pose. L-BFGS minimises the loss over the camera's
rotation and the texels within 35 degrees of that point. docs/differentiable.md explains the steps.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble import SoftTrack, soft_track
from sphereorient.cameras import PinholeCamera, Rays, triangulate
from sphereorient.cameras.parameters import ROTATION, with_parameters
from sphereorient.pose.implicit import ImplicitPose, implicit_pose
from sphereorient.sphere.renderer import PaintedBall, expected_grey
from sphereorient.sphere.texture import map_directions
from sphereorient.synth import random_texture
from sphereorient.synth.scene import LAMPS, make_scene, render_frame, seeded
from sphereorient.synth.settings import SynthSettings

mpl.use("Agg")
import matplotlib.pyplot as plt

REPO = Path(__file__).resolve().parents[1]
FRAMES, MAP_HEIGHT = 16, 32
SCENE = SynthSettings(diameter_px=60.0, image_size=(74, 74), blur_px=1.0, read_noise=2.0)
NOISE, RIM_NOISE = 3.5, 15.0  # grey levels; near the limb the paint is foreshortened, and the model too simple
RIM = (0.85, 1.05)  # radii
GIVEN_WRONG_DEG = (0.12, 0.25, -0.11)  # of the second camera, about its own x, y, z: 0.3 in all
SPOT_AT, SPOT_DEG = (0.2, -0.9, 0.4), 20.0  # body; where the map is wrong
DOUBT_DEG = 35.0  # texels within it of that point are free; the others fix the body frame
UNIT_DEG = 1.0  # of the angles in the descent: makes the loss about as curved along them as along texels
TURN_DEG = (3.0, -2.0, 7.0)  # from frame to frame, lab
EVERY_PX = 2  # every second pixel across and down is compared
OUTLINE_PX, PLACE_MM = 0.03, 0.01  # standard deviations of located centres, and of the position from them
LOOKS = ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 1, 0], [0, 0, -1], [-1, 0, 0]])  # along lab +y, along lab -x
OWN = (0, 1, 0, 1)  # which camera each candidate of a frame is fitted to


def f64(value: object) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Movie:
    """The pictures and their truth."""

    grey: Tensor  # (N, 2, P), grey levels of the pixels compared
    noise: Tensor  # (N, 2, P), grey levels, standard deviation of the residuals
    uv_px: Tensor  # (P, 2), these pixels
    middle_px: Tensor  # (2, N, 2), centres of the outlines
    cameras: tuple[PinholeCamera, PinholeCamera]  # true
    texture: Tensor  # (H, 2 H), true
    R_lab_body: Tensor  # (N, 3, 3), true
    position_lab_mm: Tensor  # (N, 3), true


def film() -> Movie:
    """Render the movie."""
    rng, noise = torch.Generator().manual_seed(4), seeded(4)
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
    middle_px = torch.stack([camera.project(position) for camera in cameras])
    middle_px = middle_px + OUTLINE_PX * torch.randn(middle_px.shape, generator=rng, dtype=torch.float64)
    radii = (uv_px - middle_px.movedim(0, 1)[:, :, None]).norm(dim=-1) / (SCENE.diameter_px / 2)
    return Movie(
        grey=grey,
        noise=torch.where((radii > RIM[0]) & (radii < RIM[1]), RIM_NOISE, NOISE).double(),
        uv_px=uv_px,
        middle_px=middle_px,
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
    """Return the lines of sight of all pixels compared, (2, P, 3)."""
    both = [camera.rays(movie.uv_px) for camera in cameras]
    return Rays(
        origin_lab_mm=torch.stack([rays.origin_lab_mm for rays in both]),
        direction_lab=torch.stack([rays.direction_lab for rays in both]),
    )


def located(movie: Movie, cameras: tuple[PinholeCamera, PinholeCamera]) -> Tensor:
    """Return positions (N, 3), lab, mm, from the ball's outlines."""
    first, second = (camera.rays(uv_px) for camera, uv_px in zip(cameras, movie.middle_px, strict=True))
    return triangulate(first, second)[0]


def misfit(movie: Movie, sight: Rays, ball: PaintedBall, position_lab_mm: Tensor, R_lab_body: Tensor) -> Tensor:
    """Return residuals of both pictures at poses (N, ...), in units of the noise, (N, 2, P)."""
    return (expected_grey(sight, position_lab_mm[:, None], R_lab_body[:, None], ball) - movie.grey) / movie.noise


def fit_candidates(
    movie: Movie, sight: Rays, ball: PaintedBall, start: tuple[Tensor, Tensor], place: Tensor, iterations: int
) -> ImplicitPose:
    """Fit every candidate (N * C) to its own camera's pictures, and to the position within its error."""
    own = torch.tensor(OWN)
    rays = Rays(origin_lab_mm=sight.origin_lab_mm[own], direction_lab=sight.direction_lab[own])
    seen, noise, known = movie.grey[:, own], movie.noise[:, own], place[:, None]

    def residual(R_lab_body: Tensor, position_lab_mm: Tensor) -> Tensor:
        R, X = R_lab_body.unflatten(0, seen.shape[:2]), position_lab_mm.unflatten(0, seen.shape[:2])
        picture = (expected_grey(rays, X, R, ball) - seen) / noise
        return torch.cat([picture, (X - known) / PLACE_MM], dim=-1).flatten(0, 1)

    return implicit_pose(residual, start[0], start[1], iterations=iterations)


def track_of(movie: Movie, fitted: ImplicitPose) -> SoftTrack:
    """Weight the candidates by half their mean squared residual and by the rotations between frames."""
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


def starts(movie: Movie) -> tuple[Tensor, Tensor]:
    """Return starts of the candidates as a search would give them: 1.5 and 60 degrees off."""
    rng = torch.Generator().manual_seed(5)

    def off(degrees: float) -> Tensor:
        axis = torch.nn.functional.normalize(torch.randn(FRAMES, 3, generator=rng, dtype=torch.float64), dim=-1)
        return so3.exp(math.radians(degrees) * axis) @ movie.R_lab_body

    R = torch.stack([off(1.5), off(1.5), off(60.0), off(60.0)], dim=1).flatten(0, 1)
    return R, located(movie, movie.cameras).repeat_interleave(len(OWN), 0)


def picture_loss(movie: Movie, sight: Rays, ball: PaintedBall, track: SoftTrack) -> Tensor:
    """Return half the mean squared residual of both cameras' pictures at the expected poses, without lost frames."""
    there = track.marginals.detach().sum(-1) > 0
    seen = replace(movie, grey=movie.grey[there], noise=movie.noise[there])
    r = misfit(seen, sight, ball, track.position_lab_mm[there], track.R_lab_body[there])
    return 0.5 * r.square().mean()


class Descent:
    """Estimate of the second camera and of the paint, and its loss; each call starts from the last fit."""

    def __init__(self, movie: Movie) -> None:
        self.movie = movie
        away = map_directions(MAP_HEIGHT) @ torch.nn.functional.normalize(f64(SPOT_AT), dim=0)
        self.spot, self.doubt = (away > math.cos(math.radians(degrees)) for degrees in (SPOT_DEG, DOUBT_DEG))
        self.given = torch.where(self.spot, 1.0 - movie.texture, movie.texture)
        self.texels = self.given[self.doubt].requires_grad_()
        # Error of the second camera's rotation: converges to 0.
        self.turn = (f64(GIVEN_WRONG_DEG) / UNIT_DEG).requires_grad_()
        self.start, self.iterations = starts(movie), 30
        self.seen: list[tuple[float, float, float, float]] = []  # loss, degrees, texels, degrees of the track

    @property
    def texture(self) -> Tensor:
        """Return the estimated map (H, 2 H)."""
        return self.given.masked_scatter(self.doubt, self.texels)

    def loss(self) -> Tensor:
        """Return the loss: fit, weight, compare."""
        movie = self.movie
        given = with_parameters(movie.cameras[1], ROTATION, torch.deg2rad(UNIT_DEG * self.turn))
        sight, ball = sight_lines(movie, (movie.cameras[0], given)), ball_of(self.texture)
        place = located(movie, (movie.cameras[0], given))
        fitted = fit_candidates(movie, sight, ball, self.start, place, self.iterations)
        self.start, self.iterations = (fitted.R_lab_body.detach(), fitted.position_lab_mm.detach()), 8
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


def recover(steps: int = 30) -> Descent:
    """Minimise the loss by L-BFGS."""
    descent = Descent(film())
    optimiser = torch.optim.LBFGS(
        [descent.texels, descent.turn],
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


def draw(descent: Descent, out: Path) -> None:
    """Draw loss, angle and paint by evaluation, and the given, recovered and true map."""
    loss, angle_deg, texels, _ = (np.array(column) for column in zip(*descent.seen, strict=True))
    figure = plt.figure(figsize=(11, 6.4), layout="constrained")
    grid = figure.add_gridspec(2, 3)
    curves = (
        (loss, "half the mean squared residual,\nin units of the noise", True),
        (angle_deg, "error of the second camera's\nrotation, degrees", False),
        (texels, "error of the spot's texels, rms\n(1: black for white)", False),
    )
    for k, (curve, label, logarithmic) in enumerate(curves):
        axes = figure.add_subplot(grid[0, k])
        axes.plot(curve, "-", marker=".", color="C0")
        axes.set(xlabel="evaluations of loss and gradient", ylabel=label)
        if logarithmic:
            axes.set_yscale("log")
            axes.set_yticks([0.5, 1, 2, 5], labels=["0.5", "1", "2", "5"])
            axes.minorticks_off()
        else:
            axes.set_ylim(0, 1.15 * curve.max())
        axes.grid(alpha=0.3)
    maps = (descent.given, descent.texture.detach(), descent.movie.texture)
    for k, (texture, title) in enumerate(zip(maps, ("map as given", "map recovered", "true map"), strict=True)):
        axes = figure.add_subplot(grid[1, k])
        axes.imshow(texture, cmap="gray", vmin=0, vmax=1, extent=(-180, 180, -90, 90))
        for area, color in ((descent.spot, "C3"), (descent.doubt, "C1")):
            axes.contour(np.linspace(-177.2, 177.2, 64), np.linspace(87.2, -87.2, 32), area, [0.5], colors=color)
        axes.set(title=title, xlabel="longitude, degrees", ylabel="latitude, degrees")
        axes.set(xlim=(-160, 10), ylim=(-40, 80), xticks=range(-150, 1, 50), yticks=range(-30, 61, 30))
    figure.savefig(out, dpi=110)
    plt.close(figure)


def main() -> None:
    """Read the options, recover, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=30, help="evaluations of loss and gradient")
    parser.add_argument("--out", type=Path, default=REPO / "docs" / "differentiable.png")
    options = parser.parse_args()
    began = time.monotonic()
    descent = recover(options.steps)
    for name, (loss, angle_deg, texels, track_deg) in (("before", descent.seen[0]), ("after", descent.seen[-1])):
        print(
            f"{name:7} loss {loss:.3f}  camera {angle_deg:.3f} degrees off  "
            f"spot {texels:.3f} rms  track {track_deg:.3f} degrees rms"
        )
    print(f"{len(descent.seen)} evaluations in {time.monotonic() - began:.0f} s")
    draw(descent, options.out)


if __name__ == "__main__":
    main()
