from __future__ import annotations

import io
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from calibrate_examples import PITCH, SIZE, Posed, document, pictures, plate_poses, true_cameras, write, write_tables
from calibration_examples import triangulated_error_mm
from conftest import SHARED
from rich.console import Console

from sphereorient import so3
from sphereorient.calibration.bundle import Rig
from sphereorient.calibration.calibrated import parameters_table, pictures_table, summary
from sphereorient.calibration.document import load_calibration
from sphereorient.calibration.plates import calibrate_cameras, see_pictures, tie_floating
from sphereorient.cameras import load_cameras, load_covariance, save_cameras, triangulate
from sphereorient.errors import CameraError, SphereOrientError
from sphereorient.report import calibration_figure

PORT = {"offset": 100.0, "thickness": 12.0, "n_glass": 1.49, "n_fluid": 1.36}

# Where the fiducials are, and where they would be half a turn on: without these the two look alike.
HIDDEN = ((0, 0), (3, 0), (0, 2), (-3, 0), (0, -2))


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return write(tmp_path_factory.mktemp("plates"))


@pytest.fixture(scope="module")
def result(source):
    return calibrate_cameras(source)


@pytest.mark.slow
def test_cameras_come_out_of_pictures(result):
    true = true_cameras()
    assert result.rms_px("cam1") < 0.03
    assert triangulated_error_mm(result.cameras, true) < 0.01
    between = [rig["cam2"].R_cam_lab @ rig["cam1"].R_cam_lab.mT for rig in (result.cameras, true)]
    assert math.degrees(float(so3.geodesic_distance(*between))) < 0.03
    assert float(result.cameras["cam1"].f_mm) / PITCH[0] == pytest.approx(900.0, rel=1e-3)
    assert len(result.pictures) == len(pictures())
    for one in result.pictures:
        assert one.reason == ""
        assert len(one.view) == 99
        assert bool(one.used.all())
        assert one.rms_px < 0.03


@pytest.mark.slow
def test_errors_of_the_cameras_are_those_that_the_sigmas_promise(result):
    for name, camera in result.cameras.items():
        true = true_cameras()[name]
        sigma = camera.covariance.sigmas
        assert abs(float(camera.f_mm) - 18.0) < 4 * sigma["f"]
        assert abs(float((camera.T_cam_lab_mm - true.T_cam_lab_mm)[2])) < 4 * sigma["T_z"]
        assert abs(float((camera.centre_px - true.centre_px)[0])) < 4 * sigma["centre_u"]


@pytest.mark.slow
def test_table_and_figure_show_all_of_it(result, tmp_path):
    console = Console(record=True, width=140, file=io.StringIO())
    console.print(pictures_table(result))
    console.print(parameters_table(result))
    text = console.export_text()
    for word in ("cam1_03.png", "kappa1", "centre_u", "T_z", "99"):
        assert word in text
    assert any("axes at 50.0" in line for line in summary(result))
    calibration_figure(result, tmp_path / "figure.png")
    drawn = cv2.imread(str(tmp_path / "figure.png"))
    assert min(drawn.shape[:2]) > 400


@pytest.mark.slow
def test_the_file_of_cameras_keeps_the_covariance_of_all_together(result, tmp_path):
    path = tmp_path / "cameras.yaml"
    save_cameras(path, result.cameras, covariance=result.covariance)
    cameras = load_cameras(path)
    known = load_covariance(path, cameras)
    assert known.names == result.covariance.names
    assert torch.equal(known.matrix, result.covariance.matrix)
    half = len(known.names) // 2
    assert float(known.matrix[:half, half:].abs().max()) > 0  # errors of both come from the same plates
    alone = load_covariance(path, {"cam2": cameras["cam2"]})
    assert all(name.startswith("cam2.") for name in alone.names)
    assert torch.equal(alone.matrix, known.matrix[half:, half:])
    own = cameras["cam2"].covariance
    assert torch.allclose(own.matrix, alone.matrix)


@pytest.mark.slow
def test_without_the_joint_covariance_those_of_the_cameras_stand_side_by_side(result, tmp_path):
    path = tmp_path / "cameras.yaml"
    save_cameras(path, result.cameras)
    known = load_covariance(path, load_cameras(path))
    half = len(known.names) // 2
    assert not known.matrix[:half, half:].any()
    bare = {name: replace(camera, covariance=None) for name, camera in result.cameras.items()}
    save_cameras(path, bare)
    assert load_covariance(path, load_cameras(path)) is None


@pytest.mark.slow
def test_a_covariance_of_unknown_parameters_is_refused(result, tmp_path):
    path = tmp_path / "cameras.yaml"
    names = tuple(name.replace("cam2.f", "cam2.focus") for name in result.covariance.names)
    save_cameras(path, result.cameras, covariance=replace(result.covariance, names=names))
    with pytest.raises(CameraError, match=r"covariance, parameters.*cam2.focus"):
        load_covariance(path, load_cameras(path))


def redrawn(folder, name, **how):
    """Draw one picture anew."""
    camera, row = name.removesuffix(".png").split("_")
    R, T = plate_poses()[int(row)]
    view = true_cameras()[camera]
    scene = Posed(R=view.R_cam_lab @ R, T=view.R_cam_lab @ T + view.T_cam_lab_mm)
    cv2.imwrite(str(folder / name), scene.picture(noise=1.0, **how))


@pytest.mark.slow
def test_a_picture_without_fiducials_is_tied_through_the_other_camera(tmp_path):
    path = write(tmp_path)
    redrawn(tmp_path, "cam2_02.png", without=HIDDEN)
    document = load_calibration(path)
    views = see_pictures(document, lambda stage, done, total: None)
    floating = next(picture for picture in views if picture.path.name == "cam2_02.png")
    assert views[floating].state == "floating"
    result = calibrate_cameras(document)
    (one,) = (one for one in result.pictures if one.picture.path.name == "cam2_02.png")
    assert one.reason == ""
    assert one.rms_px < 0.03
    assert triangulated_error_mm(result.cameras, true_cameras()) < 0.01


@pytest.mark.slow
def test_an_untied_picture_of_a_pose_that_no_other_camera_saw_is_left_out_with_the_reason(tmp_path):
    path = write(tmp_path)
    redrawn(tmp_path, "cam1_04.png", without=HIDDEN)
    result = calibrate_cameras(path)
    (one,) = (one for one in result.pictures if one.picture.path.name == "cam1_04.png")
    assert "cam1_04.png" in one.reason
    assert len(one.used) == 0
    assert triangulated_error_mm(result.cameras, true_cameras()) < 0.01


def refused(path, words):
    with pytest.raises(CameraError, match=words) as caught:
        calibrate_cameras(path)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_picture_without_dots_has_the_first_reason(tmp_path):
    path = write(tmp_path)
    for name in pictures():
        if name.startswith("cam2"):
            cv2.imwrite(str(tmp_path / name), np.full(SIZE[::-1], 90, np.uint8))
    refused(path, "cam2: .* none of 5; .*cam2_00.png")


@pytest.mark.slow  # draws six pictures anew
def test_no_fiducials_in_any_picture_of_a_camera_is_refused(tmp_path):
    path = write(tmp_path)
    for name in pictures():
        if name.startswith("cam1"):
            redrawn(tmp_path, name, small=((0, 0), (3, 0), (0, 2)))
    refused(path, "cam1: .* none of 6; .*larger dots")


@pytest.mark.slow
@pytest.mark.parametrize(("columns", "rows"), [(7, 7), (31, 9)])
def test_a_grid_of_another_size_is_refused_or_does_no_harm(source, tmp_path, columns, rows):
    """A smaller plate than seen is refused. A larger one may lie partly outside the picture; the dots stay."""
    plate = document()["plate"] | {"columns": columns, "rows": rows}
    path = write(tmp_path, {"plate": plate})
    if columns < 11:
        refused(path, "cam1: .* none of 6; .*7")
    else:
        assert triangulated_error_mm(calibrate_cameras(path).cameras, true_cameras()) < 0.01


def write_empty(folder):
    """Write calibration.yaml and black pictures, which take no time to draw."""
    path = write(folder, drawn=False)
    for entry in document()["pictures"]:
        for camera in entry.keys() - {"pose"}:
            cv2.imwrite(str(folder / entry[camera]), np.zeros(SIZE[::-1], np.uint8))
    return path


def test_pictures_of_another_size_are_refused_before_any_work(tmp_path):
    path = write_empty(tmp_path)
    cv2.imwrite(str(tmp_path / "cam2_03.png"), np.zeros((200, 300), np.uint8))
    refused(path, "cam2_03.png: .* got 300 x 200")


def test_pictures_that_are_missing_or_none_are_refused(tmp_path):
    path = write_empty(tmp_path)
    (tmp_path / "cam1_01.png").unlink()
    refused(path, "cam1_01.png: .* no such file")
    (tmp_path / "cam1_01.png").write_text("no picture")
    refused(path, "cam1_01.png: .* no picture")
    (tmp_path / "cam1_01.png").write_bytes(b"")
    refused(path, "cam1_01.png: .* no picture")


@pytest.mark.slow
def test_poses_too_alike_are_refused_and_the_loose_parameter_is_named(tmp_path):
    entries = [{"pose": row, "cam1": "cam1_00.png", "cam2": "cam2_00.png"} for row in range(4)]
    path = write(tmp_path, {"pictures": entries})
    refused(path, r"got loose: .*cam[12]\.\w+ \(sigma")


@pytest.mark.slow
@pytest.mark.parametrize("model", ["tsai", "brown", "pinhole"])
def test_cameras_come_out_of_tables_of_points(tmp_path, model):
    result = calibrate_cameras(write_tables(tmp_path, model=model))
    assert triangulated_error_mm(result.cameras, true_cameras()) < 0.05
    assert result.rms_px("cam1") < 0.05
    calibration_figure(result, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").is_file()
    assert {one.picture.path.name for one in result.pictures} == {"cam1.csv", "cam2.csv"}


def test_a_table_with_a_wrong_row_names_it_as_an_outlier(tmp_path):
    path = write_tables(tmp_path, points={"cam1": "cam1.csv"})
    lines = (tmp_path / "cam1.csv").read_text().splitlines()
    start, _, last = lines[8].rpartition(",")
    lines[8] = f"{start},{float(last) + 3.0}"
    (tmp_path / "cam1.csv").write_text("\n".join(lines))
    result = calibrate_cameras(path)
    assert np.flatnonzero(~result.pictures[0].used).tolist() == [7]


def test_too_few_points_are_refused_with_the_table_s_name(tmp_path):
    refused(write_tables(tmp_path, count=2), "cam1.csv, points")


@pytest.mark.slow
def test_a_wall_that_does_not_stand_before_the_camera_is_refused(tmp_path):
    ports = {name: PORT | {"normal": [0, 0, -1]} for name in ("cam1", "cam2")}
    with pytest.raises(SphereOrientError, match="port"):
        calibrate_cameras(write(tmp_path, {"ports": ports}))


@pytest.mark.slow
def test_a_tie_needs_a_known_pose(source, result):
    document = load_calibration(source)
    views = see_pictures(document, lambda stage, done, total: None)
    rig = Rig(cameras=result.cameras, R_lab_plate=result.R_lab_plate, T_lab_plate_mm=result.T_lab_plate_mm)
    assert tie_floating(document, rig, views) == {}


@pytest.mark.shared
@pytest.mark.slow  # a dozen seconds each
@pytest.mark.parametrize("name", ["experiment", "tank"])
def test_cameras_of_the_shared_sets_meet_the_bars(name):
    """The bars: rms 0.06 px; over the cube of 120 mm 0.08 mm, without the plate's own pose 0.03 mm; 0.02 degrees."""
    result = calibrate_cameras(SHARED / name / "calibration" / "calibration.yaml")
    true = load_cameras(SHARED / name / "cameras.yaml")
    points = 60 * (2 * torch.rand(1000, 3, generator=torch.Generator().manual_seed(1)).double() - 1)
    rays = [result.cameras[camera].rays(true[camera].project(points)) for camera in true]
    found, _ = triangulate(*rays)
    assert float((found - points).square().sum(-1).mean().sqrt()) <= 0.08
    U, _, Vh = torch.linalg.svd((found - found.mean(0)).mT @ (points - points.mean(0)))
    moved = (found - found.mean(0)) @ (U @ torch.diag(torch.tensor([1, 1, torch.det(U @ Vh)])).double() @ Vh)
    assert float((moved - (points - points.mean(0))).square().sum(-1).mean().sqrt()) <= 0.03
    between = [rig["cam2"].R_cam_lab @ rig["cam1"].R_cam_lab.mT for rig in (result.cameras, true)]
    assert math.degrees(float(so3.geodesic_distance(*between))) <= 0.02
    for camera in true:
        assert result.rms_px(camera) <= 0.06
    assert all(one.reason == "" for one in result.pictures)
