"""Small movies of several balls that pass before each other, with exact truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import yaml

from sphereorient import so3
from sphereorient.cameras import save_cameras
from sphereorient.files.picture import write_picture
from sphereorient.synth import SynthSettings, make_scene, random_texture
from sphereorient.synth.scene import digitise, expose, seeded
from sphereorient.synth.write import default_cameras

FRAMES, RATE_HZ, DIAMETER_MM = 30, 600.0, 14.0
PAINTS = {"a": 5, "b": 8, "c": 5}  # seeds: a and c look alike


@dataclass(frozen=True, eq=False)
class Several:
    """An experiment in a folder, and the poses of its balls."""

    experiment: Path
    position_mm: dict[str, np.ndarray]  # (N, 3)
    R_lab_body: dict[str, np.ndarray]  # (N, 3, 3)


def write_several(folder: Path, balls: str = "abc", cameras: int = 3) -> Several:
    """Balls that cross in the pictures: a passes before b in the first camera, c follows behind."""
    scene = {"image_size": (260, 260), "diameter_px": 52.0, "diameter_mm": DIAMETER_MM, "distance_mm": 520.0}
    settings = SynthSettings(frames=FRAMES, cameras=cameras, black=70.0, exposure=0.0, exposure_samples=1, **scene)
    t = torch.arange(FRAMES, dtype=torch.float64)[:, None] / FRAMES - 0.5
    place = {
        "a": torch.tensor([[2.0, -12.0, 3.0]]).double() + 30.0 * t * torch.tensor([1.0, 0.1, 0.0]).double(),
        "b": torch.tensor([[-2.0, 8.0, 1.0]]).double() - 24.0 * t * torch.tensor([1.0, 0.0, 0.2]).double(),
        "c": torch.tensor([[3.0, 14.0, -14.0]]).double() + 10.0 * t * torch.tensor([0.5, 0.3, 1.0]).double(),
    }
    axis = {"a": [2.0, 1.0, 0.5], "b": [-1.0, 2.0, 1.0], "c": [0.5, -1.5, 2.0]}
    generator = torch.Generator().manual_seed(1)
    first = dict(zip("abc", so3.random_rotations(3, generator=generator), strict=True))
    R = {name: so3.exp(1.2 * t * torch.tensor(axis[name]).double()) @ first[name] for name in balls}
    seen = default_cameras(settings)
    save_cameras(folder / "cameras.yaml", seen)
    paint = {seed: random_texture("patches", seed) for seed in {PAINTS[name] for name in balls}}
    for seed, texture in paint.items():
        write_picture(folder / f"texture_{seed}.png", np.rint(texture.numpy() * 255).astype(np.uint8))
    scenes = [make_scene(paint[PAINTS[name]], settings) for name in balls]
    for n, (name, camera) in enumerate(seen.items()):
        rng = seeded(n)
        movie = []
        for k in range(FRAMES):
            X_now, R_now = (torch.stack([poses[ball][k : k + 1] for ball in balls]) for poses in (place, R))
            picture = expose(scenes, camera, X_now, R_now).before(settings.background)
            movie.append(digitise(picture, settings, rng))
        np.save(folder / f"{name}.npy", np.stack(movie))
        height, width = movie[0].shape
        write_picture(folder / f"empty_{name}.png", np.full((height, width), round(settings.background), np.uint8))
    spheres = {name: {"diameter": DIAMETER_MM, "texture": f"texture_{PAINTS[name]}.png"} for name in balls}
    document = {
        "schema": "sphereorient-experiment/1",
        "name": "several",
        "frame_rate": RATE_HZ,
        **({"spheres": spheres} if len(balls) > 1 else {"sphere": spheres[balls]}),
        "cameras": "cameras.yaml",
        "backgrounds": {name: f"empty_{name}.png" for name in seen},
        "movies": {name: f"{name}.npy" for name in seen},
    }
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return Several(path, {name: place[name].numpy() for name in balls}, {name: R[name].numpy() for name in balls})
