"""OpenCV's files: read as OpenCV wrote them, and every fault in one line."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from camera_examples import ROTVEC, SIZE, T_MM, load_opencv, turned
from conftest import assert_close

from sphereorient.errors import CameraError

K = np.array([[700.0, 0, 331], [0, 715, 228.5], [0, 0, 1]])
D = np.array([-0.21, 0.12, 2e-3, -1.5e-3, -0.03])


def opencv_file(path: Path, **nodes: object) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    whole = {"image_width": SIZE[0], "image_height": SIZE[1], "camera_matrix": K, "distortion_coefficients": D}
    for key, value in (whole | nodes).items():
        if value is not None:
            storage.write(key, value)
    storage.release()
    return path


@pytest.mark.parametrize("suffix", [".yml", ".yaml", ".xml", ".json"])
def test_numbers_are_read_to_the_last_bit(tmp_path, suffix):
    wider = K * np.array([[7 / 3], [7 / 3], [1]])
    nodes = {"camera_matrix": wider, "R": turned().numpy(), "T": np.array(T_MM)[:, None] / 7}
    camera = load_opencv(opencv_file(tmp_path / f"cam{suffix}", distortion_coefficients=D[:, None] / 3, **nodes))
    assert camera.image_size == SIZE
    assert camera.f_px.tolist() == [700 * (7 / 3), 715 * (7 / 3)]
    assert camera.centre_px.tolist() == [331 * (7 / 3), 228.5 * (7 / 3)]
    assert [*camera.k[:2].tolist(), *camera.p.tolist(), float(camera.k[2])] == (D / 3).tolist()
    assert torch.equal(camera.R_cam_lab, turned())
    assert camera.T_cam_lab_mm.tolist() == [each / 7 for each in T_MM]


@pytest.mark.parametrize(
    "distortion", [D, D[:, None], D[None], np.append(D, np.zeros(3))], ids=["5", "5x1", "1x5", "8"]
)
@pytest.mark.parametrize(
    "pose",
    [
        {"R": turned().numpy(), "T": np.array(T_MM)},
        {"rvec": np.array(ROTVEC), "tvec": np.array(T_MM)[:, None]},
    ],
    ids=["matrix", "vector"],
)
def test_files_of_opencv_are_read(tmp_path, distortion, pose):
    camera = load_opencv(opencv_file(tmp_path / "cam.xml", distortion_coefficients=distortion, **pose))
    x_lab_mm = np.array([[10.0, -20.0, 30.0], [-60.0, 5.0, 0.0]])
    expected, _ = cv2.projectPoints(x_lab_mm, np.array(ROTVEC), np.array(T_MM), K, D)
    assert_close(camera.project(torch.from_numpy(x_lab_mm)), torch.from_numpy(expected[:, 0]), atol=1e-9)


def test_without_a_pose_the_lab_is_the_camera_and_four_coefficients_end_with_p2(tmp_path):
    camera = load_opencv(opencv_file(tmp_path / "cam.yml", distortion_coefficients=D[:4]))
    assert torch.equal(camera.R_cam_lab, torch.eye(3, dtype=torch.float64))
    assert torch.equal(camera.T_cam_lab_mm, torch.zeros(3, dtype=torch.float64))
    assert camera.k.tolist() == [-0.21, 0.12, 0.0]
    assert camera.p.tolist() == [2e-3, -1.5e-3]


def test_a_size_that_the_file_lacks_is_given(tmp_path):
    path = opencv_file(tmp_path / "cam.yml", image_width=None, image_height=None)
    assert load_opencv(path, image_size=SIZE).image_size == SIZE
    with pytest.raises(CameraError, match="two whole numbers, got none"):
        load_opencv(path)
    with pytest.raises(CameraError, match="650, 480"):
        load_opencv(opencv_file(tmp_path / "cam.yml"), image_size=(9, 9))


def with_coefficient(place: int, count: int) -> np.ndarray:
    return np.append(D, np.zeros(count - 5)) + 0.1 * np.eye(count)[place]


FAULTS = {
    "no matrix": ({"camera_matrix": None}, "camera_matrix: .* got keys"),
    "number for a matrix": ({"camera_matrix": 3.0}, "camera_matrix: expected 3 x 3"),
    "shear": ({"camera_matrix": K + np.eye(3, k=1)}, "camera_matrix: .* diagonal"),
    "no distortion": ({"distortion_coefficients": None}, "add distortion_coefficients"),
    "three": ({"distortion_coefficients": D[:3]}, "14 numbers, got 3"),
    "rational": ({"distortion_coefficients": with_coefficient(6, 8)}, "rational"),
    "thin prism": ({"distortion_coefficients": with_coefficient(9, 12)}, "thin prism"),
    "not a number": ({"R": np.eye(3), "T": np.array([0.0, np.nan, 0.0])}, "T: expected 3 numbers"),
    "odd R": ({"R": np.zeros((2, 2)), "T": np.zeros(3)}, "R: expected a matrix"),
    "R without T": ({"R": np.eye(3)}, "R, T: expected both or none"),
    "flag": ({"fisheye_model": "maybe"}, "fisheye_model: expected 0 or 1"),
}


@pytest.mark.parametrize(("nodes", "message"), FAULTS.values(), ids=FAULTS)
def test_every_fault_is_one_line_that_names_the_file(tmp_path, nodes, message):
    path = opencv_file(tmp_path / "cam.yml", **nodes)
    with pytest.raises(CameraError, match=message) as refused:
        load_opencv(path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)
