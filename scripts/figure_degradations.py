"""Draw docs/degradations.png and write docs/degradations.md: what each degradation looks like, and its five values.

    scripts/figure_degradations.py [--out docs] [--check]

With --check nothing is drawn or written; the exit code is 1 if the page differs from the table in
sphereorient/synth/severities.py.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import h5py
import matplotlib
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sphereorient.cameras import Camera
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.sphere import load_texture
from sphereorient.synth import DEGRADATIONS, SynthSettings, severity, write_degraded
from sphereorient.synth.degrade_scene import Filming, picture_of_ball
from sphereorient.synth.severities import Degradation
from sphereorient.synth.write import default_cameras

REPO = Path(__file__).resolve().parents[1]
LEVELS = (0, 1, 3, 5)
BASE = SynthSettings(frames=3, image_size=(200, 200), volume_mm=6.0, seed=11)
FRAME = 1
TRUE, GIVEN, LOST = "#56B4E9", "#E69F00", "#000000"  # of Okabe and Ito
AXIS_MM = 13.0  # length of the drawn body axes: they end outside of the ball
MOVIE = 50  # frames of the movie whose dropped ones are shown
BLOCKS, DPI = 2, 120
HEAD = """\
# Degradations

Planted faults of pictures, cameras and maps, for the [robustness benchmark](robustness.md) and for training.
`synth.write_degraded(folder, settings, {"defocus": 3, "spin": 2})` renders an experiment with exact truth and any
number of them at once; `synth.degrade` applies those of pictures to a batch.

![Degradations](degradations.png)

A picture without each degradation, and at levels 1, 3 and 5. Blue is true, orange is given to the method. Dropped
frames: 50 of each camera, lost ones black.

Level 1 may occur in a good lab; at level 5 failure is expected. Degradations are applied in the order of the table,
which is that of the light, then of the files. The default ball ([`synth`](parameters.md)) has 78 px and rotates by 1.3
degrees a frame. Movies of several balls (`balls`) take all but `uneven_light`, `highlights`, `occlusion` and `bubbles`,
which lie on the disk of one ball. `scripts/figure_degradations.py` makes table and figure.

| name | unit | nothing | 1 | 2 | 3 | 4 | 5 | what it does |
|---|---|---|---|---|---|---|---|---|
"""


def page() -> str:
    """The page docs/degradations.md."""
    lines = []
    for row in DEGRADATIONS.values():
        nothing = "the scene's own" if row.nothing is None else f"{row.nothing:g}"
        values = " | ".join(f"{value:g}" for value in row.values)
        lines.append(f"| `{row.name}` | {row.unit} | {nothing} | {values} | {row.does} |")
    return HEAD + "\n".join(lines) + "\n"


def figure() -> Figure:
    """All degradations at four levels."""
    rows = -(-len(DEGRADATIONS) // BLOCKS)
    drawn = Figure(figsize=(BLOCKS * 5.1, rows * 1.16), layout="constrained")
    FigureCanvasAgg(drawn)
    drawn.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.0, hspace=0.0)
    cells = drawn.subplots(rows, BLOCKS * (len(LEVELS) + 1), gridspec_kw={"width_ratios": [1.3, 1, 1, 1, 1] * BLOCKS})
    for cell in cells.flat:
        cell.set_axis_off()
    for number, row in enumerate(DEGRADATIONS.values()):
        block, at = divmod(number, rows)
        line = cells[at, block * (len(LEVELS) + 1) : (block + 1) * (len(LEVELS) + 1)]
        unit = (
            row.unit.replace(", ", ",\n").replace(" of ", "\nof ").replace(" per ", "\nper ").replace(" to ", "\nto ")
        )
        line[0].text(0.0, 0.88, row.name.replace("_", " "), size=9, weight="bold", va="top")
        line[0].text(0.0, 0.62, unit, size=7.5, va="top", linespacing=1.25)
        for cell, level in zip(line[1:], LEVELS, strict=True):
            cell.set_title("without" if level == 0 else f"{level}: {severity(row.name, level):g}", size=8, pad=2)
            draw(cell, row, level)
    return drawn


def draw(cell: Any, row: Degradation, level: int) -> None:
    """Draw one degradation at one level."""
    if row.name == "dropped_frames":
        cell.imshow(lost(row, level), cmap=matplotlib.colors.ListedColormap([TRUE, LOST]), vmin=0, vmax=1)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = write_degraded(Path(folder), BASE, {row.name: level} if level else {})
        if row.name == "texture_error":
            texture = load_texture(path.parent / "texture.png").numpy()
            grey(cell, 255 * texture[:, texture.shape[1] // 4 : -texture.shape[1] // 4])  # the half around longitude 0
            cell.set(frame_on=True, xticks=[], yticks=[])
            cell.set_axis_on()
            return
        name = "cam2" if row.name.startswith("camera_") else "cam1"
        half = 0.66 * (severity("ball_size", level) if row.name == "ball_size" and level else BASE.diameter_px)
        grey(cell, crop(path, name, FRAME, half))
        if row.name == "spin":
            grey(cell, np.hstack([crop(path, name, FRAME + k, half) for k in (0, 1)]))
        if row.where == "reported":
            compare(cell, path, name, half)


def grey(cell: Any, picture: NDArray[Any]) -> None:
    """Show grey levels 0 .. 255."""
    cell.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="nearest")


def lost(row: Degradation, level: int) -> NDArray[np.float64]:
    """Draw which frames of both cameras are lost, in rows of ten, a gap between the cameras."""
    filming = Filming(BASE, {row.name: severity(row.name, level)} if level else {}, default_cameras(BASE))
    masks = [[k in filming.lost(name, MOVIE) for k in range(MOVIE)] for name in ("cam1", "cam2")]
    tiles = [np.kron(np.reshape(mask, (-1, 10)), np.pad(np.ones((8, 8)), 1)) for mask in masks]
    return np.vstack([tiles[0], np.full((6, 100), np.nan), tiles[1]])


def crop(path: Path, name: str, number: int, half: float) -> NDArray[np.uint8]:
    """Cut the ball out of a frame."""
    with h5py.File(path.parent / "truth.h5") as file:
        u, v = np.rint(file[f"{name}/centre_px"][number]).astype(int)
    movies = open_movies(load_experiment(path))
    frame = list(movies[name].frames())[number]
    r = round(half)
    return np.asarray(np.pad(frame, r)[v : v + 2 * r + 1, u : u + 2 * r + 1])


def compare(cell: Any, path: Path, name: str, half: float) -> None:
    """Draw outline and body axes, true and as the method has them."""
    with h5py.File(path.parent / "truth.h5") as file:
        position, R_lab_body = (torch.from_numpy(file[key][FRAME]) for key in ("position", "orientation"))
        corner = torch.from_numpy(np.rint(file[f"{name}/centre_px"][FRAME])) - round(half)
    experiment = load_experiment(path)
    given = (experiment.cameras[name], float(experiment.diameter_mm or 0) / 2)
    true = (default_cameras(BASE)[name], BASE.diameter_mm / 2)
    # The true one wider and below, so that it is seen where both agree.
    outline(cell, true, (position, R_lab_body), corner, {"color": TRUE, "linewidth": 2.6})
    outline(cell, given, (position, R_lab_body), corner, {"color": GIVEN, "linewidth": 0.9})
    cell.set(xlim=(-0.5, 2 * round(half) + 0.5), ylim=(2 * round(half) + 0.5, -0.5))


def outline(
    cell: Any,
    seen_by: tuple[Camera, float],
    pose: tuple[torch.Tensor, torch.Tensor],
    corner: torch.Tensor,
    look: dict[str, Any],
) -> None:
    """Draw the circle and the three body axes of a ball of some radius, mm, in a camera's picture."""
    (camera, radius_mm), (position, R_lab_body) = seen_by, pose
    disk = picture_of_ball(camera, position, radius_mm)
    angle = torch.linspace(0, 2 * torch.pi, 100, dtype=torch.float64)
    centre = disk.centre_px - corner
    rim = centre + disk.radius_px * torch.stack([angle.cos(), angle.sin()], dim=-1)
    cell.plot(*rim.T, **look)
    for end in camera.project(position + AXIS_MM * R_lab_body.mT):
        cell.plot(*torch.stack([centre, end - corner]).T, **look)


def main() -> None:
    """Read the options; write, or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=REPO / "docs")
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    path = options.out / "degradations.md"
    if options.check:
        if not path.is_file() or path.read_text(encoding="utf-8") != page():
            sys.exit(f"{path} differs from the table: run scripts/figure_degradations.py")
        return
    path.write_text(page(), encoding="utf-8")
    figure().savefig(options.out / "degradations.png", dpi=DPI, metadata={"Software": None})


if __name__ == "__main__":
    main()
