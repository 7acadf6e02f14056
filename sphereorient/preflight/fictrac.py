"""config.txt of FicTrac, for an animal on a ball."""

import math
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Camera
from sphereorient.cameras.model import focal_of_field
from sphereorient.errors import ExperimentError
from sphereorient.experiment.experiment import input_error
from sphereorient.files.whole_file import TEXT_BYTES, read_text
from sphereorient.sphere.view import fitted_circle
from sphereorient.trajectory.rotations import rotations
from sphereorient.trajectory.walk import FicTracAxes

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
DO = "name the config.txt with which FicTrac ran"
# Keys that change the picture: accepted values, their description, and what to do.
CHOICES = {
    "fisheye": (("n", "y", "0", "1", ""), "y or n", "correct it"),
    "thr_rgb_tfrm": (("grey", "gray", ""), "grey, all colours", "write a movie of this colour alone, in grey"),
}
USED = {"src_fn", "src_fps", "vfov", "roi_circ", "roi_ignr", "c2a_r", *CHOICES}
# Corners of a square along two axes of the animal, in FicTrac's order, by the end of c2a_src. Source: its geometry.h.
SQUARES = {
    "xy": ((0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0), (-0.5, -0.5, 0)),
    "yz": ((0, -0.5, -0.5), (0, 0.5, -0.5), (0, 0.5, 0.5), (0, -0.5, 0.5)),
    "xz": ((0.5, 0, -0.5), (-0.5, 0, -0.5), (-0.5, 0, 0.5), (0.5, 0, 0.5)),
}
SURE = 4.5  # half of 3^2: three sigmas for the tilt of a square with corner errors of one pixel
Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class FicTracConfig:
    """Camera, ball and animal of a config.txt."""

    source: Path | int  # a movie, or the number of a camera
    rate_hz: float | None  # None: that of the file
    vfov_deg: float  # field of view, from the top of the picture to its bottom
    fisheye: bool  # equidistant: vfov_deg / height is the angle of every pixel
    ignored: tuple[NDArray[np.int32], ...]  # polygons (n, 2), px, where something hides the ball
    circle_px: tuple[float, float, float] | None  # u, v, radius of the circle through points of the limb
    limb_px: Floats  # (n, 2), u, v of the points of the limb
    ahead_cam: Floats | None  # (3,), towards the ball's centre, if stated: `roi_c` has priority over the limb
    turn: Floats  # (3,), rad, from camera to animal; of c2a_r, or (4, 2), px: the corners of the square of c2a_src
    plane: str | None  # of the square: xy, yz or xz of the animal; None: `turn` is a rotation
    unread: tuple[str, ...]  # keys that are ignored

    def R_animal_cam(self, image_size: tuple[int, int]) -> Tensor:
        """Return the rotation (3, 3) to the animal's axes: x ahead, y right, z down; ExperimentError: corners do not
        show it.
        """
        if self.plane is None:
            return so3.exp(torch.from_numpy(self.turn))
        return _R_of_square(
            np.array(SQUARES[self.plane]), self.rays_cam(self.turn, image_size), 1 / self.focal_px(image_size)
        )

    def focal_px(self, image_size: tuple[int, int]) -> float:
        """Return the focal length, px, of a picture (width, height); of a fisheye px/rad."""
        height = image_size[1]
        return height / math.radians(self.vfov_deg) if self.fisheye else focal_of_field(height, self.vfov_deg)

    def rays_cam(self, points_px: Floats, image_size: tuple[int, int]) -> Floats:
        """Return unit rays (n, 3) of points (n, 2), px, by FicTrac's camera, whose axis is in the picture's middle."""
        aside = points_px - np.array(image_size) / 2
        away = np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-9)
        angle = away / self.focal_px(image_size)
        angle = angle if self.fisheye else np.arctan(angle)
        return np.hstack([aside / away * np.sin(angle), np.cos(angle)])


def read_fictrac_config(path: Path) -> FicTracConfig:
    """Read config.txt. Raises ExperimentError: not such a file; no movie, field of view or animal's frame; a colour
    that is not supported.
    """
    lines = read_text(path, TEXT_BYTES, "a config.txt", ExperimentError, DO).splitlines()
    pairs = (line.partition(":") for line in lines if ":" in line and not line.lstrip().startswith(("#", "%")))
    values = {key.strip(): value.strip() for key, _, value in pairs}
    needed = {"src_fn": "the movie", "vfov": "the camera's field of view, degrees"}
    for name, what in needed.items():
        if not values.get(name):
            raise input_error(f"{path}, {name}", what, "none", DO)
    for name, (usual, what, do) in CHOICES.items():
        if values.get(name, "").lower() not in usual:
            raise input_error(f"{path}, {name}", what, f"'{values[name][:40]}'", do)
    vfov = _numbers(values["vfov"])
    fisheye = values.get("fisheye", "").lower() in ("y", "1")
    widest = 360 if fisheye else 180
    if len(vfov) != 1 or not 0 < vfov[0] < widest:
        raise input_error(f"{path}, vfov", f"degrees, 0 to {widest}", f"'{values['vfov'][:40]}'", "correct it")
    used, turn, plane = USED, np.array(_numbers(values.get("c2a_r", ""))), None
    if len(turn) != 3:  # FicTrac then uses the corners
        corners = values.get("c2a_src", "")
        turn, plane = np.array(_numbers(values.get(corners, ""))), corners[-2:]
        if len(turn) != 8 or plane not in SQUARES:
            got, do = f"'{values.get('c2a_r', '')[:40]}'", "run FicTrac's configGui; { 0, 0, 0 } is the camera's frame"
            raise input_error(f"{path}, c2a_r", "three numbers, rad, or four corners by c2a_src", got, do)
        turn, used = turn.reshape(4, 2), USED | {"c2a_src", corners}
    rate, limb = _numbers(values.get("src_fps", "")), _points(values.get("roi_circ", ""))
    ahead = np.array(_numbers(values.get("roi_c", "")))
    return FicTracConfig(
        source=int(values["src_fn"]) if values["src_fn"].isdecimal() else path.parent / values["src_fn"],
        rate_hz=rate[0] if len(rate) == 1 and rate[0] > 0 else None,
        vfov_deg=vfov[0],
        fisheye=fisheye,
        ignored=tuple(np.rint(one).astype(np.int32) for one in _polygons(values.get("roi_ignr", ""))),
        circle_px=fitted_circle(limb) if len(limb) >= 3 else None,
        limb_px=limb,
        ahead_cam=ahead if len(ahead) == 3 and ahead.any() and values.get("roi_r") else None,
        turn=turn,
        plane=plane,
        unread=tuple(key for key in values if key not in used),
    )


def _R_of_square(square: Floats, seen: Floats, pixel_rad: float) -> Tensor:
    """Return the rotation (3, 3) from camera to animal, from corners (4, 3) of a square and unit vectors to them
    (4, 3): least squares between unit vectors. Source: FicTrac's SquareRT. Raises ExperimentError: within a pixel the
    corners also fit the square tilted the other way.
    """

    def off(pose: Floats) -> Floats:
        there = square @ cv2.Rodrigues(pose[:3])[0].T + pose[3:]
        return np.asarray(there / np.linalg.norm(there, axis=1, keepdims=True) - seen).ravel()

    slopes, do = seen[:, :2] / np.maximum(seen[:, 2:], 0.05), "mark another square in FicTrac's configGui, or add c2a_r"
    try:
        _, turns, places, _ = cv2.solvePnPGeneric(square, slopes, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        starts = (np.concatenate(pose).ravel() for pose in zip(turns, places, strict=True))
        best, other = sorted((least_squares(off, start) for start in starts), key=lambda fit: float(fit.cost))
    except (cv2.error, ValueError):
        raise input_error("config.txt, c2a_src", "the corners of a square", "others", do) from None
    R, mirrored = so3.exp(torch.from_numpy(np.stack([best.x[:3], other.x[:3]]))).mT.unbind()
    apart_deg = math.degrees(float(so3.log(R.mT @ mirrored).norm()))
    if apart_deg > 1 and other.cost - best.cost < SURE * pixel_rad**2:
        got = f"corners that fit two rotations {apart_deg:.0f} degrees apart"
        raise input_error("config.txt, c2a_src", "a square whose perspective shows", got, do)
    return R


def fictrac_axes(camera: Camera, config: Path | None) -> FicTracAxes:
    """Return the axes of FicTrac's table for a camera: the experiment's lab, or with a config.txt FicTrac's: its
    "camera" looks at the ball's centre, and c2a_r rotates that frame to its "lab". Raises ExperimentError: no such
    file, or no limb in it. Source: FicTrac 2.1.2, Trackball.cpp (roi_to_cam_r, updatePath), geometry.cpp
    (circleFit_camModel).
    """
    R_cam_lab = camera.R_cam_lab.numpy()
    if config is None:
        return FicTracAxes.of_lab(R_cam_lab)
    said = read_fictrac_config(config)
    ahead = said.ahead_cam
    if ahead is None:
        if len(said.limb_px) < 3:
            got, do = f"{len(said.limb_px)}", "run FicTrac's configGui"
            raise input_error(f"{config}, roi_circ", "three points of the ball's limb or more", got, do)
        rays = said.rays_cam(said.limb_px, camera.image_size)
        normal = np.linalg.svd(rays - rays.mean(0))[2][2]  # of the plane through their ends
        ahead = normal * np.sign(normal @ rays.sum(0))
    across = np.cross([0.0, 0.0, 1.0], ahead / np.linalg.norm(ahead))
    sine = float(np.linalg.norm(across))
    R_cam_roi = rotations((across / max(sine, 1e-12) * np.arcsin(min(sine, 1.0)))[None])[0]
    R_animal = said.R_animal_cam(camera.image_size).numpy()
    return FicTracAxes(R_own_lab=R_animal @ R_cam_roi.T @ R_cam_lab, R_cam_own=R_animal.T)


def _numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(NUMBER, text)]


def _points(text: str) -> Floats:
    """Return numbers as points (n, 2); an odd last number is dropped, as in FicTrac."""
    numbers = _numbers(text)
    return np.array(numbers[: len(numbers) // 2 * 2]).reshape(-1, 2)


def _polygons(text: str) -> list[Floats]:
    """Return the innermost { ... } of a text as polygons (n, 2) of at least three points."""
    return [points for group in re.findall(r"\{([^{}]+)\}", text) if len(points := _points(group)) >= 3]
