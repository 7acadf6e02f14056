"""`sphereorient mark`: drawn shapes become the mask, also in a browser; requests need the token."""

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from mark_examples import ask, opened, place, served
from preflight_examples import PAINTED, Example, clean_example, write  # noqa: F401

from sphereorient.errors import ExperimentError
from sphereorient.experiment import load_experiment
from sphereorient.experiment.recording import given_mask
from sphereorient.preflight.mark_masks import MaskMarking, drawn_mask

pytest_plugins = ["browser_examples"]
TRIANGLE = {"kind": "hide", "points": [[10, 10], [60, 10], [10, 60]]}
DISK = {"kind": "show", "u": 100.0, "v": 70.0, "radius": 40.0}


@pytest.fixture
def marking(clean: Example, tmp_path: Path) -> MaskMarking:
    return MaskMarking(write(clean, tmp_path / "experiment", sphere=PAINTED))


@pytest.fixture
def address(marking: MaskMarking) -> Iterator[str]:
    with served(marking) as found:
        yield found


def test_a_shape_hides_or_is_all_that_is_shown():
    hidden = drawn_mask((120, 160), [TRIANGLE], None)
    assert not hidden[20, 20]
    assert hidden[50, 50]
    region = drawn_mask((120, 160), [DISK, TRIANGLE], None)
    assert region[70, 100]
    assert region.mean() == pytest.approx(np.pi * 40**2 / (120 * 160), rel=0.03)
    old = np.ones((120, 160), bool)
    old[70, 100] = False
    assert not drawn_mask((120, 160), [DISK], old)[70, 100]


@pytest.mark.parametrize(
    "shape",
    [
        {"kind": "paint", "points": TRIANGLE["points"]},
        {"kind": "hide", "points": [[1, 2], [3, 4]]},
        {"kind": "hide", "points": [[1, 2], [3, float("nan")], [4, 5]]},
        {"kind": "hide", "points": [[1, 2], [3, 1e9], [4, 5]]},
        {"kind": "hide", "u": 1.0, "v": "x", "radius": 3.0},
        {"kind": "hide", "u": 1.0, "v": 3.0},
        {"kind": "hide", "u": 80.0, "v": 60.0, "radius": 500.0},
        "circle",
    ],
)
def test_impossible_shapes_are_refused(shape):
    with pytest.raises(ExperimentError):
        drawn_mask((120, 160), [shape], None)


def test_the_mask_is_saved_and_named(marking):
    marking.save("cam1", [TRIANGLE], keep=True)
    experiment = load_experiment(marking.path)
    assert list(experiment.mask_paths) == ["cam1"]
    shown = given_mask(experiment, "cam1", (240, 240))
    np.testing.assert_array_equal(shown, drawn_mask((240, 240), [TRIANGLE], None))
    marking.save("cam2", [DISK], keep=True)
    marking.save("cam1", [{"kind": "hide", "u": 200.0, "v": 200.0, "radius": 9.0}], keep=True)
    experiment = load_experiment(marking.path)
    assert list(experiment.mask_paths) == ["cam1", "cam2"]
    again = given_mask(experiment, "cam1", (240, 240))
    assert not again[20, 20]  # kept
    assert not again[200, 200]


@pytest.mark.parametrize("how", ["vertical", "transpose"])
def test_a_mirrored_movie_keeps_its_mask_where_it_was_drawn(clean, tmp_path, how):
    marking = MaskMarking(write(clean, tmp_path / "experiment", flip={"cam1": how}))
    marking.save("cam1", [TRIANGLE], keep=True)
    experiment = load_experiment(marking.path)
    file = cv2.imread(str(experiment.mask_paths["cam1"]), cv2.IMREAD_GRAYSCALE)
    drawn = drawn_mask((240, 240), [TRIANGLE], None)
    assert np.array_equal(file > 127, drawn[::-1] if how == "vertical" else drawn.T)  # as in the file
    assert np.array_equal(given_mask(experiment, "cam1", (240, 240)), drawn)


def test_comments_and_other_keys_of_the_file_stay(marking):
    text = "# mine\n" + marking.path.read_text() + "# masks: {cam1: mask_cam1.png}  # an example\n# the end\n"
    marking.path.write_text(text)
    before = yaml.safe_load(text)
    marking.save("cam1", [TRIANGLE], keep=True)
    after = marking.path.read_text()
    assert after.startswith("# mine\n")
    assert after.endswith("# the end\n")
    assert yaml.safe_load(after) == before | {"masks": {"cam1": "cam1_mask.png"}}


def test_a_key_of_several_lines_is_left_alone(marking):
    text = marking.path.read_text() + "masks:\n  cam2: other.png\n"
    cv2.imwrite(str(marking.path.parent / "other.png"), np.full((240, 240), 255, np.uint8))
    marking.path.write_text(text)
    with pytest.raises(ExperimentError, match=r"write masks: \{cam1: cam1_mask.png\} there"):
        marking.save("cam1", [TRIANGLE], keep=True)
    assert marking.path.read_text() == text


def test_the_server_answers_requests_with_the_token(marking, address):
    mine = f"{address}/{marking.token}"
    assert ask(f"{mine}/")[0] == 200
    assert json.loads(ask(f"{mine}/state")[1])["cameras"][0]["frames"] == 64
    picture = cv2.imdecode(np.frombuffer(ask(f"{mine}/frame/cam1/5")[1], np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (240, 240)
    status, content = ask(f"{mine}/save/cam1", {"shapes": [TRIANGLE], "keep": True})
    assert (status, json.loads(content)["hidden"]) == (200, pytest.approx(100 * 1250 / 240**2, rel=0.1))


def test_the_map_is_laid_on_the_ball_as_it_lies_there(marking):
    """The re-rendered ball looks like the picture, at its position."""
    answer = marking.rendered("cam1")
    assert answer["explained"] > 60
    content = np.frombuffer(base64.b64decode(answer["picture"].partition(",")[2]), np.uint8)
    picture = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    shown = marking.movies["cam1"].sample([answer["frame"]])[0].astype(float)
    assert picture.shape == (*shown.shape, 4)
    inside = picture[..., 3] > 0
    assert abs(inside.sum() / (np.pi * answer["radius"] ** 2) - 1) < 0.05
    assert np.corrcoef(picture[..., 0][inside], shown[inside])[0, 1] > 0.6


def test_without_a_map_it_prints_how_to_learn_one(marking):
    marking.experiment.texture_path.unlink()
    with pytest.raises(ExperimentError, match="learn it: `sphereorient map"):
        marking.rendered("cam1")


@pytest.mark.parametrize("path", ["/", "/state", "/wrong/state", "/{token}", "/{token}/nothing", "/{token}/../state"])
def test_requests_without_the_token_get_nothing(marking, address, path):
    assert ask(address + path.format(token=marking.token))[0] == 404


def test_a_page_of_another_host_gets_nothing(marking, address):
    assert ask(f"{address}/{marking.token}/state", Host="evil.example:80")[0] == 404


@pytest.mark.parametrize(
    ("path", "content", "words"),
    [
        ("frame/cam1/99999", None, "0 .. 63"),
        ("frame/cam9/1", None, "cam1, cam2"),
        ("save/cam1", {"shapes": [{"kind": "hide"}], "keep": True}, "circle"),
        ("save/cam1", {"keep": True}, "shapes and keep"),
        ("save/cam1", [1], "shapes and keep"),
    ],
)
def test_a_wrong_request_is_reported_and_changes_nothing(marking, address, path, content, words):
    before = sorted(marking.path.parent.iterdir())
    status, answer = ask(f"{address}/{marking.token}/{path}", content)
    assert status == 400
    assert words in json.loads(answer)["error"]
    assert sorted(marking.path.parent.iterdir()) == before


@pytest.mark.slow  # a browser
def test_a_person_draws_a_mask(marking, address, browser: Any, tmp_path: Path):
    with opened(browser, f"{address}/{marking.token}/") as page:
        page.get_by_label("frame number").fill("7")
        page.get_by_label("frame number").press("Tab")
        for corner in TRIANGLE["points"]:
            page.mouse.click(*place(page, *corner))
        page.get_by_role("button", name="close polygon").click()
        page.get_by_role("button", name="show only").click()
        page.get_by_role("button", name="circle", exact=True).click()
        page.mouse.move(*place(page, 120, 120))
        page.mouse.down()
        page.mouse.move(*place(page, 220, 120))
        page.mouse.up()
        page.get_by_text("show only circle, 200 px across").wait_for()
        page.get_by_role("button", name="find the ball").click()
        page.get_by_text("moves, found in").wait_for()
        page.get_by_role("button", name="overlay the map").click()
        page.get_by_text("The map explains").wait_for()
        page.screenshot(path=str(tmp_path / "mark.png"))
        page.get_by_role("button", name="save mask").click()
        page.get_by_text("of the picture is hidden").wait_for()
    drawn = given_mask(load_experiment(marking.path), "cam1", (240, 240))
    expected = drawn_mask((240, 240), [TRIANGLE, {"kind": "show", "u": 120, "v": 120, "radius": 100}], None)
    assert np.mean(drawn != expected) < 0.01  # the mouse stands on whole pixels of the screen
