"""Measure the basin of the fit: share of starts that converge, by angle from the truth and width of detail.

    scripts/basin.py [--experiment FOLDER] [--every 2]

Starts are true orientations rotated about random axes, on frames of the bundled excerpt (or of a folder with
experiment.yaml and truth.h5), both cameras. Each start is fitted at one width of detail and then, as in a cold start,
at the finer ones. It has converged if it ends within half a degree. Prints Markdown, and the covering radius of the
search bank's grid.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import h5py
import torch

from sphereorient import so3
from sphereorient.experiment.recording import open_recording
from sphereorient.files.threads import silent
from sphereorient.follow.appearance import estimate_appearance
from sphereorient.follow.initialise import Initialiser
from sphereorient.locate import screened_frames
from sphereorient.methods.paint import open_views
from sphereorient.methods.settings import Settings
from sphereorient.pose import base_table
from sphereorient.pose.camera_view import FIRST_BLUR_PX, widest_px
from sphereorient.pose.fitter import first_fitter
from sphereorient.pose.poses import PoseStart
from sphereorient.search import GreySearch

REPO = Path(__file__).resolve().parents[1]
ANGLES_DEG = (1, 2, 4, 6, 8, 10, 14, 20)
ARRIVED_DEG = 0.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--experiment", type=Path, default=REPO / "synthetic_data" / "excerpt")
    parser.add_argument("--every", type=int, default=2, help="use every n-th frame")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings, every = Settings(), arguments.every
    with open_recording(arguments.experiment / "experiment.yaml") as recording:
        numbers, texture, radius_mm = recording.frames, recording.texture, recording.experiment.radius_mm
        views = [open_views(recording, stream, settings, silent)[""] for stream in recording.streams]
        movies = [
            list(screened_frames(stream, view.background))[::every]
            for stream, view in zip(recording.streams, views, strict=True)
        ]
    with h5py.File(arguments.experiment / "truth.h5") as file:
        X, R = (
            torch.from_numpy(file[key][()])[numbers.start : numbers.stop : every] for key in ("position", "orientation")
        )
    proposers = {view.name: GreySearch(texture, settings.search) for view in views}
    base = base_table(texture, widest_px(views))
    taken = list(zip(*movies, strict=True))
    first = Initialiser(
        fitter=first_fitter(views, radius_mm, base, FIRST_BLUR_PX),
        proposers=proposers,
        locating=settings.locate,
        candidates=settings.refine.candidates,
    )
    fitter = estimate_appearance(first, taken[:16], base, settings.refine).fitter
    frames = [[frame.picture for frame in row] for row in taken]
    use = torch.ones(len(frames), len(views), dtype=torch.bool)
    optics = fitter.optics
    levels = {"coarse": (optics.coarse, 8), "middle": (optics.middle, 8), "fine": (optics.fine, 8)}
    pixels = {name: fitter.pixels(frames, X, level) for name, (level, _) in levels.items()}
    generator = torch.Generator().manual_seed(0)
    print("| detail | " + " | ".join(f"{angle}°" for angle in ANGLES_DEG) + " |\n|" + "---|" * (len(ANGLES_DEG) + 1))
    for first in range(3):
        cells = []
        for angle in ANGLES_DEG:
            axis = torch.nn.functional.normalize(torch.randn(len(R), 3, generator=generator, dtype=R.dtype), dim=-1)
            at, place = so3.exp(math.radians(angle) * axis) @ R, X
            for name in list(levels)[first:]:
                fit = fitter.fit(pixels[name], PoseStart(place, at, use), *levels[name])
                at, place = fit.R_lab_body, fit.position_lab_mm
            arrived = so3.geodesic_distance(at, R) < math.radians(ARRIVED_DEG)
            cells.append(f"{100 * float(arrived.double().mean()):.0f} %")
        name = list(levels)[first]
        print(f"| {name}, blur {levels[name][0].blur_px:.2f} px | " + " | ".join(cells) + " |", flush=True)
    print(f"\nSearch bank of {settings.search.step_deg:g} degrees; at 12 every rotation is within 14.5 of a template.")


if __name__ == "__main__":
    main()
