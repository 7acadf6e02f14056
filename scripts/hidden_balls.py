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
from sphereorient.experiment import load_experiment
from sphereorient.synth.scene import hidden_shares
from sphereorient.trajectory import Flag, Tracks

DOUBT = Flag.IDENTITY | Flag.CONTRADICTION | Flag.ONE_CAMERA | Flag.POSITION_INTERPOLATED


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
    shares = hidden_shares({name: parts["position"] for name, parts in truth.items()}, experiment.cameras, radii)
    print("ball  hidden frames  valid, no flag  error (95 %)")
    for name, track in tracks.items():
        # Balls that look alike may have each other's names: the truth that lies nearest is meant.
        away = {one: np.linalg.norm(track.position - parts["position"], axis=1) for one, parts in truth.items()}
        own = min(away, key=lambda one, far=away: float(np.nanmedian(far[one])))
        hidden = (shares[own] > given.share).sum(0) >= given.cameras
        sure = hidden & track.valid & ((track.flags & int(DOUBT)) == 0)
        R = [torch.from_numpy(part[sure]) for part in (track.orientation, truth[own]["orientation"])]
        error = np.degrees(so3.geodesic_distance(*R).numpy())
        worst = f"{np.quantile(error, 0.95):.3f}" if len(error) else "-"
        print(f"{name:4}  {int(hidden.sum()):13}  {int(sure.sum()):14}  {worst}")


if __name__ == "__main__":
    main()
