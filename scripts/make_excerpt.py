"""Cut the excerpt of a path-traced experiment that is bundled in synthetic_data/ for the demo and the tests.

    scripts/make_excerpt.py EXPERIMENT_FOLDER OUT_FOLDER [--first 22] [--frames 40]

The frames' grey values are kept exactly. Times begin at 0 again. The pictures of the empty scene are the clipped mean
of the whole movie: in 40 frames the sphere moves too little to separate it from the background.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
from pathlib import Path

import cv2
import h5py
import numpy as np

from sphereorient import locate
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.experiment.recording import spread_frames
from sphereorient.files.whole_file import writing
from sphereorient.locate import LocateSettings
from sphereorient.movies import write_ffv1

EXPERIMENT = """\
schema: sphereorient-experiment/1
name: excerpt
frame_rate: 600.0
exposure: 0.0004
sphere: {diameter: 18.0, texture: texture.png}
cameras: cameras.yaml
movies: {cam1: cam1.mkv, cam2: cam2.mkv}
backgrounds: {cam1: empty_cam1.png, cam2: empty_cam2.png}   # the scene without the ball: the movies are short
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--first", type=int, default=22)
    parser.add_argument("--frames", type=int, default=40)
    arguments = parser.parse_args()
    source, out, first, last = arguments.source, arguments.out, arguments.first, arguments.first + arguments.frames
    out.mkdir(parents=True, exist_ok=True)
    experiment = load_experiment(source / "experiment.yaml")
    for name, movie in open_movies(experiment).items():
        with writing(force=True):
            write_ffv1(out / f"{name}.mkv", movie.frames(first, last), experiment.frame_rate_hz)
        diameter_px = locate.expected_diameter_px(name, experiment.cameras, experiment.diameter_mm)
        spread = spread_frames(range(len(movie)), 100)
        empty = locate.learn_background(movie.sample(spread), diameter_px, LocateSettings())
        cv2.imwrite(str(out / f"empty_{name}.png"), np.rint(empty.mean).astype(np.uint8))
    for file in ("texture.png", "cameras.yaml"):
        shutil.copyfile(source / file, out / file)
    (out / "experiment.yaml").write_text(EXPERIMENT, encoding="utf-8")
    cut_truth(source / "truth.h5", out / "truth.h5", first, last)
    write_card(source, out, first, last)


def cut_truth(source: Path, out: Path, first: int, last: int) -> None:
    with h5py.File(source) as whole, h5py.File(out, "w") as part:

        def copy(name: str, dataset: object) -> None:
            if isinstance(dataset, h5py.Dataset):
                rows = dataset[first:last]
                part.create_dataset(name, data=rows - rows[0] if name == "time" else rows)

        whole.visititems(copy)


def write_card(source: Path, out: Path, first: int, last: int) -> None:
    files = sorted(path for path in out.iterdir() if path.name != "card.json")
    card = {
        "what": f"frames {first} .. {last - 1} of two cameras filming a painted sphere in a mixer, with exact truth",
        "origin": "path traced with Mitsuba 3 from geometry written for this project's tests; made without "
        "sphereorient; no third-party content",
        "licence": "MIT, as the project",
        "made_by": "scripts/make_excerpt.py",
        "source_sha256": {
            name: hashlib.sha256((source / name).read_bytes()).hexdigest()
            for name in ("cam1.mkv", "cam2.mkv", "truth.h5")
        },
        "sha256": {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files},
    }
    (out / "card.json").write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
