"""Camera files of other programs: read as those programs project; unused keys named, faults refused by cause."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from camera_examples import load_opencv
from conftest import assert_close

from sphereorient.cameras import Camera
from sphereorient.cameras.fisheye import FisheyeCamera
from sphereorient.cameras.io.opencv import load_camera_files
from sphereorient.errors import CameraError

K = np.array([[600.0, 0, 321.5], [0, 610, 238.0], [0, 0, 1]])
D = np.array([-0.2, 0.05, 1e-3, -5e-4, 0.01])
FISHEYE = np.array([-0.02, 0.005, -0.004, 0.001])
ROTVEC, T_MM = np.array([0.1, 1.0, -0.2]), np.array([-100.0, 20.0, 50.0])
X_LAB_MM = np.array([[10.0, -20.0, 500.0], [-60.0, 5.0, 620.0], [0.0, 40.0, 450.0]])
RESTS = np.zeros(3)


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def check_projects(camera: Camera, rotvec: np.ndarray, T_mm: np.ndarray, K: np.ndarray = K, D: np.ndarray = D) -> None:
    """Compare with OpenCV's own projection of points before the camera."""
    x_lab_mm = (X_LAB_MM - T_mm) @ cv2.Rodrigues(rotvec)[0]
    if isinstance(camera, FisheyeCamera):
        expected, _ = cv2.fisheye.projectPoints(x_lab_mm[:, None], rotvec, T_mm, K, D)
    else:
        expected, _ = cv2.projectPoints(x_lab_mm, rotvec, T_mm, K, D)
    assert_close(camera.project(torch.from_numpy(x_lab_mm)), torch.from_numpy(expected.reshape(-1, 2)), atol=1e-9)


ROS = f"""image_width: 640
image_height: 480
camera_name: cam_left
camera_matrix: {{rows: 3, cols: 3, data: {K.ravel().tolist()}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [-0.2, 0.05, 1e-3, -5e-4, 0.01]}}
rectification_matrix: {{rows: 3, cols: 3, data: [0, 1, 0, -1, 0, 0, 0, 0, 1]}}
projection_matrix: {{rows: 3, cols: 4, data: [580, 0, 320, 0, 0, 585, 240, 0, 0, 0, 1, 0]}}
"""


def test_ros_files_are_read_and_what_is_not_used_is_named(tmp_path):
    (found,) = load_camera_files([written(tmp_path / "left.yaml", ROS)])
    assert (found.name, found.placed) == ("left", False)
    assert found.unread == ("rectification_matrix", "projection_matrix")
    check_projects(found.camera, RESTS, RESTS)


def test_rs_of_a_ros_message_turns_the_rectified_picture_and_is_no_pose(tmp_path):
    text = f"height: 480\nwidth: 640\ndistortion_model: plumb_bob\nD: {D.tolist()}\nK: {K.ravel().tolist()}\n"
    text += "R: [0, 1, 0, -1, 0, 0, 0, 0, 1]\nP: [580, 0, 320, 0, 0, 585, 240, 0, 0, 0, 1, 0]\nbinning_x: 0\n"
    (found,) = load_camera_files([written(tmp_path / "info.yaml", text)])
    assert not found.placed
    assert found.unread == ("R", "P", "binning_x")
    check_projects(found.camera, RESTS, RESTS)


ANIPOSE = f"""[cam_0]
name = "A"
size = [ 640, 480,]
matrix = {K.tolist()}
distortions = {D.tolist()}
rotation = [ 0.0, 0.0, 0.0,]
translation = [ 0.0, 0.0, 0.0,]

[cam_1]
name = "B"
size = [ 640, 480,]
matrix = {K.tolist()}
distortions = {FISHEYE.tolist()}
rotation = {ROTVEC.tolist()}
translation = {T_MM.tolist()}
fisheye = true

[metadata]
adjusted = false
"""


def test_aniposes_vectors_take_the_world_to_the_camera(tmp_path):
    one, other = load_camera_files([written(tmp_path / "calibration.toml", ANIPOSE)])
    assert [one.name, other.name] == ["A", "B"]
    assert one.placed
    assert other.placed
    assert set(one.unread) == {"metadata"}
    check_projects(one.camera, RESTS, RESTS)
    check_projects(other.camera, ROTVEC, T_MM, D=FISHEYE)


def stereo(folder: Path, **nodes: np.ndarray) -> Path:
    path = folder / f"{'_'.join(nodes)}.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in nodes.items():
        storage.write(key, value)
    storage.release()
    return path


@pytest.mark.parametrize("names", ["M1 D1 M2 D2", "K1 D1 K2 D2", "cameraMatrix1 distCoeffs1 cameraMatrix2 distCoeffs2"])
@pytest.mark.parametrize("apart", [False, True], ids=["one file", "intrinsics.yml, extrinsics.yml"])
def test_a_stereo_pair_is_two_cameras_and_the_first_is_the_lab(tmp_path, names, apart):
    M2 = K * [[1, 1, 1.02], [1, 1, 1], [1, 1, 1]]
    lenses = dict(zip(names.split(), (K, D, M2, D / 2), strict=True))
    pose = {"R": cv2.Rodrigues(ROTVEC)[0], "T": T_MM[:, None], "R1": np.eye(3), "P1": np.eye(3), "Q": np.eye(4)}
    files = [stereo(tmp_path, **lenses), stereo(tmp_path, **pose)] if apart else [stereo(tmp_path, **lenses, **pose)]
    first, second = load_camera_files(files, (640, 480))
    assert [first.name, second.name] == ["cam1", "cam2"]
    assert second.unread == ("R1", "P1", "Q")
    check_projects(first.camera, RESTS, RESTS)
    check_projects(second.camera, ROTVEC, T_MM, M2, D / 2)


def test_a_pair_without_r_and_t_has_no_place(tmp_path):
    found = load_camera_files([stereo(tmp_path, M1=K, D1=D, M2=K, D2=D)], (640, 480))
    assert [one.placed for one in found] == [False, False]


@pytest.mark.parametrize(
    ("matrix", "lens"),
    [("camera_matrix", "dist_coeff"), ("mtx", "dist"), ("K", "D"), ("cameraMatrix", "distCoeffs")],
)
@pytest.mark.parametrize("indent", [None, "\t"])
def test_scripts_write_lists_in_json_under_several_names(tmp_path, matrix, lens, indent):
    text = json.dumps({matrix: K.tolist(), lens: [D.tolist()], "error": 1e-07}, indent=indent)
    (found,) = load_camera_files([written(tmp_path / "cam.json", text)], (640, 480))
    assert found.unread == ("error",)
    check_projects(found.camera, RESTS, RESTS)


@pytest.mark.parametrize(
    ("line", "K", "D"),
    [
        ("SIMPLE_PINHOLE 640 480 600 320 240", [600, 600, 319.5, 239.5], [0, 0, 0, 0]),
        ("PINHOLE 640 480 600 610 320 240", [600, 610, 319.5, 239.5], [0, 0, 0, 0]),
        ("SIMPLE_RADIAL 640 480 600 320 240 -0.2", [600, 600, 319.5, 239.5], [-0.2, 0, 0, 0]),
        ("RADIAL 640 480 600 320 240 -0.2 0.05", [600, 600, 319.5, 239.5], [-0.2, 0.05, 0, 0]),
        ("OPENCV 640 480 600 610 320 240 -0.2 0.05 1e-3 -5e-4", [600, 610, 319.5, 239.5], [-0.2, 0.05, 1e-3, -5e-4]),
        (
            "FULL_OPENCV 640 480 600 610 320 240 -0.2 0.05 1e-3 -5e-4 0.01 0 0 0",
            [600, 610, 319.5, 239.5],
            [-0.2, 0.05, 1e-3, -5e-4, 0.01],
        ),
        ("SIMPLE_RADIAL_FISHEYE 640 480 300 320 240 -0.02", [300, 300, 319.5, 239.5], [-0.02, 0, 0, 0]),
        ("RADIAL_FISHEYE 640 480 300 320 240 -0.02 0.005", [300, 300, 319.5, 239.5], [-0.02, 0.005, 0, 0]),
        ("OPENCV_FISHEYE 640 480 300 310 320 240 -0.02 0.005 -0.004 0.001", [300, 310, 319.5, 239.5], FISHEYE),
    ],
)
def test_colmaps_models_are_opencvs_and_its_first_pixel_has_its_centre_at_one_half(tmp_path, line, K, D):
    text = f"# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n3 {line}\n"
    (found,) = load_camera_files([written(tmp_path / "cameras.txt", text)])
    assert (found.name, found.placed, found.camera.image_size) == ("cam3", False, (640, 480))
    assert isinstance(found.camera, FisheyeCamera) == ("FISHEYE" in line)
    fx, fy, cx, cy = K
    check_projects(found.camera, RESTS, RESTS, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.array(D, float))


REFUSED = {
    "a model of COLMAP": ("cameras.txt", "1 FOV 640 480 600 600 320 240 0.9", "camera 1: .* got 'FOV'"),
    "too few of COLMAP": ("cameras.txt", "1 PINHOLE 640 480 600 320 240", "4 parameters of PINHOLE"),
    "a lens of ROS": ("c.yaml", ROS.replace("plumb_bob", "thin_prism"), "distortion_model: .*, got 'thin_prism'"),
    "no camera": ("c.toml", "[metadata]\nadjusted = false\n", "got keys .'metadata'"),
    "one place": ("c.toml", ANIPOSE.replace("translation", "shift"), "A, R, T: expected both"),
    "numbers as keys": ("c.yaml", "1: {2: 3}\n", "camera_matrix: .* got keys"),
}


@pytest.mark.parametrize(("name", "text", "message"), REFUSED.values(), ids=REFUSED)
def test_unknown_keys_are_refused_by_name(tmp_path, name, text, message):
    with pytest.raises(CameraError, match=message) as refused:
        load_camera_files([written(tmp_path / name, text)])
    assert str(tmp_path / name) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_advice_of_a_missing_lens_can_be_followed(tmp_path):
    text = ROS.replace("distortion_coefficients:", "lens_shape:")
    path = written(tmp_path / "left.yaml", text)
    with pytest.raises(CameraError, match="add distortion_coefficients"):
        load_opencv(path)
    camera = load_opencv(written(path, text + "distortion_coefficients: [0, 0, 0, 0, 0]\n"))
    check_projects(camera, RESTS, RESTS, D=np.zeros(5))


def test_opencvs_list_of_corners_does_not_make_a_file_too_long(tmp_path):
    path = tmp_path / "cam.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    nodes = {"image_width": 640, "image_height": 480, "camera_matrix": K, "distortion_coefficients": D}
    for key, value in (nodes | {"image_points": np.zeros((50, 220, 2))}).items():
        storage.write(key, value)
    storage.release()
    (found,) = load_camera_files([path])
    assert found.unread == ("image_points",)
