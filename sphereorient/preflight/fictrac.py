"""config.txt of FicTrac, whose users film an animal on a ball."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import ExperimentError
from sphereorient.experiment.experiment import refused
from sphereorient.files.whole_file import TEXT_BYTES, read_text
from sphereorient.sphere.view import fitted_circle

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
    limb = np.array(_numbers(values.get("roi_circ", "")))
    return FicTracConfig(
        source=int(values["src_fn"]) if values["src_fn"].isdecimal() else path.parent / values["src_fn"],
        rate_hz=rate[0] if len(rate) == 1 and rate[0] > 0 else None,
        vfov_deg=vfov[0],
        fisheye=fisheye,
        ignored=tuple(_polygons(path, values.get("roi_ignr", ""))),
        circle_px=fitted_circle(limb.reshape(-1, 2)) if len(limb) >= 6 and len(limb) % 2 == 0 else None,
        R_animal_cam=so3.exp(torch.tensor(turn, dtype=torch.float64)),
    )


def _numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(NUMBER, text)]


def _polygons(path: Path, text: str) -> list[NDArray[np.int32]]:
    """Return the innermost { ... } of a text as polygons (n, 2)."""
    polygons = [np.array(_numbers(group)) for group in re.findall(r"\{([^{}]+)\}", text)]
    if any(len(one) < 6 or len(one) % 2 for one in polygons):
        raise refused(f"{path}, roi_ignr", "u, v of three points or more", "another count of numbers", "correct it")
    return [np.rint(one).astype(np.int32).reshape(-1, 2) for one in polygons]
