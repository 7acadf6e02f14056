"""Measure the error from light and blur learnt from spoilt pictures, where much is hidden or the map is wrong.

    scripts/light_limits.py [--work FOLDER] [--scenes occlusion:3 occlusion:4 texture_error:3 texture_error:4]

Scenes of the robustness benchmark, fitted from the true poses: with the light and blur learnt from their own pictures,
and with those of the clean movie. Prints median errors of the orientation, degrees, of all cameras together.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import h5py
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.bench.scenes import CLEAN, BenchmarkScene, write_scene
from sphereorient.errors import ExperimentError
from sphereorient.experiment.recording import Recording, open_recording
from sphereorient.files.threads import silent
from sphereorient.follow.appearance import Appearance
from sphereorient.follow.follower import sample_frames
from sphereorient.methods.method import Job
from sphereorient.methods.precise import learn
from sphereorient.methods.settings import Settings
from sphereorient.pose import Fitter, Optics, base_table
from sphereorient.pose.camera_view import widest_px
from sphereorient.pose.poses import PoseStart

SCENES = ["occlusion:2", "occlusion:3", "occlusion:4", "occlusion:5", *(f"texture_error:{k}" for k in (3, 4, 5))]
STEPS = 20  # of the fits: enough to converge


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, help="keep the scenes here")
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| scene | own light and blur | the clean movie's | blur learnt, px |\n|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary) if options.work is None else options.work
        with open_recording(scene(work, CLEAN, 0)) as recording:
            clean = appearance_of(recording)
        for name, level in (words.split(":") for words in options.scenes):
            path = scene(work, name, int(level))
            with open_recording(path) as recording:
                known = with_map_of(clean.fitter, recording)
                right = f"{error_deg(known, recording, path):.3f}"
                try:
                    own = appearance_of(recording)
                    cells = f"{error_deg(own.fitter, recording, path):.3f}", f"{own.fitter.optics.blur_px:.2f}"
                except ExperimentError:
                    cells = "refused", ""
            print(f"| {name} {level} | {cells[0]} | {right} | {cells[1]} |", flush=True)


def scene(work: Path, kind: str, level: int) -> Path:
    """Render a scene of the benchmark, if it is not there."""
    path = work / f"{kind}-{level}" / "experiment.yaml"
    if not path.is_file():
        degradations = {} if kind == CLEAN else {kind: level}
        one = BenchmarkScene(kind=kind, level=level, seed=0, number=0, degradations=degradations)
        write_scene(path.parent, one)
    return path


def appearance_of(recording: Recording) -> Appearance:
    """Return the appearance that the precise method learns from a movie."""
    job = Job(recording=recording, settings=Settings(), device=torch.device("cpu"))
    return learn(job, silent).appearance


def with_map_of(fitter: Fitter, recording: Recording) -> Fitter:
    """Return the same light and blur with another movie's map."""
    widest = widest_px(fitter.views)
    return replace(fitter, optics=Optics(base_table(recording.texture, widest), fitter.optics.blur_px, widest))


def error_deg(fitter: Fitter, recording: Recording, path: Path) -> float:
    """Return the median error of the orientation of all frames, fitted from the truth."""
    with h5py.File(path.parent / "truth.h5") as truth:
        X, R = (torch.from_numpy(truth[name][()]) for name in ("position", "orientation"))
    samples, _ = sample_frames(recording, fitter.views, len(X))
    use: Tensor = torch.ones(len(X), len(fitter.views), dtype=torch.bool)
    pixels = fitter.pixels([[frame.picture for frame in instant] for instant in samples], X, fitter.optics.fine)
    fit = fitter.fit(pixels, PoseStart(X, R, use), fitter.optics.fine, STEPS)
    return float(torch.rad2deg(so3.geodesic_distance(fit.R_lab_body, R)).median())


if __name__ == "__main__":
    main()
