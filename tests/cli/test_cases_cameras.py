"""Camera files of others that came up in public, ../shared/cases: each has the right answer in its README."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from conftest import SHARED, assert_close
from typer.testing import CliRunner

from sphereorient.cameras import Camera, PortCamera, load_cameras
from sphereorient.cli import app
from sphereorient.errors import CameraError, ExperimentError, SettingsError, SphereOrientError

pytestmark = pytest.mark.shared
CASES = SHARED / "cases"


def run(*arguments: object) -> str:
    """Run a command as a user does; return what it prints."""
    done = CliRunner().invoke(app, list(map(str, arguments)))
    if isinstance(done.exception, SphereOrientError):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.output


def converted(folder: Path, case: str, *files: str) -> tuple[dict[str, Camera], str]:
    out = folder / "c.yaml"
    options = [word if word.startswith("-") or "," in word else CASES / case / word for word in files]
    said = run("convert-cameras", *options, "--out", out)
    return load_cameras(out), said


@pytest.fixture
def case(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A case in a folder where a command may write."""
    monkeypatch.chdir(shutil.copytree(CASES / request.param, tmp_path / "case"))
    tmp_path.joinpath("case").chmod(0o755)
    return tmp_path / "case"


DISTORTION = np.array([-0.2, 0.05, 0.001, -0.0005, 0.0])


@pytest.mark.parametrize(
    ("file", "size", "K"),
    [
        ("ros_camera_info.yaml", [], (600, 601, 320, 240)),
        ("python.json", ["--image-size", "640,480"], (600, 600, 319.5, 239.5)),
        ("colmap_cameras.txt", [], (600, 600, 319.5, 239.5)),  # 320 from the picture's corner
    ],
)
def test_one_camera_of_others(tmp_path, file, size, K):
    cameras, said = converted(tmp_path, "camera_files_of_others", file, *size)
    (camera,) = cameras.values()
    fx, fy, cx, cy = K
    points = np.array([[10.0, -20.0, 300.0], [-60.0, 5.0, 450.0]])
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, DISTORTION)
    assert_close(camera.project(torch.from_numpy(points)), torch.from_numpy(expected[:, 0]), atol=1e-9)
    assert "no R and T in the files" in said


def test_two_cameras_of_anipose(tmp_path):
    cameras, said = converted(tmp_path, "camera_files_of_others", "anipose.toml")
    assert list(cameras) == ["A", "B"]
    matrix, lens = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]]), np.array([-0.2, 0, 0, 0, 0])
    point, rotvec, T_mm = np.array([[-200.0, 10.0, 300.0]]), np.array([0.0, 1.0, 0.0]), np.array([-100.0, 0.0, 50.0])
    expected, _ = cv2.projectPoints(point, rotvec, T_mm, matrix, lens)
    assert_close(cameras["B"].project(torch.from_numpy(point)), torch.from_numpy(expected[:, 0]), atol=1e-9)
    assert "not read: metadata" in said
    assert "111.8 mm apart" in said


@pytest.mark.parametrize(
    ("folder", "files"),
    [
        ("camera_files_of_others", ["opencv_stereo.yml", "--image-size", "640,480"]),
        ("opencv_two_intrinsics", ["a.yml", "b.yml"]),
    ],
)
def test_cameras_without_places_are_not_put_into_one(tmp_path, folder, files):
    with pytest.raises(CameraError, match=r"R and T: expected the camera's pose in the lab, got none; write both"):
        converted(tmp_path, folder, *files)
    text = (tmp_path / "c.yaml").read_text()
    assert text.count("fx: 600.0") == 2
    assert text.count("cx: 319.5") == 2


@pytest.mark.parametrize("file", ["opencv_stereo.yml", "python.json"])
def test_a_file_without_a_size_asks_for_it(tmp_path, file):
    with pytest.raises(CameraError, match=r"expected two whole numbers, got none; give image_size \(--image-size"):
        converted(tmp_path, "camera_files_of_others", file)


def test_fisheye_files_are_no_other_lens(tmp_path):
    cameras, _ = converted(tmp_path, "opencv_fisheye", "fisheye.yml")
    uv_px = cameras["fisheye"].project(torch.tensor([321.394, 0.0, 383.022], dtype=torch.float64))
    assert float(uv_px[0]) == pytest.approx(527.06, abs=0.01)
    matrix, lens = np.array([[600.0, 0, 320], [0, 601, 240], [0, 0, 1]]), np.array([-0.02, 0.005, -0.004, 0.001])
    expected, _ = cv2.fisheye.projectPoints(np.array([[[80.0, 60.0, 383.0]]]), np.zeros(3), np.zeros(3), matrix, lens)
    other = converted(tmp_path, "opencv_fisheye", "ros.yml", "--force")[0]["ros"]
    seen = other.project(torch.tensor([80.0, 60.0, 383.0], dtype=torch.float64))
    assert_close(seen, torch.from_numpy(expected[0, 0]), atol=1e-9)


@pytest.mark.parametrize(
    ("par", "size", "pitch_mm", "walls"),
    [("padded.par", (1024, 1024), 0.02, 0), ("pyptv.yaml", (1280, 1024), 0.012, 2)],
)
def test_openptvs_parameters(tmp_path, par, size, pitch_mm, walls):
    cameras, _ = converted(tmp_path, "openptv_par", "cam1.ori", "cam2.ori", "--par", par)
    ports = [camera for camera in cameras.values() if isinstance(camera, PortCamera)]
    assert len(ports) == walls
    for camera in ports:
        numbers = camera.port.n_glass, camera.port.n_fluid, camera.port.thickness_mm
        assert [float(number) for number in numbers] == [1.46, 1.33, 6.0]
    inner = [camera.camera if isinstance(camera, PortCamera) else camera for camera in cameras.values()]
    assert [camera.image_size for camera in inner] == [size, size]
    assert all(camera.pixel_pitch_mm.tolist() == [pitch_mm] * 2 for camera in inner)


@pytest.mark.parametrize("case", ["fictrac_empty_ignore"], indirect=True)
def test_fictracs_empty_polygons_hide_nothing(case):
    said = run("init", "--from-fictrac", "config.txt")
    assert not (case / "cam1_mask.png").exists()
    assert "config.txt, not read: do_display, q_factor" in said


@pytest.mark.parametrize("case", ["fictrac_fisheye"], indirect=True)
def test_fictracs_fisheye(case):
    run("init", "--from-fictrac", "config.txt", "-q")
    assert load_cameras(case / "cameras.yaml")["cam1"].f_px.tolist() == pytest.approx([76.4, 76.4], abs=0.05)


@pytest.mark.parametrize("case", ["fictrac_no_c2a_r"], indirect=True)
def test_fictracs_corners_that_are_a_rectangle_fit_two_squares(case):
    """Of 50 x 40 px, without perspective: tilted by acos(0.8) to one side or the other, 73.7 degrees apart at most."""
    with pytest.raises(ExperimentError, match=r"c2a_src: .* fit two rotations 7\d degrees apart; .* add c2a_r"):
        run("init", "--from-fictrac", "config.txt", "-q")
    assert not (case / "experiment.yaml").exists()
    assert not (case / "cameras.yaml").exists()


@pytest.mark.parametrize("case", ["fictrac_camera_source"], indirect=True)
def test_fictracs_camera_as_a_source(case):
    with pytest.raises(SettingsError, match=r"got camera 0 \(src_fn\); film .*init MOVIE --from-fictrac config\.txt"):
        run("init", "--from-fictrac", "config.txt")
    assert "live experiment.yaml --source camera:0" in run("init", "m.avi", "--from-fictrac", "config.txt")
