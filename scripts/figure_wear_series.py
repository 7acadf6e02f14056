"""Make the figure of docs/map.md of a series of maps: planted wear, found as by `compare-maps`.

    scripts/figure_wear_series.py [--out docs/map_series.png]

Maps of four movies of one ball, each in its own body frame, at its own brightness, with noise, its paint displaced by
0.3 degrees; one region wears off from the second movie on, another from the third. Prints the found and the planted
wear. Half a minute of one core.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.report.texture_map import write_texture
from sphereorient.sphere import sample_texture
from sphereorient.sphere.compare import turned_map
from sphereorient.sphere.texture import map_directions, texel_areas
from sphereorient.synth import random_texture

DOCS = Path(__file__).resolve().parents[1] / "docs"
HEIGHT = 256
NOISE, WARP_RAD, WORN_GREY = 0.03, math.radians(0.3), 0.95
PLACES = ((40.0, 20.0), (-75.0, -10.0))  # longitude and latitude, degrees
RADII_DEG = ((0.0, 0.0), (10.0, 0.0), (14.0, 8.0), (18.0, 13.0))  # of both, movie by movie
FRAMES = ((0.0, 0.0, 0.0), (0.3, -0.2, 0.5), (-1.0, 0.4, 2.0), (2.0, 1.0, -0.3))  # rotation vectors, rad


def main() -> None:
    """Make maps, compare them, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=DOCS / "map_series.png")
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        paths = [Path(temporary) / f"movie {k + 1}.png" for k in range(len(RADII_DEG))]
        for k, path in enumerate(paths):
            write_texture(learnt(k), path)
        command = [sys.executable, "-m", "sphereorient.cli", "compare-maps", "--force", "--series", *map(str, paths)]
        subprocess.run([*command, "--out", str(options.out)], check=True)
    area = texel_areas(HEIGHT) / (4 * math.pi)
    for k in range(1, len(RADII_DEG)):
        print(f"planted in movie {k + 1}: {100 * float(area[worn(k) & (paint() < 0.5)].sum()):.1f} %")


def paint() -> Tensor:
    """Return the ball's paint when it was new."""
    return random_texture("patches", 7, HEIGHT)


def worn(k: int) -> Tensor:
    """Return where the ball of the k-th movie has lost its paint, (H, 2 H) bool."""
    lost = torch.zeros(HEIGHT, 2 * HEIGHT, dtype=torch.bool)
    for (longitude, latitude), radius in zip(torch.deg2rad(torch.tensor(PLACES)).tolist(), RADII_DEG[k], strict=True):
        level = math.cos(latitude)
        middle = [level * math.cos(longitude), level * math.sin(longitude), math.sin(latitude)]
        near = map_directions(HEIGHT) @ torch.tensor(middle, dtype=torch.float64) > math.cos(math.radians(radius))
        lost |= near & (radius > 0)
    return lost


def learnt(k: int) -> Tensor:
    """Return a map as the k-th movie might give it."""
    texture = torch.where(worn(k), WORN_GREY, paint())
    direction = map_directions(HEIGHT)
    x, y, z = direction.unbind(-1)
    turn = WARP_RAD * torch.stack([torch.sin(2 * y + k), torch.cos(3 * z + k), torch.sin(2 * x - k)], dim=-1)
    place = torch.nn.functional.normalize(direction + torch.linalg.cross(turn, direction), dim=-1)
    displaced = sample_texture(texture.double(), place).float()
    noise = NOISE * torch.randn(displaced.shape, generator=torch.Generator().manual_seed(k))
    grey = (0.85 - 0.05 * k) * displaced + 0.05 + noise
    return turned_map(grey.clamp(0, 1), so3.exp(torch.tensor(FRAMES[k], dtype=torch.float64)).mT)


if __name__ == "__main__":
    main()
