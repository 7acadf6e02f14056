"""experiment.yaml: its meaning, its refusals, and how movies, cameras and times come together."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED
from experiment_examples import FULL, HEIGHT, SHORT, WIDTH, make_folder, save_movie, written
from experiment_file import write_experiment
from PIL import Image

from sphereorient.cameras.response import Response
from sphereorient.errors import CameraError, ExperimentError, MovieError, OutputError
from sphereorient.experiment import (
    Experiment,
    Sphere,
    input_files,
    load_experiment,
    open_movies,
    recording,
)
from sphereorient.experiment.experiment import outside_paths
from sphereorient.sphere import load_texture


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make_folder(tmp_path)


def test_every_key_arrives_with_its_unit_and_paths_are_relative_to_the_file(folder):
    experiment = load_experiment(written(folder, FULL))
    assert experiment.name == "mixer-3Hz"
    assert experiment.path == folder / "experiment.yaml"
    assert experiment.folder == folder
    assert experiment.frame_rate_hz == 600.0
    assert experiment.exposure_s == 0.0004
    assert experiment.diameter_mm == 18.0
    assert experiment.texture_path == folder / "texture.png"
    assert experiment.fixed is False
    assert experiment.cameras_path == folder / "cameras.yaml"
    assert list(experiment.cameras) == ["cam1", "cam2"]
    assert experiment.movie_paths == {"cam1": folder / "cam1.npy", "cam2": folder / "films" / "cam2.npy"}
    assert experiment.mask_paths == {"cam1": folder / "mask.png"}
    assert experiment.start == {"cam1": 0, "cam2": 3}
    assert experiment.frames == (2, 10)
    assert experiment.flow == {"viscosity": 8e-6, "dissipation": 1.7}


def test_omitted_keys_have_their_defaults(folder):
    experiment = load_experiment(str(written(folder, SHORT)))
    assert experiment.name == "experiment"
    assert experiment.diameter_mm is None
    assert experiment.texture_path is None
    assert experiment.exposure_s is None
    assert experiment.frames is None
    assert experiment.fixed is True
    assert experiment.start == {"cam1": 0}
    assert experiment.mask_paths == experiment.flow == {}
    assert list(experiment.cameras) == ["cam1"]  # cameras.yaml has one more, which no movie needs


@pytest.mark.parametrize("text", [FULL, SHORT], ids=["full", "short"])
def test_a_written_experiment_is_read_back_the_same(folder, text):
    experiment = load_experiment(written(folder, text))
    path = write_experiment(dataclasses.replace(experiment, path=folder / "again.yaml"))
    again = load_experiment(path)
    for part in dataclasses.fields(Experiment):
        if part.name not in ("path", "cameras"):
            assert getattr(again, part.name) == getattr(experiment, part.name), part.name
    assert path.read_text().startswith("# made by sphereorient\nschema: sphereorient-experiment/1\n")
    assert str(folder) not in path.read_text()


def test_an_experiment_in_another_folder_finds_its_files(folder, tmp_path_factory):
    experiment = load_experiment(written(folder, SHORT))
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    again = load_experiment(write_experiment(dataclasses.replace(experiment, path=elsewhere / "experiment.yaml")))
    with open_movies(again)["cam1"] as movie:
        assert len(movie) == 12


def test_a_folder_that_cannot_be_made_cannot_be_written_to(folder):
    experiment = load_experiment(written(folder, SHORT))
    with pytest.raises(OutputError, match="Not a directory"):
        write_experiment(dataclasses.replace(experiment, path=experiment.path / "experiment.yaml"))


def balls(keys: str) -> str:
    return SHORT.replace("sphere: {diameter: null, fixed: true}", keys)


FAULTS = {
    "unknown key": (FULL.replace("exposure", "exposre"), "write 'exposure'"),
    "unknown key inside": (FULL.replace("diameter", "diametre"), "sphere: .*write 'diameter'"),
    "no sphere": (balls(""), "sphere: expected a value"),
    "no diameter": (SHORT.replace("diameter: null, ", ""), r"sphere\.diameter: expected a value, got none"),
    "frame rate of zero": (SHORT.replace("30", "0"), "frame_rate: expected greater than 0"),
    "negative diameter": (FULL.replace("18.0", "-18.0"), r"sphere\.diameter: expected greater than 0"),
    "exposure in ms": (FULL.replace("0.0004", "0.4"), "exposure: .* 0.001667 s"),
    "frames backwards": (FULL.replace("[2, 10]", "[10, 2]"), "frames: .* got .10, 2."),
    "start below zero": (FULL.replace("cam2: 3", "cam2: -3"), r"start\.cam2"),
    "start of no movie": (FULL.replace("start: {cam2", "start: {cam3"), "start: .*got 'cam3'; write 'cam"),
    "mask of no movie": (FULL.replace("masks: {cam1", "masks: {side"), "masks: .* got 'side'"),
    "movie without camera": (SHORT.replace("{cam1:", "{cam9:"), "camera of movie cam9"),
    "both keys": (SHORT + "spheres: {a: {diameter: 14}}\n", "spheres, got both"),
    "no ball": (balls("spheres: {}"), "spheres: .*at least 1"),
    "unknown key of a ball": (balls("spheres: {a: {diametre: 14}}"), "spheres, a: .*write 'diameter'"),
    "a name that is a path": (balls("spheres: {a/b: {diameter: 14}}"), "names without"),
    "several balls, one of unknown diameter": (
        balls("spheres: {a: {diameter: 14}, b: {diameter: null}}"),
        r"spheres\.b\.diameter: .* got none",
    ),
    "nine cameras": (
        SHORT.replace("{cam1: cam1.npy}", f"{{{', '.join(f'c{k}: c{k}.mkv' for k in range(9))}}}"),
        "movies: .*at most 8",
    ),
    "no movies": (SHORT.replace("{cam1: cam1.npy}", "{}"), "movies: .*at least 1"),
    "movies as a list": (SHORT.replace("{cam1: cam1.npy}", "[cam1.npy]"), "movies: .* dictionary"),
    "fixed as a word": (SHORT.replace("true", "maybe"), r"sphere\.fixed: .* got 'maybe'"),
    "times beside a rate": (SHORT + "times: times.csv\n", "times, got both"),
    "neither": (SHORT.replace("frame_rate: 30", "name: none"), "times, got neither"),
    "a flip that there is not": (SHORT + "flip: {cam1: upside}\n", "flip.cam1"),
    "a response that falls": (SHORT + "response: [[0, 0], [90, 120], [255, 100]]\n", "response"),
    "a response of one row": (SHORT + "response: [[0, 0]]\n", "response"),
    "a response that is no curve": (SHORT + "response: {gamma: bright}\n", "response"),
    "a response of no camera": (SHORT + "response: {cam7: srgb}\n", "got 'cam7'"),
    "a setting of a camera that there is not": (SHORT + "camera: {cam1: {triger: Line1}}\n", "'trigger'"),
    "a pixel format of colour": (SHORT + "camera: {cam1: {pixel_format: BayerRG8}}\n", "pixel_format: expected"),
    "a line that YAML reads as no": (SHORT + "camera: {cam1: {trigger: off}}\n", "cam1.trigger: expected"),
    "an exposure longer than the interval": (
        SHORT + "camera: {cam1: {exposure_ms: 4, rate_hz: 500}}\n",
        "exposure_ms: expected at most 2 ms",
    ),
    "schema": (SHORT.replace("experiment/1", "experiment/7"), "schema: expected sphereorient-experiment/1, got"),
}


def test_settings_of_live_for_a_camera_are_read(folder):
    given = "{cam1: {trigger: Line1, exposure_ms: 0.4, rate_hz: 600, pixel_format: Mono12, offset: [8, 4]}}"
    (name, keys), *others = load_experiment(written(folder, SHORT + f"camera: {given}\n")).devices.items()
    assert not others
    assert (name, keys.trigger, keys.exposure_ms, keys.rate_hz) == ("cam1", "Line1", 0.4, 600.0)
    assert (keys.pixel_format, keys.offset) == ("Mono12", (8, 4))
    free = load_experiment(written(folder, SHORT + "camera: {cam1: {trigger: none}}\n")).devices["cam1"]
    assert (free.trigger, free.exposure_ms) == ("none", None)


@pytest.mark.parametrize(("text", "message"), FAULTS.values(), ids=FAULTS)
def test_every_fault_is_one_line_that_names_the_file(folder, text, message):
    path = written(folder, text)
    with pytest.raises(ExperimentError, match=message) as refused:
        load_experiment(path)
    assert str(folder) in str(refused.value)
    assert "\n" not in str(refused.value)
    assert "pydantic" not in str(refused.value)


def test_missing_cameras_are_a_camera_error(folder):
    with pytest.raises(CameraError, match=r"other\.yaml"):
        load_experiment(written(folder, SHORT.replace("cameras.yaml", "other.yaml")))


def test_a_movie_of_another_size_than_its_camera_is_refused(folder):
    save_movie(folder / "cam1.npy", 12, (WIDTH, HEIGHT))  # rows and columns exchanged
    with pytest.raises(MovieError, match=f"cam1 .* got {HEIGHT} x {WIDTH}"):
        open_movies(load_experiment(written(folder, SHORT)))


def test_a_camera_that_the_experiment_does_not_have_is_refused(folder):
    with pytest.raises(ExperimentError, match="got 'cam7'"):
        open_movies(load_experiment(written(folder, SHORT)), ["cam7"])


@pytest.mark.shared
@pytest.mark.parametrize(("name", "count"), [("experiment", 240), ("fixed_ball", 250)])
def test_the_shared_experiments_open(name, count):
    experiment = load_experiment(SHARED / name / "experiment.yaml")
    movies = open_movies(experiment)
    assert {len(movie) for movie in movies.values()} == {count}
    assert experiment.fixed == (name == "fixed_ball")


def test_files_outside_of_the_experiments_folder_are_reported(folder, tmp_path_factory):
    assert outside_paths(load_experiment(written(folder, FULL))) == []
    other = tmp_path_factory.mktemp("other") / "texture.png"
    (folder / "link.png").symlink_to(other)
    for name in ("../texture.png", str(other), "link.png"):
        experiment = load_experiment(written(folder, FULL.replace("texture.png", name)))
        assert [path.name for path in outside_paths(experiment)] == [Path(name).name]


def test_a_flipped_movie_is_read_flipped(folder):
    picture = np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(1, HEIGHT, WIDTH)
    np.save(folder / "cam1.npy", picture)
    flips = {"none": picture, "vertical": picture[:, ::-1], "horizontal": picture[:, :, ::-1]}
    for how, expected in (flips | {"both": picture[:, ::-1, ::-1]}).items():
        movies = open_movies(load_experiment(written(folder, SHORT + f"flip: {{cam1: {how}}}\n")))
        np.testing.assert_array_equal(movies["cam1"].sample([0]), expected)


@pytest.mark.parametrize(
    ("written_as", "expected"),
    [
        ("linear", Response()),
        ("srgb", Response(srgb=True)),
        ("{gamma: 2.2}", Response(gamma=2.2)),
        ("[[0, 0], [50, 10], [100, 40]]", Response(table=((0.0, 0.0), (0.5, 0.25), (1.0, 1.0)))),
    ],
)
def test_a_response_is_of_all_cameras_or_of_one(folder, written_as, expected):
    keys = FULL + f"response: {written_as}\n", FULL + f"response: {{cam2: {written_as}}}\n", FULL
    every, second, none = (load_experiment(written(folder, text)).response for text in keys)
    assert every == {"cam1": expected, "cam2": expected}
    assert second == {"cam2": expected}
    assert none == {}


# several balls

BALLS = FULL.replace(
    "sphere: {diameter: 18.0, texture: texture.png}",
    "spheres: {b: {diameter: 18.0, texture: texture.png}, a: {diameter: 14, texture: other.png, fixed: true}}",
)


def test_spheres_are_read_in_their_order_and_written_back_the_same(folder):
    experiment = load_experiment(written(folder, BALLS))
    assert experiment.spheres == (
        Sphere(name="b", diameter_mm=18.0, texture_path=folder / "texture.png"),
        Sphere(name="a", diameter_mm=14.0, texture_path=folder / "other.png", fixed=True),
    )
    again = load_experiment(write_experiment(dataclasses.replace(experiment, path=folder / "again.yaml")))
    assert again.spheres == experiment.spheres
    assert {folder / "texture.png", folder / "other.png"} <= input_files(experiment).keys()


def test_the_experiment_of_one_ball_is_that_of_a_file_with_only_this_ball(folder):
    of_b = load_experiment(written(folder, BALLS)).of("b")
    alone = load_experiment(written(folder, FULL))
    assert of_b.spheres == of_b.of("b").spheres == of_b.of("").spheres == (dataclasses.replace(alone.sphere, name="b"),)
    assert (of_b.diameter_mm, of_b.texture_path, of_b.radius_mm) == (18.0, folder / "texture.png", 9.0)
    assert alone.spheres == alone.of("").spheres
    with pytest.raises(ExperimentError, match="without name"):
        alone.of("b")


def test_keys_for_one_ball_are_refused_for_several(folder):
    experiment = load_experiment(written(folder, BALLS))
    for name in ("sphere", "diameter_mm", "texture_path", "fixed", "radius_mm"):
        with pytest.raises(ExperimentError, match="expected one ball"):
            getattr(experiment, name)
    with pytest.raises(ExperimentError, match="got 'c'"):
        experiment.of("c")
    assert experiment.length_unit == "mm"


def test_textures_of_several_balls_are_read_once_a_file(folder, monkeypatch):
    read = []
    for name in ("texture.png", "other.png"):
        Image.fromarray(np.arange(128, dtype=np.uint8).reshape(8, 16)).save(folder / name)
    monkeypatch.setattr(recording, "load_texture", lambda path: read.append(path) or load_texture(path))
    text = BALLS.replace("{b:", "{c: {diameter: 18.0, texture: texture.png}, b:").replace(
        "masks: {cam1: mask.png}\n", ""
    )
    with recording.open_recording(load_experiment(written(folder, text))) as opened:
        assert sorted(path.name for path in read) == ["other.png", "texture.png"]
        assert opened.maps["c"] is opened.maps["b"]
        assert opened.of("a").texture is opened.maps["a"].grey
        assert opened.of("a").streams is opened.streams
        assert opened.of("a").experiment.diameter_mm == 14
        with pytest.raises(ExperimentError, match="expected one ball"):
            _ = opened.texture
    with (
        pytest.raises(ExperimentError, match=r".*spheres\.a\.texture"),
        recording.open_recording(load_experiment(written(folder, text.replace(", texture: other.png", "")))),
    ):
        pass
