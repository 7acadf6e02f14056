"""A ball that is not found is reported once, with the likely cause, and so is its return."""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np
import pytest
import torch
from live_examples import EXCERPT, LIMIT_S, rows, until
from overlay_examples import true_track

from sphereorient.live.feed import Arrival, Feed
from sphereorient.live.live import Measured, measured
from sphereorient.live.loop import open_live
from sphereorient.live.page import LOST_S, Monitor
from sphereorient.live.sources import movie_frames
from sphereorient.methods.method import Learnt, save_learnt
from sphereorient.methods.settings import Settings
from sphereorient.report.texture_map import write_texture
from sphereorient.sphere.texture import blobs
from sphereorient.trajectory import Reason


def watched(frames: Sequence[Measured]) -> list[str]:
    """Return the messages about measured frames."""
    messages: list[str] = []
    arrivals = (Arrival(number=now.number, time_s=now.time_s, pictures=[], arrived_s=0.0) for now in frames)
    monitor = Monitor(Feed(arrivals, 1, wait=True), messages.append)
    for _, now in zip(monitor, frames, strict=True):
        monitor.saw(now)
    return messages


def shown(count: int, found: Sequence[int], reason: Reason) -> list[Measured]:
    """Return frames at 100 Hz, without a pose but those found."""
    known = next(rows(true_track()))
    lost = replace(known, position_lab_mm=np.full(3, np.nan), reason=(reason,))
    return [replace(known if k in found else lost, number=k, time_s=0.01 * k) for k in range(count)]


def test_a_ball_that_is_not_found_is_reported_once_and_so_is_its_return():
    found = (0, 5, 6, 80, 90, 91)  # the one alone is no return
    messages = watched(shown(100, found, Reason.NOT_FOUND))
    assert len(messages) == 2
    assert messages[0].startswith("frame 56: the ball is not found for 0.5 s (not_found): nothing of its size")
    assert messages[1] == "frame 91: the ball is found again."


def test_it_is_reported_before_another_search_where_one_takes_longer():
    frames = shown(2, (), Reason.LOW_SCORE)
    messages = watched([frames[0], replace(frames[1], time_s=0.8, number=80)])
    assert len(messages) == 1
    assert messages[0].startswith("frame 0: the ball is not found for 0.5 s (low_score)")


def test_a_source_that_goes_on_while_a_frame_is_searched_shows_how_long_that_took():
    """At most 3 frames wait: the next one is of 0.47 s, while the source is at 0.49 s already, then at 0.6 s."""
    messages: list[str] = []
    gate = Event()

    def source() -> Iterator[Arrival]:
        for k in range(61):
            yield Arrival(number=k, time_s=0.01 * k, pictures=[], arrived_s=0.0)
            if k in (0, 49):
                gate.wait(LIMIT_S)
                gate.clear()

    feed = Feed(source(), 3, wait=False)
    monitor = Monitor(feed, messages.append)
    frames = iter(monitor)
    lost = shown(61, (), Reason.LOW_SCORE)
    for newest, reported in ((0.49, 0), (0.6, 1)):
        arrival = next(frames)
        monitor.saw(lost[arrival.number])
        gate.set()
        until(lambda at=newest: feed.newest_s == pytest.approx(at))
        assert len(messages) == 0
        if reported:
            assert next(frames).time_s < LOST_S + 0.1
            assert len(messages) == 1


@pytest.mark.parametrize(
    ("reason", "found", "cause"),
    [
        (Reason.LOW_SCORE, (), "the map of another one"),
        (Reason.LOW_SCORE, range(15), "partly hidden, the light or the focus has changed"),
        (Reason.OUTLINE, (), "sphere.diameter"),
        (Reason.DARK, (0,), "the lamp is off"),
        (Reason.UNDECODABLE, (0,), "no picture is usable"),
    ],
)
def test_the_likely_cause_is_reported(reason, found, cause):
    (messages,) = watched(shown(70, found, reason))
    assert cause in messages


@pytest.mark.slow  # learns the appearance of the excerpt, and searches for a ball that is not there
def test_the_map_of_another_ball_is_reported(tmp_path):
    folder = Path(shutil.copytree(EXCERPT, tmp_path / "excerpt"))
    with open_live(EXCERPT / "experiment.yaml", Settings(), ["cam1"], None) as opened:
        save_learnt({"": Learnt.of(opened.tracker.appearances[""])}, tmp_path / "learnt.h5")
    (folder / "texture.png").unlink()
    write_texture(blobs(256, torch.Generator().manual_seed(5)), folder / "texture.png")
    messages: list[str] = []
    with open_live(folder / "experiment.yaml", Settings(), ["cam1"], tmp_path / "learnt.h5") as opened:
        frames = list(movie_frames(opened.recording, paced=False))[:8]
        slow = (replace(frame, time_s=0.1 * frame.number) for frame in frames)
        monitor = Monitor(Feed(slow, 1, wait=True), messages.append)
        for now in measured(opened.tracker, opened.tracker.appearances[""].fitter.views, monitor):
            assert not now.valid
            monitor.saw(now)
    assert len(messages) == 1
    assert messages[0].startswith("frame 4: the ball is not found for 0.5 s (low_score)")
    assert "the map of another one" in messages[0]
