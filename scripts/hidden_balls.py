"""Errors of several balls in frames where others hide over half of one in two cameras or more, by exact truth.

    hidden_balls.py EXPERIMENT.yaml TRACK.h5 TRUTH.h5 [--share 0.5] [--cameras 2]

Prints for each ball the frames that are hidden so, how many of them are valid without a flag, and the error of the
orientation there (95 %), degrees. A frame is flagged where it is not valid or has one of the flags below. Names of
balls that look alike are those of the truth.
"""

import argparse
from pathlib import Path

import h5py
import numpy as np
import torch

from sphereorient import so3
from sphereorient.cameras import Camera, sphere_disk_px
from sphereorient.experiment import load_experiment
from sphereorient.trajectory import Flag, Tracks

DOUBT = Flag.IDENTITY | Flag.CONTRADICTION | Flag.ONE_CAMERA | Flag.POSITION_INTERPOLATED
POINTS = 41  # across a disk


def hidden_share(places: dict[str, torch.Tensor], radii: dict[str, float], camera: Camera, name: str) -> torch.Tensor:
    """Return the share of a ball's disk (N,) that nearer balls cover, by their outlines as circles."""
    disks = {other: sphere_disk_px(camera, X, radii[other]) for other, X in places.items()}
    far = {other: (X @ camera.R_cam_lab.mT + camera.T_cam_lab_mm).norm(dim=-1) for other, X in places.items()}
    across = torch.linspace(-1, 1, POINTS, dtype=torch.float64)
    place = torch.cartesian_prod(across, across)
    place = place[place.square().sum(1) < 1]
    middle, radius = disks[name]
    at = middle[:, None] + radius[:, None, None] * place
    covered = torch.zeros(at.shape[:2], dtype=torch.bool)
    for other, (there, size) in disks.items():
        if other != name:
            inside = (at - there[:, None]).norm(dim=-1) < size[:, None]
            covered |= inside & (far[other] < far[name])[:, None]
    return covered.double().mean(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("experiment", type=Path)
    parser.add_argument("track", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--share", type=float, default=0.5)
    parser.add_argument("--cameras", type=int, default=2)
    given = parser.parse_args()
    experiment, tracks = load_experiment(given.experiment), Tracks.load(given.track)
    radii = {sphere.name: float(sphere.diameter_mm or 0) / 2 for sphere in experiment.spheres}
    with h5py.File(given.truth) as file:
        truth = {
            name: {key: file[f"spheres/{name}/{key}"][()] for key in ("position", "orientation")} for name in radii
        }
    places = {name: torch.from_numpy(one["position"]) for name, one in truth.items()}
    print("ball  hidden frames  valid, no flag  error (95 %)")
    for name, track in tracks.items():
        # Balls that look alike may have each other's names: the truth that lies nearest is meant.
        away = {one: np.linalg.norm(track.position - parts["position"], axis=1) for one, parts in truth.items()}
        own = min(away, key=lambda one, far=away: float(np.nanmedian(far[one])))
        shares = torch.stack([hidden_share(places, radii, camera, own) for camera in experiment.cameras.values()])
        hidden = ((shares > given.share).sum(0) >= given.cameras).numpy()
        sure = hidden & track.valid & ((track.flags & int(DOUBT)) == 0)
        R = [torch.from_numpy(part[sure]) for part in (track.orientation, truth[own]["orientation"])]
        error = np.degrees(so3.geodesic_distance(*R).numpy())
        worst = f"{np.quantile(error, 0.95):.3f}" if len(error) else "-"
        print(f"{name:4}  {int(hidden.sum()):13}  {int(sure.sum()):14}  {worst}")


if __name__ == "__main__":
    main()
