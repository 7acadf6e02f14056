"""The page of `live`: what it shows is what was measured; who may ask; and that it holds nothing up."""

from __future__ import annotations

import base64
import json
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Thread
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from live_examples import EXCERPT, rows, until
from overlay_examples import true_track

from sphereorient.errors import OutputError
from sphereorient.experiment.recording import open_recording
from sphereorient.files.page_server import HOST
from sphereorient.live.feed import Arrival, Feed
from sphereorient.live.lines import FicTracLines
from sphereorient.live.page import LivePage, Monitor, open_page
from sphereorient.live.sources import movie_frames
from sphereorient.trajectory import Reason

pytest_plugins = ["browser_examples"]


@pytest.fixture(scope="module")
def recording():
    with open_recording(EXCERPT / "experiment.yaml") as opened:
        yield opened


@pytest.fixture(scope="module")
def arrivals(recording) -> list[Arrival]:
    return list(movie_frames(recording, paced=False))


def poses():
    """The excerpt's truth, told as if it were measured; frames 7 and 8 have none."""
    track = true_track()
    orientation, position = track.orientation.copy(), track.position.copy()
    orientation[7:9] = np.nan
    for now in rows(replace(track, orientation=orientation)):
        where = position[now.number] if now.valid else now.position_lab_mm
        yield replace(now, position_lab_mm=where, latency_s=0.001 * (1 + now.number))


def shown(recording, arrivals: list[Arrival], count: int) -> LivePage:
    """A page after some frames."""
    views = [SimpleNamespace(name=name, camera=camera) for name, camera in recording.cameras.items()]
    monitor = Monitor(Feed(iter(arrivals), 100, wait=True))
    lines = FicTracLines(views[0].camera.R_cam_lab.numpy())
    for _, now, _ in zip(monitor, poses(), range(count), strict=False):
        monitor.saw(now, lines.columns(now))
    return LivePage(monitor=monitor, views=views, radius_mm=recording.experiment.radius_mm)


def ask(address: str, post: bool = False, **headers: str) -> tuple[int, Any]:
    request = urllib.request.Request(address, data=b"" if post else None, headers=headers)
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_the_page_tells_what_was_measured_of_the_newest_frame(recording, arrivals):
    page = shown(recording, arrivals, 20)
    look = json.loads(json.dumps(page.look(), allow_nan=False))
    now = list(poses())[19]
    assert (look["frame"], look["count"], look["lost"], look["dropped"]) == (19, 20, 2, 0)
    assert look["error_deg"] == pytest.approx(np.degrees(now.error_rad))
    assert look["latency"]["median_ms"] == pytest.approx(10.5)
    assert sum(look["latency"]["counts"]) == 20
    assert len(look["path"]) == 20
    assert [k for k, (x, _) in enumerate(look["path"]) if x is None] == [7, 8]
    for camera, picture in zip(look["cameras"], arrivals[19].pictures, strict=True):
        content = base64.b64decode(camera["picture"].partition(",")[2])
        sent = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)
        small = cv2.resize(picture, sent.shape[::-1], interpolation=cv2.INTER_AREA)
        assert float(np.abs(sent.astype(float) - small).mean()) < 3
        model = recording.cameras[camera["name"]]
        centre = torch.from_numpy(now.position_lab_mm)
        np.testing.assert_allclose(camera["centre"], model.project(centre).numpy())
        R = torch.from_numpy(now.R_lab_body)
        tips = [model.project(centre + recording.experiment.radius_mm * R[:, k]).numpy() for k in range(3)]
        np.testing.assert_allclose(camera["tips"], tips)
        from_centre = np.linalg.norm(np.array(camera["outline"]) - camera["centre"], axis=1)
        np.testing.assert_allclose(from_centre, from_centre.mean(), rtol=0.05)
        assert from_centre.mean() > max(np.linalg.norm(np.array(tips) - camera["centre"], axis=1)) * 0.98


def test_a_frame_without_a_pose_has_a_reason_and_no_outline(recording, arrivals):
    look = json.loads(json.dumps(shown(recording, arrivals, 8).look(), allow_nan=False))
    assert (look["valid"], look["error_deg"], look["reason"]) == (False, None, [str(Reason.NOT_FOUND)])
    assert all("outline" not in camera and camera["picture"] for camera in look["cameras"])


@pytest.fixture
def served(recording, arrivals) -> Iterator[tuple[LivePage, str]]:
    page = shown(recording, arrivals, 20)
    server = open_page(page, 0)
    yield page, server.address
    server.shutdown()
    server.server_close()


def test_others_get_nothing(served):
    page, place = served
    base = place.removesuffix(f"{page.token}/")
    for path in ("", "look", "wrong/look", f"{page.token}/nothing"):
        assert ask(base + path)[0] == 404
    assert ask(f"{base}wrong/stop", post=True)[0] == 404
    assert ask(f"{place}look", Host="evil.example:80")[0] == 404
    assert page.monitor.running.is_set()


def test_stop_holds_the_next_frame_and_start_lets_it_go(served):
    page, place = served
    found: list[int] = []
    assert ask(f"{place}stop", post=True)[0] == 200
    Thread(target=lambda: found.extend(one.number for one in page.monitor), daemon=True).start()
    assert json.loads(ask(f"{place}look")[1])["running"] is False
    assert found == []
    assert ask(f"{place}start", post=True)[0] == 200
    until(lambda: found == list(range(21, 40)))  # 20 was asked for by the loop that ended


def test_a_map_is_saved_where_one_is_learnt(served):
    page, place = served
    status, said = ask(f"{place}save", post=True)
    assert (status, "learnt meanwhile" in json.loads(said)["error"]) == (400, True)
    page.save_map = lambda: "Wrote map.png."
    assert json.loads(ask(f"{place}save", post=True)[1]) == {"said": "Wrote map.png."}


def test_before_the_first_frame_the_page_says_so_and_a_port_in_use_is_told(recording):
    page = LivePage()
    server = open_page(page, 0)
    try:
        assert json.loads(ask(f"{server.address}look")[1]) == {"begun": False}
        with pytest.raises(OutputError, match="expected a free port"):
            open_page(LivePage(), server.server_address[1])
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.slow  # a browser
def test_a_person_looks_and_stops(served, browser: Any, tmp_path: Path):
    page, place = served
    page.save_map = lambda: "Wrote map.png."
    tab = browser.new_page(viewport={"width": 1280, "height": 800})
    wrong: list[str] = []
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    tab.on(
        "request", lambda asked: None if asked.url.startswith((f"http://{HOST}", "data:")) else wrong.append(asked.url)
    )
    tab.goto(place)
    tab.get_by_text("frames measured").wait_for()
    tab.wait_for_function("document.querySelectorAll('main canvas').length === 2")
    cells = dict(
        tab.evaluate("[...document.querySelectorAll('tr')].map(row => [...row.cells].map(one => one.textContent))")
    )
    assert (cells["frame"], cells["frames measured"], cells["without a pose"]) == ("19", "20", "2")
    tab.get_by_role("button", name="stop").click()
    tab.get_by_text("Tracking is stopped").wait_for()
    assert not page.monitor.running.is_set()
    tab.get_by_role("button", name="start").click()
    tab.get_by_text("Tracking goes on").wait_for()
    tab.get_by_role("button", name="save map").click()
    tab.get_by_text("Wrote map.png").wait_for()
    tab.wait_for_timeout(300)
    picture = cv2.imdecode(np.frombuffer(tab.screenshot(path=str(tmp_path / "live.png")), np.uint8), cv2.IMREAD_COLOR)
    outline = np.array([0xE9, 0xB4, 0x56])  # blue, green, red
    assert (np.abs(picture.astype(int) - outline).max(-1) < 30).sum() > 300  # it is drawn
    tab.close()
    assert wrong == []
