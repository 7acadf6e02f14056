"""A clip is tracked again on the page while circle, mask, light and field of view are changed, and these are saved."""

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from mark_examples import opened, place, served
from preflight_examples import CAMERAS, clean_example, write  # noqa: F401

from sphereorient.cameras.response import Response
from sphereorient.errors import SphereOrientError
from sphereorient.experiment import load_experiment
from sphereorient.experiment.recording import given_mask
from sphereorient.preflight.clip import Clip, in_light
from sphereorient.preflight.mark_masks import MaskMarking
from sphereorient.synth import SynthSettings, write_synthetic_experiment

pytest_plugins = ["browser_examples"]
NOTHING: dict[str, Any] = {"shapes": [], "keep": True}
VFOV_DEG = 20.0
CORNER = {"kind": "hide", "points": [[0, 0], [20, 0], [0, 20]]}


@pytest.fixture(scope="module")
def turning(tmp_path_factory) -> Path:
    """A fixed ball, of one camera, with comments in its files."""
    settings = SynthSettings(
        frames=60, image_size=(150, 150), diameter_px=56.0, volume_mm=8.0, velocity_rms=0.0, exposure=1e-4,
        exposure_samples=1, omega_rms=60.0, seed=5,
    )  # fmt: skip
    path = write_synthetic_experiment(tmp_path_factory.mktemp("turns"), settings)
    content = yaml.safe_load(path.read_text())
    movie = content["movies"]["cam1"]
    path.write_text(
        f"# mine\nschema: {content['schema']}\nframe_rate: {content['frame_rate']}\n"
        f"sphere: {{diameter: null, fixed: true}}  # a ball\ncameras: one.yaml\nmovies: {{cam1: {movie}}}\n"
    )
    path.with_name("one.yaml").write_text(
        "# my camera\nschema: sphereorient-cameras/1\ncameras:\n  cam1:\n    model: pinhole\n"
        f"    image_size: [150, 150]\n    vfov_deg: {VFOV_DEG}  # measured\n"
    )
    return path


@pytest.fixture
def marking(turning: Path, tmp_path: Path) -> MaskMarking:
    for file in turning.parent.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return MaskMarking(tmp_path / turning.name)


def test_a_wrong_circle_is_seen_in_the_figures(marking):
    right = marking.done(["track", "cam1"], NOTHING)
    u, v, radius = right["circles"]["cam1"]
    assert radius == pytest.approx(28, abs=1)
    assert (right["found"], right["frames"]) == (60, 60)
    wrong = marking.done(["track", "cam1"], NOTHING | {"circle": [u + 4, v, radius]})
    assert wrong["circles"]["cam1"] == (u + 4, v, radius)
    assert wrong["score"] < right["score"] - 0.02
    assert wrong["error_deg"] > right["error_deg"]


def test_mask_light_and_field_of_view_are_those_that_are_tried(marking):
    circle = list(marking.done(["track", "cam1"], NOTHING)["circles"]["cam1"])
    right = marking.done(["track", "cam1"], NOTHING | {"circle": circle})
    disk = {"kind": "hide", "u": circle[0], "v": circle[1], "radius": 16}
    for more in ({"shapes": [disk]}, {"light": {"gamma": 0.4}}, {"vfov_deg": 70.0}):
        other = marking.done(["track", "cam1"], NOTHING | {"circle": circle} | more)
        assert abs(other["left"] - right["left"]) > 0.02 * right["left"], more
    assert not list(marking.path.parent.glob("*mask*")), "nothing is written until it is saved"


def test_tried_values_are_saved_and_all_else_stays(marking):
    asked = NOTHING | {"circle": [75.25, 74.5, 28.0], "light": {"gamma": 2.2}, "vfov_deg": 25, "shapes": [CORNER]}
    files = marking.done(["adopt", "cam1"], asked)["files"]
    saved = load_experiment(marking.path)
    assert saved.circles == {"cam1": (75.25, 74.5, 28.0)}
    assert saved.response["cam1"].gamma == 2.2
    assert float(saved.cameras["cam1"].f_px) == pytest.approx(75 / math.tan(math.radians(12.5)))
    assert saved.mask_paths["cam1"].name == "cam1_mask.png"
    assert {Path(file).name for file in files} == {"cam1_mask.png", "one.yaml", marking.path.name}
    assert marking.path.read_text().startswith("# mine\n")
    assert "# a ball" in marking.path.read_text()
    assert "vfov_deg: 25.0  # measured" in saved.cameras_path.read_text()
    tried = marking.done(["track", "cam1"], NOTHING)
    assert tried["circles"] == {"cam1": (75.25, 74.5, 28.0)}, "the saved one from now on"


def test_only_the_circle_of_this_camera_is_written(clean, tmp_path):
    """Before: all circles, as they were when the page was opened; those edited meanwhile were lost."""
    circles = {"cam1": [120.0, 120.0, 28.0], "cam2": [120.0, 120.0, 28.0]}
    path = write(clean, tmp_path, sphere={"diameter": 18.0, "fixed": True}, circles=circles)
    marking = MaskMarking(path)
    document = yaml.safe_load(path.read_text())
    lines = yaml.safe_dump({key: value for key, value in document.items() if key != "circles"})
    path.write_text(lines + "circles: {cam1: [120.0, 120.0, 28.0], cam2: [110.0, 119.0, 27.0]}\n")
    marking.done(["adopt", "cam1"], NOTHING | {"circle": [118.0, 121.0, 28.5]})
    assert load_experiment(path).circles == {"cam1": (118.0, 121.0, 28.5), "cam2": (110.0, 119.0, 27.0)}


def test_frames_without_a_picture_of_each_camera_are_left_out_of_all(clean, tmp_path):
    """Before: of this camera only, so that its later pictures were compared with those of other frames."""
    path = write(clean, tmp_path, sphere={"diameter": 18.0, "fixed": True}, movies={name: name for name in CAMERAS})
    for name in CAMERAS:
        (tmp_path / name).mkdir()
        for k in range(12):
            if (name, k) != ("cam2", 5):
                cv2.imwrite(str(tmp_path / name / f"{k:03d}.png"), np.full((240, 240), 10 * k, np.uint8))
    pictures = Clip(load_experiment(path)).pictures
    grey = {name: [int(one[0, 0]) for one in each] for name, each in pictures.items()}
    assert grey == {name: [10 * k for k in range(12) if k != 5] for name in CAMERAS}


def test_light_of_12_bits_is_that_of_8_bits():
    """Before: light relative to 65535, where a camera of 12 bits is black by any response."""
    levels = np.linspace(0, 255, 256).astype(np.uint8).reshape(16, 16)
    response = Response(srgb=True)
    (shallow,), (deep,) = (in_light([one], response) for one in (levels, levels.astype(np.uint16) * 16 + 15))
    assert np.abs(deep.astype(float) - shallow).max() < 0.01 * 65535


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"circle": [1, 2]}, "radius"),
        ({"circle": [1, 2, -3]}, "radius"),
        ({"light": "dim"}, "linear, srgb"),
        ({"vfov_deg": "wide"}, "expected numbers"),
        ({"vfov_deg": 200}, "between 0 and 180"),
        ({"shapes": [{"kind": "hide", "u": 75, "v": 75, "radius": 500}]}, "all of it hidden"),
    ],
)
def test_impossible_values_are_reported_and_change_nothing(marking, asked, words):
    before = {path.name: path.read_bytes() for path in marking.path.parent.iterdir()}
    for what in ("track", "adopt"):
        with pytest.raises(SphereOrientError, match=words):
            marking.done([what, "cam1"], NOTHING | asked)
    assert {path.name: path.read_bytes() for path in marking.path.parent.iterdir()} == before


def test_a_ball_that_moves_is_refused(marking):
    marking.path.write_text(marking.path.read_text().replace("fixed: true", "fixed: false"))
    moves = MaskMarking(marking.path)
    assert moves.state()["tries"] is False
    with pytest.raises(SphereOrientError, match="fixed ball"):
        moves.done(["track", "cam1"], NOTHING)


def test_a_given_circle_is_where_the_ball_is_sought(marking):
    marking.path.write_text(marking.path.read_text() + "circles: {cam1: [70.0, 74.0, 30.0]}\n")
    assert MaskMarking(marking.path).done(["track", "cam1"], NOTHING)["circles"] == {"cam1": (70.0, 74.0, 30.0)}
    marking.path.write_text(marking.path.read_text().replace("30.0]", "-30.0]"))
    with pytest.raises(SphereOrientError, match="greater than 0"):
        load_experiment(marking.path)


@pytest.mark.slow  # a browser
def test_a_person_tries_another_circle_and_saves_it(marking, browser):
    with served(marking) as address, opened(browser, f"{address}/{marking.token}/") as page:
        page.get_by_role("button", name="track", exact=True).click()
        page.wait_for_function("document.getElementById('figures').rows.length === 2")
        found = float(page.get_by_label("radius").input_value())
        page.get_by_label("radius").fill(f"{found - 3:.1f}")
        page.get_by_role("button", name="track", exact=True).click()
        page.wait_for_function("document.getElementById('figures').rows.length === 3")
        cells = page.evaluate("[...document.querySelectorAll('#figures td')].map(cell => cell.textContent)")
        assert np.isfinite([float(cell) for cell in cells]).all()
        assert float(cells[6]) < float(cells[1]), "the score"
        page.get_by_role("button", name="save these").click()
        page.get_by_text("Wrote").wait_for()
    assert load_experiment(marking.path).circles["cam1"][2] == pytest.approx(found - 3)


@pytest.mark.slow  # a browser
def test_a_field_of_view_that_nobody_edited_is_not_written(marking, browser):
    """Before: the two digits that the page shows replaced the calibrated value."""
    cameras = marking.path.with_name("one.yaml")
    cameras.write_text(cameras.read_text().replace(f"vfov_deg: {VFOV_DEG}", "vfov_deg: 20.012345"))
    before = cameras.read_text()
    marking = MaskMarking(marking.path)
    with served(marking) as address, opened(browser, f"{address}/{marking.token}/") as page:
        for label, value in (("u", "75"), ("v", "75"), ("radius", "28")):
            page.locator(f"#{label}").fill(value)
        page.get_by_role("button", name="save these").click()
        page.get_by_text("Wrote").wait_for()
        assert load_experiment(marking.path).circles["cam1"] == (75, 75, 28)
        assert cameras.read_text() == before
        for value in ("25", "20.01"):  # then, the digits that it showed first
            page.locator("#vfov").fill(value)
            with page.expect_response("**/adopt/*"):
                page.get_by_role("button", name="save these").click()
            page.get_by_text("one.yaml").wait_for()
            assert f"vfov_deg: {float(value)}  # measured" in cameras.read_text()


@pytest.mark.slow  # a browser
def test_the_circle_of_the_ball_and_the_holder_are_drawn_dragged_and_saved(marking, browser):
    def drag(page: Any, *path: tuple[float, float]) -> None:
        page.mouse.move(*place(page, *path[0]))
        page.mouse.down()
        for u, v in path[1:]:
            page.mouse.move(*place(page, u, v))
        page.mouse.up()

    with served(marking) as address, opened(browser, f"{address}/{marking.token}/") as page:
        page.get_by_role("button", name="outline of the ball").click()
        drag(page, (70, 80), (80, 80), (90, 80))
        page.get_by_role("button", name="circle", exact=True).click()
        drag(page, (30, 130), (40, 130))  # the holder
        page.get_by_role("button", name="move", exact=True).click()
        drag(page, (70, 80), (74, 76), (75, 75))  # by its inside
        drag(page, (75, 95), (75, 103))  # by its rim
        drag(page, (30, 130), (75, 140))
        drag(page, (85, 140), (95, 140))
        page.get_by_role("button", name="save these").click()
        page.get_by_text("Wrote").wait_for()
    saved = load_experiment(marking.path)
    assert saved.circles["cam1"] == pytest.approx((75, 75, 28), abs=0.6)
    shown = given_mask(saved, "cam1", (150, 150))
    v, u = np.nonzero(~shown)
    assert (u.mean(), u.min(), u.max(), v.min()) == pytest.approx((75, 55, 95, 120), abs=1.5)
