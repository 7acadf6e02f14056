"""Differences that a short movie's own background may cause are no fault between cameras."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from sphereorient.preflight.cameras import ENOUGH, unsure
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
