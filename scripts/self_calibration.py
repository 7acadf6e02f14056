"""Measure the error that remains after cameras are bumped and then repaired by the ball itself.

    scripts/self_calibration.py EXPERIMENT_FOLDER [--cases 20] [--turn 0.3] [--move 0.5]

Each case rotates the cameras by an angle (degrees) about random axes and moves their centres (mm) in random directions,
seeded; tracks the movies with them; repairs them with that track. Prints Markdown: relative rotation of the cameras
against the exact ones before and after, and rms distance of the lines of sight to the ball's centre before, after and
with the exact cameras.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch

from sphereorient import so3
from sphereorient.calibration.self_calibration import check_cameras, observations_of, self_calibrate
from sphereorient.cameras import Camera
from sphereorient.cameras.parameters import ROTATION, TRANSLATION, with_parameters
from sphereorient.experiment import load_experiment
from sphereorient.run.stages import track_movies
from sphereorient.trajectory import Trajectory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--turn", type=float, default=0.3)
    parser.add_argument("--move", type=float, default=0.5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    experiment = load_experiment(arguments.folder / "experiment.yaml")
    exact = experiment.cameras
    print("| case | relative rotation before (°) | after (°) | gap before, rms mm | after | exact cameras | ratio |")
    print("|---|---|---|---|---|---|---|")
    for case in range(arguments.cases):
        bumped = bump(exact, math.radians(arguments.turn), arguments.move, case)
        track = track_movies(replace(experiment, cameras=bumped, camera_covariance=None))
        repaired = self_calibrate(observations_of([track], bumped)).cameras
        before, after, own = (gap_mm(cameras, track) for cameras in (bumped, repaired, exact))
        off = [math.degrees(apart_rad(cameras, exact)) for cameras in (bumped, repaired)]
        print(
            f"| {case} | {off[0]:.3f} | {off[1]:.4f} | {before:.3f} | {after:.4f} | {own:.4f} | {after / own:.2f} |",
            flush=True,
        )


def bump(cameras: Mapping[str, Camera], turn_rad: float, move_mm: float, seed: int) -> dict[str, Camera]:
    """Return cameras rotated about their own centres and moved, in random directions."""
    rng = torch.Generator().manual_seed(seed)
    bumped = {}
    for name, camera in cameras.items():
        axis, way = (torch.nn.functional.normalize(torch.randn(3, generator=rng).double(), dim=0) for _ in range(2))
        R, T = camera.R_cam_lab, camera.T_cam_lab_mm
        R_new = so3.exp(turn_rad * axis) @ R
        centre = -(R.mT @ T) + move_mm * way
        change = torch.cat([turn_rad * axis, -(R_new @ centre) - T])
        bumped[name] = with_parameters(camera, (*ROTATION, *TRANSLATION), change)
    return bumped


def apart_rad(cameras: Mapping[str, Camera], exact: Mapping[str, Camera]) -> float:
    """Return the angle between the relative rotations of two pairs of cameras."""
    one, other = list(exact)
    relative = [pair[one].R_cam_lab @ pair[other].R_cam_lab.mT for pair in (cameras, exact)]
    return float(so3.geodesic_distance(*relative))


def gap_mm(cameras: Mapping[str, Camera], track: Trajectory) -> float:
    """Return the root mean square of the distance of the lines of sight."""
    (check,) = check_cameras(cameras, track)
    return float((check.gap_mm**2).mean() ** 0.5)


if __name__ == "__main__":
    main()
