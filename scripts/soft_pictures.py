"""Compare tracks of soft pictures with learnt blur and with given blur.

    scripts/soft_pictures.py [--shared ../shared] [--frames 110] [--blurs 0.5 0.95 2] [--work FOLDER]

Blurs the first frames of the path-traced experiment by a Gaussian, restores the sensor noise, and tracks each movie
twice: with nothing given, and with the exact blur. Prints one Markdown table: median error and error over sigma of
each.
"""

from __future__ import annotations

import argparse
import math
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.bench import score_track
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.methods.settings import Settings
from sphereorient.movies import write_ffv1
from sphereorient.run import track_movies

OWN_PX = 0.62  # blur of the experiment itself: optics 0.55, pixel 0.29
READ, SHOT = 0.7, 0.05  # grey levels, and grey levels^2 per grey level: assumed, not measured
REACH = 4  # sigmas of the Gaussian


def blurred(frames: Iterable[NDArray[np.generic]], blur_px: float, seed: int) -> Iterator[NDArray[np.uint8]]:
    """Yield frames blurred by a Gaussian, with the lost share of the sensor's noise restored."""
    rng = np.random.default_rng(seed)
    width = 2 * math.ceil(REACH * blur_px) + 1
    kernel = cv2.getGaussianKernel(width, blur_px)
    lost = 1.0 - float((kernel**2).sum()) ** 2
    for frame in frames:
        soft = cv2.sepFilter2D(frame.astype(np.float32), cv2.CV_32F, kernel, kernel)
        sigma = np.sqrt(lost * (READ**2 + SHOT * soft.clip(0)))
        yield np.rint(soft + sigma * rng.standard_normal(soft.shape)).clip(0, 255).astype(np.uint8)


def copied(source: Path, folder: Path, frames: int, blur_px: float) -> Path:
    """Write a blurred copy of an experiment's first frames, and return its experiment.yaml."""
    folder.mkdir(parents=True)
    for name in ("experiment.yaml", "cameras.yaml", "texture.png", "truth.h5"):
        shutil.copyfile(source / name, folder / name)
    experiment = load_experiment(source / "experiment.yaml")
    for seed, (name, movie) in enumerate(open_movies(experiment).items()):
        path = folder / experiment.movie_paths[name].name
        write_ffv1(path, blurred(movie.frames(0, frames), blur_px, seed), experiment.frame_rate_hz)
    return folder / "experiment.yaml"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path(__file__).resolve().parents[2] / "shared")
    parser.add_argument("--frames", type=int, default=110)
    parser.add_argument("--blurs", type=float, nargs="+", default=(0.5, 0.95, 2.0))
    parser.add_argument("--work", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        print(
            "| further blur, px | given | p50 | p95 (degrees) | over sigma | p50 (mm) | over sigma |\n"
            + "|---" * 7
            + "|"
        )
        for blur_px in options.blurs:
            folder = work / f"blur-{blur_px:g}"
            path = folder / "experiment.yaml"
            if not path.is_file():
                copied(options.shared / "experiment", folder, options.frames, blur_px)
            for given in (None, round(math.hypot(OWN_PX, blur_px), 3)):
                settings = Settings.model_validate({"refine": {"blur_px": given}})
                found = score_track(track_movies(path, settings=settings), folder / "truth.h5")
                (turn, p95, *_), (place, *_) = found.percentiles_deg(), found.percentiles_mm()
                of_turn, of_place = found.over_stated()
                cells = [f"{blur_px:g}", "nothing" if given is None else f"{given:.2f} px", f"{turn:.3f}", f"{p95:.3f}"]
                cells += [f"{of_turn:.2f}", f"{place:.4f}", f"{of_place:.2f}"]
                print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
