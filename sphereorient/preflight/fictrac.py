"""config.txt of FicTrac, whose users film an animal on a ball."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Camera
from sphereorient.errors import ExperimentError
from sphereorient.experiment.experiment import refused
from sphereorient.files.whole_file import TEXT_BYTES, read_text
from sphereorient.sphere.view import fitted_circle
from sphereorient.trajectory.rotations import rotations
from sphereorient.trajectory.walk import FicTracAxes

Floats = NDArray[np.float64]
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
DO = "name the config.txt with which FicTrac ran"
# Keys that change the picture: values that are taken over, what is expected, and what to do.
NOT_READ = {
    "fisheye": (("n", "y", ""), "y or n", "correct it"),
    "thr_rgb_tfrm": (("grey", "gray", ""), "grey, all colours", "write a movie of this colour alone, in grey"),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class FicTracConfig:
    """What a config.txt says of camera, ball and animal."""

    source: Path | int  # a movie, or the number of a camera
    rate_hz: float | None  # None: that of the file
    vfov_deg: float  # field of view, from the top of the picture to its bottom
    fisheye: bool  # equidistant: vfov_deg / height is the angle of every pixel
    ignored: tuple[NDArray[np.int32], ...]  # polygons (n, 2), px, where something hides the ball
    circle_px: tuple[float, float, float] | None  # u, v, radius of the circle through points of the limb
    R_animal_cam: Tensor  # (3, 3): x ahead, y to the right, z down, of the animal
    limb_px: Floats  # (n, 2), u, v of the points of the limb
    ahead_cam: Floats | None  # (3,), towards the ball's middle, where the file states it: `roi_c` goes before the limb


def read_fictrac_config(path: Path) -> FicTracConfig:
    """Read config.txt; ExperimentError for another file, one that lacks movie, field of view or the animal's frame, or
    one of a lens or a colour that is not taken over.
    """
    lines = read_text(path, TEXT_BYTES, "a config.txt", ExperimentError, DO).splitlines()
    pairs = (line.partition(":") for line in lines if ":" in line and not line.lstrip().startswith("#"))
    values = {key.strip(): value.strip() for key, _, value in pairs}
    needed = {"src_fn": "the movie", "vfov": "the camera's field of view, degrees"}
    for name, what in needed.items():
        if not values.get(name):
            raise refused(f"{path}, {name}", what, "none", DO)
    vfov = _numbers(values["vfov"])
    fisheye = values.get("fisheye", "").lower() == "y"
    widest = 360 if fisheye else 180
    if len(vfov) != 1 or not 0 < vfov[0] < widest:
        raise refused(f"{path}, vfov", f"degrees, 0 to {widest}", f"'{values['vfov'][:40]}'", "correct it")
    for name, (usual, what, do) in NOT_READ.items():
        if values.get(name, usual[0]).lower() not in usual:
            raise refused(f"{path}, {name}", what, f"'{values[name][:40]}'", do)
    if not values.get("c2a_r"):
        do = "run FicTrac's configGui, or write c2a_r : { 0, 0, 0 } for the camera's own frame"
        raise refused(f"{path}, c2a_r", "the turn to the animal, rad", "none", do)
    rate, turn = _numbers(values.get("src_fps", "")), _numbers(values["c2a_r"])
    if len(turn) != 3:
        raise refused(f"{path}, c2a_r", "three numbers, rad", f"{len(turn)}", "correct it")
    limb, ahead = (np.array(_numbers(values.get(name, ""))) for name in ("roi_circ", "roi_c"))
    return FicTracConfig(
        source=int(values["src_fn"]) if values["src_fn"].isdecimal() else path.parent / values["src_fn"],
        rate_hz=rate[0] if len(rate) == 1 and rate[0] > 0 else None,
        vfov_deg=vfov[0],
        fisheye=fisheye,
        ignored=tuple(_polygons(path, values.get("roi_ignr", ""))),
        circle_px=fitted_circle(limb.reshape(-1, 2)) if len(limb) >= 6 and len(limb) % 2 == 0 else None,
        R_animal_cam=so3.exp(torch.tensor(turn, dtype=torch.float64)),
        limb_px=limb[: len(limb) // 2 * 2].reshape(-1, 2),
        ahead_cam=ahead if len(ahead) == 3 and ahead.any() and values.get("roi_r") else None,
    )


def fictrac_axes(camera: Camera, config: Path | None) -> FicTracAxes:
    """Return the axes of FicTrac's table for the camera of an experiment: its lab, or with a config.txt those in which
    FicTrac itself writes. Its "camera" looks along the line of sight to the ball's middle, and c2a_r turns this frame,
    not the camera's, to its "lab". Raise ExperimentError: no such file, or one that does not state the ball's limb.
    Source: FicTrac 2.1.2, Trackball.cpp (roi_to_cam_r, updatePath), geometry.cpp (circleFit_camModel).
    """
    R_cam_lab = camera.R_cam_lab.numpy()
    if config is None:
        return FicTracAxes.of_lab(R_cam_lab)
    said = read_fictrac_config(config)
    ahead = said.ahead_cam
    if ahead is None:
        if len(said.limb_px) < 3:
            got, do = f"{len(said.limb_px)}", "run FicTrac's configGui"
            raise refused(f"{config}, roi_circ", "three points of the ball's limb or more", got, do)
        rays = _rays_cam(said, camera.image_size)
        normal = np.linalg.svd(rays - rays.mean(0))[2][2]  # of the plane through their ends
        ahead = normal * np.sign(normal @ rays.sum(0))
    across = np.cross([0.0, 0.0, 1.0], ahead / np.linalg.norm(ahead))
    sine = float(np.linalg.norm(across))
    R_cam_roi = rotations((across / max(sine, 1e-12) * np.arcsin(min(sine, 1.0)))[None])[0]
    R_animal = said.R_animal_cam.numpy()
    return FicTracAxes(R_own_lab=R_animal @ R_cam_roi.T @ R_cam_lab, R_cam_own=R_animal.T)


def _rays_cam(said: FicTracConfig, image_size: tuple[int, int]) -> Floats:
    """Return the unit rays (n, 3) of the limb by FicTrac's camera, whose axis is at half the width and height."""
    away = said.limb_px - np.array(image_size) / 2
    reach, field = np.linalg.norm(away, axis=1, keepdims=True) / image_size[1], np.radians(said.vfov_deg)
    angle = reach * field if said.fisheye else np.arctan(2 * reach * np.tan(field / 2))
    return np.hstack([away / image_size[1] / np.maximum(reach, 1e-12) * np.sin(angle), np.cos(angle)])


def _numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(NUMBER, text)]


def _polygons(path: Path, text: str) -> list[NDArray[np.int32]]:
    """Return the innermost { ... } of a text as polygons (n, 2)."""
    polygons = [np.array(_numbers(group)) for group in re.findall(r"\{([^{}]+)\}", text)]
    if any(len(one) < 6 or len(one) % 2 for one in polygons):
        raise refused(f"{path}, roi_ignr", "u, v of three points or more", "another count of numbers", "correct it")
    return [np.rint(one).astype(np.int32).reshape(-1, 2) for one in polygons]
