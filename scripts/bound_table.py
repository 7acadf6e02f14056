"""Compute the table of the Cramér-Rao bound by diameter and kind of paint, beside the specified figures.

    scripts/bound_table.py [--experiment FOLDER]

One picture, noise 5 % of the black-white step, optics sigma 0.55 px, background as dark as the black paint. Each figure
is the root of the mean variance over several seeds of paint and random attitudes. Prints Markdown: orientation,
degrees, in brackets with centre and radius known; after the slash the ratio to the specification. 35 s of one core.

Paint with twice the border has 0.7 times the bound, so the specified figures hold for paint as fine as the specified
one: blobs with as much border as the experiment's map, 34 evenly spread dots, and polygons. The number of polygons is
not specified: 100 are taken, as the 60 of synth give figures 1.1 to 1.2 times as large. The coarser paints of
`sphereorient.synth` follow at the end.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import normalize

from sphereorient import so3
from sphereorient.sphere import Sampling, load_texture
from sphereorient.sphere.texture import map_directions
from sphereorient.synth import random_texture
from sphereorient.tools.design.bound import cramer_rao_bound

SEEDS = 5
HEIGHT = 512  # of the maps
# Specified: diameter, then orientation and orientation with known position for each kind, centre for blobs.
SPECIFIED = {
    20: ((0.287, 0.181), (0.282, 0.198), (0.257, 0.170), 0.029),
    40: ((0.089, 0.054), (0.093, 0.063), (0.084, 0.052), 0.018),
    60: ((0.045, 0.028), (0.049, 0.034), (0.044, 0.029), 0.013),
    80: ((0.028, 0.018), (0.031, 0.021), (0.028, 0.020), 0.011),
    120: ((0.015, 0.010), (0.017, 0.012), (0.016, 0.011), 0.009),
    160: ((0.010, 0.007), (0.012, 0.008), (0.011, 0.008), 0.007),
}
EXPERIMENT = (0.030, 0.018, 0.012)  # its own map at 80 px


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--experiment", type=Path, help="folder with texture.png, for one more line")
    arguments = parser.parse_args()
    begin = time.perf_counter()
    kinds: tuple[Callable[[int], Tensor], ...] = (fine_blobs, fine_patches, spread_dots)
    maps = [[kind(seed) for seed in range(SEEDS)] for kind in kinds]
    print("| diameter px | blobs | patches | dots | centre, px (blobs) |\n|---|---|---|---|---|")
    for diameter_px, specified in SPECIFIED.items():
        found = [rms(textures, diameter_px) for textures in maps]
        cells = [pair(got, want) for got, want in zip(found, specified, strict=False)]
        cells.append(beside(found[0][2], specified[3]))
        print(f"| {diameter_px} | " + " | ".join(cells) + " |", flush=True)
    print("\nAt 80 px:")
    if arguments.experiment:
        got = rms([load_texture(arguments.experiment / "texture.png")] * SEEDS, 80)
        print(f"the experiment's map: {pair(got, EXPERIMENT)}, centre {beside(got[2], EXPERIMENT[2])} px")
    for kind, specified in zip(("blobs", "patches", "dots"), SPECIFIED[80], strict=False):
        got = rms([random_texture(kind, seed, HEIGHT) for seed in range(SEEDS)], 80)
        print(f"synth's {kind}: {pair(got, specified)}, centre {got[2]:.3f} px")
    print(f"\n{time.perf_counter() - begin:.0f} s")


def rms(textures: Sequence[Tensor], diameter_px: float) -> tuple[float, float, float]:
    """Return rms over maps and attitudes: orientation, degrees, without and with known position, and centre, px."""
    rng = torch.Generator().manual_seed(round(diameter_px))
    # Bounds of larger disks scatter less, and take longer.
    attitudes = 3 if diameter_px <= 80 else 1
    bounds = [
        cramer_rao_bound(
            texture,
            so3.random_rotations(attitudes, generator=rng, dtype=torch.float32),
            diameter_px=diameter_px,
            sampling=Sampling(supersampling=8 if diameter_px < 40 else 4),
        )
        for texture in textures
    ]
    full, known, centre = (
        mean_root([part(bound) for bound in bounds])
        for part in (
            lambda bound: bound.orientation_rms_rad,
            lambda bound: bound.orientation_known_place_rms_rad,
            lambda bound: bound.centre_rms_px,
        )
    )
    return math.degrees(full), math.degrees(known), centre


def mean_root(parts: Sequence[Tensor]) -> float:
    return float(torch.cat(list(parts)).square().mean().sqrt())


def pair(got: Sequence[float], specified: Sequence[float]) -> str:
    return f"{got[0]:.3f} ({got[1]:.3f}) / {got[0] / specified[0]:.2f} ({got[1] / specified[1]:.2f})"


def beside(got: float, specified: float) -> str:
    return f"{got:.3f} / {got / specified:.2f}"


def directions(count: int, rng: torch.Generator) -> Tensor:
    return normalize(torch.randn(count, 3, generator=rng, dtype=torch.float64), dim=-1)


def fine_blobs(seed: int) -> Tensor:
    """Blobs like synth's, 1.8 times finer: 3.9 rad of border per steradian, as the experiment's map has."""
    rng = torch.Generator().manual_seed(seed)
    wave = directions(60, rng) * (9 + 9 * torch.rand(60, 1, generator=rng, dtype=torch.float64))
    phase = 2 * math.pi * torch.rand(60, generator=rng, dtype=torch.float64)
    value = torch.cos(map_directions(HEIGHT) @ wave.T + phase).sum(-1)
    return (0.5 + (value - value.median()) / 0.45).clamp(0, 1).float()


def fine_patches(seed: int) -> Tensor:
    """Polygons like synth's, 100 of them."""
    points = directions(100, torch.Generator().manual_seed(seed))
    return ((map_directions(HEIGHT) @ points.T).argmax(-1) % 2).float()


def spread_dots(seed: int) -> Tensor:
    """34 dots as large as synth's, pushed apart until they hardly touch."""
    rng = torch.Generator().manual_seed(seed)
    points = directions(34, rng)
    for _ in range(300):
        apart = points[:, None] - points
        push = (apart / (apart.norm(dim=-1, keepdim=True) ** 3 + 1e-9)).sum(1)
        points = normalize(points + 0.01 * push, dim=-1)
    radius = torch.deg2rad(8 + 6 * torch.rand(34, generator=rng, dtype=torch.float64))
    outside = (torch.acos((map_directions(HEIGHT) @ points.T).clamp(-1, 1)) - radius).amin(-1)
    return (0.5 + outside * HEIGHT / math.pi).clamp(0, 1).float()


if __name__ == "__main__":
    main()
