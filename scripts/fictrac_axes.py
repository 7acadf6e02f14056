"""Compare heading and path of a rendered movie in the lab's axes, in FicTrac's, and by FicTrac's formulas.

    scripts/fictrac_axes.py [--work FOLDER] [--frames 300]

The ball is 9 degrees beside the camera's axis. `live` follows it without a map and writes lines in the lab's axes and,
with `--axes config.txt`, in FicTrac's. FicTrac itself does not run: `fictrac_columns` repeats its Trackball.cpp (2.1.2)
for known rotations, here those of the movie's truth.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
SIZE, VFOV_DEG, HALF_DEG = (240, 200), 30.0, 7.0
SEED = 4


@dataclass(frozen=True, kw_only=True)
class FicTracSetUp:
    """Camera and ball as in FicTrac's config.txt."""

    size: tuple[int, int]  # px
    vfov_deg: float
    limb_px: Floats  # (n, 2), its roi_circ
    c2a_r: Floats  # (3,)
    fisheye: bool = False

    def text(self, source: str) -> str:
        """Return its config.txt."""
        limb = ", ".join(f"{number:g}" for number in self.limb_px.ravel())
        turn = ", ".join(f"{number:.9f}" for number in self.c2a_r)
        eye = "y" if self.fisheye else "n"
        lines = f"src_fn : {source}", f"vfov : {self.vfov_deg}", f"fisheye : {eye}", f"roi_circ : {{ {limb} }}"
        return "\n".join([*lines, f"c2a_r : {{ {turn} }}"]) + "\n"

    def ball(self) -> Floats:
        """Return the line of sight to the ball's middle, (3,): the normal of the plane through the limb's rays."""
        rays = np.array([self._ray(u, v) for u, v in self.limb_px])
        vectors = np.linalg.eigh(np.cov(rays.T))[1]
        return vectors[:, 0] * np.sign(vectors[:, 0] @ rays.mean(0))

    def _ray(self, u: float, v: float) -> Floats:
        x, y = u - 0.5 * self.size[0], v - 0.5 * self.size[1]
        if self.fisheye:
            alpha = np.hypot(x, y) * np.radians(self.vfov_deg) / self.size[1]
            scale = np.sin(alpha) / np.hypot(x, y)
            return np.array([x * scale, y * scale, np.cos(alpha)])
        ray = np.array([x, y, 0.5 * self.size[1] / np.tan(0.5 * np.radians(self.vfov_deg))])
        return ray / np.linalg.norm(ray)


def fictrac_columns(R_cam_body: Floats, about: FicTracSetUp) -> Floats:
    """Return columns 2 to 4, 6 to 21 of FicTrac's table, (N, 19), for orientations (N, 3, 3) of a ball in true camera
    axes. Source: Trackball::updatePath, doSearch; CmPoint::getRotationTo.
    """
    sphere_c = about.ball()
    axis = np.cross(sphere_c, [0.0, 0.0, 1.0])
    roi_to_cam_r = axis / np.linalg.norm(axis) * np.arcsin(np.linalg.norm(axis))
    R_roi = Rotation.from_rotvec(roi_to_cam_r).as_matrix() @ R_cam_body  # the ball in the remapped picture
    cam_to_lab = Rotation.from_rotvec(about.c2a_r).as_matrix()
    rows, total = [], np.eye(3)
    heading = prev_heading = posx = posy = intx = inty = 0.0
    for k in range(len(R_roi)):
        dr_cam = Rotation.from_matrix(R_roi[k] @ R_roi[max(k - 1, 0)].T).as_rotvec()
        total = Rotation.from_rotvec(dr_cam).as_matrix() @ total
        dr_lab = cam_to_lab @ dr_cam
        r_cam, r_lab = (Rotation.from_matrix(one).as_rotvec() for one in (total, cam_to_lab @ total))
        velx, vely = dr_lab[1], -dr_lab[0]
        step_mag, step_dir = np.hypot(velx, vely), np.arctan2(vely, velx) % (2 * np.pi)
        intx, inty = intx + velx, inty + vely
        heading = (heading - dr_lab[2]) % (2 * np.pi)
        heading_step = ((heading - prev_heading + np.pi) % (2 * np.pi) - np.pi) / 4
        towards = step_dir + prev_heading + heading_step / 2
        for _ in range(4):
            posx, posy = posx + step_mag / 4 * np.cos(towards), posy + step_mag / 4 * np.sin(towards)
            towards += heading_step
        prev_heading = heading
        rows.append([*dr_cam, *dr_lab, *r_cam, *r_lab, posx, posy, heading, step_dir, step_mag, intx, inty])
    return np.array(rows)


def write_movie(folder: Path, frames: int) -> tuple[FicTracSetUp, Floats]:
    """Render the movie and its config.txt; return FicTrac's set-up, and R_cam_body (N, 3, 3)."""
    from sphereorient.bench.ball import BallScene, Caps, write_ball_scene
    from sphereorient.experiment import load_experiment

    paint = Caps(caps=60, radius_deg=(8.0, 16.0))
    scene = BallScene(
        size=SIZE, field_deg=VFOV_DEG, azimuth_deg=8.0, elevation_deg=-4.0, half_deg=HALF_DEG, paint=paint
    )
    experiment = load_experiment(write_ball_scene(folder, scene, frames, SEED))
    R_cam_lab = experiment.cameras["cam1"].R_cam_lab.numpy()
    with h5py.File(folder / "truth.h5") as truth:
        R, X_lab = truth["orientation"][:], truth["position"][0]
    away, radius = R_cam_lab @ X_lab, float(np.sin(np.radians(HALF_DEG)) * np.linalg.norm(X_lab))
    limb = limb_px(away, radius)
    c2a_r = Rotation.from_matrix(R_cam_lab.T).as_rotvec()
    about = FicTracSetUp(size=SIZE, vfov_deg=VFOV_DEG, limb_px=limb, c2a_r=c2a_r)
    (folder / "config.txt").write_text(about.text("cam1.mkv"))
    for name in ("experiment.yaml", "cameras.yaml"):
        (folder / name).unlink()
    return about, R_cam_lab @ R


def limb_px(X_cam: Floats, radius: float) -> Floats:
    """Return twelve points of a ball's limb, whole pixels as people click them: rays that touch it."""
    ahead = X_cam / np.linalg.norm(X_cam)
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    half, round_ = np.arcsin(radius / np.linalg.norm(X_cam)), 2 * np.pi * np.arange(12)[:, None] / 12
    rays = np.cos(half) * ahead + np.sin(half) * (np.cos(round_) * right + np.sin(round_) * np.cross(ahead, right))
    focal = 0.5 * SIZE[1] / np.tan(0.5 * np.radians(VFOV_DEG))
    return np.round(focal * rays[:, :2] / rays[:, 2:] + 0.5 * np.array(SIZE))


def main() -> None:
    """Print heading, path and the angle between the axes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path)
    parser.add_argument("--frames", type=int, default=300)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = given.work or Path(place) / "movie"
        about, R_cam_body = write_movie(folder, given.frames)
        words = [sys.executable, "-m", "sphereorient.cli"]
        live = ["live", "experiment.yaml", "--source", "movie-fast", "-q", "--to"]
        runs = [["init", "--from-fictrac", "config.txt", "-q"], [*live, "lab.dat"]]
        for run in [*runs, [*live, "fictrac.dat", "--axes", "config.txt"]]:
            subprocess.run([*words, *run], cwd=folder, check=True, capture_output=True)
        theirs = fictrac_columns(R_cam_body, about)
        tables = {name: np.loadtxt(folder / f"{name}.dat", delimiter=",") for name in ("lab", "fictrac")}
    print(f"the ball is {np.degrees(np.arccos(about.ball()[2])):.1f} degrees beside the axis")
    print("| | axes apart, degrees | heading at the end, rad | end of the path, radii |\n|---|---|---|---|")
    for name, table in tables.items():
        apart = Rotation.align_vectors(theirs[:, 3:6], table[:, 5:8])[0].magnitude()
        x, y, heading = table[-1, 14:17]
        print(f"| live, {name} | {np.degrees(apart):.2f} | {heading:.3f} | {x:.3f}, {y:.3f} |")
    end = theirs[-1]
    print(f"| FicTrac's formulas | | {end[14]:.3f} | {end[12]:.3f}, {end[13]:.3f} |")


if __name__ == "__main__":
    main()
