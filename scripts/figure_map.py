"""Make the figures of docs/map.md: a synthetic ball's map learnt, an old map corrected, a worn place found.

    scripts/figure_map.py [--work FOLDER]

Renders a movie, runs `sphereorient map` with a warped map as the old one, and compares the result with a map on which a
place was rubbed off. About five minutes of one core.
"""

from __future__ import annotations

import argparse
import math
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
import yaml
from torch import Tensor

from sphereorient.report.texture_map import write_texture
from sphereorient.sphere import load_texture, sample_texture
from sphereorient.sphere.texture import map_directions
from sphereorient.synth import SynthSettings, write_synthetic_experiment

DOCS = Path(__file__).resolve().parents[1] / "docs"
SCENE = SynthSettings(
    frames=150,
    image_size=(300, 300),
    diameter_px=78.0,
    volume_mm=25.0,
    exposure=1e-4,
    exposure_samples=1,
    omega_rms=30.0,
    texture="dots",
    seed=7,
)
PICTURES = {"learnt_map.png": "map.png", "learnt_moved.png": "map_moved.png", "wear.png": "map_wear.png"}
WARP_DEG, WORN_DEG = 1.0, 14.0  # rms of the old map's error; radius of the place that is rubbed off


def main() -> None:
    """Render, learn, compare, copy."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, help="keep the movie and all files here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if options.work is None else options.work
        draw(folder)
        for source, name in PICTURES.items():
            shutil.copy(folder / source, DOCS / name)


def draw(folder: Path) -> None:
    """Make all files in a folder."""
    path = write_synthetic_experiment(folder / "scene", SCENE)
    document = yaml.safe_load(path.read_text())
    true = load_texture(path.parent / document["sphere"].pop("texture"))
    path.write_text(yaml.safe_dump(document))
    write_texture(warped(true), folder / "old.png")
    sphereorient("map", path, "--init", folder / "old.png", "--out", folder / "learnt.png")
    learnt = load_texture(folder / "learnt.png")
    worn = rubbed(learnt)
    write_texture(worn, folder / "worn.png")
    sphereorient("compare-maps", folder / "worn.png", folder / "learnt.png", "--out", folder / "wear.png")


def warped(texture: Tensor) -> Tensor:
    """Return a map (H, 2 H) with a smooth error."""
    height = len(texture)
    d = map_directions(height)
    x, y, z = d.unbind(-1)
    moved = torch.linalg.cross(torch.stack([torch.sin(2 * y + 1), torch.cos(3 * z), torch.sin(2 * x - 0.5)], -1), d)
    area = (1 - z.square()).sqrt()
    rms = ((moved.square().sum(-1) * area).sum() / area.sum()).sqrt()
    place = torch.nn.functional.normalize(d + moved * math.radians(WARP_DEG) / rms, dim=-1)
    return sample_texture(texture.double(), place).float()


def rubbed(texture: Tensor) -> Tensor:
    """Return a map whose black paint is gone about longitude 40, latitude 20."""
    longitude, latitude = math.radians(40), math.radians(20)
    middle = [math.cos(latitude) * math.cos(longitude), math.cos(latitude) * math.sin(longitude), math.sin(latitude)]
    near = map_directions(len(texture)) @ torch.tensor(middle, dtype=torch.float64) > math.cos(math.radians(WORN_DEG))
    return torch.where(near, texture.quantile(0.9), texture)


def sphereorient(*arguments: object) -> None:
    """Run one command."""
    subprocess.run([sys.executable, "-m", "sphereorient.cli", *map(str, arguments)], check=True)


if __name__ == "__main__":
    main()
