from __future__ import annotations

import math

import pytest
import torch
from calibrate_examples import document, write
from conftest import assert_close

from sphereorient.calibration.document import load_calibration, read_points
from sphereorient.errors import CameraError

PORT = {"normal": [0, 0, 1], "offset": 100.0, "thickness": 12.0, "n_glass": 1.49, "n_fluid": 1.36}


def test_a_calibration_file_is_read_with_poses_as_rows(tmp_path):
    content = document()
    content["pictures"] = [{"pose": 12, "cam1": "b.png"}, {"pose": 3, "cam2": "c.png", "cam1": "a.png"}]
    content["surveyed"]["pose"] = 12
    read = load_calibration(write(tmp_path, content, drawn=False))
    assert read.poses == (3, 12)
    assert read.cameras == ("cam1", "cam2")
    assert {(p.camera, p.row, p.path) for p in read.pictures} == {
        ("cam1", 1, tmp_path / "b.png"),
        ("cam2", 0, tmp_path / "c.png"),
        ("cam1", 0, tmp_path / "a.png"),
    }
    assert list(read.surveyed) == [1]
    assert read.keys.model == "tsai"


def test_a_rotation_with_few_digits_is_made_one(tmp_path):
    content = document()
    c, s = round(math.cos(0.7), 5), round(math.sin(0.7), 5)
    content["surveyed"]["R_lab_plate"] = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    R, _ = load_calibration(write(tmp_path, content, drawn=False)).surveyed[0]
    assert_close(R @ R.mT, torch.eye(3).double(), atol=1e-12)
    assert_close(R[0, 0], torch.tensor(c).double(), atol=1e-5)


def surveyed(**changes):
    return {"surveyed": document()["surveyed"] | changes}


MIRROR = [[1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0]]
TWICE = [{"pose": 0, "cam1": "a.png"}, {"pose": 0, "cam1": "b.png"}]


def clicked(points, name="cam1"):
    return {"pictures": [{"pose": 0, "cam1": "a.png", "clicked": {name: points}}]}


FAULTS = [
    ({"surveyed": None}, "surveyed: .* got none"),
    (surveyed(pose=77), "surveyed: .* got pose 77"),
    (surveyed(R_lab_plate=MIRROR), "R_lab_plate: expected a rotation"),
    (surveyed(T_lab_plate=[0.0, float("nan"), 0.0]), "surveyed.T_lab_plate"),
    ({"plate": None}, "plate: .* got none"),
    ({"plate": {"type": "dotz"}}, "plate: .* got 'dotz'"),
    ({"pictures": None}, "points: .* got neither"),
    ({"points": {"cam1": "p.csv"}}, "points: .* got both"),
    ({"pictures": [{"cam1": "a.png"}]}, "pictures.0.pose"),
    ({"pictures": [{"pose": 0}]}, "pictures, 0: .* got none"),
    ({"pictures": [{"pose": 0, "cam1": 7}]}, "pictures.0.cam1"),
    ({"pictures": [{"pose": 0, "lab/left": "a.png"}]}, "pictures: expected names without '/', got 'lab/left'"),
    ({"pictures": [{"pose": 0, "": "a.png"}]}, "pictures: expected names without '/', got ''"),
    ({"plate": None, "surveyed": None, "pictures": None, "points": {".": "p.csv"}}, "points: .* without '/', got '.'"),
    ({"pictures": TWICE}, "pictures, 1, cam1: .* a second"),
    (clicked([[1, 2]]), "clicked, cam1: .* two or three"),
    (clicked([[1, 2], [3, 4, 5]]), "pictures.0.clicked.cam1.1"),
    (clicked([[1, 2], [480.0, 4]]), r"clicked, cam1, \+x: .* inside"),
    (clicked([[1, 2], [3, 4]], "cam2"), "clicked: .* got 'cam2'"),
    (
        clicked([[1, 2], [3, 4]]) | {"plate": {"type": "chessboard", "columns": 9, "rows": 6, "pitch": 8.0}},
        "clicked: .* fiducials",
    ),
    ({"image_size": [0, 400]}, "image_size.0"),
    ({"pixel_pitch": [0.02, float("nan")]}, "pixel_pitch.1"),
    ({"model": "fisheye"}, "model: .* got 'fisheye'"),
    ({"modle": "tsai"}, "write 'model'"),
    ({"ports": {"cam3": PORT}}, "ports.*cam3"),
    ({"ports": {"cam1": PORT}, "fit_ports": ["port_ofset"]}, "write 'port_offset'"),
    ({"fit_ports": ["port_offset"]}, "fit_ports: .* got none"),
    ({"ports": {"cam1": PORT}, "fit_ports": ["port_offset"] * 2}, "fit_ports: expected different"),
]


@pytest.mark.parametrize(("changes", "words"), FAULTS)
def test_faults_of_the_file_are_refused_in_one_line(tmp_path, changes, words):
    path = write(tmp_path, changes, drawn=False)
    with pytest.raises(CameraError, match=words) as caught:
        load_calibration(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_tables_of_points_need_no_plate_and_no_survey(tmp_path):
    content = {"plate": None, "surveyed": None, "pictures": None, "points": {"cam1": "p.csv"}}
    read = load_calibration(write(tmp_path, content, drawn=False))
    assert read.points == {"cam1": tmp_path / "p.csv"}
    assert read.cameras == ("cam1",)
    R, T = read.surveyed[0]
    assert_close(R, torch.eye(3).double())
    assert_close(T, torch.zeros(3).double())


def test_columns_of_a_table_are_found_by_their_names(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("u, v, x, y, z, note\n1,2,3,4,5,corner\n10,20,30,40,50,\n")
    assert read_points(path).tolist() == [[3, 4, 5, 1, 2], [30, 40, 50, 10, 20]]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no rows"),
        ("x,y,z,u,v\n", "no rows"),
        ("x,y,z,u\n1,2,3,4\n", "got no v; write mm"),
        ("x,y,z,u,v\n1,2,3,4,nan\n", "row 1, v: expected a number, got 'nan'"),
        ("x,y,z,u,v\n1,2,3,4,5\n1,2,three,4,5\n", "row 2, z: expected a number, got 'three'"),
        ("x,y,z,u,v\n1,2,3\n", "row 1, u: expected a number, got None"),
    ],
)
def test_tables_that_are_none_are_refused(tmp_path, text, words):
    path = tmp_path / "p.csv"
    path.write_text(text)
    with pytest.raises(CameraError, match=words):
        read_points(path)
    with pytest.raises(CameraError, match="no such file"):
        read_points(tmp_path / "q.csv")
