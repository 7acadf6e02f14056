"""The page of `live` shows the measured poses, answers only requests with its token, and holds nothing up."""

import base64
import json
import math
import socket
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import Pipe
from pathlib import Path
from threading import Event, Thread
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from live_examples import EXCERPT, rows, until
from live_examples import arrivals as numbered
from overlay_examples import true_track

from sphereorient.errors import OutputError
from sphereorient.experiment.recording import open_recording
from sphereorient.files.page_server import HOST, PageServer, listen, new_token
from sphereorient.live.feed import Arrival, Feed
from sphereorient.live.page import LivePage, Monitor, PageProcess, PageWriter
from sphereorient.live.sources import movie_frames
from sphereorient.trajectory import Reason

pytest_plugins = ["browser_examples"]
TOKEN = new_token()


@pytest.fixture(scope="module")
def recording():
    with open_recording(EXCERPT / "experiment.yaml") as opened:
        yield opened


@pytest.fixture(scope="module")
def arrivals(recording) -> list[Arrival]:
    return list(movie_frames(recording, paced=False))


def poses():
    """The excerpt's truth, as if it were measured; frames 7 and 8 have none."""
    track = true_track()
    orientation, position = track.orientation.copy(), track.position.copy()
    orientation[7:9] = np.nan
    for now in rows(replace(track, orientation=orientation)):
        where = position[now.number] if now.valid else now.position_lab_mm
        yield replace(now, position_lab_mm=where, reason=2 * now.reason, latency_s=0.001 * (1 + now.number))


@dataclass
class Shown:
    """A page after some frames, and its state in the loop."""

    page: LivePage
    running: Event
    messages: list[str]


@contextmanager
def shown(recording, arrivals: list[Arrival], folder: Path, count: int, save_map=None) -> Iterator[Shown]:
    ours, theirs = Pipe()
    running, messages = Event(), []
    running.set()
    writer = PageWriter(folder, ours, messages.append)
    writer.begin(recording, running, save_map)
    for arrival, now, _ in zip(arrivals, poses(), range(count), strict=False):
        writer.saw(arrival, now)
    page = LivePage(recording, folder, theirs)
    Thread(target=page.follow, daemon=True).start()
    yield Shown(page, running, messages)
    writer.close()


@pytest.fixture(autouse=True)
def each_picture(monkeypatch):
    monkeypatch.setattr("sphereorient.live.page.PICTURES_HZ", math.inf)


def ask(address: str, post: bool = False, **headers: str) -> tuple[int, Any]:
    request = urllib.request.Request(address, data=b"" if post else None, headers=headers)
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_the_page_shows_what_was_measured_of_the_newest_frame(recording, arrivals, tmp_path):
    with shown(recording, arrivals, tmp_path, 20) as seen:
        look = json.loads(json.dumps(seen.page.look(), allow_nan=False))
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


def test_a_frame_without_a_pose_has_a_reason_and_no_outline(recording, arrivals, tmp_path):
    with shown(recording, arrivals, tmp_path, 8) as seen:
        look = json.loads(json.dumps(seen.page.look(), allow_nan=False))
    assert (look["valid"], look["error_deg"], look["reason"]) == (False, None, 2 * [str(Reason.NOT_FOUND)])
    assert all("outline" not in camera and camera["picture"] for camera in look["cameras"])


@pytest.fixture
def served(recording, arrivals, tmp_path) -> Iterator[tuple[Shown, str]]:
    with shown(recording, arrivals, tmp_path, 20, lambda: "Wrote map.png.") as seen:
        server = PageServer(seen.page, listen(0, "--page", OutputError), TOKEN)
        Thread(target=server.serve_forever, daemon=True).start()
        yield seen, server.address
        server.shutdown()
        server.server_close()


def test_requests_without_the_token_get_nothing(served):
    seen, place = served
    base = place.removesuffix(f"{TOKEN}/")
    for path in ("", "look", "wrong/look", f"{TOKEN}/nothing"):
        assert ask(base + path)[0] == 404
    assert ask(f"{base}wrong/stop", post=True)[0] == 404
    assert ask(f"{place}look", Host="evil.example:80")[0] == 404
    assert ask(f"{place}stop", post=True, Host="evil.example:80")[0] == 404
    assert seen.running.is_set()


def test_stop_and_start_reach_the_loop(served):
    seen, place = served
    assert ask(f"{place}stop", post=True)[0] == 200
    assert not seen.running.is_set()
    assert json.loads(ask(f"{place}look")[1])["running"] is False
    assert ask(f"{place}start", post=True)[0] == 200
    assert seen.running.is_set()


def test_a_stopped_monitor_holds_the_next_frame():
    found: list[int] = []
    monitor = Monitor(Feed(numbered(30), 100, wait=True))
    monitor.running.clear()
    Thread(target=lambda: found.extend(one.number for one in monitor), daemon=True).start()
    assert found == []
    monitor.running.set()
    until(lambda: found == list(range(30)))


def test_a_map_is_saved_where_one_is_learnt(served, recording, arrivals, tmp_path):
    _, place = served
    assert json.loads(ask(f"{place}save", post=True)[1]) == {"said": "Wrote map.png."}
    assert json.loads(ask(f"{place}look")[1])["map"] is True
    (tmp_path / "other").mkdir()
    with shown(recording, arrivals, tmp_path / "other", 3) as seen:
        assert seen.page.look()["map"] is False
        with pytest.raises(OutputError, match="learnt live"):
            seen.page.done(["save"], {})


def test_poses_that_the_page_misses_are_counted_and_pictures_are_few(recording, arrivals, tmp_path, monkeypatch):
    """More poses than the ring holds before the page looks for the first time."""
    monkeypatch.setattr("sphereorient.live.page.PICTURES_HZ", 1e-3)
    monkeypatch.setattr("sphereorient.live.page.POSES", 16)
    with shown(recording, arrivals, tmp_path, 40) as seen:
        look = seen.page.look()
    assert (look["count"], sum(look["latency"]["counts"])) == (40, 15)
    assert look["frame"] == 0, "the only picture"


def test_before_the_first_frame_the_page_shows_that_and_a_port_in_use_is_refused(recording, tmp_path):
    page = LivePage(recording, tmp_path, Pipe()[1])
    assert page.look() == {"begun": False}
    assert "no frame is measured yet" in page.done(["stop"], {})["said"]
    with socket.create_server((HOST, 0)) as taken, pytest.raises(OutputError, match="expected a free port"):
        PageProcess(EXCERPT / "experiment.yaml", None, taken.getsockname()[1], pytest.fail)


@pytest.mark.slow  # a process of its own, which imports torch
def test_a_page_process_that_is_killed_is_reported_and_tracking_goes_on(recording, arrivals):
    messages: list[str] = []
    running = Event()
    page = PageProcess(EXCERPT / "experiment.yaml", None, 0, messages.append)
    try:
        page.begin(recording, running, None)
        folder = page.folder
        page.saw(arrivals[0], next(poses()))
        assert json.loads(ask(f"{page.address}look")[1])["frame"] == 0
        assert ask(f"{page.address}stop", post=True)[0] == 200
        page.process.kill()
        until(lambda: messages)
        assert messages == ["page: its process has ended; tracking goes on without the page."]
        assert running.is_set(), "else it could not be started again"
        page.saw(arrivals[1], next(poses()))
    finally:
        page.close()
    assert not folder.exists()
    assert len(messages) == 1


@pytest.mark.slow  # a process of its own, which imports torch
def test_faults_of_the_files_are_reported_by_the_loop_alone(tmp_path, capfd):
    (tmp_path / "experiment.yaml").write_text((EXCERPT / "experiment.yaml").read_text())  # without movies
    page = PageProcess(tmp_path / "experiment.yaml", None, 0, pytest.fail)
    page.process.join()
    page.close()
    assert capfd.readouterr().err == ""


@pytest.mark.slow  # a browser
def test_a_person_looks_and_stops(served, browser: Any, tmp_path: Path):
    seen, place = served
    tab = browser.new_page(viewport={"width": 1280, "height": 800})
    wrong: list[str] = []
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
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
    assert not seen.running.is_set()
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
