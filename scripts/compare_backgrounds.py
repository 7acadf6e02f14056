"""Measure the outline's centre error with the paper's background, a plain mean, and with the ball left out of it.

    scripts/compare_backgrounds.py EXPERIMENT_FOLDER

Prints one line per camera and background: frames found, median, 95th percentile and maximum of the centre's error, px.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from sphereorient import locate
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.experiment.recording import spread_frames
from sphereorient.locate import Background, LocateSettings
from sphereorient.movies import Movie


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    experiment = load_experiment(folder / "experiment.yaml")
    settings = LocateSettings()
    for name, movie in open_movies(experiment).items():
        with h5py.File(folder / "truth.h5") as file:
            truth = file[f"{name}/centre_px"][()]
        diameter_px = locate.expected_diameter_px(name, experiment.cameras, experiment.diameter_mm)
        spread = spread_frames(range(len(movie)), settings.background_frames)
        without = locate.learn_background(movie.sample(spread), diameter_px, settings)
        plain = replace(without, mean=movie.sample(spread).mean(axis=0, dtype=np.float32))
        for label, background in (("plain mean", plain), ("without the ball", without)):
            print(f"{name}, {label}: {errors(movie, background, diameter_px, settings, truth)}", flush=True)


def errors(
    movie: Movie, background: Background, diameter_px: float, settings: LocateSettings, truth: np.ndarray
) -> str:
    found = locate.sightings_of(
        locate.find_ball(picture, background, diameter_px, settings) for picture in movie.frames()
    )
    error = np.linalg.norm(found.centre_px.numpy() - truth, axis=1)
    error = error[np.isfinite(error)]
    p50, p95, largest = np.percentile(error, [50, 95, 100])
    return f"{len(error)} of {len(truth)} found, {p50:.2f} / {p95:.2f} / {largest:.2f} px"


if __name__ == "__main__":
    main()
