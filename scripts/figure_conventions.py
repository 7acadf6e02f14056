"""Draw docs/conventions.png: frames, map, its picture in a camera, and pixel coordinates; and docs/animal.png.

    scripts/figure_conventions.py [--out docs]

The second figure shows how an animal's walk follows from the ball's rotation. Maps, spheres and walks are computed by
the package's own functions.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.report.plots.style import AXIS_COLOURS
from sphereorient.sphere import orthographic_view
from sphereorient.trajectory.walk import walk_of

REPO = Path(__file__).resolve().parents[1]
HEIGHT = 180  # rows of the map, one a degree
R_CAM_LAB = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # looks along lab +y, lab z up
R_LAB_BODY = so3.exp(torch.tensor([0.0, 0.0, -math.pi / 2]))  # body +x towards that camera


def letter_map() -> Tensor:
    """Return a map (H, 2 H), 0 .. 1: an F about its middle, which shows mirroring, and lines every 30 degrees."""
    grey = torch.full((HEIGHT, 2 * HEIGHT), 0.82)
    grey[:, ::30] = grey[::30, :] = 0.62
    grey[:, HEIGHT:] -= 0.12  # east of the middle a little darker
    top, left = HEIGHT // 2 - 40, HEIGHT - 26
    for rows, columns in (((0, 80), (0, 16)), ((0, 16), (0, 54)), ((32, 46), (0, 40))):
        grey[top + rows[0] : top + rows[1], left + columns[0] : left + columns[1]] = 0.08
    return grey


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=REPO / "docs", help="folder")
    out = parser.parse_args().out
    figure = plt.figure(figsize=(9.6, 6.6), dpi=110, layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1.0))
    draw_frames(figure.add_subplot(grid[0, 0], projection="3d"))
    draw_map(figure.add_subplot(grid[0, 1]))
    draw_picture(figure.add_subplot(grid[1, 0]))
    draw_pixels(figure.add_subplot(grid[1, 1]))
    figure.savefig(out / "conventions.png", metadata={"Software": None})
    figure = plt.figure(figsize=(9.6, 4.2), dpi=110, layout="constrained")
    grid = figure.add_gridspec(1, 2)
    draw_turns(figure.add_subplot(grid[0], projection="3d"))
    draw_walk(figure.add_subplot(grid[1]))
    figure.savefig(out / "animal.png", metadata={"Software": None})


def draw_frames(axes: Any) -> None:
    """Draw lab, camera and body axes, to check all signs."""
    camera, sphere = np.array([0.0, -4.6, 0.0]), np.zeros(3)
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 49), np.linspace(0, np.pi, 25))
    ball = 0.8 * np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
    axes.plot_surface(*ball, color="0.8", alpha=0.35, linewidth=0)
    axes.plot(*np.stack([camera, sphere]).T, color="0.6", lw=1, ls=":")
    triad(axes, np.array([1.9, -2.4, -1.2]), np.eye(3), "lab", 1.2)
    triad(axes, camera, R_CAM_LAB.numpy().T, "cam", 1.2)  # columns of R_lab_cam: the camera's axes in the lab
    triad(axes, sphere, R_LAB_BODY.numpy(), "body", 1.7)
    axes.set(xlim=(-1.6, 2.9), ylim=(-4.8, 1.6), zlim=(-2.0, 1.8))
    axes.set_box_aspect((4.5, 6.4, 3.8), zoom=1.35)
    axes.view_init(elev=24, azim=-28)
    axes.set_axis_off()
    axes.set_title("frames: the camera looks along lab +y,\nR_lab_body = Rz(-90 degrees)", fontsize=10)
    handles = [Line2D([], [], color=colour, lw=2, label=name) for colour, name in zip(AXIS_COLOURS, "xyz", strict=True)]
    axes.legend(handles=handles, loc="lower right", fontsize=8, frameon=False, ncols=3)


def triad(axes: Any, origin: NDArray[Any], columns: NDArray[Any], name: str, length: float) -> None:
    """Draw three arrows; `columns` are their directions in the lab."""
    for axis, direction, colour in zip("xyz", columns.T, AXIS_COLOURS, strict=True):
        axes.quiver(*origin, *(length * direction), color=colour, lw=2, arrow_length_ratio=0.18)
        axes.text(*(origin + 1.25 * length * direction), f"{name} {axis}", color=colour, fontsize=8, ha="center")


def draw_map(axes: Any) -> None:
    """Draw the map, oriented as maps of the Earth are."""
    axes.imshow(letter_map(), cmap="gray", vmin=0, vmax=1, extent=(-180, 180, -90, 90))
    for longitude, down, text in ((0, 62, "body +x"), (90, 17, "body +y"), (-90, 17, "body -y")):
        axes.plot(longitude, 0, "o", color="#d35400", ms=5)
        axes.text(longitude, -down, text, color="#d35400", fontsize=9, ha="center", weight="bold")
    axes.text(0, 76, "north: body +z", color="#d35400", fontsize=9, ha="center", weight="bold")
    axes.set(xticks=range(-180, 181, 90), yticks=(-90, 0, 90))
    axes.set_xlabel("longitude (degrees), column 0 is the left", fontsize=9)
    axes.set_ylabel("latitude", fontsize=9)
    axes.set_title("the map: north up, east to the right, W = 2H", fontsize=10)


def draw_picture(axes: Any) -> None:
    """Draw the picture of that map in the first panel's camera."""
    size = 240
    view = orthographic_view(size)
    picture = view.render(letter_map(), R_CAM_LAB @ R_LAB_BODY)
    seen = np.ma.masked_array(picture.numpy(), ~view.inside.numpy())
    axes.imshow(seen, cmap="gray", vmin=0, vmax=1)
    arrow = {"arrowprops": {"arrowstyle": "<-", "color": "black", "lw": 1.5}, "va": "center", "ha": "center"}
    axes.annotate("u, cam x", (-28, -12), (62, -12), fontsize=9, **arrow)
    axes.annotate("v, cam y", (-28, -12), (-28, 70), fontsize=9, rotation=90, **arrow)
    axes.text(size + 12, size / 2, "east of the\nmap's middle", fontsize=9, va="center")
    axes.text(size / 2, size + 14, "this camera's picture: the F is not mirrored", fontsize=10, ha="center", va="top")
    axes.set(xlim=(-110, size + 130), ylim=(size + 34, -30))
    axes.set_axis_off()


def draw_pixels(axes: Any) -> None:
    """Draw a picture of 4 x 3 pixels: whole numbers are centres."""
    width, height = 4, 3
    for u in range(width):
        for v in range(height):
            axes.add_patch(Rectangle((u - 0.5, v - 0.5), 1, 1, fc="0.94" if (u + v) % 2 else "0.85", ec="0.5"))
            axes.plot(u, v, "k.", ms=4)
            axes.text(u, v + 0.24, f"({u}, {v})", ha="center", fontsize=8)
    axes.set(xlim=(-0.8, 3.8), ylim=(2.8, -0.8), xticks=(-0.5, 0, 1, 2, 3, 3.5), yticks=(-0.5, 0, 1, 2, 2.5))
    axes.xaxis.tick_top()
    for each in (axes.xaxis, axes.yaxis):
        each.set_major_formatter("{x:g}")
    axes.tick_params(labelsize=8)
    axes.set_aspect("equal")
    axes.set_ylabel("v, row", fontsize=9)
    axes.set_xlabel("pixels (u, v) of a 4 x 3 picture: it spans -0.5 .. 3.5 and -0.5 .. 2.5", fontsize=9)


def draw_turns(axes: Any) -> None:
    """Draw the ball under the animal, and its rotation in each part of a walk."""
    upright = np.diag([1.0, -1.0, -1.0])  # the lab's z points down, that of the drawing up
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 49), np.linspace(0, np.pi, 25))
    ball = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
    axes.plot_surface(*ball, color="0.8", alpha=0.35, linewidth=0)
    axes.plot([0.3, -0.3], [0, 0], [1.09, 1.09], color="0.25", lw=7, solid_capstyle="round")
    axes.plot([0.34], [0], [1.12], "o", color="0.25", ms=10)
    triad(axes, np.zeros(3), upright, "lab", 1.5)
    parts = (
        (np.array([0.0, 1.0, 0.0]), 1.15, "ahead", (-0.35, 1.15, 0.05)),
        (np.array([-1.0, 0.0, 0.0]), 1.15, "to the right", (1.3, -0.1, -0.5)),
        (np.array([0.0, 0.0, -1.0]), 1.15, "turn to the right", (0.95, 0.35, 1.28)),
    )
    for turn, along, name, at in parts:
        axis = int(np.abs(turn).argmax())
        first = np.roll(np.eye(3)[axis], 1)
        around = np.linspace(0.0, 1.6 * np.pi, 60)[:, None]
        arc = 0.32 * (np.cos(around) * first + np.sin(around) * np.cross(turn, first))
        arc[:, axis] = along
        arc = arc @ upright
        colour = AXIS_COLOURS[axis]
        axes.plot(*arc.T, color=colour, lw=1.6)
        axes.quiver(*arc[-2], *(10 * (arc[-1] - arc[-2])), color=colour, lw=1.6, arrow_length_ratio=0.9)
        axes.text(*(upright @ np.array(at)), name, color=colour, fontsize=9, ha="center")
    axes.set(xlim=(-1.3, 1.3), ylim=(-1.3, 1.3), zlim=(-1.3, 1.3))
    axes.set_box_aspect((1, 1, 1), zoom=1.3)
    axes.view_init(elev=20, azim=-118)
    axes.set_axis_off()
    axes.set_title(
        "the animal on the ball; x ahead, y to the right, z down;\nthe ball's turns by which the animal goes",
        fontsize=10,
    )


def draw_walk(axes: Any) -> None:
    """Draw a walk: ahead, a turn to the right, ahead, a step to the right."""
    ahead, right, about = np.array([0.0, 0.1, 0.0]), np.array([-0.1, 0.0, 0.0]), np.array([0.0, 0.0, -np.pi / 60])
    steps = [ahead] * 12 + [ahead + about] * 30 + [ahead] * 8 + [right] * 8
    R = [torch.eye(3, dtype=torch.float64)]
    for step in steps:
        R.append(so3.exp(torch.from_numpy(step)) @ R[-1])
    walk = walk_of(np.arange(len(R)) / 100, torch.stack(R).numpy())
    axes.plot(walk.path[:, 1], walk.path[:, 0], ".-", color="0.3", ms=4, lw=1)
    some = slice(0, None, 6)
    axes.quiver(
        *walk.path[some, ::-1].T,
        np.sin(walk.heading_rad[some]),
        np.cos(walk.heading_rad[some]),
        color=AXIS_COLOURS[0],
        scale=14,
        width=0.008,
        zorder=3,
    )
    for k, text, off in ((6, "ahead", -6), (24, "ahead, and a turn\nto the right", -8), (53, "to the right", 26)):
        side = "right" if off < 0 else "left"
        axes.annotate(text, walk.path[k, ::-1], (off, 0), textcoords="offset points", fontsize=9, ha=side)
    axes.set(xlabel="path y (radii)", ylabel="path x (radii)", xlim=(-1.8, 4.4), aspect="equal")
    axes.tick_params(labelsize=8)
    axes.set_title("path and heading (arrows) of a walk", fontsize=10)


if __name__ == "__main__":
    main()
