"""OpenPTV's calibration files: .ori and .addpar of each camera, ptv.par of all.

OpenPTV's first pixel has its centre at (0.5, 0.5), ours at (0, 0). Its camera looks along its -z with y up.
"""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras.brown import OpenPTVCamera
from sphereorient.cameras.camera import Camera
from sphereorient.cameras.checks import camera_error, named
from sphereorient.cameras.model import middle_of_picture
from sphereorient.cameras.port import Port, PortCamera
from sphereorient.errors import CameraError
from sphereorient.files.whole_file import TEXT_BYTES, read_text
from sphereorient.files.yaml_file import read_yaml, short

# Number and names of the values in each file.
ORI = 21, "centre, angles, matrix, xh yh cc, glass vector"
ADDPAR = 7, "k1 k2 k3 p1 p2 scx she"
PAR = 12, "hp_flag allCam_flag tiff_flag imx imy pix_x pix_y chfield n1 n2 n3 d after the cameras' names"
YAML_KEYS = ("imx", "imy", "pix_x", "pix_y", "chfield", "mmp_n1", "mmp_n2", "mmp_n3", "mmp_d")
MOST_NAMES = 4  # camera names in files of older programs, whatever the number of cameras
NO_ADDPAR = [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]  # OpenPTV's defaults without the file
AXES = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))  # OpenPTV's camera components to ours


@dataclass(frozen=True)
class PtvPar:
    """Content of ptv.par: the sensor, and the media between camera and liquid."""

    image_size: tuple[int, int]  # W, H px
    pixel_pitch_mm: tuple[float, float]
    n_air: float = 1.0
    n_glass: float = 1.0
    n_fluid: float = 1.0
    thickness_mm: float = 0.0


def load_openptv(ori: Path | str, par: PtvPar, addpar: Path | str | None = None) -> Camera:
    """Read a camera from .ori and .addpar (None: no distortion), behind a port if the media refract.
    The lab is OpenPTV's world, mm; as in OpenPTV, the angles of the .ori file are used, not its matrix.
    Source: OpenPTV's read_ori; dm = Rx(omega) Ry(phi) Rz(kappa), R_cam_lab = diag(1, -1, -1) dm^T. Raises CameraError
    (a missing, truncated or malformed file, or impossible parameters).
    """
    v = _numbers(Path(ori), None, *ORI)
    centre, angles, (xh, yh, cc), glass = v[:3], v[3:6], v[15:18], v[18:21]
    *k_p, scx, she = NO_ADDPAR if addpar is None else _numbers(Path(addpar), None, *ADDPAR)
    if scx != 1.0:
        warnings.warn(f"{addpar}: scx = {scx:g} was read as x' = scx x, y' = y, OpenPTV's classic form.", stacklevel=2)
    R_cam_lab = AXES @ so3.from_tait_bryan(_tensor(angles)).mT
    shift_px = _tensor((xh / par.pixel_pitch_mm[0], -yh / par.pixel_pitch_mm[1]))
    with named(str(ori)):
        camera = OpenPTVCamera(
            image_size=par.image_size,
            R_cam_lab=R_cam_lab,
            T_cam_lab_mm=-R_cam_lab @ _tensor(centre),
            centre_px=middle_of_picture(par.image_size) + shift_px,
            f_mm=_tensor(cc),
            pixel_pitch_mm=_tensor(par.pixel_pitch_mm),
            k=_tensor(k_p[:3]),
            p=_tensor(k_p[3:]),
            scx=_tensor(scx),
            she=_tensor(she),
        )
        if par.n_air == par.n_glass == par.n_fluid:  # equal indices: no wall
            return camera
        return PortCamera(camera=camera, port=_port(glass, par))


def load_ptv_par(path: Path | str) -> PtvPar:
    """Read the sensor and the media from ptv.par (also with more names than cameras, as older programs write it), or
    from the key ptv of OpenPTV's YAML; CameraError if missing, malformed or interlaced.
    """
    path = Path(path)
    parts = PAR
    if path.suffix in (".yaml", ".yml"):
        document = read_yaml(path, CameraError)
        ptv = document.get("ptv") if isinstance(document, dict) else None
        parts = len(YAML_KEYS), " ".join(YAML_KEYS)
        words = [str(ptv[key]) for key in YAML_KEYS if key in ptv] if isinstance(ptv, dict) else []
    else:
        words = _words(path, "\n")
        count = words[0].strip() if words else ""
        if not (count.isascii() and count.isdigit() and len(count) < 4):
            do = "name OpenPTV's ptv.par, or its YAML with the key ptv"
            raise camera_error(str(path), "the number of cameras first", short(count[:20]), do)
        names = max(2 * int(count), min(len(words) - 1 - PAR[0], 2 * MOST_NAMES))
        words = words[1 + names :]
    imx, imy, pix_x, pix_y, chfield, *media = _numbers(path, words, *parts)[-len(YAML_KEYS) :]
    if chfield != 0:
        got, do = f"chfield {chfield:g}", "make whole frames of the fields first"
        raise camera_error(str(path), "whole frames (chfield 0)", got, do)
    if min(imx, imy, pix_x, pix_y, *media[:3]) <= 0:
        expected, do = "sizes, pixels and indices above zero", f"correct them ({PAR[1]})"
        raise camera_error(str(path), expected, "zero or less", do)
    return PtvPar((int(imx), int(imy)), (pix_x, pix_y), *media)


def _port(glass_mm: Sequence[float], par: PtvPar) -> Port:
    vector = _tensor(glass_mm)
    distance = vector.norm()
    if float(distance) == 0:
        do = "write the wall's normal; its length is the distance of the wall's liquid side from the origin"
        raise camera_error("glass vector", "a vector longer than 0", "0 0 0", do)
    return Port(
        normal=vector / distance,
        offset_mm=distance,
        thickness_mm=_tensor(par.thickness_mm),
        n_glass=_tensor(par.n_glass / par.n_air),
        n_fluid=_tensor(par.n_fluid / par.n_air),
    )


def _words(path: Path, separator: str | None = None) -> list[str]:
    text = read_text(path, TEXT_BYTES, "a text file of OpenPTV", CameraError, "correct the path")
    return text.strip().split(separator)


def _numbers(path: Path, words: Sequence[str] | None, count: int, parts: str) -> list[float]:
    words = _words(path) if words is None else words
    if len(words) != count:
        do = "copy the file again, it is cut off" if len(words) < count else "name a file of this kind"
        raise camera_error(str(path), f"{count} numbers ({parts})", str(len(words)), do)
    numbers = []
    for place, word in enumerate(words):
        try:
            number = float(word)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            name, do = f"{path}, number {place + 1} of {count}", f"correct it ({parts})"
            raise camera_error(name, "a finite number", short(word[:20]), do)
        numbers.append(number)
    return numbers


def _tensor(value: object) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)
