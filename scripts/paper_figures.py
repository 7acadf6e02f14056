"""The figures of the paper in its own layout, one function each; 8 to 12 are those of the report."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import torch
from matplotlib import colormaps, patheffects
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from paper_table import Measured, whole_in_picture
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Camera
from sphereorient.errors import TrackError, refusal
from sphereorient.experiment import Experiment, open_movies
from sphereorient.methods.paper import in_the_lab
from sphereorient.report import plots
from sphereorient.report.build import uncorrected
from sphereorient.report.plots import style as look
from sphereorient.search import Candidates, TemplateBank, crop_disk
from sphereorient.sphere import load_texture, orthographic_view
from sphereorient.statistics.cameras import camera_distances
from sphereorient.statistics.summary import Distributions
from sphereorient.trajectory import Reason, Trajectory
from sphereorient.trajectory.rotations import tait_bryan

Floats = NDArray[np.float64]
SIZE_PX = 80  # of the disks that are compared
CAMERA = "cam2"  # its lamps leave more candidates
SHOWN_FRAMES = 80  # of the path through the candidates
WANTED = 5  # candidates of the example
OUTSIDE = 0.5  # grey beside a rendering


@dataclass(frozen=True, kw_only=True, eq=False)
class Example:
    """One picture of one camera with what was found in it; made by `example_of`."""

    experiment: Experiment
    track: Trajectory  # of the method `paper`
    frame: int
    picture: NDArray[np.uint8]  # (H, W)
    texture: Tensor  # (H, 2 H)
    R_lab_view: Tensor  # (3, 3)

    @property
    def camera(self) -> Camera:
        """The camera of the picture."""
        return self.experiment.cameras[CAMERA]

    @property
    def place(self) -> tuple[float, float, float]:
        """Centre u, v and radius of the disk, px."""
        seen = self.track.cameras[CAMERA]
        return (*seen.centre_px[self.frame].tolist(), float(seen.radius_px[self.frame]))

    @property
    def disk(self) -> Tensor:
        """The disk, (S, S) grey levels."""
        return torch.from_numpy(crop_disk(self.picture, *self.place, SIZE_PX))

    @property
    def candidates(self) -> tuple[Tensor, Floats]:
        """R_view_body (M, 3, 3) and T (M,) of the candidates, best first."""
        seen = self.track.cameras[CAMERA]
        rows = slice(*seen.candidate_offset[self.frame : self.frame + 2])
        return self.R_lab_view.mT @ torch.from_numpy(seen.candidate_orientation[rows]), seen.candidate_score[rows]


def example_of(found: Measured) -> Example:
    """Choose the track with the most valid frames, and in it a frame with several candidates for the whole ball."""
    number = int(np.argmax([track.valid.sum() for track in found.tracks]))
    track, experiment = found.tracks[number], found.experiments[number]
    seen, camera = track.cameras[CAMERA], experiment.cameras[CAMERA]
    good = track.valid & (np.array(seen.reason) == Reason.OK)
    good &= whole_in_picture(seen.centre_px, camera)
    if not good.any():
        do = "choose another --out, and film again"
        raise TrackError(refusal(CAMERA, expected="a frame with the whole ball", got="none", do=do))
    counts = np.diff(seen.candidate_offset)
    wanted = np.where(good, np.abs(counts - WANTED), 1000)
    chosen = np.flatnonzero(wanted == wanted.min())
    frame = int(chosen[len(chosen) // 2])
    with open_movies(experiment, [CAMERA])[CAMERA] as movie:
        picture = np.asarray(movie.sample([frame])[0])
    centre = torch.from_numpy(seen.centre_px[frame : frame + 1])
    view = in_the_lab(Candidates.none((Reason.OK,)), camera, centre).R_lab_view
    assert view is not None
    assert experiment.texture_path is not None
    return Example(
        experiment=experiment,
        track=track,
        frame=frame,
        picture=picture,
        texture=load_texture(experiment.texture_path),
        R_lab_view=view[0],
    )


def blank(axes: Axes, words: str = "", below: str = "") -> None:
    """Remove ticks and frame of a panel with a picture, and label it."""
    axes.grid(False)
    axes.set(xticks=[], yticks=[])
    axes.set_title(words, fontsize=7.5)
    axes.set_xlabel(below, fontsize=7.5)
    for spine in axes.spines.values():
        spine.set_visible(False)


def show(axes: Axes, picture: Any, words: str = "", below: str = "", **more: Any) -> None:
    """Draw a grey picture."""
    axes.imshow(picture, **({"cmap": "gray", "interpolation": "nearest"} | more))
    blank(axes, words, below)


def rendered(texture: Tensor, R_view_body: Tensor, size_px: int = SIZE_PX) -> NDArray[np.float32]:
    """Return pictures (..., S, S), 0 black .. 1 white, `OUTSIDE` beside the sphere."""
    return orthographic_view(size_px).render(texture, R_view_body.float(), outside=OUTSIDE).numpy()


def angles(x: float, y: float, z: float) -> Tensor:
    """Return R of Tait-Bryan angles, degrees."""
    return so3.from_tait_bryan(torch.deg2rad(torch.tensor([x, y, z], dtype=torch.float64)))


@look.in_style
def setup(example: Example) -> Figure:
    """Figure 1: the mixer, the cameras, the textured sphere in several orientations."""
    figure = look.new_figure(look.WIDTH_IN, 5.0)
    top, bottom = figure.subfigures(2, 1, height_ratios=[2.6, 1])
    mixer, arrangement = (top.add_subplot(1, 2, k, projection="3d") for k in (1, 2))
    tank(mixer)
    for side in (-1, 1):
        impeller(mixer, 100.0 * side)
    ball(mixer, example.texture, np.zeros(3), 26.0)
    to_scale(mixer, np.full(3, -110.0), np.full(3, 110.0), 1.15)
    mixer.set_title("a) two counter-rotating disks with blades\nin a square tank of 20 cm", fontsize=8)
    tank(arrangement)
    ball(arrangement, example.texture, np.zeros(3), 22.0)
    cameras = {name: camera.R_cam_lab.mT @ -camera.T_cam_lab_mm for name, camera in example.experiment.cameras.items()}
    for (name, centre), colour in zip(cameras.items(), (look.AXIS_COLOURS[0], look.AXIS_COLOURS[2]), strict=True):
        at = 0.55 * centre.numpy()
        arrangement.plot(*np.stack([at, np.zeros(3)]).T, color=colour, linewidth=1.4)
        arrangement.scatter(*at, color=colour, marker="s", s=60, depthshade=False)
        arrangement.text(
            *(at + np.array([25.0, 0.0, -45.0])), f"{name}\n600 Hz\n650 × 650", color=colour, fontsize=7, va="center"
        )
    for direction, name, colour in zip(np.eye(3), "xyz", look.AXIS_COLOURS, strict=True):
        corner = np.array([100.0, -100.0, -100.0])
        arrangement.quiver(*corner, *(70 * direction), color=colour, linewidth=1.4, arrow_length_ratio=0.25)
        arrangement.text(*(corner + 92 * direction), name, color=colour, fontsize=8, ha="center", va="center")
    to_scale(arrangement, np.array([-120.0, -310.0, -110.0]), np.array([120.0, 110.0, 310.0]), 1.35)
    arrangement.set_title("b) two cameras at 90 degrees\n", fontsize=8)
    R = so3.random_rotations(7, generator=torch.Generator().manual_seed(3))
    for axes, picture in zip(bottom.subplots(1, 7), rendered(example.texture, R), strict=True):
        show(axes, picture)
    bottom.suptitle("c) the painted sphere in seven orientations", fontsize=8)
    return figure


def tank(axes: Any) -> None:
    """Draw the edges of a cube of 200 mm."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 100.0
    for k, a in enumerate(corners):
        for b in corners[k + 1 :]:
            if np.isclose(np.linalg.norm(a - b), 200):
                axes.plot(*np.stack([a, b]).T, color=look.GREY, linewidth=0.7)
    axes.view_init(elev=22, azim=-62)
    axes.set_axis_off()


def to_scale(axes: Any, low: Floats, high: Floats, zoom: float) -> None:
    """Show the box between two corners, with one scale for all axes."""
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(tuple(high - low), zoom=zoom)


def impeller(axes: Any, x: float) -> None:
    """Draw a disk across x with eight straight blades."""
    angle = np.linspace(0, 2 * np.pi, 60)
    inward = x - 12 * np.sign(x)
    axes.plot_surface(
        np.full((2, 60), x), np.outer([0, 96], np.cos(angle)), np.outer([0, 96], np.sin(angle)), color="0.7", alpha=0.5
    )
    for blade in np.arange(8) * np.pi / 4:
        radii = np.array([12.0, 96.0])
        plane = np.array([[x, x], [inward, inward]])
        axes.plot_surface(
            plane, np.tile(radii * np.cos(blade), (2, 1)), np.tile(radii * np.sin(blade), (2, 1)), color="0.45"
        )
    turn = np.linspace(0.2, 1.5, 30) if x > 0 else np.linspace(1.5, 0.2, 30)
    ring = np.stack([np.full(30, 1.06 * x), 108 * np.cos(turn), 108 * np.sin(turn)])
    axes.plot(*ring, color="black", linewidth=1)
    axes.quiver(*ring[:, -2], *(ring[:, -1] - ring[:, -3]) * 3, color="black", linewidth=1, arrow_length_ratio=1.2)


def ball(axes: Any, texture: Tensor, centre: Floats, radius: float) -> None:
    """Draw the painted sphere."""
    height = 48
    rows = torch.linspace(0, texture.shape[0] - 1, height).long()
    grey = texture[rows][:, torch.linspace(0, texture.shape[1] - 1, 2 * height).long()].numpy()
    longitude, latitude = np.meshgrid(
        np.linspace(-np.pi, np.pi, 2 * height + 1), np.linspace(np.pi / 2, -np.pi / 2, height + 1)
    )
    points = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    colours = np.repeat(grey[..., None], 3, axis=-1)
    axes.plot_surface(
        *(centre[:, None, None] + radius * points),
        facecolors=colours,
        rstride=1,
        cstride=1,
        shade=False,
        linewidth=0,
        antialiased=False,
    )


@look.in_style
def rotations(example: Example) -> Figure:
    """Figure 2: the three rotations of Tait-Bryan angles, about the fixed z, y and x (errata E9)."""
    figure = look.new_figure(look.WIDTH_IN, 2.4)
    theta = (35.0, 30.0, 50.0)
    steps = [
        ((0, 0, 0), "lab and body"),
        ((0, 0, theta[2]), r"$R_z(\theta_z)$"),
        ((0, *theta[1:]), r"$R_y(\theta_y) R_z$"),
    ]
    steps.append((theta, r"$R_x(\theta_x) R_y R_z$"))
    for k, (angle, words) in enumerate(steps):
        axes = figure.add_subplot(1, 4, k + 1, projection="3d")
        R = angles(*angle).numpy()
        for i, style in enumerate(look.COMPONENTS):
            axes.plot(*np.outer(np.eye(3)[i], [0, 1.15]), color="0.65", linewidth=0.9)
            axes.quiver(*np.zeros(3), *R[:, i], color=style.colour, linewidth=1.8, arrow_length_ratio=0.16)
            axes.text(*(1.2 * R[:, i]), style.name, color=style.colour, fontsize=8, ha="center", va="center")
        if k:
            before = angles(*steps[k - 1][0]).numpy()
            about = 3 - k  # z, y, x
            axis = np.eye(3)[about]
            axes.plot(*np.outer(axis, [-1.3, 1.3]), color="black", linewidth=1, linestyle=(0, (4, 2)))
            for i in range(3):
                if abs(before[about, i]) < 0.999:
                    turn = torch.from_numpy(np.outer(np.linspace(0, math.radians(theta[about]), 20), axis))
                    axes.plot(
                        *(so3.exp(turn).numpy() @ (0.8 * before[:, i])).T, color=look.COMPONENTS[i].colour, linewidth=1
                    )
        axes.set_title(words, fontsize=8, pad=12)
        to_scale(axes, np.full(3, -0.85), np.full(3, 0.95), 1.4)
        axes.view_init(elev=22, azim=35)
        axes.set_axis_off()
    look.note(figure, "grey: lab axes; dashed: the fixed axis of this rotation; coloured: body axes and their paths")
    return figure


@look.in_style
def renderings(example: Example) -> Figure:
    """Figure 3: a camera picture with its contrast enhanced, and rendered orientations around it."""
    figure = look.new_figure(look.WIDTH_IN, 4.9)
    columns, rows = 7, 5
    grid = figure.add_gridspec(rows, columns)
    enhanced = cv2.createCLAHE(4.0, (4, 4)).apply(cv2.convertScaleAbs(np.sqrt(example.picture / 255.0) * 255))
    show(figure.add_subplot(grid[:3, :3]), enhanced, f"{CAMERA}, contrast enhanced")
    R, _ = example.candidates
    places = [(r, c) for r in range(rows) for c in range(columns) if r >= 3 or c >= 3]
    for r, c in places:
        turned = angles(24.0 * (r - 2), 0.0, 0.0) @ angles(0.0, 24.0 * (c - 3), 0.0) @ R[0]
        show(figure.add_subplot(grid[r, c]), rendered(example.texture, turned))
    look.note(figure, "renderings: 24 degrees from column to column and from row to row")
    return figure


@look.in_style
def extraction(example: Example) -> Figure:
    """Figure 4: grey disk, paint of three values, rendering, and their product, whose mean gives T."""
    figure = look.new_figure(look.WIDTH_IN, 2.25)
    bank = TemplateBank(example.texture, SIZE_PX)
    paint = bank.paint(example.disk)
    R, _ = example.candidates
    synthetic = 2 * bank.renderer(R[0].float()) - 1
    quality = float(bank.quality(paint, R[0].float()))
    panels = figure.subplots(1, 4)
    grey = np.where(orthographic_view(SIZE_PX).inside, example.disk, np.nan)
    show(panels[0], grey, "grey disk G", f"{2 * example.place[2]:.0f} px across")
    three = {"vmin": -1, "vmax": 1}
    show(panels[1], paint, "paint I", "−1 black, 0 undecided, +1 white", **three)
    show(panels[2], synthetic, "rendering S", "of the best candidate", **three)
    show(
        panels[3], paint * synthetic, "product I · S", f"T = ½ + mean / 2 = {quality:.3f}", **(three | {"cmap": "PRGn"})
    )
    return figure


@look.in_style
def candidates(example: Example) -> Figure:
    """Figure 5: T of the coarse grid, the possible orientations with their groups, and the candidates."""
    R, score = example.candidates
    shown = min(len(R), 7)
    figure = look.new_figure(look.WIDTH_IN, 4.6)
    top, bottom = figure.subfigures(2, 1, height_ratios=[2.2, 1])
    left, right = top.subfigures(1, 2, width_ratios=[1, 2.6])
    u, v, radius = example.place
    axes = left.subplots()
    show(axes, example.picture, f"{CAMERA}, frame {example.frame}")
    reach = 1.4 * radius
    axes.set(xlim=(u - reach, u + reach), ylim=(v + reach, v - reach))
    bank = TemplateBank(example.texture, SIZE_PX)
    grid, quality = bank.grid, bank.score(bank.paint(example.disk))
    possible = grid[bank.groups(quality[None])[0] >= 0]
    near = so3.geodesic_distance(possible[:, None].double(), R[None, :shown]).argmin(1)  # the candidate of its group
    sphere = right.add_subplot(projection="mollweide")
    order = quality.argsort()
    points = sphere.scatter(*facing(grid[order]), c=quality[order], s=9, cmap="viridis", linewidth=0)
    colours = [colormaps["tab10"](k) for k in range(shown)]
    outlined = [patheffects.withStroke(linewidth=2.5, foreground="white")]
    for k in range(shown):
        rings = {"facecolor": "none", "edgecolor": [colours[k]], "linewidth": 1.3}
        sphere.scatter(*facing(possible[near == k]), s=30, **rings)
        at = [float(x) for x in facing(R[k])]
        words = {"color": colours[k], "fontsize": 11, "fontweight": "bold", "ha": "center", "va": "center"}
        sphere.annotate(str(k + 1), at, path_effects=outlined, **words)
    sphere.set(xticklabels=[], yticklabels=[])
    sphere.set_title(
        f"T of the {len(grid):,} templates by the body's side that faces the camera (best roll on top);\n"
        f"rings: the {len(possible)} possible orientations, coloured by group; numbers: candidates",
        fontsize=7.5,
    )
    right.colorbar(points, ax=sphere, shrink=0.7, label="T")
    for k, panel in enumerate(bottom.subplots(1, 7)):
        if k < shown:
            show(panel, rendered(example.texture, R[k]), str(k + 1), f"T = {score[k]:.3f}")
            panel.title.set_color(colours[k])
        else:
            panel.remove()
    if len(R) > shown:
        look.note(bottom, f"the best {shown} of {len(R)} candidates")
    return figure


def facing(R_view_body: Tensor) -> tuple[Tensor, Tensor]:
    """Return longitude and latitude on the body, rad, of the direction to the camera."""
    to_camera = -R_view_body[..., 2, :]  # body components of view -z
    return torch.atan2(to_camera[..., 1], to_camera[..., 0]), to_camera[..., 2].clamp(-1, 1).asin()


@look.in_style
def graph(example: Example) -> Figure:
    """Figure 6: a sketch of the graph between candidates, and the path through those of a movie."""
    figure = look.new_figure(look.WIDTH_IN, 3.4)
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.9])
    heights = {1: (1.0, 2.6), 3: (0.5, 1.7, 2.9), 4: (1.2, 2.4), 5: (0.7, 1.8, 3.0)}
    path = {1: 1.0, 3: 1.7, 4: 1.2, 5: 1.8}
    steps = list(heights)
    for a, b in pairwise(steps):
        for start in heights[a]:
            for end in heights[b]:
                chosen = path[a] == start and path[b] == end
                arrow = {"arrowstyle": "->", "color": "black" if chosen else look.SHADE, "lw": 1.8 if chosen else 0.7}
                left.annotate("", (b - 0.1, end), (a + 0.1, start), arrowprops=arrow | {"shrinkA": 4, "shrinkB": 4})
    for step, nodes in heights.items():
        for height in nodes:
            on = path[step] == height
            left.plot(step, height, "o", markersize=10, color="black" if on else "white", markeredgecolor=look.GREY)
    left.text(2, 3.15, "no candidate", ha="center", va="center", fontsize=7, color=look.GREY)
    left.text(3.5, 0.15, r"cost $d(A, B)\,(2 - T_A - T_B) / \Delta t$", ha="center", fontsize=7)
    left.grid(False)
    left.set(xlim=(0.6, 5.4), ylim=(-0.1, 3.4), xticks=range(1, 6), yticks=[], xlabel="time step", title="sketch")
    track = example.track
    seen = track.cameras[CAMERA]
    first = max(0, min(example.frame - SHOWN_FRAMES // 2, len(track) - SHOWN_FRAMES))
    last = min(first + SHOWN_FRAMES, len(track))
    origin = torch.from_numpy(seen.orientation[first:last][np.isfinite(seen.score[first:last])][0])
    rows = slice(int(seen.candidate_offset[first]), int(seen.candidate_offset[last]))
    frame = np.repeat(np.arange(first, last), np.diff(seen.candidate_offset[first : last + 1]))
    apart = np.rad2deg(so3.geodesic_distance(torch.from_numpy(seen.candidate_orientation[rows]), origin).numpy())
    dots = right.scatter(frame, apart, c=seen.candidate_score[rows], s=7, cmap="viridis", linewidth=0)
    chosen = np.rad2deg(so3.geodesic_distance(torch.from_numpy(seen.orientation[first:last]), origin).numpy())
    right.plot(np.arange(first, last), chosen, color=look.AXIS_COLOURS[0], linewidth=1.2, label="path of least cost")
    figure.colorbar(dots, ax=right, label="T of the candidates")
    right.set(xlabel="frame", ylabel="angle from the first orientation (degrees)")
    right.set(title=f"{example.experiment.name}, {CAMERA}", ylim=(-4, 184), yticks=range(0, 181, 45))
    right.legend(loc="upper right", frameon=True)
    return figure


@look.in_style
def sample_track(example: Example) -> Figure:
    """Figure 7: position and angles of one track against time, and below the distance of the two cameras."""
    track = example.track
    figure = look.new_figure(look.WIDTH_IN, 5.6)
    panels = figure.subplots(3, 1, sharex=True, height_ratios=[1, 1.3, 0.8])
    time_ms = 1e3 * track.time
    theta = np.rad2deg(tait_bryan(track.orientation))
    for i, style in enumerate(look.COMPONENTS):
        dots = {"linestyle": "none", "color": style.colour, "marker": style.marker, "markersize": 2.2}
        panels[0].plot(time_ms, track.position[:, i], **dots)
        panels[1].plot(time_ms, theta[:, i], **dots)
    names = list(track.cameras)
    pair = [torch.from_numpy(track.cameras[name].orientation) for name in names[:2]]
    apart = np.rad2deg(so3.geodesic_distance(*pair).numpy())
    panels[2].plot(time_ms, apart, ".", color="black", markersize=2.5)
    panels[0].set(ylabel="position, lab (mm)", ylim=(-110, 110))  # the tank; positions by one camera may be outside
    panels[1].set(ylabel="angles (degrees)", ylim=(-185, 185), yticks=range(-180, 181, 90))
    panels[2].set(yscale="log", ylabel="distance of the\ncameras (degrees)", xlabel="time (ms)")
    look.plain_logarithms(panels[2].yaxis)
    figure.align_ylabels()
    handles = [
        style.handle(f"{style.name}, θ{style.name}", marker=style.marker, linestyle="none") for style in look.COMPONENTS
    ]
    look.legend_of_figure(figure, handles, ncols=3)
    return figure


def camera_distance(found: Measured) -> Figure:
    """Figure 8: PDF of the distance of the cameras, with and without the correction of perspective."""
    rough = [
        uncorrected(track, experiment.cameras)
        for track, experiment in zip(found.tracks, found.experiments, strict=True)
    ]
    return plots.camera_distance_figure(camera_distances(found.tracks, rough))


def distributions(found: Measured) -> Distributions:
    """Return the statistics of two segments or more, or refuse."""
    if found.summary.distributions is None:
        do = "film more movies"
        raise TrackError(refusal("tracks", expected="two segments or more", got="one", do=do))
    return found.summary.distributions


def durations(found: Measured) -> Figure:
    """Figure 9: durations of the segments, with the exponential law."""
    spans = distributions(found).durations
    assert spans is not None  # no segment is cut
    return plots.durations_figure(spans)


OF_EXAMPLE: Mapping[str, tuple[Callable[[Example], Figure], str]] = {
    "01-setup": (setup, "Setup: a) the mixer, b) the cameras, c) the painted sphere."),
    "02-angles": (
        rotations,
        "Tait-Bryan angles. The matrix of the paper rotates about the fixed z, the fixed y and the fixed x, in this "
        "order (errata E9).",
    ),
    "03-renderings": (
        renderings,
        "Upper left: a picture of the movie; the driving disks on either side and their reflections move. Around it: "
        "renderings in neighbouring orientations.",
    ),
    "04-extraction": (
        extraction,
        "From grey levels to the quality T: the disk, its paint in three values, the rendering of the best candidate, "
        "and the product of both (green: equal, violet: different).",
    ),
    "05-candidates": (
        candidates,
        "Candidates of one picture. Each template of the coarse grid is drawn at the side of the body that faces the "
        "camera; below, the renderings of the candidates.",
    ),
    "06-path": (
        graph,
        "The graph between candidates, as a sketch, and the path through the candidates of one camera.",
    ),
    "07-track": (
        sample_track,
        "A track in six dimensions, as measured, and the distance of the two cameras. Positions jump where one camera "
        "alone sees the sphere: they are then known from its size only, and no velocity is computed from them.",
    ),
}
OF_TRACKS: Mapping[str, tuple[Callable[[Measured], Figure], str]] = {
    "08-distance": (camera_distance, "Distance of the cameras, with and without the correction of perspective."),
    "09-durations": (durations, "Durations of the segments, with an exponential law of the same mean."),
    "10-orientations": (
        lambda one: plots.angles_figure(distributions(one).angles, distributions(one).uniformity),
        "The angles, beside those of uniform orientations.",
    ),
    "11-omega": (
        lambda one: plots.densities_figure(one.summary, ["omega_lab"]),
        "Components of the angular velocity, in standard deviations.",
    ),
    "11-increments": (
        lambda one: plots.increments_figure(distributions(one), one.summary.table),
        "Increments of the angular velocity: short lags have the tails of the angular acceleration (errata E7).",
    ),
    "12-alpha": (
        lambda one: plots.densities_figure(one.summary, ["alpha_lab"]),
        "Components of the angular acceleration, in standard deviations.",
    ),
}
OF_PRECISE: Mapping[str, tuple[Callable[[Measured], Figure], str]] = {
    "12-alpha-precise": (OF_TRACKS["12-alpha"][0], "The same by `precise`, which does not damp the bursts."),
}
