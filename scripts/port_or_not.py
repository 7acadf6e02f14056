"""Measure the cost of cameras without a port in a tank: calibrated from the same plate pictures, with and without wall.

    scripts/port_or_not.py EXPERIMENT_FOLDER [--figure port_or_not.png]

The folder holds an experiment behind walls (cameras.yaml exact, calibration/, movies, truth.h5). Both sets of cameras
are compared with the exact ones over the volume, then the movies are tracked with all three. Prints Markdown.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

import h5py
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sphereorient import so3
from sphereorient.bench import Score, score_track
from sphereorient.calibration.document import load_calibration
from sphereorient.calibration.plates import calibrate_cameras
from sphereorient.cameras import Camera, triangulate
from sphereorient.experiment import load_experiment
from sphereorient.run.stages import track_movies
from sphereorient.trajectory import Trajectory

HALF_SIZE_MM = 50.0
COLOURS = {"exact cameras": "#444444", "calibrated, with port": "#009E73", "calibrated, without port": "#D55E00"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """One set of cameras and its results."""

    rms_px: Mapping[str, float]
    cameras: Mapping[str, Camera]
    track: Trajectory
    score: Score


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    folder = arguments.folder
    torch.set_num_threads(1)
    experiment = load_experiment(folder / "experiment.yaml")
    document = load_calibration(folder / "calibration" / "calibration.yaml")
    found = {"calibrated, with port": calibrate_cameras(document)}
    with mock.patch("sphereorient.calibration.plates.doubts", return_value={}):  # else it is refused
        found["calibrated, without port"] = calibrate_cameras(replace(document, ports={}))
    sets: dict[str, tuple[Mapping[str, Camera], Mapping[str, float]]] = {"exact cameras": (experiment.cameras, {})}
    for name, result in found.items():
        sets[name] = result.cameras, {camera: result.rms_px(camera) for camera in result.cameras}
    cases = {}
    for name, (cameras, rms_px) in sets.items():
        changed = replace(experiment, cameras={each: cameras[each] for each in experiment.cameras})
        track = track_movies(changed)
        score = score_track(track, folder / "truth.h5")
        cases[name] = Case(rms_px=rms_px, cameras=cameras, track=track, score=score)
    table(cases, experiment.cameras)
    if arguments.figure:
        draw(cases, experiment.cameras, folder / "truth.h5", arguments.figure)


def table(cases: Mapping[str, Case], exact: Mapping[str, Camera]) -> None:
    print(
        "| cameras | plate pictures, rms px | position over the volume, rms mm | best rigid motion removed, mm | "
        "orientation p50 / p95 (°) | position p50 / p95 (mm) | omega | alpha | acceleration |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    places = volume(9)
    for name, case in cases.items():
        off = errors_mm(case.cameras, exact, places)
        rigid = off - fitted_motion(places, off)
        px = " / ".join(f"{rms:.3f}" for rms in case.rms_px.values()) or "–"
        deg, mm, rates = case.score.percentiles_deg(), case.score.percentiles_mm(), case.score.relative_rms
        print(
            f"| {name} | {px} | {rms(off):.4f} | {rms(rigid):.4f} | {deg[0]:.3f} / {deg[1]:.3f} | "
            f"{mm[0]:.4f} / {mm[1]:.4f} | {rates['omega_lab']:.4f} | {rates['alpha_lab']:.3f} | "
            f"{rates['acceleration']:.4f} |",
            flush=True,
        )


def volume(count: int) -> np.ndarray:
    """Return a lattice of points in the cube, (count^3, 3) mm."""
    at = np.linspace(-HALF_SIZE_MM, HALF_SIZE_MM, count)
    return np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3)


def errors_mm(cameras: Mapping[str, Camera], exact: Mapping[str, Camera], places: np.ndarray) -> np.ndarray:
    """Return positions by `cameras` of points in the exact cameras' pictures, less the points, (n, 3)."""
    one, other = list(exact)
    x = torch.from_numpy(places)
    middle, _ = triangulate(*(cameras[name].rays(exact[name].project(x)) for name in (one, other)))
    return middle.numpy() - places


def fitted_motion(places: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Return the part of small errors (n, 3) that a rigid motion explains."""
    n = len(places)
    turn = np.zeros((n, 3, 3))
    for k, axis in enumerate(np.eye(3)):
        turn[:, :, k] = np.cross(axis, places)
    design = np.concatenate([turn, np.tile(np.eye(3), (n, 1, 1))], axis=2).reshape(3 * n, 6)
    solution = np.linalg.lstsq(design, off.reshape(-1), rcond=None)[0]
    return (design @ solution).reshape(n, 3)


def rms(off: np.ndarray) -> float:
    return float(np.sqrt((off**2).sum(1).mean()))


def draw(cases: Mapping[str, Case], exact: Mapping[str, Camera], truth: Path, path: Path) -> None:
    """Draw the errors of position without a port over two planes, and the errors of orientation and alpha in time."""
    figure = Figure(figsize=(13, 7.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2)
    without = cases["calibrated, without port"]
    for ax, (i, j, k) in zip(axes[0], ((0, 1, 2), (0, 2, 1)), strict=True):
        at = np.linspace(-HALF_SIZE_MM, HALF_SIZE_MM, 13)
        places = np.zeros((len(at) ** 2, 3))
        places[:, i], places[:, j] = (grid.reshape(-1) for grid in np.meshgrid(at, at))
        off = errors_mm(without.cameras, exact, places)
        size = np.linalg.norm(off, axis=1)
        arrows = ax.quiver(
            places[:, i], places[:, j], off[:, i], off[:, j], size, angles="xy", scale_units="xy", cmap="viridis",
            scale=size.max() / 10,
        )  # fmt: skip
        figure.colorbar(arrows, ax=ax, label="error (mm)")
        ax.set(xlabel=f"{'xyz'[i]} (mm)", ylabel=f"{'xyz'[j]} (mm)", aspect="equal")
        ax.set_title(f"position seen less true position without the port, {'xyz'[k]} = 0", fontsize=10)
    with h5py.File(truth) as file:
        alpha, R_true = file["alpha_lab"][()], torch.from_numpy(file["orientation"][()])
    for name, case in cases.items():
        track, t = case.track, 1e3 * case.track.time
        turned = np.rad2deg(so3.log(R_true @ torch.from_numpy(track.orientation).mT).norm(dim=-1).numpy())
        axes[1, 0].plot(t, turned, color=COLOURS[name], lw=1.3, label=name)
        axes[1, 1].plot(t, np.linalg.norm(track.alpha_lab - alpha, axis=1), color=COLOURS[name], lw=1.3, label=name)
    axes[1, 0].set(xlabel="time (ms)", ylabel="error of orientation (°)")
    axes[1, 1].set(xlabel="time (ms)", ylabel="error of alpha (rad/s²)")
    axes[1, 1].axhline(float(np.sqrt((alpha**2).sum(1).mean())), color="0.6", ls=":", label="alpha itself, rms")
    for ax in axes[1]:
        ax.legend(fontsize=8)
        ax.set_ylim(bottom=0)
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
