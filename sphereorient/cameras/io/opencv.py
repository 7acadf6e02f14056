"""Camera files with OpenCV's lens: of OpenCV, ROS, anipose, COLMAP, and of scripts with OpenCV's names."""

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.cameras.brown import BrownCamera
from sphereorient.cameras.camera import Camera
from sphereorient.cameras.checks import camera_error, named
from sphereorient.cameras.fisheye import FisheyeCamera
from sphereorient.errors import CameraError
from sphereorient.files.whole_file import TEXT_BYTES, read_whole
from sphereorient.files.yaml_file import FAULTS, parse_yaml, short, yaml_words

SUFFIXES = (".yml", ".yaml", ".xml", ".json", ".toml", ".txt")
MOST_NODES = 200_000  # OpenCV's sample adds the corners of all pictures
# Names of lens models; True: the coefficients are k1 to k4 of cv2.fisheye.
FISHEYE = {"": False, "plumb_bob": False, "radtan": False, "rational_polynomial": False}
FISHEYE |= {"fisheye": True, "equidistant": True}
# Meanings of keys, without case and underscores.
KEYS = {
    "camera_matrix": "cameramatrix intrinsicmatrix matrix mtx k m",
    "distortion_coefficients": "distortioncoefficients distortions distortion distcoeffs distcoeff dist d",
    "R": "r rvec rotation",
    "T": "t tvec translation",
    "image_size": "imagesize size",
    "image_width": "imagewidth width",
    "image_height": "imageheight height",
    "distortion_model": "distortionmodel",
    "fisheye_model": "fisheyemodel fisheye",
    "name": "name cameraname",
}
MEANING = {name: meaning for meaning, names in KEYS.items() for name in names.split()}
SIDE = re.compile(r"(.+?)(?:(1|left|l)|(2|right|r))")  # keys of a stereo pair, likewise
RECTIFIED = {"p", "projectionmatrix"}  # with one of them ROS' R rotates the rectified picture, and is no pose
# COLMAP's models and their numbers of parameters. Source: its sensor/models.h.
COLMAP = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "FULL_OPENCV": 12}
COLMAP |= {"SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "OPENCV_FISHEYE": 8}

Floats = NDArray[np.float64]
Tree = dict[str, Any]  # a file, or a part of it
Said = dict[str, tuple[str, Any]]  # key and value in a file, by the meaning of the key
Part = tuple[str, Said, list[str]]  # a camera's name, its entries in the file, and the unused keys


@dataclass(frozen=True, kw_only=True)
class FoundCamera:
    """A camera in a file of another program."""

    name: str  # the file's name for a single camera
    camera: Camera
    placed: bool = True  # False: no R and T in the file; the camera's frame is the lab
    unread: tuple[str, ...] = ()  # keys of the file that were not used


def load_camera_files(paths: Sequence[Path | str], image_size: tuple[int, int] | None = None) -> list[FoundCamera]:
    """Read cameras whose lens is OpenCV's; the first pixel's centre is (0, 0), T is taken as mm. A file is OpenCV's
    YAML, XML or JSON, ROS' camera_info, anipose's TOML, COLMAP's cameras.txt, or any YAML, JSON or TOML with keys of
    `KEYS`: of one camera, of several by name, or of a stereo pair (M1, D1, M2, D2, R, T). A file of R and T alone
    belongs to the one before. `image_size` (W, H), px, is for files without it. Raises CameraError: another file, a
    missing or impossible key, shear, a lens other than k1, k2, p1, p2, k3 or cv2.fisheye's k1 to k4.
    """
    trees: list[tuple[Path, Tree]] = []
    for path in map(Path, paths):
        tree = _tree(path)
        if trees and not _parts(path, tree) and {"R", "T"} <= set(_said(tree)):
            trees[-1][1].update(tree)  # extrinsics.yml of OpenCV's stereo sample
        else:
            trees.append((path, tree))
    found = []
    for path, tree in trees:
        parts = _parts(path, tree)
        if not parts:
            do = "name the matrix camera_matrix in the file"
            raise camera_error(f"{path}, camera_matrix", "3 x 3 numbers for each camera", f"keys {short([*tree])}", do)
        for name, said, unread in parts:
            with named(str(path) if len(parts) == 1 else f"{path}, {name}"):
                camera = _camera(said, image_size)
            found.append(FoundCamera(name=name, camera=camera, placed="T" in said, unread=tuple(unread)))
    return found


def _tree(path: Path) -> Tree:
    """Parse a file into mappings, lists, numbers and texts; numbers may still be texts."""
    content = read_whole(path, TEXT_BYTES, "a camera file", CameraError, "correct the path")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        expected = f"a file ending in {', '.join(SUFFIXES)}, or all in .ori"
        do = "name camera files of OpenCV, ROS, anipose, COLMAP (cameras.txt) or OpenPTV"
        raise camera_error(str(path), expected, f"'{path.name}'", do)
    text = content.decode("utf-8-sig", errors="replace")
    try:
        if suffix == ".txt":
            return _colmap(path, text)
        if suffix == ".toml":
            return tomllib.loads(text)
        if suffix == ".xml":
            tree = _xml(ElementTree.fromstring(text))
        else:  # JSON is YAML except for tabs; OpenCV's first line and tags are not
            text = re.sub(r"\A%YAML.*|!!opencv-[a-z-]+", "", text.replace("\t", " "))
            tree = parse_yaml(text, MOST_NODES)
    except (*FAULTS, ElementTree.ParseError, RecursionError) as fault:
        raise camera_error(str(path), "a file that can be parsed", yaml_words(fault), "correct it there") from None
    if not isinstance(tree, dict):
        raise camera_error(str(path), "keys and values", short(tree), "name a camera file")
    return tree


def _xml(element: ElementTree.Element) -> Any:
    """Return an element of OpenCV's XML, in which list entries are named _ and a matrix is one text."""
    if not len(element):
        words = (element.text or "").split()
        return words[0] if len(words) == 1 else words
    if all(child.tag == "_" for child in element):
        return [_xml(child) for child in element]
    return {child.tag: _xml(child) for child in element}


def _colmap(path: Path, text: str) -> Tree:
    """Return the cameras of COLMAP's cameras.txt, whose first pixel has its centre at (0.5, 0.5)."""
    tree: Tree = {}
    for line in text.splitlines():
        name, model, *words = [*line.split(), "", ""]
        if not name or name.startswith("#"):
            continue
        where = f"{path}, camera {name[:20]}"
        if model not in COLMAP:
            expected, do = f"one of {', '.join(COLMAP)}", "name COLMAP's cameras.txt with such a model"
            raise camera_error(where, expected, short(model), do)
        expected = f"width, height and {COLMAP[model]} parameters of {model}"
        size, numbers = np.split(_numbers(where, words[:-2], expected, 2 + COLMAP[model]), [2])
        single = model.startswith(("SIMPLE", "RADIAL"))
        fx, fy, cx, cy, *coefficients = [*numbers[:1], *numbers] if single else numbers
        tree[f"cam{name}"] = {
            "camera_matrix": [[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]],
            "distortion_coefficients": [*coefficients, *[0.0] * (4 - len(coefficients))],
            "image_size": size,
            "fisheye": model.endswith("FISHEYE"),
        }
    return tree


def _parts(path: Path, tree: Tree) -> list[Part]:
    """Return the cameras in a file; empty if there are none."""
    said = _said(tree)
    if "camera_matrix" in said:
        return [(path.name.partition(".")[0], said, _unread(tree, said))]
    inside = {key: _said(part) for key, part in tree.items() if isinstance(part, dict)}
    inside = {key: part for key, part in inside.items() if "camera_matrix" in part}
    others = [key for key in tree if key not in inside]
    parts = [(key, part, _unread(tree[key], part) + others) for key, part in inside.items()]
    return [(str(part.get("name", ("", key))[1]), part, unread) for key, part, unread in parts] or _pair(tree, said)


def _pair(tree: Tree, said: Said) -> list[Part]:
    """Return both cameras of a stereo pair, X_2 = R X_1 + T; the lab is the frame of the first."""
    lenses: tuple[Said, Said] = {}, {}
    for key, value in tree.items():
        side = SIDE.fullmatch(_folded(key))
        if side and (meaning := MEANING.get(side[1])) in ("camera_matrix", "distortion_coefficients"):
            lenses[side[3] is not None][meaning] = key, value
    if not all("camera_matrix" in lens for lens in lenses):
        return []
    unread = _unread(tree, said, *lenses)
    first: Said = {"R": ("R", np.eye(3)), "T": ("T", np.zeros(3))} if "T" in said else {}
    return [("cam1", said | lenses[0] | first, unread), ("cam2", said | lenses[1], unread)]


def _said(tree: Tree) -> Said:
    said: Said = {}
    for key, value in tree.items():
        if meaning := MEANING.get(_folded(key)):
            said.setdefault(meaning, (key, value))
    if "T" not in said and RECTIFIED & set(map(_folded, tree)):
        said.pop("R", None)
    return said


def _unread(tree: Tree, *said: Said) -> list[str]:
    used = {key for one in said for key, _ in one.values()}
    return [str(key) for key in tree if key not in used]


def _folded(key: object) -> str:
    return str(key).lower().replace("_", "")


def _camera(said: Said, image_size: tuple[int, int] | None) -> Camera:
    key, K = said["camera_matrix"][0], _numbers(*said["camera_matrix"], "3 x 3 numbers", 9).reshape(3, 3)
    if K[0, 1] != 0 or K[1, 0] != 0 or not np.allclose(K[2], (0, 0, 1)):
        expected = "fx and fy on the diagonal, cx and cy in the last column, zeros and a one elsewhere"
        raise camera_error(key, expected, short(K.round(6).tolist()), "calibrate without shear")
    fisheye = _is_fisheye(said)
    coefficients = torch.from_numpy(_coefficients(said, fisheye))
    lens: dict[str, Any] = {"centre_px": torch.from_numpy(K[:2, 2]), "f_px": torch.from_numpy(K[[0, 1], [0, 1]])}
    lens |= {"image_size": _size(said, image_size)} | _pose(said)
    if fisheye:
        return FisheyeCamera(k=coefficients, **lens)
    return BrownCamera(k=coefficients[[0, 1, 4]], p=coefficients[[2, 3]], **lens)


def _numbers(name: str, value: Any, expected: str, *counts: int) -> Floats:
    """Return numbers in lists, or in OpenCV's rows, cols and data, as one row; CameraError for other counts."""
    try:
        if isinstance(value, dict):
            shape = value["sizes"] if "sizes" in value else (value["rows"], value["cols"])
            flat = np.asarray(value["data"], np.float64).reshape([int(side) for side in shape]).reshape(-1)
        else:
            flat = np.asarray(value, np.float64).reshape(-1)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise camera_error(name, expected, short(value), "correct the file") from None
    if len(flat) not in counts:
        raise camera_error(name, expected, f"{len(flat)} numbers", "correct the file")
    return flat


def _is_fisheye(said: Said) -> bool:
    """Return whether the file names OpenCV's fisheye model; CameraError for an unknown model."""
    key, model = said.get("distortion_model", ("", ""))
    if str(model) not in FISHEYE:
        raise camera_error(key, f"one of {', '.join(FISHEYE)}", short(model), "calibrate with one of these")
    return FISHEYE[str(model)] or bool(_numbers(*said.get("fisheye_model", ("", 0)), "0 or 1", 1)[0])


def _coefficients(said: Said, fisheye: bool) -> Floats:
    if "distortion_coefficients" not in said:
        do = "add distortion_coefficients to the file: k1, k2, p1, p2, k3; zeros for a lens without distortion"
        raise camera_error("distortion_coefficients", "the lens' coefficients", "none under a known name", do)
    key, value = said["distortion_coefficients"]
    if fisheye:
        return _numbers(key, value, "k1 to k4 of the fisheye model", 4)
    flat = _numbers(key, value, "4, 5, 8, 12 or 14 numbers", 4, 5, 8, 12, 14)
    if np.any(flat[5:] != 0):
        last = len(np.trim_zeros(flat, "b"))
        model = "rational" if last <= 8 else "thin prism" if last <= 12 else "tilted"
        raise camera_error(key, "k1, k2, p1, p2, k3 alone", f"OpenCV's {model} model", "calibrate without it")
    return np.pad(flat, (0, 1))[:5]


def _pose(said: Said) -> dict[str, Any]:
    if ("R" in said) != ("T" in said):
        raise camera_error("R, T", "both or none", "one", "write both into the file, X_cam = R X_lab + T")
    R = _numbers(*said.get("R", ("R", np.eye(3))), "a matrix of 3 x 3 or a vector of 3 numbers", 3, 9)
    T = _numbers(*said.get("T", ("T", np.zeros(3))), "3 numbers", 3)
    R = R.reshape(3, 3) if len(R) == 9 else np.asarray(cv2.Rodrigues(R)[0], np.float64)
    return {"R_cam_lab": torch.from_numpy(R), "T_cam_lab_mm": torch.from_numpy(T)}


def _size(said: Said, image_size: tuple[int, int] | None) -> tuple[int, int]:
    where, sides = said.get("image_size", ("image_width, image_height", None))
    if "image_width" in said and "image_height" in said:
        where, sides = "image_width, image_height", [said[f"image_{side}"][1] for side in ("width", "height")]
    if sides is None:
        if image_size is None:
            raise camera_error(where, "two whole numbers", "none", "give image_size (--image-size W,H)")
        return image_size
    sides = _numbers(where, sides, "two whole numbers", 2).tolist()
    width, height = (int(side) if side.is_integer() else side for side in sides)  # the camera refuses fractions
    if image_size not in (None, (width, height)):
        raise camera_error(where, str(image_size), short((width, height)), "correct one")
    return width, height
