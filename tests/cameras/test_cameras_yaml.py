"""cameras.yaml: there and back, and every fault in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from camera_examples import MODELS, behind_port, f64, tsai, whole_picture
from conftest import SHARED, assert_close

from sphereorient.cameras import load_cameras, load_covariance, save_cameras
from sphereorient.cameras.camera import ParameterCovariance
from sphereorient.errors import CameraError

TSAI = """
schema: sphereorient-cameras/1
cameras:
  cam1:
    model: tsai
    image_size: [650, 480]
    f: 45.0
    pixel_pitch: [0.02, 0.02]
    sx: 1.0
    centre: [324.5, 239.5]
    kappa1: 2.2e-4
    R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    T: [0.0, 0.0, 520.0]
"""
PINHOLE = """
schema: sphereorient-cameras/1
cameras:
  cam1: {model: pinhole, image_size: [384, 288], vfov_deg: 45.0, R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], T: [0, 0, 0]}
"""
PORT = "    port: {normal: [0, 0, -1], offset: 120.0, thickness: 12.0, n_glass: 1.49, n_fluid: 1.36}\n"
COVARIANCE = "    covariance: {parameters: [f, kappa1], matrix: [[0.1, 0.0], [0.0, 1.0e-8]]}\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "cameras.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_numbers_that_yaml_takes_for_text_are_still_read(tmp_path):
    camera = load_cameras(written(tmp_path, TSAI.replace("2.2e-4", "22e-5")))["cam1"]
    assert camera.kappa1.item() == 22e-5


def test_a_tensor_that_requires_gradients_can_be_saved(tmp_path):
    save_cameras(tmp_path / "cameras.yaml", {"cam1": tsai(kappa1=f64(1e-4).requires_grad_())})
    assert load_cameras(tmp_path / "cameras.yaml")["cam1"].kappa1.item() == 1e-4


def test_the_fields_of_the_file_have_the_meaning_of_the_docs(tmp_path):
    camera = load_cameras(written(tmp_path, TSAI.replace("sx: 1.0", "sx: 1.5")))["cam1"]
    assert camera.image_size == (650, 480)
    # 52 mm aside at 520 mm: x_u = 4.5 mm = x_d (1 + 2.2e-4 x_d^2), u = 1.5 x_d / 0.02 + 324.5
    uv_px = camera.project(f64((52.0, 0.0, 0.0)))
    r_d = (uv_px[0].item() - 324.5) * 0.02 / 1.5
    assert r_d * (1 + 2.2e-4 * r_d**2) == pytest.approx(4.5, abs=1e-12)
    assert uv_px[1].item() == 239.5


def test_a_pinhole_takes_the_middle_of_the_picture_unless_the_file_gives_its_centre(tmp_path):
    camera = load_cameras(written(tmp_path, PINHOLE))["cam1"]
    assert_close(camera.project(f64((0.0, 0.0, 1.0))), f64((191.5, 143.5)))
    assert camera.f_px.item() == pytest.approx(347.6467, abs=1e-4)
    given = written(tmp_path, PINHOLE.replace("vfov_deg: 45.0", "f_px: 300.0, centre: [192.0, 144.0]"))
    assert_close(load_cameras(given)["cam1"].project(f64((1.0, 0.0, 1.0))), f64((492.0, 144.0)))


FAULTS = {
    "unknown key": (TSAI.replace("kappa1", "kapa1"), "write 'kappa1'"),
    "unknown model": (TSAI.replace("tsai", "tsay"), "cam1, model: .* write 'tsai'"),
    "model as a list": (TSAI.replace("tsai", "[tsai]"), "cam1, model: expected"),
    "no model": (TSAI.replace("    model: tsai\n", ""), "cam1, model: .* got none"),
    "half a port": (TSAI + "    port: {normal: [0, 0, -1], offset: 120.0}\n", "cam1: expected all needed keys"),
    "unknown key of a port": (TSAI + PORT.replace("n_fluid", "n_liquid"), "cam1, port: .* write 'n_fluid'"),
    "wall the wrong way round": (TSAI + PORT.replace("-1]", "1]"), "cam1, port: .* before the wall"),
    "covariance of nothing": (TSAI + "    covariance: 3\n", "cam1, covariance: expected"),
    "covariance of another": (TSAI + COVARIANCE.replace("kappa1", "kapa1"), "covariance.* write 'kappa1'"),
    "short covariance": (TSAI + COVARIANCE.replace("[0.1, 0.0]", "[0.1]"), "covariance.* 2 numbers"),
    "lopsided covariance": (TSAI + COVARIANCE.replace("[0.1, 0.0]", "[0.1, 1.0e-5]"), "symmetric"),
    "negative variance": (TSAI + COVARIANCE.replace("[0.1", "[-0.1"), "covariance.* below zero"),
    "missing key": (TSAI.replace("    f: 45.0\n", ""), "cam1, f: .* got none"),
    "text for a number": (TSAI.replace("45.0", "wide"), "cam1, f: .* got 'wide'"),
    "not a number": (TSAI.replace("45.0", ".nan"), "cam1, f_mm: expected finite numbers"),
    "no rotation": (TSAI.replace("[0, 0, 1]]", "[0, 0, 1.1]]"), "cam1, R_cam_lab: .* det = 1.1"),
    "two rows": (TSAI.replace(", [0, 0, 1]]", "]"), r"cam1, R\.2: .* got none"),
    "one size": (TSAI.replace("[650, 480]", "[650]"), r"cam1, image_size\.1: expected a value"),
    "schema": (TSAI.replace("cameras/1", "cameras/2"), "schema: expected sphereorient-cameras/1"),
    "no schema": (TSAI.replace("schema: sphereorient-cameras/1", ""), "cameras/1, got none"),
    "no cameras": ("schema: sphereorient-cameras/1\ncameras: {}\n", "expected named cameras"),
    "both foci": (PINHOLE.replace("vfov_deg: 45.0", "vfov_deg: 45.0, f_px: 3.0"), "exactly one, got both"),
    "no focus": (PINHOLE.replace("vfov_deg: 45.0, ", ""), "exactly one, got none"),
    "wide": (PINHOLE.replace("45.0", "181"), "cam1, vfov_deg: expected an angle"),
    "name with a slash": (TSAI.replace("cam1:", "lab/left:"), "cameras: expected names without '/', got 'lab/left'"),
    "name of a point": (TSAI.replace("cam1:", "'.':"), "cameras: expected names without '/', got '.'"),
    "empty name": (TSAI.replace("cam1:", "'':"), "cameras: expected names without '/', got ''"),
    "a list": ("- 1\n- 2\n", "expected keys and values"),
    "no yaml": ("a: [1, 2\nb: }", "expected YAML"),
}


@pytest.mark.parametrize(("text", "message"), FAULTS.values(), ids=FAULTS)
def test_every_fault_is_one_line_that_names_the_file(tmp_path, text, message):
    path = written(tmp_path, text)
    with pytest.raises(CameraError, match=message) as refused:
        load_cameras(path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_name_that_cannot_be_read_back_is_not_written(tmp_path):
    with pytest.raises(CameraError, match="names without '/', got 'lab/left'"):
        save_cameras(tmp_path / "cameras.yaml", {"lab/left": tsai()})
    assert not list(tmp_path.iterdir())


def covariance(variance: float, *names: str) -> ParameterCovariance:
    return ParameterCovariance(names=names, matrix=variance * torch.eye(len(names), dtype=torch.float64))


def test_cameras_outside_the_joint_covariance_add_their_own(tmp_path):
    path, own = tmp_path / "cameras.yaml", covariance(4.0, "T_x", "T_z")
    rig = {name: tsai(covariance=own) for name in ("cam1", "cam2", "cam3")}
    save_cameras(path, rig, covariance=covariance(9.0, "cam1.T_x", "cam2.T_x"))
    known = load_covariance(path, load_cameras(path))
    assert known.names == ("cam1.T_x", "cam2.T_x", "cam3.T_x", "cam3.T_z")
    assert_close(known.matrix, torch.diag(f64([9.0, 9.0, 4.0, 4.0])))
    assert load_covariance(path, {"cam3": rig["cam3"]}).names == ("cam3.T_x", "cam3.T_z")
    assert load_covariance(path, rig | {"cam3": tsai()}) is None  # not known is not exact


def test_a_folder_that_is_not_there_is_made_on_writing(tmp_path):
    save_cameras(tmp_path / "new" / "cameras.yaml", {"cam1": tsai()})
    assert list(load_cameras(tmp_path / "new" / "cameras.yaml")) == ["cam1"]


def test_an_old_file_survives_a_camera_that_cannot_be_written(tmp_path):
    path = tmp_path / "cameras.yaml"
    save_cameras(path, {"cam1": tsai()})
    before = path.read_bytes()
    with pytest.raises(CameraError, match="register the model"):
        save_cameras(path, {"cam1": object()})
    assert path.read_bytes() == before


@pytest.mark.shared
def test_exact_cameras_behind_walls_project_the_true_positions_onto_the_true_pixels():
    h5py = pytest.importorskip("h5py")
    cameras = load_cameras(SHARED / "tank" / "cameras.yaml")
    with h5py.File(SHARED / "tank" / "truth.h5") as truth:
        position = torch.from_numpy(truth["position"][:])
        for name, camera in cameras.items():
            centre_px = torch.from_numpy(truth[name]["centre_px"][:])
            assert_close(camera.project(position), centre_px, atol=1e-6)
            assert (camera.camera.project(position) - centre_px).norm(dim=-1).max() > 5  # without the wall


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("wall", [False, True], ids=["air", "port"])
def test_every_model_comes_back_to_the_last_bit(tmp_path, model, wall):
    names = ("T_y", "rotation_x") + (("port_tilt_x",) if wall else ())
    root = torch.linspace(0.1, 0.7, len(names) ** 2, dtype=torch.float64).reshape(len(names), -1)
    camera = model()
    camera = behind_port(camera, normal=f64((1.0, 2.0, 2.001)) / -3) if wall else camera
    camera = replace(camera, covariance=ParameterCovariance(names=names, matrix=root @ root.mT / 3))
    save_cameras(tmp_path / "cameras.yaml", {"cam1": camera}, comment="two lines\nof comment")
    text = (tmp_path / "cameras.yaml").read_text()
    assert text.startswith("# made by sphereorient\n# two lines\n# of comment\nschema: sphereorient-cameras/1\n")
    assert [file.name for file in tmp_path.iterdir()] == ["cameras.yaml"]
    back = load_cameras(tmp_path / "cameras.yaml")["cam1"]
    assert type(back) is type(camera)
    assert back.image_size == camera.image_size
    assert torch.equal(back.rays(whole_picture()).direction_lab, camera.rays(whole_picture()).direction_lab)
    assert torch.equal(back.rays(whole_picture()).origin_lab_mm, camera.rays(whole_picture()).origin_lab_mm)
    assert back.covariance.names == names
    assert torch.equal(back.covariance.matrix, camera.covariance.matrix)
    save_cameras(tmp_path / "again.yaml", {"cam1": back}, comment="two lines\nof comment")
    assert (tmp_path / "again.yaml").read_bytes() == (tmp_path / "cameras.yaml").read_bytes()


def test_brown_and_telecentric_read_the_keys_of_the_design(tmp_path):
    head = "schema: sphereorient-cameras/1\ncameras:\n  cam1: {image_size: [384, 288], "
    pose = "R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], T: [0, 0, 10], "
    keys = "model: brown, fx: 100.0, fy: 200.0, cx: 190.0, cy: 140.0, k: [0.5, 0.25, 0.125], p: [0.01, 0.02]}"
    # X/Z = 0.1, Y/Z = 0.2: r^2 = 0.05, radial 1.025640625, tangential as OpenCV's manual has it
    u = 190 + 100 * (0.1 * 1.025640625 + 2 * 0.01 * 0.02 + 0.02 * (0.05 + 2 * 0.01))
    v = 140 + 200 * (0.2 * 1.025640625 + 0.01 * (0.05 + 2 * 0.04) + 2 * 0.02 * 0.02)
    camera = load_cameras(written(tmp_path, head + pose + keys))["cam1"]
    assert_close(camera.project(f64((1.0, 2.0, 0.0))), f64((u, v)), atol=1e-9)
    camera = load_cameras(written(tmp_path, head + pose + "model: telecentric, scale: 0.5}"))["cam1"]
    assert_close(camera.project(f64((1.0, 2.0, 77.0))), f64((191.5 + 2, 143.5 + 4)))
