"""Measure how often a single frame without history gets the right orientation: found, fitted, within 1 degree.

    scripts/cold_start.py [EXPERIMENT_FOLDER ...] [--frames 200]

First frames of the project's own renderer, three paints, 5 % noise, random attitudes and positions; then every frame of
the experiments given, which hold experiment.yaml and truth.h5. Each camera alone, light and blur learnt as in a track.
Prints Markdown.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Camera
from sphereorient.experiment.recording import open_recording, spread_frames
from sphereorient.files.threads import silent
from sphereorient.follow.appearance import estimate_appearance
from sphereorient.follow.initialise import Initialiser
from sphereorient.locate import Background, Frame
from sphereorient.methods.paint import open_views
from sphereorient.methods.settings import Settings
from sphereorient.pose import CameraView, LinesOfSight, base_table
from sphereorient.pose.camera_view import FIRST_BLUR_PX
from sphereorient.pose.fitter import first_fitter
from sphereorient.search import GreySearch
from sphereorient.synth import SynthSettings, make_scene, random_texture, render_frame
from sphereorient.synth.scene import seeded
from sphereorient.synth.write import default_cameras

RIGHT_DEG = 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--frames", type=int, default=200, help="rendered frames of each paint")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("| frames | right within 1 degree | median, degrees | wrong |\n|---|---|---|---|")
    for light, ambient in (("even light", 1.0), ("lamps, one side dark", SynthSettings().ambient)):
        for seed, paint in enumerate(("blobs", "patches", "dots"), 1):
            rendered(paint, seed, arguments.frames, light, ambient)
    for folder in arguments.folders:
        measured(folder)


def report(name: str, errors: list[float]) -> None:
    """Print one row; a frame without any pose counts as wrong."""
    right = sum(error <= RIGHT_DEG for error in errors)
    median = float(np.median(errors))
    share = 100 * right / len(errors)
    print(f"| {name} | {right} of {len(errors)} ({share:.1f} %) | {median:.3f} | {len(errors) - right} |", flush=True)


def errors_deg(
    view: CameraView, texture: Tensor, radius_mm: float, frames: list[np.ndarray], R_lab_body: Tensor
) -> list[float]:
    """Return the error of each frame, found by itself; infinite where nothing is found."""
    settings = Settings()
    search = {view.name: GreySearch(texture, settings.search)}
    spread = spread_frames(range(len(frames)), settings.refine.appearance_frames)
    base = base_table(texture, view.diameter_px)
    samples = [[Frame(shown=frames[k])] for k in spread]
    first = Initialiser(
        fitter=first_fitter([view], radius_mm, base, FIRST_BLUR_PX),
        proposers=search,
        locating=settings.locate,
        candidates=settings.refine.candidates,
    )
    learnt = estimate_appearance(first, samples, base, settings.refine)
    errors = []
    for frame, R in zip(frames, R_lab_body, strict=True):
        poses = replace(first, fitter=learnt.fitter, score_min=learnt.clear_score).poses([Frame(shown=frame)])
        error = float(so3.geodesic_distance(poses.R_lab_body[0], R)) if len(poses) else math.inf
        errors.append(math.degrees(error))
    return errors


def rendered(paint: str, seed: int, count: int, light: str, ambient: float) -> None:
    """Measure frames of the project's own renderer."""
    settings = SynthSettings(read_noise=0.05 * SynthSettings().white, shot_noise=0.0, ambient=ambient)
    camera = next(iter(default_cameras(settings).values()))
    texture = random_texture(paint, seed)
    scene = make_scene(texture, settings)
    rng = seeded(seed)
    generator = torch.Generator().manual_seed(seed)
    R_lab_body = so3.random_rotations((count,), generator=generator, dtype=torch.float64)
    place = 10.0 * (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5)
    frames = [render_frame(scene, camera, place[k : k + 1], R_lab_body[k : k + 1], rng) for k in range(count)]
    view = rendered_eye(camera, settings)
    report(f"{paint}, {light}", errors_deg(view, texture, settings.diameter_mm / 2, frames, R_lab_body))


def rendered_eye(camera: Camera, settings: SynthSettings) -> CameraView:
    """Return the view of a camera with a known, even background."""
    width, height = camera.image_size
    even = np.full((height, width), settings.background, np.float32)
    background = Background(mean=even, noise=np.full_like(even, settings.read_noise), full_scale=255.0)
    return CameraView(
        name="cam1", camera=camera, background=background, diameter_px=settings.diameter_px, sight=LinesOfSight(camera)
    )


def measured(folder: Path) -> None:
    """Measure every frame of an experiment, each camera by itself."""
    settings = Settings()
    with open_recording(folder / "experiment.yaml") as recording:
        frames = recording.frames
        with h5py.File(folder / "truth.h5") as file:
            R_lab_body = torch.from_numpy(file["orientation"][()])[frames.start : frames.stop]
        for stream in recording.streams:
            view = open_views(recording, stream, settings, silent)[""]
            pictures = [picture for picture, _ in stream.pictures() if picture is not None]
            errors = errors_deg(view, recording.texture, recording.experiment.radius_mm, pictures, R_lab_body)
            report(f"{folder.name}, {stream.name}", errors)


if __name__ == "__main__":
    main()
