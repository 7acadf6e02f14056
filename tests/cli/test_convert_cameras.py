"""`sphereorient convert-cameras`: files of OpenCV and OpenPTV to cameras.yaml, refusals in one line."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from camera_examples import load_opencv
from typer.testing import CliRunner

from sphereorient.cameras import PortCamera, load_cameras
from sphereorient.cameras.io.openptv import load_openptv, load_ptv_par
from sphereorient.cli import app
from sphereorient.errors import CameraError

ORI = "105.3 102.7 403.9\n-0.238 0.244 0.055\n1 0 0\n0 1 0\n0 0 1\n-0.2 0.3\n20.0\n0.0001 0.00001 150.0\n"
PAR = "1\nimg/cam1.\ncal/cam1.tif\n1\n0\n1\n1280\n1024\n0.012\n0.011\n0\n1\n1.49\n1.33\n6\n"


@pytest.fixture
def folder(tmp_path):
    for name, f in (("left.yml", 700.0), ("right.xml", 710.0)):
        storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix", np.array([[f, 0, 331], [0, 715, 228.5], [0, 0, 1]]))
        storage.write("distortion_coefficients", np.array([-0.2, 0.1, 2e-3, -1e-3, 0.0]))
        storage.write("rvec", np.array([0.0, f / 1000, 0.0]))
        storage.write("tvec", np.array([f, 0.0, 0.0]))
        storage.release()
    (tmp_path / "cam1.tif.ori").write_text(ORI)
    (tmp_path / "cam1.tif.addpar").write_text("-0.00001 0 0 0 0 1 0.002\n")
    (tmp_path / "ptv.par").write_text(PAR)
    return tmp_path


def convert(*arguments):
    return CliRunner().invoke(app, ["convert-cameras", *map(str, arguments)])


def test_opencv_files_become_named_cameras(folder):
    out = folder / "cameras.yaml"
    sizes = ("--image-size", "650,480")
    done = convert(folder / "left.yml", folder / "right.xml", "--out", out, "--names", "cam1,cam2", *sizes)
    assert done.exit_code == 0, done.output
    cameras = load_cameras(out)
    assert list(cameras) == ["cam1", "cam2"]
    x = torch.tensor([10.0, -20.0, 500.0], dtype=torch.float64)
    assert torch.equal(cameras["cam2"].project(x), load_opencv(folder / "right.xml", (650, 480)).project(x))


def test_an_openptv_camera_keeps_its_wall_and_its_distortion(folder):
    out = folder / "cameras.yaml"
    done = convert(folder / "cam1.tif.ori", "--out", out, "--par", folder / "ptv.par")
    assert done.exit_code == 0, done.output
    camera = load_cameras(out)["cam1"]
    assert isinstance(camera, PortCamera)
    uv = torch.tensor([100.0, 900.0], dtype=torch.float64)
    same = load_openptv(folder / "cam1.tif.ori", load_ptv_par(folder / "ptv.par"), folder / "cam1.tif.addpar")
    assert torch.equal(camera.rays(uv).direction_lab, same.rays(uv).direction_lab)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("left.yml",), "image_height: expected two whole"),
        (("left.yml", "--image-size", "wide"), "--image-size: .* got 'wide'"),
        (("cam1.tif.ori",), "--par: .* got none"),
        (("ptv.par",), r"ptv\.par: expected a file ending in \.yml, .* all in \.ori"),
        (("none.yml",), "none.yml: expected .*, got no such file"),
        (("left.yml", "right.xml", "--image-size", "650,480", "--names", "cam1"), "--names: .* name all"),
        (("left.yml", "right.xml", "--image-size", "650,480", "--names", "a,a"), "--names: .* different"),
    ],
)
def test_refusals_are_one_line(folder, monkeypatch, arguments, message):
    monkeypatch.chdir(folder)
    refused = convert(*arguments, "--out", "cameras.yaml")
    assert isinstance(refused.exception, CameraError)
    with pytest.raises(CameraError, match=message):
        raise refused.exception
    assert "\n" not in str(refused.exception)
    assert not (folder / "cameras.yaml").exists()


def test_cameras_of_unknown_place_are_written_without_one_and_unread_keys_are_named(tmp_path):
    text = "K: [[700, 0, 331], [0, 715, 228.5], [0, 0, 1]]\nD: [0, 0, 0, 0, 0]\nimage_size: [650, 480]\n"
    (tmp_path / "a.yaml").write_text(text + "rms: 0.2\n")
    (tmp_path / "b.yaml").write_text(text + "rms: 0.3\nflags: 10\n")
    out = tmp_path / "cameras.yaml"
    log = convert(tmp_path / "a.yaml", tmp_path / "b.yaml", "--out", out).output
    assert "not read: rms, flags\n" in log
    assert "no R and T in the files: a, b; write them into" in log
    with pytest.raises(CameraError, match="a, R and T"):
        load_cameras(out)
    log = convert(tmp_path / "a.yaml", "--out", out, "--force").output
    assert "no R and T in the files: a; the lab is the camera's frame" in log
    assert torch.equal(load_cameras(out)["a"].R_cam_lab, torch.eye(3, dtype=torch.float64))


def test_the_distance_of_two_cameras_shows_the_unit(folder):
    sizes = ("--image-size", "650,480")
    log = convert(folder / "left.yml", folder / "right.xml", "--out", folder / "cameras.yaml", *sizes).output
    centres = [-cv2.Rodrigues(np.array([0, f / 1000, 0]))[0].T @ (f, 0, 0) for f in (700.0, 710.0)]
    assert f"T taken as mm: the first and the last camera are {np.linalg.norm(centres[1] - centres[0]):.4g} mm" in log
