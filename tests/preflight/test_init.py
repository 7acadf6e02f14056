"""`sphereorient init`: its measurements and the files that it writes, which are read back."""

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import UnionType
from typing import get_args

import cv2
import numpy as np
import pytest
import torch
import yaml
from plate_drawing import Scene
from preflight_examples import Example, clean_example  # noqa: F401
from pydantic import BaseModel
from typer.testing import CliRunner

from sphereorient import so3
from sphereorient.calibration.document import CalibrationKeys, load_calibration
from sphereorient.calibration.draft import numbered_pictures
from sphereorient.cameras import load_cameras
from sphereorient.cli import app
from sphereorient.errors import CameraError, ExperimentError, SettingsError, SphereOrientError
from sphereorient.experiment import load_experiment
from sphereorient.experiment.experiment import ExperimentKeys
from sphereorient.files.whole_file import has_mark
from sphereorient.files.yaml_file import DraftKey, draft_yaml, given
from sphereorient.movies import open_movie
from sphereorient.preflight.fictrac import read_fictrac_config
from sphereorient.preflight.first_look import FirstLook, experiment_keys, look_at
from sphereorient.synth import SynthSettings, write_synthetic_experiment

ROUND = ["--set", "frame_rate=600", "--set", "sphere.diameter=18"]
CONFIG = """## FicTrac v2.1.2 config file
c2a_r            : { 0.72, -0.13, -0.46 }
roi_circ         : { 10, 0, 0, 10, -10, 0 }
roi_ignr         : { { 96, 156, 113, 147, 106, 128 }, { 71, 113, 90, 119, 114, 118, 135, 111 } }
src_fn           : cam1.mkv
src_fps          : -1
vfov             : 45
"""


def init(*arguments: object) -> str:
    """Run the command as a user does, without a terminal; return its output."""
    run = CliRunner().invoke(app, ["init", *map(str, arguments)])
    if isinstance(run.exception, SphereOrientError):
        raise run.exception
    assert run.exit_code == 0, run.output
    return run.output


def no_ball(folder: Path, name: str = "empty.npy") -> Path:
    """A movie of noise, for tests that need no ball."""
    np.save(folder / name, np.random.default_rng(0).integers(20, 24, (40, 48, 64)).astype(np.uint8))
    return folder / name


def two_movies(clean: Example, folder: Path) -> list[Path]:
    """Link two movies into an empty folder."""
    for name in ("cam1", "cam2"):
        (folder / f"{name}.mkv").symlink_to(clean.folder / f"{name}.mkv")
    return [folder / "cam1.mkv", folder / "cam2.mkv"]


@pytest.mark.slow
def test_two_movies_become_an_experiment(clean, tmp_path):
    printed = init(*two_movies(clean, tmp_path), "--out", tmp_path / "experiment.yaml", *ROUND, "-q")
    assert printed == ""
    with pytest.raises(CameraError, match=r"cameras.yaml.*`sphereorient calibrate`"):
        load_experiment(tmp_path / "experiment.yaml")
    (tmp_path / "cameras.yaml").symlink_to(clean.folder / "cameras.yaml")
    experiment = load_experiment(tmp_path / "experiment.yaml")
    assert (experiment.frame_rate_hz, experiment.diameter_mm, experiment.fixed) == (600.0, 18.0, False)
    assert list(experiment.movie_paths.values()) == [tmp_path / "cam1.mkv", tmp_path / "cam2.mkv"]
    assert cv2.imread(str(tmp_path / "experiment.png")) is not None


def test_unknown_values_are_requested_by_name_in_one_refusal(clean, tmp_path):
    printed = init(*two_movies(clean, tmp_path), "--out", tmp_path / "experiment.yaml")
    assert re.findall(r"write in experiment.yaml: ([\w.]+),", printed) == ["frame_rate", "sphere.diameter"]
    assert "moves, found in" in printed
    with pytest.raises(ExperimentError, match=r"frame_rate or times, sphere\.diameter"):
        load_experiment(tmp_path / "experiment.yaml")


@pytest.mark.slow
def test_the_look_measures_the_ball(clean, tmp_path):
    for look in look_at(two_movies(clean, tmp_path)):
        assert look.diameter_px == pytest.approx(56.0, rel=0.12)  # nearer and farther
        assert look.stays is not True  # half a radius to and fro in cam1, more in the other
        assert not look.sways
        assert look.found > 0.9 * look.looked


@pytest.mark.slow
def test_the_look_finds_a_ball_that_stays(tmp_path):
    settings = SynthSettings(frames=40, image_size=(200, 200), diameter_px=60.0, velocity_rms=0.0, volume_mm=1e-3)
    write_synthetic_experiment(tmp_path, settings)
    (look,) = look_at([tmp_path / "cam1.mkv"])
    assert look.stays is True
    assert look.diameter_px == pytest.approx(60.0, rel=0.05)
    printed = init(tmp_path / "cam1.mkv", "--out", tmp_path / "new.yaml")
    assert "fixed, outline" in printed


def test_a_movie_without_a_ball_is_reported(tmp_path):
    (look,) = look_at([no_ball(tmp_path)])
    assert look.diameter_px is None
    assert "no ball was found" in init(tmp_path / "empty.npy", "--out", tmp_path / "experiment.yaml")


def leaves(model: type[BaseModel], before: str = "") -> Iterator[str]:
    for name, field in model.model_fields.items():
        kinds = get_args(field.annotation) if isinstance(field.annotation, UnionType) else (field.annotation,)
        inner = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)]
        yield from leaves(inner[0], f"{before}{name}.") if inner else [before + name]


def look(folder: Path) -> FirstLook:
    """A movie of noise, with a look as if a ball of 80 px moved in it."""
    np.save(folder / "a.npy", np.zeros((40, 48, 64), np.uint8))
    movie = open_movie(folder / "a.npy")
    frame = {"found": 40, "looked": 40, "frame": 0, "picture": np.zeros((48, 64)), "outline": None}
    return FirstLook(name="cam1", movie=movie, rate_hz=None, diameter_px=80.0, stays=False, **frame)


def uncommented(text: str) -> str:
    """Return a draft with its examples put to use, as a user does: the "#" before a key goes, and nothing else."""
    return re.sub(r"(?m)^(\s*)#(\w+:)", r"\1\2", text)


def test_a_draft_has_every_key_and_valid_examples(tmp_path):
    keys = experiment_keys([look(tmp_path)], tmp_path)
    text = uncommented(draft_yaml("sphereorient-experiment/1", keys))
    document = yaml.safe_load(text)
    assert document.pop("schema") == "sphereorient-experiment/1"
    ExperimentKeys.model_validate(document)
    names = {key for key in leaves(ExperimentKeys) if not key.startswith("flow.")} | {"flow"}
    written = {key.name for key in keys}
    assert names - written == {"times", "time_unit", "spheres"}  # instead of frame_rate and sphere


def test_a_key_that_is_not_one_is_refused_with_its_neighbour():
    keys = [DraftKey(name="sphere.diameter", comment="mm")]
    assert given(keys, ["sphere.diameter=null"])[0].value is None
    for text in ("sphere.diametre=18", "sphere.diameter", "sphere.diameter=[1"):
        with pytest.raises(SettingsError):
            given(keys, [text])


def plates(folder: Path, scenes: Sequence[Scene]) -> Path:
    folder.mkdir()
    for pose, scene in enumerate(scenes):
        cv2.imwrite(str(folder / f"left-{pose:02d}.png"), scene.picture())
    return folder


KINDS = [
    DraftKey(name="rate", comment="Hz", example=600.0),
    DraftKey(name="fixed", value=False, comment="whether it stays"),
    DraftKey(name="pitch", comment="mm", example=[0.02, 0.02]),
    DraftKey(name="walls", comment="of cameras", example={"cam1": {"offset": 120.0}}),
]


def test_a_value_of_its_kind_is_taken_and_another_one_refused():
    several = "walls={cam1: {offset: 90}, cam2: {offset: 1.5}}"
    for change in ("rate=25", "rate=null", "fixed=true", "pitch=[1, 2]", several):
        name, _, text = change.partition("=")
        assert {key.name: key.value for key in given(KINDS, [change])}[name] == yaml.safe_load(text)
    for change in ("rate=fast", "rate=true", "rate=[1]", "fixed=1", "pitch=0.02", "pitch=[a, b]", "walls={cam1: 3}"):
        with pytest.raises(SettingsError, match=f"--set {change.partition('=')[0]}: expected a value like "):
            given(KINDS, [change])


def test_a_folder_of_plates_becomes_a_calibration(tmp_path):
    scenes = [Scene(tilt_deg=20.0, about_deg=about, spin_deg=spin) for about, spin in ((0, 10), (90, 100), (45, 200))]
    folder, plate = plates(tmp_path / "plates", scenes), Scene().plate
    out = tmp_path / "calibration.yaml"
    known = [f"plate.pitch={plate.pitch_mm}", "pixel_pitch=[0.02, 0.02]", "surveyed.T_lab_plate=[0, 0, 0]"]
    printed = init("--plate", folder, "--out", out, *(word for text in known for word in ("--set", text)))
    assert re.findall(r"write in calibration.yaml: ([\w.]+),", printed) == ["surveyed.R_lab_plate"]
    with pytest.raises(CameraError, match=r"surveyed\.R_lab_plate"):
        load_calibration(out)
    known.append("surveyed.R_lab_plate=[[1,0,0],[0,1,0],[0,0,1]]")
    init("--plate", folder, "--out", out, "--force", *(word for text in known for word in ("--set", text)))
    found = load_calibration(out).plate
    for name in ("columns", "rows", "fiducials", "dark"):
        assert getattr(found, name) == getattr(plate, name)
    assert found.dot_diameter_mm == pytest.approx(plate.dot_diameter_mm, rel=0.03)
    assert found.fiducial_diameter_mm == pytest.approx(plate.fiducial_diameter_mm, rel=0.03)
    assert set(leaves(CalibrationKeys)) - set(yaml.safe_load(out.read_text())) <= {
        *("ports", "points", "fit_ports", "surveyed.pose", "surveyed.R_lab_plate", "surveyed.T_lab_plate")
    }


def test_all_missing_keys_of_a_calibration_are_reported_at_once(tmp_path):
    out = tmp_path / "calibration.yaml"
    init("--plate", plates(tmp_path / "plates", [Scene()]), "--out", out, "-q")
    with pytest.raises(CameraError) as refused:
        load_calibration(out)
    for key in ("plate.pitch", "plate.dot_diameter", "pixel_pitch", "surveyed.R_lab_plate", "surveyed.T_lab_plate"):
        assert key in str(refused.value)


def test_plate_pictures_are_paired_by_number(tmp_path):
    for name in ("cam1_00.png", "cam2_00.png", "cam1_10.tif", "3.jpg", "notes.txt", "unnumbered.png"):
        (tmp_path / name).touch()
    assert numbered_pictures(tmp_path) == {
        0: {"cam1": "cam1_00.png", "cam2": "cam2_00.png"},
        3: {"cam1": "3.jpg"},
        10: {"cam1": "cam1_10.tif"},
    }
    with pytest.raises(CameraError, match="no pictures"):
        numbered_pictures(tmp_path / "nowhere")


def test_a_folder_without_plates_is_reported(tmp_path):
    cv2.imwrite(str(tmp_path / "a1.png"), np.full((100, 120), 90, np.uint8))
    printed = init("--plate", tmp_path, "--out", tmp_path / "calibration.yaml")
    assert "no dots found in 1 pictures" in printed


def test_fictrac_is_taken_over(clean, tmp_path):
    two_movies(clean, tmp_path)
    (tmp_path / "config.txt").write_text(CONFIG)
    fictrac = read_fictrac_config(tmp_path / "config.txt")
    assert fictrac.circle_px == pytest.approx((0.0, 0.0, 10.0), abs=1e-9)
    assert [len(one) for one in fictrac.ignored] == [3, 4]
    init("--from-fictrac", tmp_path / "config.txt", "--out", tmp_path / "experiment.yaml")
    experiment = load_experiment(tmp_path / "experiment.yaml")
    camera = experiment.cameras["cam1"]
    assert experiment.sphere.sways  # half a radius to and fro in this movie
    assert experiment.diameter_mm is None
    assert experiment.frame_rate_hz == 600.0  # of the file: FicTrac's own is -1
    assert float(camera.f_px) == pytest.approx(120.0 / math.tan(math.radians(22.5)))
    C = so3.exp(torch.tensor([0.72, -0.13, -0.46], dtype=torch.float64))
    torch.testing.assert_close(camera.R_cam_lab, C.mT)  # x_animal = C x_cam
    mask = cv2.imread(str(experiment.mask_paths["cam1"]), cv2.IMREAD_GRAYSCALE)
    assert mask[140, 105] == 0
    assert mask[10, 10] == 255


def test_a_camera_of_fictrac_needs_a_movie_of_the_set_up_and_is_the_source_of_live(clean, tmp_path):
    movie, _ = two_movies(clean, tmp_path)
    config, out = tmp_path / "config.txt", tmp_path / "experiment.yaml"
    config.write_text(CONFIG.replace("src_fn           : cam1.mkv", "src_fn           : 2"))
    with pytest.raises(SettingsError, match="got camera 2"):
        init("--from-fictrac", config, "--out", out)
    with pytest.raises(SettingsError, match="expected one movie, got 2"):
        init(movie, movie, "--from-fictrac", config, "--out", out)
    assert not out.exists()
    printed = init(movie, "--from-fictrac", config, "--out", out)
    assert f"sphereorient live {out} --source camera:2" in printed
    experiment = load_experiment(out)
    assert experiment.movie_paths["cam1"] == movie
    assert float(experiment.cameras["cam1"].f_px) == pytest.approx(120.0 / math.tan(math.radians(22.5)))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("src_fn           :", "src_fn: expected the movie"),
        ("vfov             : 190", "vfov: expected degrees"),
        ("c2a_r            : { 1, 2 }", "c2a_r: expected three numbers"),
        ("c2a_r            :", "c2a_r: expected three numbers, rad, or four corners"),
        ("c2a_src          : ext\nc2a_r : ", "c2a_r: expected three numbers, rad, or four corners"),
        ("fisheye          : 2", "fisheye: expected y or n"),
        ("thr_rgb_tfrm     : red", "thr_rgb_tfrm: expected grey"),
    ],
)
def test_a_wrong_config_is_refused_by_its_key(tmp_path, line, message):
    key = "c2a_r" if "c2a_r" in line else line.partition(":")[0]
    others = [each for each in CONFIG.splitlines() if not each.startswith(key)]
    (tmp_path / "config.txt").write_text("\n".join([*others, line]))
    with pytest.raises(ExperimentError, match=message):
        read_fictrac_config(tmp_path / "config.txt")


def test_fictracs_own_rotation_comes_from_its_corners(tmp_path):
    """The sample's config holds both: corners in a picture of 384 x 288 px, and configGui's rotation from them."""
    text = CONFIG.replace("c2a_r            : { 0.72, -0.13, -0.46 }", "c2a_src : c2a_cnrs_xy")
    text += "c2a_cnrs_xy      : { 191, 171, 128, 272, 20, 212, 99, 132 }\nc2a_t : { -0.67, 0.39, 2.89 }\n"
    (tmp_path / "config.txt").write_text(text)
    fictrac = read_fictrac_config(tmp_path / "config.txt")
    theirs = so3.exp(torch.tensor([0.722445, -0.131314, -0.460878], dtype=torch.float64))
    assert math.degrees(float(so3.log(theirs.mT @ fictrac.R_animal_cam((384, 288))).norm())) < 0.001
    assert fictrac.unread == ("c2a_t",)


@pytest.mark.parametrize("fisheye", [False, True])
@pytest.mark.parametrize(
    ("plane", "corners"),  # FicTrac's geometry.h
    [
        ("xy", [(0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0), (-0.5, -0.5, 0)]),
        ("yz", [(0, -0.5, -0.5), (0, 0.5, -0.5), (0, 0.5, 0.5), (0, -0.5, 0.5)]),
        ("xz", [(0.5, 0, -0.5), (-0.5, 0, -0.5), (-0.5, 0, 0.5), (0.5, 0, 0.5)]),
    ],
)
def test_corners_of_any_plane_and_lens_show_the_rotation(tmp_path, plane, corners, fisheye):
    R = so3.exp(torch.tensor([0.6, -0.5, 0.4], dtype=torch.float64))  # animal to camera
    x, y, z = (np.array(corners) @ R.numpy().T + (0.2, -0.1, 1.5)).T
    away = np.hypot(x, y)
    radius = 288 / math.radians(60) * np.arctan2(away, z) if fisheye else 144 / math.tan(math.radians(30)) * away / z
    uv = np.column_stack([x, y]) / away[:, None] * radius[:, None] + (192, 144)  # FicTrac's middle of 384 x 288 px
    lines = CONFIG.replace("c2a_r  ", "old  ").replace(": 45", ": 60")
    lines += f"c2a_src : c2a_cnrs_{plane}\nc2a_cnrs_{plane} : {{ {', '.join(map(str, uv.ravel()))} }}\n"
    (tmp_path / "config.txt").write_text(lines + f"fisheye : {'1' if fisheye else '0'}\n")
    found = read_fictrac_config(tmp_path / "config.txt").R_animal_cam((384, 288))
    torch.testing.assert_close(found, R.mT, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    "corners", ["130, 60, 130, 100, 80, 100, 80, 60", "0, 0, 0, 0, 0, 0, 0, 0", "1, 1, 2, 2, 3, 3, 4, 4"]
)
def test_corners_that_do_not_show_a_rotation_are_refused(tmp_path, corners):
    text = CONFIG.replace("c2a_r  ", "old  ") + f"c2a_src : c2a_cnrs_xy\nc2a_cnrs_xy : {{ {corners} }}\n"
    (tmp_path / "config.txt").write_text(text)
    with pytest.raises(ExperimentError, match=r"c2a_src: .* add c2a_r"):
        read_fictrac_config(tmp_path / "config.txt").R_animal_cam((200, 160))


@pytest.mark.parametrize(
    ("text", "points"),
    [
        ("{  }", []),
        ("", []),
        ("{ {  }, { 1, 2, 3, 4 } }", []),
        ("{ { 1, 2, 3, 4, 5, 6, 7 } }", [[[1, 2], [3, 4], [5, 6]]]),
    ],
)
def test_polygons_are_those_that_fictrac_fills(tmp_path, text, points):
    lines = [line for line in CONFIG.splitlines() if not line.startswith("roi_ignr")]
    (tmp_path / "config.txt").write_text("\n".join([*lines, f"roi_ignr : {text}"]))
    assert [one.tolist() for one in read_fictrac_config(tmp_path / "config.txt").ignored] == points


def test_every_key_of_fictrac_is_used_or_named(clean, tmp_path):
    """Those of its doc/params.md."""
    two_movies(clean, tmp_path)
    used = {"src_fn", "vfov", "fisheye", "src_fps", "c2a_r", "roi_circ", "roi_ignr", "thr_rgb_tfrm"}
    others = "do_display save_debug save_raw sock_host sock_port com_port com_baud q_factor max_bad_frames"
    others += " opt_do_global opt_max_err thr_ratio thr_win_pc vid_codec sphere_map_fn opt_max_evals opt_bound opt_tol"
    others += " c2a_cnrs_xy c2a_cnrs_yz c2a_cnrs_xz c2a_src c2a_t roi_c roi_r"
    text = CONFIG + "fisheye : n\nthr_rgb_tfrm : grey\n% vfov : 90\n"
    (tmp_path / "config.txt").write_text(text + "".join(f"{key} : 1\n" for key in others.split()))
    printed = init("--from-fictrac", tmp_path / "config.txt", "--out", tmp_path / "experiment.yaml")
    (line,) = [line for line in printed.splitlines() if "not read: " in line]
    assert line.partition("not read: ")[2].split(", ") == others.split()
    assert not used & set(others.split())


def test_fictracs_fisheye_has_one_angle_for_every_pixel(clean, tmp_path):
    two_movies(clean, tmp_path)
    (tmp_path / "config.txt").write_text(CONFIG.replace(": 45", ": 190") + "fisheye          : y\n")  # a pinhole: < 180
    init("--from-fictrac", tmp_path / "config.txt", "--out", tmp_path / "experiment.yaml", "-q")
    camera = load_experiment(tmp_path / "experiment.yaml").cameras["cam1"]
    height_px = camera.image_size[1]
    edges = camera.rays(camera.centre_px + torch.tensor([[0.0, -0.5], [0.0, 0.5]]).double() * height_px).direction_lab
    assert math.degrees(math.acos(float(edges[0] @ edges[1]))) == pytest.approx(360 - 190)
    assert camera.f_px.tolist() == pytest.approx([height_px / math.radians(190)] * 2)


def test_init_replaces_its_own_file_until_a_user_changes_it(tmp_path):
    movie, out = no_ball(tmp_path), tmp_path / "experiment.yaml"
    init(movie, "--out", out)
    first = out.read_text()
    assert has_mark(out)  # also for another process
    init(movie, "--out", out, *ROUND)
    second = out.read_text()
    assert second != first
    out.write_text(second.replace("diameter: 18", "diameter: 19"))
    with pytest.raises(SphereOrientError, match=r"changed draft.*--force"):
        init(movie, "--out", out)
    assert "diameter: 19" in out.read_text()
    assert not has_mark(out)


def test_half_a_pose_is_refused(tmp_path):
    camera = "{model: pinhole, image_size: [64, 48], vfov_deg: 30, T: [0, 0, 0]}"
    (tmp_path / "cameras.yaml").write_text(f"schema: sphereorient-cameras/1\ncameras:\n  cam1: {camera}\n")
    with pytest.raises(CameraError, match="cam1, R: expected"):
        load_cameras(tmp_path / "cameras.yaml")


def test_a_movie_in_place_of_an_experiment_is_reported(clean):
    with pytest.raises(ExperimentError, match=r"got a movie; .*`sphereorient init"):
        load_experiment(clean.folder / "cam1.mkv")


@pytest.mark.parametrize("arguments", [[], ["a.mkv", "--plate", "b"], [f"{k}.mkv" for k in range(9)]])
def test_one_source_is_named(tmp_path, arguments):
    with pytest.raises(SettingsError):
        init(*arguments, "--out", tmp_path / "experiment.yaml")


def one_uncommented(text: str) -> Iterator[tuple[str, str]]:
    """Each commented line of a draft, and the text with one comment mark taken from it, and a space behind it."""
    lines = text.splitlines()
    for k, line in enumerate(lines):
        if line.lstrip().startswith("#"):
            for mark in ("#", "# ") if "# " in line[: len(line) - len(line.lstrip()) + 2] else ("#",):
                yield line, "\n".join([*lines[:k], line.replace(mark, "", 1), *lines[k + 1 :]])


def test_each_commented_line_of_a_draft_can_be_uncommented_alone(tmp_path):
    two, one = [no_ball(tmp_path, f"cam{k}.npy") for k in (1, 2)], tmp_path / "one" / "experiment.yaml"
    init(*two, "--out", tmp_path / "experiment.yaml")
    init(two[0], "--out", one)
    plate = tmp_path / "calibration.yaml"
    init("--plate", plates(tmp_path / "plates", [Scene()]), "--out", plate)
    count = 0
    for path in (tmp_path / "experiment.yaml", one, one.with_name("cameras.yaml"), plate):
        plain = yaml.safe_load(path.read_text())
        assert not re.search(r"[&*]id", path.read_text()), "an alias, of which a change is one of two keys"
        for line, text in one_uncommented(path.read_text()):
            found, count = yaml.safe_load(text), count + 1
            key = re.match(r"\s*#(\w+):", line)
            assert (found != plain) == (key is not None), line
            if key is not None:
                assert f"'{key[1]}': " in str(found), line
                assert str(found).count("None") == str(plain).count("None"), "a value of its own"
    assert count > 30


def test_an_uncommented_wall_is_read_and_each_camera_has_its_own(tmp_path):
    folder = plates(tmp_path / "plates", [Scene()])
    for file in list(folder.iterdir()):
        (folder / file.name.replace("left", "right")).write_bytes(file.read_bytes())
    out = tmp_path / "calibration.yaml"
    values = ("pixel_pitch=[0.02, 0.02]", "plate.pitch=8", "plate.dot_diameter=3", "plate.fiducial_diameter=5")
    lab = ("surveyed.R_lab_plate=[[1,0,0],[0,1,0],[0,0,1]]", "surveyed.T_lab_plate=[0,0,0]")
    init("--plate", folder, "--out", out, *(word for text in (*values, *lab) for word in ("--set", text)))
    text = out.read_text()
    assert "2 pictures of 1 poses" in text
    out.write_text(text.replace("#ports", "ports"))
    walls = yaml.safe_load(out.read_text())["ports"]
    assert walls["left"]["normal"] != walls["right"]["normal"]
    assert set(load_calibration(out).ports) == {"left", "right"}


@pytest.mark.parametrize("change", ["\ufeff{}", "# mine\n{}", "first line"])
def test_a_draft_that_an_editor_changed_is_known_as_that_of_init(tmp_path, change):
    movie, out = no_ball(tmp_path), tmp_path / "experiment.yaml"
    init(movie, "--out", out)
    text = out.read_text()
    out.write_text(text.partition("\n")[2] if change == "first line" else change.format(text), newline="\r\n")
    with pytest.raises(SphereOrientError, match="changed draft"):
        init(movie, "--out", out)


def test_a_rate_that_fictrac_does_not_give_is_reported(tmp_path):
    config, text = tmp_path / "config.txt", CONFIG.replace("cam1.mkv", no_ball(tmp_path).name)
    config.write_text(text)
    more = ("--from-fictrac", config, "--out", tmp_path / "experiment.yaml")
    assert "src_fps gives no rate" in init(*more)
    assert "src_fps" not in init(*more, "--set", "frame_rate=99")
    config.write_text(text.replace("src_fps          : -1", "src_fps          : 80"))
    assert "src_fps" not in init(*more)
