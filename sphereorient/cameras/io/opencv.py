import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.cameras.brown import BrownCamera
from sphereorient.cameras.checks import camera_error
from sphereorient.cameras.fisheye import FisheyeCamera
from sphereorient.errors import CameraError
from sphereorient.files.whole_file import TEXT_BYTES, check_ending, put_aside, read_whole
from sphereorient.files.yaml_file import short

SUFFIXES = (".yml", ".yaml", ".xml", ".json")  # OpenCV chooses the format by them
MOST = 64  # numbers of a matrix: OpenCV allocates what the file claims before it counts
# OpenCV's parser recurses at each level and can crash. Each level needs one of these; usual files have dozens.
OPENER = re.compile(rb"[\[{]|-\s|<[^/?!]")
MOST_OPENERS, MOST_BLANKS = 3000, 200  # the second: levels by indentation
LENGTHS = (4, 5, 8, 12, 14)  # of distortion_coefficients, in OpenCV's order k1 k2 p1 p2 k3 ...
ROS_MODELS = {"": False, "plumb_bob": False, "rational_polynomial": False, "equidistant": True}  # fisheye or not

Array = NDArray[np.float64]


def load_opencv(path: Path | str, image_size: tuple[int, int] | None = None) -> BrownCamera | FisheyeCamera:
    """Read a camera that OpenCV's calibration has written; the first pixel's centre is (0, 0).
    The file has `camera_matrix`, `distortion_coefficients`, optional `R` or `rvec`, `T` or `tvec` (mm; without them the
    lab is the camera frame), `image_width` and `image_height` (without them give `image_size`, (W, H) px). Raises
    CameraError (no OpenCV file, a missing or impossible key, shear, or distortion beyond k1, k2, p1, p2, k3).
    With `fisheye_model: 1`, or ROS' `distortion_model: equidistant`, the coefficients are k1 to k4 of cv2.fisheye.
    """
    storage = _opened(Path(path))
    try:
        K, fisheye = _camera_matrix(storage), _is_fisheye(storage)
        coefficients = torch.from_numpy(_coefficients(storage, 4 if fisheye else 5))
        lens: dict[str, Any] = {"centre_px": torch.from_numpy(K[:2, 2]), "f_px": torch.from_numpy(K[[0, 1], [0, 1]])}
        lens |= {"image_size": _size(storage, image_size)} | _pose(storage)
        if fisheye:
            return FisheyeCamera(k=coefficients, **lens)
        return BrownCamera(k=coefficients[[0, 1, 4]], p=coefficients[[2, 3]], **lens)
    except CameraError as error:
        raise CameraError(f"{path}, {error}") from None
    finally:
        storage.release()


def save_opencv(path: Path | str, camera: BrownCamera | FisheyeCamera) -> None:
    """Write a camera, T in mm, as OpenCV does, to the last bit, without covariance.
    Raises OutputError (an ending other than .yml, .yaml, .xml or .json, or a file that cannot be written).
    """
    path = Path(path)
    check_ending(path, "OpenCV file", SUFFIXES)
    (fx, fy), (cx, cy) = camera.f_px.tolist(), camera.centre_px.tolist()
    coefficients = camera.k if isinstance(camera, FisheyeCamera) else torch.cat([camera.k[:2], camera.p, camera.k[2:]])
    with put_aside(path) as aside:
        storage = cv2.FileStorage(str(aside), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", camera.image_size[0])
        storage.write("image_height", camera.image_size[1])
        storage.write("camera_matrix", np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
        storage.write("fisheye_model", int(isinstance(camera, FisheyeCamera)))
        storage.write("distortion_coefficients", coefficients.detach().numpy()[:, None])
        storage.write("R", camera.R_cam_lab.detach().numpy())
        storage.write("T", camera.T_cam_lab_mm.detach().numpy()[:, None])
        storage.release()


def _opened(path: Path) -> cv2.FileStorage:
    expected = "a file of OpenCV's FileStorage"
    content = read_whole(path, TEXT_BYTES, expected, CameraError, "correct the path")
    if len(OPENER.findall(content)) > MOST_OPENERS or re.search(rb"[ \t]{%d}" % MOST_BLANKS, content):
        got, do = "one with thousands of lists, tags or levels", "name the file of one camera"
        raise camera_error(str(path), expected, got, do)
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError):  # SystemError: a fault of the parser inside the constructor
        storage = None
    if storage is None or not storage.isOpened() or not storage.root().isMap():
        raise camera_error(str(path), expected, "another", "write it with cv2.FileStorage")
    return storage


def _node(storage: cv2.FileStorage, key: str) -> Array | None:
    """Return a matrix of at most MOST numbers; None for anything else."""
    node = storage.getNode(key)
    if node.empty() or not node.isMap() or not _claims_few(node):
        return None
    try:
        matrix = node.mat()
    except cv2.error:
        return None
    return None if matrix is None or matrix.size > MOST else np.asarray(matrix, np.float64)


def _claims_few(node: cv2.FileNode) -> bool:
    """Return whether a matrix claims at most MOST numbers, by rows and columns or by the sizes of its axes."""
    axes = node.getNode("sizes")
    if axes.empty():
        sides = [_whole(node.getNode(side)) for side in ("rows", "cols")]
    else:
        sides = [_whole(axes.at(k)) for k in range(axes.size())] if axes.isSeq() and axes.size() < 4 else [_whole(axes)]
    known = [side for side in sides if side is not None and 0 < side <= MOST]
    return len(known) == len(sides) and math.prod(known) <= MOST


def _whole(node: cv2.FileNode) -> int | None:
    number = float(node.real()) if node.isInt() or node.isReal() else math.nan
    return int(number) if number.is_integer() else None


def _required(storage: cv2.FileStorage, key: str) -> Array:
    matrix = _node(storage, key)
    if matrix is not None:
        return matrix
    for first in ("K1", "M1"):
        if key == "camera_matrix" and _node(storage, first) is not None:
            expected, got = "the matrix of one camera", f"a stereo pair ({first}, D1, ...)"
            raise camera_error(key, expected, got, "split the stereo file into one file per camera")
    do = "write five zeros where there is no distortion"
    if key == "camera_matrix":
        do = "name a file with camera_matrix as OpenCV writes it, or write f, centre and distortion into cameras.yaml"
    raise camera_error(key, "an OpenCV matrix", "none", do)


def _camera_matrix(storage: cv2.FileStorage) -> Array:
    K = _required(storage, "camera_matrix")
    if K.shape != (3, 3):
        raise camera_error("camera_matrix", "3 x 3 numbers", str(K.shape), "correct the file")
    if K[0, 1] != 0 or K[1, 0] != 0 or not np.allclose(K[2], (0, 0, 1)):
        expected = "fx and fy on the diagonal, cx and cy in the last column, zeros and a one elsewhere"
        raise camera_error("camera_matrix", expected, short(K.round(6).tolist()), "calibrate without shear")
    return K


def _is_fisheye(storage: cv2.FileStorage) -> bool:
    """Return whether the file names OpenCV's fisheye model; CameraError for a model that is not known."""
    model = storage.getNode("distortion_model")
    name = model.string() if model.isString() else "" if model.empty() else "another"
    if name not in ROS_MODELS:
        do = "calibrate with one of these"
        raise camera_error("distortion_model", f"one of {', '.join(ROS_MODELS)}", short(name), do)
    flag = _whole(storage.getNode("fisheye_model"))
    return ROS_MODELS.get(name, False) or bool(flag)


def _coefficients(storage: cv2.FileStorage, count: int) -> Array:
    where = "distortion_coefficients"
    flat = _required(storage, where).reshape(-1)
    if count == 4 != len(flat):
        raise camera_error(where, "k1 to k4 of the fisheye model", f"{len(flat)} numbers", "correct the file")
    if len(flat) not in LENGTHS:
        expected = f"{', '.join(map(str, LENGTHS[:-1]))} or {LENGTHS[-1]} numbers"
        raise camera_error(where, expected, str(len(flat)), "correct the file")
    if np.any(flat[5:] != 0):
        do = "calibrate without CALIB_RATIONAL_MODEL, CALIB_THIN_PRISM_MODEL and CALIB_TILTED_MODEL"
        raise camera_error(where, "k1, k2, p1, p2, k3 and nothing else", "further ones that are not 0", do)
    return np.pad(flat, (0, 1))[:count]


def _first(storage: cv2.FileStorage, keys: tuple[str, str], usual: Array) -> tuple[str, Array]:
    """Return the first of two keys that the file has, and its matrix; without both the usual one."""
    return next(((key, found) for key in keys if (found := _node(storage, key)) is not None), (keys[0], usual))


def _pose(storage: cv2.FileStorage) -> dict[str, Any]:
    key, R = _first(storage, ("R", "rvec"), np.eye(3))
    if R.size != 3 and R.shape != (3, 3):
        raise camera_error(key, "a matrix of 3 x 3 or a vector of 3 numbers", str(R.shape), "correct the file")
    R = np.asarray(cv2.Rodrigues(R.reshape(3, 1))[0], np.float64) if R.size == 3 else R
    key, T = _first(storage, ("T", "tvec"), np.zeros(3))
    if T.size != 3:
        raise camera_error(key, "3 numbers", str(T.shape), "correct the file")
    return {"R_cam_lab": torch.from_numpy(R), "T_cam_lab_mm": torch.from_numpy(T.reshape(3))}


def _size(storage: cv2.FileStorage, image_size: tuple[int, int] | None) -> tuple[int, int]:
    where = "image_width, image_height"
    width, height = (_whole(storage.getNode(key)) or 0 for key in ("image_width", "image_height"))
    if width > 0 and height > 0:
        if image_size not in (None, (width, height)):
            raise camera_error(where, str(image_size), short((width, height)), "correct one")
        return width, height
    if image_size is None:
        raise camera_error(where, "two whole numbers", "none", "give image_size (--image-size W,H)")
    return image_size
