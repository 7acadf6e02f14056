"""Faults that hostile inputs once found, a test each: hangs, crashes, filled memory, wrong results."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from camera_examples import load_opencv
from hostile_files import bomb_png, encoded, pattern, png, tiff
from hostile_kinds import BOMBS
from hostile_texts import OPENCV, ORI, PAR, PINHOLE, calibration_documents, camera, cameras_documents

from sphereorient.calibration.document import load_calibration
from sphereorient.cameras import Camera, load_cameras
from sphereorient.cameras.io.openptv import load_openptv, load_ptv_par
from sphereorient.errors import CameraError, ExperimentError, SettingsError, TextureError
from sphereorient.experiment.recording import load_background
from sphereorient.files.whole_file import read_whole
from sphereorient.files.yaml_file import parse_yaml
from sphereorient.methods.settings import load_settings
from sphereorient.sphere import load_texture


def written(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def one_camera(folder: Path, **keys: object) -> dict[str, Camera]:
    document = {"schema": "sphereorient-cameras/1", "cameras": {"cam1": PINHOLE | keys}}
    return load_cameras(written(folder / "cameras.yaml", yaml.safe_dump(document)))


# Places where no file is


def test_a_name_that_no_file_can_have_is_refused(tmp_path):
    with pytest.raises(CameraError, match="a name that no file can have"):
        read_whole(tmp_path / "zero\0byte", 1000, "a file", CameraError, "correct the path")


# YAML


@pytest.mark.parametrize(
    "name",
    [
        "billion laughs",
        "billion keys",
        "merged without end",
        *(pytest.param(many, marks=pytest.mark.slow) for many in ("many items", "many keys")),
    ],
)
def test_documents_of_too_many_values_are_refused(name):
    with pytest.raises(yaml.YAMLError, match="more than 20000 values"):
        parse_yaml(BOMBS[name])


@pytest.mark.parametrize("name", ["deep lists", "deep mappings", "deep blocks", "deep keys", "deep lines"])
def test_nesting_is_refused_before_it_recurses(name):
    with pytest.raises(yaml.YAMLError, match="more than 30 levels"):
        parse_yaml(BOMBS[name])


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("&a [*a]", "contains itself"),
        ("&a {b: {<<: *a}}", "contains itself"),
        ("a: 1\nb: 2\na: 3", "the key 'a' twice"),
        ("{? [a] : 1}", "no name"),
        ("{'a\\tb': 1}".replace("'", '"'), "control characters"),
        ("k" * 101 + ": 1", "no name"),
        ("!!python/object/apply:os.system ['true']", "a tag"),
        ("!!timestamp x", "a tag"),  # once an AttributeError
        ("!!int ''", "a tag"),  # once an IndexError
        ("!!bool 7", "a tag"),  # once a KeyError
        ('"a\\0b"', "control characters"),
        ('"a\\u2028b"', "several lines"),
        ("9" * 65, "more than 64 characters"),
        (":".join(["1"] * 500) + ".5", "more than 64 characters"),  # once an OverflowError
        ("x" * 5000, "more than 4096 characters"),
    ],
)
def test_unsupported_features_of_yaml_are_refused(text, problem):
    with pytest.raises(yaml.YAMLError, match=problem):
        parse_yaml(text)


def test_aliases_merge_keys_and_a_mark_in_front_still_work(tmp_path):
    text = "base: &base {f: 1, g: [1, 2]}\none: {<<: *base, f: 2}\ntwo: *base\n"
    assert parse_yaml(text) == {"base": (base := {"f": 1, "g": [1, 2]}), "one": base | {"f": 2}, "two": base}
    document = yaml.safe_dump(cameras_documents()[0])
    assert list(load_cameras(written(tmp_path / "cameras.yaml", "\ufeff" + document))) == ["cam1"]
    assert parse_yaml("name: fl\u00fcssig \U0001f600 \u3000") == {"name": "fl\u00fcssig \U0001f600 \u3000".strip(" ")}


def test_a_covariance_of_a_hundred_parameters_is_not_too_much():
    rows = np.eye(100).tolist()
    assert parse_yaml(yaml.safe_dump({"matrix": rows}))["matrix"] == rows


def test_an_unknown_key_below_a_name_that_the_file_gives_is_refused(tmp_path):
    # Once a KeyError: the name cam1 was looked up among the keys of a port.
    document = calibration_documents()[0]
    document["ports"] = {"cam1": document["ports"]["cam1"] | {"n_glas": 1.5}}
    with pytest.raises(CameraError, match=r"calibration\.yaml, ports, cam1: .* got 'n_glas'; "):
        load_calibration(written(tmp_path / "calibration.yaml", yaml.safe_dump(document)))


# Cameras


@pytest.mark.parametrize("key", ["k", "p"])
def test_distortions_whose_powers_overflow_are_refused(tmp_path, key):
    # Once a LinAlgError out of the roots of the polynomial.
    document = {
        "schema": "sphereorient-cameras/1",
        "cameras": {"cam1": camera("brown") | {key: [1e308, 1e308, 1e308][: 3 if key == "k" else 2]}},
    }
    with pytest.raises(CameraError, match=f"cam1, {key}"):
        load_cameras(written(tmp_path / "cameras.yaml", yaml.safe_dump(document)))


def test_a_picture_of_a_trillion_pixels_is_no_cameras(tmp_path):
    with pytest.raises(CameraError, match="cam1, image_size"):
        one_camera(tmp_path, image_size=[1_000_000, 1_000_000])


def test_messages_do_not_hold_whole_files(tmp_path):
    for model in ("x" * 4000, list(range(5000)), {f"k{k}": k for k in range(3000)}):
        with pytest.raises(CameraError) as refused:
            one_camera(tmp_path, model=model)
        assert len(str(refused.value).replace(str(tmp_path), "")) < 300


# Calibrations


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"columns": 10**9}, "plate, columns: .* at most 1000"),
        ({"pitch": 10**30}, "plate, pitch: expected a length"),
        ({"fiducials": [[0, 0], [float("inf"), 0], [0, 2]]}, "plate, fiducials: expected three"),
        ({"fiducials": 3}, "plate, fiducials: expected three"),
        ({"type": "charuco"}, "plate: expected the keys"),
        ({"type": "charuco", "dictionary": 4}, "plate"),  # once an AttributeError
    ],
)
def test_a_plate_that_is_none_is_refused_with_the_name_of_the_file(tmp_path, change, words):
    document = calibration_documents()[0]
    document["plate"] = document["plate"] | change
    with pytest.raises(CameraError, match=words) as refused:
        load_calibration(written(tmp_path / "calibration.yaml", yaml.safe_dump(document)))
    assert str(tmp_path / "calibration.yaml") in str(refused.value)


def test_a_port_that_is_none_is_refused_with_the_name_of_the_file(tmp_path):
    document = calibration_documents()[0]
    document["ports"] = {"cam1": document["ports"]["cam1"] | {"normal": [0.0, 0.0, 0.0]}}
    with pytest.raises(CameraError, match=r"calibration\.yaml, ports, cam1, "):
        load_calibration(written(tmp_path / "calibration.yaml", yaml.safe_dump(document)))


# OpenCV's and OpenPTV's files


@pytest.mark.parametrize(
    ("suffix", "nested"), [("yml", "a: " + "[" * 100_000), ("yml", "a: " + "- " * 100_000), ("xml", "<a>" * 100_000)]
)
def test_nesting_on_which_opencvs_parser_crashes_is_refused(tmp_path, suffix, nested):
    with pytest.raises(CameraError, match="can be parsed"):
        load_opencv(written(tmp_path / f"cam.{suffix}", OPENCV[suffix] + nested))


@pytest.mark.parametrize("claim", ["100000", "2147483647", "-1", "0", "1.5", "x"])
def test_a_matrix_that_claims_much_is_not_made_room_for(tmp_path, claim):
    text = OPENCV["yml"].replace("rows: 3", f"rows: {claim}").replace("cols: 3", f"cols: {claim}")
    with pytest.raises(CameraError, match="camera_matrix"):
        load_opencv(written(tmp_path / "cam.yml", text))


def test_an_opencv_file_without_keys_and_sizes_that_are_no_numbers_are_refused(tmp_path):
    for text, words in (
        ("%YAML:1.0\n---\n- 1\n", "expected keys and values"),  # once a cv2.error
        (OPENCV["yml"].replace("640", ".Inf"), "two whole numbers"),  # once an OverflowError
        (OPENCV["yml"].replace("640", ".Nan"), "two whole numbers"),  # once a ValueError
    ):
        with pytest.raises(CameraError, match=words):
            load_opencv(written(tmp_path / "cam.yml", text))


@pytest.mark.parametrize(
    "text",
    [
        "\u00b2" + PAR[1:],  # a digit to isdigit, none to int
        "9" * 5000 + PAR[1:],
        PAR.replace("0.012", "0.0"),  # once a ZeroDivisionError
        PAR.replace("\n0\n1\n1.49", "\n0\n0\n1.49"),
        PAR.replace("1280", "nan"),
    ],
    ids=["digit", "digits", "pitch", "index", "nan"],
)
def test_a_ptv_par_that_is_none_is_refused(tmp_path, text):
    with pytest.raises(CameraError, match=r"ptv\.par") as refused:
        load_openptv(written(tmp_path / "cam.ori", ORI), load_ptv_par(written(tmp_path / "ptv.par", text)))
    assert len(str(refused.value).splitlines()) == 1


def test_an_ori_with_a_mark_in_front_is_read_and_one_with_controls_is_refused_in_print(tmp_path):
    par = load_ptv_par(written(tmp_path / "ptv.par", PAR))
    load_openptv(written(tmp_path / "cam.ori", "\ufeff" + ORI), par)
    with pytest.raises(CameraError, match=r"got '\\x1b105.2632'"):
        load_openptv(written(tmp_path / "cam.ori", "\x1b" + ORI), par)


# Pictures


@pytest.mark.parametrize(
    "content",
    [png(30_000, 15_000), bomb_png(20_000, 10_000), tiff(65_536, 32_768), tiff(65_536, 32_768, big=True)],
    ids=["png", "bomb", "tiff", "tiff big"],
)
def test_a_picture_that_claims_too_much_is_refused_before_room_is_made(tmp_path, content):
    with pytest.raises(TextureError, match=r"33\.6 million pixels"):
        load_texture(written(tmp_path / "texture.png", content))
    with pytest.raises(ExperimentError, match="32 x 16 px"):
        load_background(written(tmp_path / "empty.png", content), (16, 32))


def test_formats_whose_size_is_not_known_before_decoding_are_refused(tmp_path):
    with pytest.raises(TextureError, match="PNG, TIFF or JPEG"):
        load_texture(written(tmp_path / "texture.png", encoded(".webp", np.dstack([pattern()] * 3))))


# Settings


@pytest.mark.parametrize(
    "text", ["motion: {truncate: .inf}", "motion: {truncate: '1e400'}", "motion: {truncate: .nan}"]
)
def test_settings_that_are_no_finite_numbers_are_refused(tmp_path, text):
    with pytest.raises(SettingsError, match=r"settings\.yaml, motion\.truncate"):
        load_settings(written(tmp_path / "settings.yaml", text))
