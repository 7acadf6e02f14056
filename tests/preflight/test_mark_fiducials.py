"""`sphereorient mark calibration.yaml`: clicked fiducials tie a picture and are saved, in a browser as well."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from mark_examples import ask, opened, place, served
from plate_drawing import PLATE, SIZE, Scene
from typer.testing import CliRunner

from sphereorient.calibration.document import load_calibration
from sphereorient.calibration.plates import see_pictures
from sphereorient.cli import app
from sphereorient.errors import CameraError
from sphereorient.preflight.mark_fiducials import FiducialMarking
from sphereorient.preflight.mark_masks import MaskMarking

pytest_plugins = ["browser_examples"]
SCENES = (Scene(tilt_deg=20, about_deg=30, spin_deg=15), Scene(tilt_deg=25, about_deg=40, spin_deg=200))
COVERED = (*PLATE.fiducials, (-3, 0), (0, -2))  # on both halves, so that the gaps do not give them away
FILE = f"""# mine
schema: sphereorient-calibration/1
image_size: [{SIZE[0]}, {SIZE[1]}]
pixel_pitch: [0.02, 0.02]   # of the sensor
plate: {{type: dots, columns: 11, rows: 9, pitch: 8.0, dot_diameter: 3.2, fiducial_diameter: 5.0,
        fiducials: [[0, 0], [3, 0], [0, 2]]}}
surveyed: {{pose: 0, R_lab_plate: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], T_lab_plate: [0, 0, 0]}}
pictures:
  - {{pose: 0, cam1: cam1_00.png}}   # good
  - pose: 1
    cam1: cam1_01.png   # dusty
# the end
"""


@pytest.fixture(scope="module")
def drawn() -> list[np.ndarray]:
    return [SCENES[0].picture(), SCENES[1].picture(without=COVERED)]


@pytest.fixture
def marking(drawn: list[np.ndarray], tmp_path: Path) -> FiducialMarking:
    for k, picture in enumerate(drawn):
        cv2.imwrite(str(tmp_path / f"cam1_{k:02}.png"), picture)
    (tmp_path / "calibration.yaml").write_text(FILE)
    return FiducialMarking(tmp_path / "calibration.yaml")


@pytest.fixture
def address(marking: FiducialMarking) -> Iterator[str]:
    with served(marking) as found:
        yield f"{found}/{marking.token}"


def clicks(*index: tuple[int, int]) -> list[list[float]]:
    return (SCENES[1].centres_px(np.array(index)) + np.array([2.0, -2.0])).round(1).tolist()


def test_the_state_of_a_picture_and_why(address):
    state = json.loads(ask(f"{address}/state")[1])
    assert [one["name"] for one in state["pictures"]] == ["cam1_00.png", "cam1_01.png"]
    assert state["fiducials"] == {"origin": [0, 0], "+x": [3, 0], "+y": [0, 2]}
    good, covered = (json.loads(ask(f"{address}/view/{k}")[1]) for k in (0, 1))
    assert good["tied"]
    assert len(good["points"]) == len(good["dots"]) == 99
    np.testing.assert_allclose(good["fiducials"], SCENES[0].centres_px(np.array(PLATE.fiducials)), atol=0.5)
    assert not covered["tied"]
    assert "click them with `sphereorient mark calibration.yaml`" in covered["reason"]
    assert covered["fiducials"] == [None] * 3
    picture = cv2.imdecode(np.frombuffer(ask(f"{address}/picture/1")[1], np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture.shape == SIZE[::-1]


def test_clicked_fiducials_are_tried_then_saved_and_the_rest_of_the_file_stays(marking, address):
    points = clicks(*PLATE.fiducials)
    answer = json.loads(ask(f"{address}/try/1", {"points": points})[1])
    assert (answer["tied"], len(answer["points"])) == (True, 94)
    assert marking.path.read_text() == FILE
    assert ask(f"{address}/save/1", {"points": points})[0] == 200
    line = f"    clicked: {{cam1: {points}}}\n"
    assert marking.path.read_text() == FILE.replace("# dusty\n", f"# dusty\n{line}")
    assert ask(f"{address}/save/0", {"points": answer["points"][:2]})[0] == 400
    # What calibrate reads then is tied, and every dot is where it was drawn.
    views = see_pictures(load_calibration(marking.path), lambda stage, done, total: None)
    view = next(view for picture, view in views.items() if picture.row == 1)
    assert view.state == "tied"
    assert np.abs(view.uv_px - SCENES[1].centres_px(view.index)).max() < 0.5
    again = FiducialMarking(marking.path)
    assert again.view(again.document.pictures[1], None)["tied"] is False  # only by the points of the file
    assert json.loads(ask(f"{address}/view/1")[1])["clicked"] == points


def test_a_saved_picture_can_be_clicked_again(marking):
    marking.save(marking.document.pictures[1], clicks(*PLATE.fiducials))
    marking.save(marking.document.pictures[1], clicks((0, 0), (3, 0)))
    entry = yaml.safe_load(marking.path.read_text())["pictures"][1]
    assert entry["clicked"] == {"cam1": clicks((0, 0), (3, 0))}


@pytest.mark.parametrize(
    ("path", "content", "words"),
    [
        ("save/1", {"points": clicks((0, 0), (2, 0), (0, 2))}, "columns and rows up to a rotation"),
        ("save/1", {"points": clicks((0, 0), (3, 0), (0, -2))}, "mirror image"),
        ("save/1", {"points": [[-9.0, 5.0], [1.0, 2.0]]}, "origin: expected a point inside 480 x 400 px"),
        ("save/1", {"points": [["a", 5.0], [1.0, 2.0]]}, "two or three pairs"),
        ("save/1", {"points": [[float("nan"), 5.0], [1.0, 2.0]]}, "a point inside"),
        ("save/1", [1], "two or three pairs"),
        ("try/1", {"points": [[1.0, 2.0]]}, "two or three pairs"),
        ("save/7", {"points": clicks(*PLATE.fiducials)}, "0 .. 1"),
        ("view/7", None, "0 .. 1"),
    ],
)
def test_a_wrong_request_is_reported_and_changes_nothing(marking, address, path, content, words):
    status, answer = ask(f"{address}/{path}", content)
    assert status == 400
    assert words in json.loads(answer)["error"]
    assert marking.path.read_text() == FILE


def test_a_file_that_cannot_be_changed_safely_stays_and_what_to_write_is_reported(marking):
    changed = FILE.replace("# dusty\n", "\n    clicked:\n      # by hand\n      cam1: [[1, 2], [3, 4]]\n")
    marking.path.write_text(changed)
    points = clicks(*PLATE.fiducials)
    with pytest.raises(CameraError, match=r"write clicked: \{cam1: \[\[.*\]\]\} into the entry of pose 1"):
        marking.save(marking.document.pictures[1], points)
    marking.path.write_text(FILE.replace("pose: 1", "pose: 2"))  # since the page was opened
    with pytest.raises(CameraError, match="one entry with pose 1"):
        marking.save(marking.document.pictures[1], points)


def test_another_kind_of_plate_needs_no_clicks(marking):
    path = marking.path
    plate = FILE[FILE.index("plate:") : FILE.index("surveyed")]
    path.write_text(FILE.replace(plate, "plate: {type: chessboard, columns: 9, rows: 6, pitch: 8.0}\n"))
    with pytest.raises(CameraError, match="a plate with fiducials"):
        FiducialMarking(path)


@pytest.mark.slow  # a browser
def test_a_person_clicks_the_fiducials(marking, address, browser: Any, tmp_path: Path):
    with opened(browser, f"{address}/") as page:
        page.get_by_text("99 of 99 dots are identified").wait_for()
        page.screenshot(path=str(tmp_path / "found.png"))
        page.get_by_role("button", name="cam1_01.png not found").wait_for()
        page.get_by_role("button", name="next not found").click()
        page.get_by_text("click them with").wait_for()
        page.screenshot(path=str(tmp_path / "refused.png"))
        page.wait_for_function("picture !== null")
        assert page.get_by_role("button", name="save").is_disabled()
        origin, on_x, on_y = clicks(*PLATE.fiducials)
        page.get_by_text("Click 1 of 3: the origin").wait_for()
        page.mouse.click(*place(page, *origin))
        page.get_by_text("Click 2 of 3: the dot on +x, 3 dots from the origin").wait_for()
        page.mouse.click(*place(page, *clicks((2, 0))[0]))
        page.get_by_text("columns and rows up to a rotation").wait_for()
        page.get_by_role("button", name="undo").click()
        page.mouse.move(*place(page, *on_x))
        page.mouse.wheel(0, -100)
        page.mouse.click(*place(page, *on_x))
        page.wait_for_function("zoom > 1.1 * Math.min(canvas.width / 480, canvas.height / 400)")
        page.get_by_text("94 of 94 dots are identified").wait_for()
        page.mouse.click(*place(page, *on_y))
        page.get_by_text("Save, or undo a click").wait_for()
        page.wait_for_function("tried !== null")
        page.screenshot(path=str(tmp_path / "clicked.png"))
        page.get_by_role("button", name="save").click()
        page.get_by_text("Saved in").wait_for()
        page.get_by_role("button", name="cam1_01.png clicked").wait_for()
    saved = yaml.safe_load(marking.path.read_text())["pictures"][1]["clicked"]["cam1"]
    assert (
        np.abs(np.array(saved) - clicks(*PLATE.fiducials)).max() < 1
    )  # the mouse stands on whole pixels of the screen


@pytest.mark.parametrize(("name", "kind"), [("calibration.yaml", FiducialMarking), ("experiment.yaml", MaskMarking)])
def test_the_command_distinguishes_the_files(marking, name, kind, monkeypatch):
    seen = []

    def begin(self, path: Path) -> None:
        seen.append(path)
        self.token = "known"

    monkeypatch.setattr(kind, "__init__", begin)
    monkeypatch.setattr("socket.create_server", lambda *_, **__: (_ for _ in ()).throw(OSError("in use")))
    path = marking.path.with_name(name)
    if kind is MaskMarking:
        path.write_text("schema: sphereorient-experiment/1\n")
    answer = CliRunner().invoke(app, ["mark", str(path), "--no-browser"])
    assert seen == [path]
    assert "expected a free port" in str(answer.exception)
