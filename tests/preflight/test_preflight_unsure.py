"""Differences that a short movie's own background may cause are no fault between cameras."""

import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from sphereorient.preflight import cameras
from sphereorient.preflight.cameras import ENOUGH, track_stretch, unsure
from sphereorient.preflight.finding import FAULT, WARNING, judged, warning

FAULTY = judged("lines of sight", "3 px", (True, FAULT, "calibrate again"))


@pytest.mark.parametrize(
    ("given", "total", "is_fault"),
    [((), ENOUGH - 1, False), (("cam1",), ENOUGH - 1, False), (("cam1", "cam2"), ENOUGH - 1, True), ((), ENOUGH, True)],
)
def test_a_fault_is_reported_where_the_background_is_given_or_the_movie_long_enough(given, total, is_fault):
    paths = {name: Path(name) for name in ("cam1", "cam2")}
    experiment = SimpleNamespace(movie_paths=paths, background_paths={name: paths[name] for name in given})
    found = unsure(FAULTY, experiment, total)
    assert (found is FAULTY) is is_fault
    if not is_fault:
        assert found.severity is WARNING
        assert found.measured == f"cannot tell: 3 px, but the background is learnt from {total} frames"
        assert found.advice == "give backgrounds:, or check more frames"
    less = warning("lines of sight", "0.9 px", "run sphereorient check-cameras")
    assert unsure(less, experiment, total) is less


class Track:
    """A track of 20 frames."""

    position = torch.zeros(20, 3).numpy()

    def __len__(self) -> int:
        return len(self.position)


@pytest.mark.parametrize(("frames", "turn_deg"), [(1, 0.1), (20, math.nan), (20, 0.1)])
def test_a_stretch_that_cannot_tell_overrules_no_outlines(monkeypatch, frames, turn_deg):
    """Before: faults of the outlines were overruled by it, and the check ended without one."""
    found = SimpleNamespace(frames=frames, turn_deg=turn_deg, contradicts=False, advice="")
    experiment = SimpleNamespace(frames=None, names=(), cameras={}, radius_mm=9.0, movie_paths={}, background_paths={})
    learnt = SimpleNamespace(second_ball=False)
    stretch = [SimpleNamespace(frame=range(20), stream=range(200))] * 2
    monkeypatch.setattr(cameras, "replace", lambda one, **_: one)
    monkeypatch.setattr(cameras, "Request", lambda **_: None)
    monkeypatch.setattr(cameras, "run_tracks", lambda *_: {"": Track()})
    monkeypatch.setattr(cameras, "said_alone", lambda *_, **__: (None, None))
    monkeypatch.setattr(cameras, "outline_stretch", lambda *_: torch.zeros(20))
    monkeypatch.setattr(cameras, "compare_cameras", lambda *_: found)
    told = track_stretch(experiment, None, SimpleNamespace(result=lambda: learnt), stretch, 0)
    can_tell = frames == 20 and not math.isnan(turn_deg)
    assert told.overrules is can_tell
    assert ("cannot tell" in told.findings[0].measured) is not can_tell
