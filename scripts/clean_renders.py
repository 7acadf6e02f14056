"""Compare the refinement with the Cramér-Rao bound on clean renders: 80 px, 5 % noise, three paints, random attitudes.

    scripts/clean_renders.py [--count 200] [--experiment FOLDER]

Exact perspective of a near camera, the ball anywhere in the picture, even light, no rounding. Each fit starts about 2
degrees, 0.5 px and 0.5 px of radius off the truth. The bound is computed for the same attitudes in the same run, light
known, from far away. Prints Markdown, one row per paint: rms errors and their ratios to the bound.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import PinholeCamera, R_cam_view
from sphereorient.locate import Background
from sphereorient.pose.camera_view import CameraView, Optics, base_table
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.lights.disk import DiskLight
from sphereorient.pose.pixels import LinesOfSight
from sphereorient.pose.poses import PoseStart
from sphereorient.sphere import Sampling, SphereRenderer, load_texture
from sphereorient.synth import random_texture
from sphereorient.tools.design.bound import Bound, cramer_rao_bound

START_RAD, START_PX = math.radians(1.2), 0.35  # standard deviation of each component of the starts' errors
FITTED_AT_ONCE = 20


DIAMETER_PX, DIAMETER_MM, DISTANCE_MM = 80.0, 18.0, 260.0  # near, so that perspective counts
BLACK, WHITE, NOISE_SHARE, SIGMA_PX = 40.0, 200.0, 0.05, 0.55  # grey levels; noise over their step; optics


@dataclass(frozen=True, kw_only=True, eq=False)
class CleanSet:
    """N pictures of a ball at random positions in random attitudes, with the truth."""

    pictures: Tensor  # (N, H, W) float32, grey levels, not rounded
    camera: PinholeCamera
    R_lab_body: Tensor  # (N, 3, 3) float64
    position_lab_mm: Tensor  # (N, 3) float64


@dataclass(frozen=True, kw_only=True, eq=False)
class Poses:
    """Poses of N pictures: starts and estimates; the radius is in the distance from the camera."""

    R_lab_body: Tensor  # (N, 3, 3)
    position_lab_mm: Tensor  # (N, 3)


Estimator = Callable[[Tensor, CleanSet, Poses], Poses]  # of map, pictures and starts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200, help="pictures of each paint")
    parser.add_argument("--experiment", type=Path, help="folder with texture.png, for one more row")
    arguments = parser.parse_args()
    textures = {kind: random_texture(kind, seed) for seed, kind in enumerate(("blobs", "patches", "dots"), 1)}
    if arguments.experiment:
        textures["experiment's map"] = load_texture(arguments.experiment / "texture.png")
    print("| paint | orientation rms, degrees | bound | ratio | centre ratio | radius ratio | over 1 degree | s |")
    print("|---|---|---|---|---|---|---|---|")
    for name, texture in textures.items():
        print(row(name, texture, arguments.count, refined), flush=True)


def row(name: str, texture: Tensor, count: int, estimator: Estimator) -> str:
    """Render, fit, compare."""
    seen = clean_set(texture, count, 1)
    start = starts(seen, torch.Generator().manual_seed(2))
    begin = time.perf_counter()
    found = estimator(texture, seen, start)
    seconds = time.perf_counter() - begin
    bound = bound_of(texture, seen)
    orientation = so3.geodesic_distance(found.R_lab_body, seen.R_lab_body)
    centre_px, radius_px = place_errors(seen, found)
    want, got = root_mean(bound.orientation_rms_rad), root_mean(orientation)
    cells = [
        name,
        f"{math.degrees(got):.4f}",
        f"{math.degrees(want):.4f}",
        f"{got / want:.2f}",
        f"{root_mean(centre_px) / root_mean(bound.centre_rms_px):.2f}",
        f"{root_mean(radius_px) / root_mean(bound.radius_rms_px):.2f}",
        f"{int((orientation > math.radians(1)).sum())} of {count}",
        f"{seconds:.0f}",
    ]
    return "| " + " | ".join(cells) + " |"


def clean_set(texture: Tensor, count: int, seed: int) -> CleanSet:
    """Draw positions and attitudes and render them, the ball wholly inside a picture four times as wide."""
    rng = torch.Generator().manual_seed(seed)
    side = 4 * math.ceil(DIAMETER_PX)
    f_px = DIAMETER_PX / DIAMETER_MM * DISTANCE_MM
    camera = PinholeCamera(
        image_size=(side, side),
        R_cam_lab=torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64),
        T_cam_lab_mm=torch.tensor([0.0, 0.0, DISTANCE_MM], dtype=torch.float64),
        centre_px=torch.full((2,), 0.5 * (side - 1), dtype=torch.float64),
        f_px=torch.tensor(f_px, dtype=torch.float64),
    )
    # Off the axis the picture is a little longer than the diameter, and the blur needs room.
    reach_mm = (0.5 * side - 0.55 * DIAMETER_PX - 5 - 4 * SIGMA_PX) / f_px * DISTANCE_MM
    aside = reach_mm * (2 * torch.rand(count, 2, generator=rng, dtype=torch.float64) - 1)
    position = torch.stack([aside[:, 0], torch.zeros(count, dtype=torch.float64), aside[:, 1]], dim=-1)
    R = so3.random_rotations(count, generator=rng)
    render = SphereRenderer(texture, radius_mm=DIAMETER_MM / 2, camera=camera, sampling=Sampling(blur_px=SIGMA_PX))
    clean = torch.cat([render(r, x) for r, x in zip(R.split(8), position.split(8), strict=True)])
    pictures = (BLACK + (WHITE - BLACK) * clean).float()
    pictures = pictures + NOISE_SHARE * (WHITE - BLACK) * torch.randn(pictures.shape, generator=rng)
    return CleanSet(pictures=pictures, camera=camera, R_lab_body=R, position_lab_mm=position)


def starts(seen: CleanSet, rng: torch.Generator) -> Poses:
    """The truth with errors of rotation, centre and radius."""
    count = len(seen.R_lab_body)
    turn, shift = (torch.randn(count, 3, generator=rng, dtype=torch.float64) for _ in range(2))
    x_cam_mm = in_camera(seen, seen.position_lab_mm)
    depth_mm, f_px = x_cam_mm[:, 2], DIAMETER_PX / DIAMETER_MM * x_cam_mm[:, 2]
    aside_mm = START_PX * shift[:, :2] * (depth_mm / f_px)[:, None]
    # A radius too small by some pixels is a ball too far by the same share.
    farther_mm = START_PX * shift[:, 2] / (DIAMETER_PX / 2) * depth_mm
    error_cam_mm = torch.cat([aside_mm, farther_mm[:, None]], dim=-1)
    return Poses(
        R_lab_body=so3.exp(START_RAD * turn) @ seen.R_lab_body,
        position_lab_mm=seen.position_lab_mm + error_cam_mm @ seen.camera.R_cam_lab,
    )


def in_camera(seen: CleanSet, position_lab_mm: Tensor) -> Tensor:
    return position_lab_mm @ seen.camera.R_cam_lab.mT + seen.camera.T_cam_lab_mm


def place_errors(seen: CleanSet, found: Poses) -> tuple[Tensor, Tensor]:
    """Errors of centre and radius, px, (N,) each."""
    centre_px = (seen.camera.project(found.position_lab_mm) - seen.camera.project(seen.position_lab_mm)).norm(dim=-1)
    true_mm, found_mm = (in_camera(seen, each.position_lab_mm).norm(dim=-1) for each in (seen, found))
    return centre_px, (true_mm / found_mm - 1) * (DIAMETER_PX / 2)


def bound_of(texture: Tensor, seen: CleanSet) -> Bound:
    """Return the bound at the attitudes of the ball in the camera."""
    R_cam_body = seen.camera.R_cam_lab @ seen.R_lab_body
    R_view_body = R_cam_view(in_camera(seen, seen.position_lab_mm)).mT @ R_cam_body
    return cramer_rao_bound(
        texture,
        R_view_body.float(),
        diameter_px=DIAMETER_PX,
        noise_share=NOISE_SHARE,
        sampling=Sampling(blur_px=SIGMA_PX),
    )


def root_mean(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


def refined(texture: Tensor, seen: CleanSet, start: Poses) -> Poses:
    """Refine as the project does: two widths of detail, light and noise learnt from the fits, the finest once more."""
    step = WHITE - BLACK
    noise = NOISE_SHARE * step
    width, height = seen.camera.image_size
    behind = np.full((height, width), BLACK, np.float32)
    view = CameraView(
        name="cam1",
        camera=seen.camera,
        background=Background(mean=behind, noise=np.full_like(behind, noise), full_scale=255.0),
        diameter_px=DIAMETER_PX,
        sight=LinesOfSight(seen.camera),
    )
    fitter = Fitter(
        views=[view],
        radius_mm=DIAMETER_MM / 2,
        optics=Optics(base_table(texture, DIAMETER_PX), math.hypot(SIGMA_PX, math.sqrt(1 / 12)), DIAMETER_PX),
        light=DiskLight.unknown(1, torch.tensor([[noise**2, 0.0, 0.0, 0.0]])),
    )
    pose = fitted(fitter, seen, start, coarse=True)
    return fitted(with_light(fitter, seen, pose), seen, pose, coarse=False)


def fitted(fitter: Fitter, seen: CleanSet, start: Poses, *, coarse: bool) -> Poses:
    """Fit all pictures, some at a time."""
    levels = ((fitter.optics.middle, 4), (fitter.optics.fine, 4)) if coarse else ((fitter.optics.fine, 4),)
    X, R = [], []
    for k in torch.arange(len(seen.pictures)).split(FITTED_AT_ONCE):
        x, r = start.position_lab_mm[k], start.R_lab_body[k]
        for level, iterations in levels:
            pixels = fitter.pixels([[seen.pictures[i].numpy()] for i in k.tolist()], x, level)
            fit = fitter.fit(pixels, PoseStart(x, r, torch.ones(len(k), 1, dtype=torch.bool)), level, iterations)
            x, r = fit.position_lab_mm, fit.R_lab_body
        X.append(x)
        R.append(r)
    return Poses(R_lab_body=torch.cat(R), position_lab_mm=torch.cat(X))


def with_light(fitter: Fitter, seen: CleanSet, pose: Poses) -> Fitter:
    """Learn light and noise from the first pictures, as `estimate_appearance` does from a movie's."""
    fine, first = fitter.optics.fine, torch.arange(min(16, len(seen.pictures)))
    X, R, use = pose.position_lab_mm[first], pose.R_lab_body[first], torch.ones(len(first), 1, dtype=torch.bool)
    pixels = fitter.pixels([[seen.pictures[i].numpy()] for i in first.tolist()], X, fine)
    fit = fitter.fit(pixels, PoseStart(X, R, use), fine, 1)
    return fitter.with_light_of(pixels, fit, use)


if __name__ == "__main__":
    main()
