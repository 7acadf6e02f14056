"""One photograph as input: from `init` to a track, against the truth of a rendered picture; and refusals."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch
import yaml
from photographs import Stills, write_stills
from PIL import Image
from typer.testing import CliRunner

from sphereorient import so3
from sphereorient.cameras import load_cameras
from sphereorient.cli import app
from sphereorient.errors import CameraError, ExperimentError
from sphereorient.experiment.recording import open_recording
from sphereorient.locate import LocateSettings, known_diameter_px
from sphereorient.locate.scene import still_ball
from sphereorient.movies import open_movie
from sphereorient.preflight.first_look import look_at
from sphereorient.trajectory import Trajectory

WITHIN_DEG, SIGMAS = 0.3, 4.5


def run(*arguments: object) -> str:
    done = CliRunner().invoke(app, [str(word) for word in arguments])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.output


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a rendered photograph, its map and its truth."""
    folder = tmp_path_factory.mktemp("still")
    write_stills(folder, Stills(count=1, seed=5))
    return folder


def photograph(folder: Path) -> Path:
    return folder / "photographs" / "000.png"


@pytest.mark.slow
def test_a_photograph_is_tracked_from_init_on(still, tmp_path):
    out = tmp_path / "experiment.yaml"
    shutil.copy(still / "cameras.yaml", tmp_path)  # calibrated: `init` leaves it as it is
    given = ["--sphere-map", still / "texture.png", "--set", "sphere.diameter=18"]
    assert "one picture" in run("init", photograph(still), "--out", out, *given)
    assert (tmp_path / "cameras.yaml").read_bytes() == (still / "cameras.yaml").read_bytes()
    run("track", out, "--out", tmp_path / "t.h5", "-q")
    track = Trajectory.load(tmp_path / "t.h5")
    with h5py.File(still / "truth.h5") as file:
        truth = torch.from_numpy(file["orientation"][:1])
    delta = so3.log(torch.from_numpy(track.orientation).double() @ truth.mT)[0].numpy()
    assert np.degrees(np.linalg.norm(delta)) < WITHIN_DEG
    assert delta @ np.linalg.solve(track.orientation_cov[0], delta) < SIGMAS**2


@pytest.mark.parametrize(
    ("suffix", "count", "given", "expected"),
    [
        (".png", 1, "", "srgb"),
        (".jpg", 1, "", "srgb"),
        (".png", 1, "response: linear\n", "linear"),
        (".tif", 1, "", "None"),
        (".png", 2, "", "None"),
    ],
)
def test_one_picture_of_an_ordinary_camera_is_taken_for_gamma_coded(still, tmp_path, suffix, count, given, expected):
    grey = cv2.imread(str(photograph(still)), cv2.IMREAD_GRAYSCALE)
    (tmp_path / "movie").mkdir()
    for k in range(count):
        cv2.imwrite(str(tmp_path / "movie" / f"{k}{suffix}"), grey)
    for name in ("cameras.yaml", "texture.png"):
        shutil.copy(still / name, tmp_path)
    keys = "cameras: cameras.yaml\nmovies: {cam1: movie}\nframe_rate: 1.0\n"
    keys += "sphere: {diameter: 18.0, texture: texture.png}\n"
    (tmp_path / "experiment.yaml").write_text(f"schema: sphereorient-experiment/1\n{keys}{given}")
    with open_recording(tmp_path / "experiment.yaml") as recording:
        assert str(recording.streams[0].response) == expected
        assert any("gamma-coded; write" in remark for remark in recording.remarks) == (expected == "srgb")


@pytest.mark.parametrize("share", [0.4, 0.7, 0.9])
def test_a_ball_that_fills_most_of_the_picture_is_found(still, share):
    grey = cv2.imread(str(photograph(still)), cv2.IMREAD_GRAYSCALE)
    side = round(200 / share)
    begin = (grey.shape[0] - side) // 2
    wide = np.pad(grey, max(0, -begin), mode="edge") if begin < 0 else grey[begin : begin + side, begin : begin + side]
    outline, background = still_ball(wide[None], LocateSettings())
    assert 2 * outline.radius_px == pytest.approx(200, rel=0.03)
    middle = (np.array(wide.shape) - 1) / 2
    assert np.hypot(outline.u_px - middle[1], outline.v_px - middle[0]) < 2
    inside = background.mean[round(outline.v_px), round(outline.u_px)]
    assert abs(float(inside) - float(np.median(grey[:5]))) < 3  # of the surroundings, not of the ball


@pytest.mark.parametrize("fixed", [True, False], ids=["movie of a fixed ball", "one picture"])
@pytest.mark.parametrize("empty", [True, False], ids=["empty scene", "guessed background"])
@pytest.mark.parametrize("placed", [True, False], ids=["placed", "camera at the lab's origin"])
def test_the_cameras_give_the_size_if_they_are_placed_and_one_picture_has_its_empty_scene(
    still, tmp_path, fixed, empty, placed
):
    shutil.copytree(still, tmp_path / "one")
    path, picture = tmp_path / "one" / "experiment.yaml", photograph(tmp_path / "one")
    document = yaml.safe_load(path.read_text("utf-8"))
    if fixed:
        shutil.copy(picture, picture.with_stem("001"))
        document["sphere"]["fixed"] = True
    if empty:
        cv2.imwrite(str(path.with_name("empty.png")), np.full_like(cv2.imread(str(picture), 0), 40))
        document["backgrounds"] = {"cam1": "empty.png"}
    if not placed:
        known = yaml.safe_load((cameras := path.with_name("cameras.yaml")).read_text("utf-8"))
        known["cameras"]["cam1"]["T"] = [0.0, 0.0, 0.0]
        cameras.write_text(yaml.safe_dump(known), "utf-8")
    path.write_text(yaml.safe_dump(document), "utf-8")
    with open_recording(path, textured=False) as recording:
        size_px = known_diameter_px(recording, recording.streams[0], LocateSettings())
    expected = pytest.approx(Stills(count=1, seed=5).diameter_px, rel=0.01)
    assert size_px == (expected if placed and (empty or fixed) else None)


def test_a_photograph_without_a_ball_is_one_line():
    noise = np.random.default_rng(0).integers(20, 24, (1, 200, 200)).astype(np.uint8)
    with pytest.raises(ExperimentError, match="a photograph of a ball"):
        still_ball(noise, LocateSettings())


def test_a_single_telecentric_camera_is_refused(still, tmp_path):
    out = tmp_path / "experiment.yaml"
    run("init", photograph(still), "--out", out, "--sphere-map", still / "texture.png", "--vfov", 5, "-q")
    text = (tmp_path / "cameras.yaml").read_text()
    (tmp_path / "cameras.yaml").write_text(
        text.replace("pinhole", "telecentric").replace("vfov_deg: 5.0", "scale: 0.1")
    )
    with pytest.raises(CameraError, match="telecentric"):
        run("track", out, "--out", tmp_path / "t.h5", "-q")


def test_a_missing_field_of_view_is_refused_and_not_assumed(still, tmp_path):
    out, cameras = tmp_path / "experiment.yaml", tmp_path / "cameras.yaml"
    printed = run("init", photograph(still), "--out", out, "--sphere-map", still / "texture.png")
    assert "write in cameras.yaml: cameras.cam1.vfov_deg" in printed
    assert "degrees" in printed
    with pytest.raises(CameraError, match="vfov_deg"):
        load_cameras(cameras)
    run("init", photograph(still), "--out", out, "--vfov", 12, "-q")  # its own draft is written anew
    assert float(load_cameras(cameras)["cam1"].f_px) == pytest.approx(140 / math.tan(math.radians(6)))
    cameras.write_text(cameras.read_text().replace("12.0", "13.0"))
    run("init", photograph(still), "--out", out, "--vfov", 14, "-q")
    assert "13.0" in cameras.read_text()  # but not one that a user wrote in


@pytest.mark.parametrize(("tagged", "known"), [((300, 200), True), ((3000, 2000), False), (None, False)])
def test_the_focal_length_of_exif_gives_the_field_of_view(tmp_path, tagged, known):
    picture, exif = Image.new("L", (300, 200), 20), Image.Exif()
    tags = exif.get_ifd(0x8769)
    tags[0xA405] = 50  # as on film of 36 x 24 mm: the same diagonal and here the same shape
    if tagged is not None:
        tags[0xA002], tags[0xA003] = tagged
    picture.save(tmp_path / "a.jpg", exif=exif)
    (look,) = look_at([tmp_path / "a.jpg"])
    assert look.vfov_deg == (pytest.approx(2 * math.degrees(math.atan(12 / 50)), rel=1e-3) if known else None)


@pytest.mark.parametrize("ending", ["jpg", "png", "tif", "bmp"])
def test_one_picture_is_a_movie_of_one_frame(still, tmp_path, ending):
    grey = cv2.imread(str(photograph(still)), cv2.IMREAD_GRAYSCALE)
    for name in ("a_1", "a_2"):  # of two beside each other only the named one
        cv2.imwrite(str(tmp_path / f"{name}.{ending}"), grey)
    movie = open_movie(tmp_path / f"a_1.{ending}")
    assert len(movie) == 1
    assert np.abs(next(iter(movie.frames())).astype(int) - grey).max() <= (30 if ending == "jpg" else 0)
