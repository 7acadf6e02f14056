"""Track single pictures of synthetic balls: with their map, mirrored, and with the map of another ball.

    scripts/single_stills.py [--stills 6] [--out out/single-stills]

Renders a movie of one camera with unrelated orientations for each kind of paint and degradation, and tracks some
frames of each as a single picture. Prints how many are measured within 5 degrees, measured wrongly, and refused,
with their confidence. Three quarters of an hour on one core.
"""

from __future__ import annotations

import argparse
import math
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import h5py
import numpy as np
import torch
import yaml

from sphereorient import so3, track_movies
from sphereorient.errors import ExperimentError
from sphereorient.movies import open_movie
from sphereorient.synth import SynthSettings, random_texture, write_degraded
from sphereorient.trajectory import Flag

PAINTS = ("blobs", "patches", "dots")
DEGRADATIONS = {
    "none": 0,
    "uneven_light": 4,
    "highlights": 4,
    "occlusion": 3,
    "defocus": 3,
    "paint_wear": 4,
    "read_noise": 5,
    "texture_error": 3,
    "saturation": 4,
    "contrast_loss": 4,
    "ball_size": 5,
}
KINDS = ("its map", "mirrored", "map of another ball")
SCENE = {"frames": 6, "frame_rate": 20.0, "cameras": 1, "image_size": (200, 200), "volume_mm": 8.0, "ambient": 0.3}
RIGHT_DEG = 5.0
Row = tuple[str, float, float, bool]  # outcome, error in degrees, confidence, whether it is ambiguous


def main() -> None:
    """Read the options, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stills", type=int, default=6, help="of each movie, at most 6")
    parser.add_argument("--out", type=Path, default=Path("out/single-stills"))
    options = parser.parse_args()
    rows: dict[str, list[Row]] = {kind: [] for kind in KINDS}
    for number, movie in enumerate(movies(options.out)):
        for place in range(options.stills):
            for kind in KINDS:
                rows[kind].append(tracked(still(movie, place, kind, number), movie, place))
    for kind, found in rows.items():
        print(line(kind, found))


def movies(out: Path) -> Iterator[Path]:
    """Yield the folders of the movies, rendered now."""
    for k, paint in enumerate(PAINTS):
        for n, (name, level) in enumerate(DEGRADATIONS.items()):
            folder = out / f"{paint}-{name}"
            settings = SynthSettings(texture=paint, seed=501 + n + k * len(DEGRADATIONS), **SCENE)
            shutil.rmtree(folder, ignore_errors=True)  # of an earlier run
            write_degraded(folder, settings, {name: level} if level else {})
            yield folder


def still(movie: Path, place: int, kind: str, number: int) -> Path:
    """Write an experiment of one frame of a movie."""
    folder = movie / f"{place}-{kind.replace(' ', '-')}"
    (folder / "still").mkdir(parents=True, exist_ok=True)
    for name in ("texture.png", "cameras.yaml", "empty_cam1.png"):
        shutil.copy(movie / name, folder / name)
    document = yaml.safe_load((movie / "experiment.yaml").read_text("utf-8"))
    with open_movie(movie / "cam1.mkv") as pictures:
        (picture,) = pictures.sample([place])
    cv2.imwrite(str(folder / "still" / "frame_0000.png"), np.asarray(picture))
    document |= {"movies": {"cam1": "still"}, "backgrounds": {"cam1": "empty_cam1.png"}}
    document["response"] = "linear"  # a picture file of 8 bits without it is taken for gamma-coded
    if kind == "mirrored":
        document["flip"] = {"cam1": "horizontal"}
    if kind == "map of another ball":
        other = random_texture(movie.name.split("-")[0], 9000 + number)
        cv2.imwrite(str(folder / "texture.png"), (255 * other).byte().numpy())
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(document), "utf-8")
    return path


def tracked(path: Path, movie: Path, place: int) -> Row:
    """Track a still."""
    try:
        track = track_movies(path)
    except ExperimentError as error:
        return "mirrored" if "not mirrored" in str(error) else "refused", math.nan, math.nan, False
    if not track.valid[0]:
        return "refused", math.nan, math.nan, False
    with h5py.File(movie / "truth.h5") as truth:
        true = torch.from_numpy(truth["orientation"][place])
    off_deg = math.degrees(float(so3.geodesic_distance(torch.from_numpy(track.orientation[0]), true)))
    ambiguous = bool(track.flags[0] & Flag.AMBIGUOUS)
    return "right" if off_deg < RIGHT_DEG else "wrong", off_deg, float(track.confidence[0]), ambiguous


def line(kind: str, rows: list[Row]) -> str:
    """Return a line of the table."""
    whats = ("right", "wrong", "mirrored", "refused")
    count = {what: sum(row[0] == what for row in rows) for what in whats}
    cells = [kind, str(len(rows)), *(str(count[what]) for what in whats)]
    for what in whats[:2]:
        sure = sorted(row[2] for row in rows if row[0] == what)
        flagged = sum(row[3] for row in rows if row[0] == what)
        cells.append(f"{sure[0]:.3f} {np.median(sure):.5f}, {flagged} ambiguous" if sure else "–")
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
