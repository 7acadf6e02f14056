"""`track` of an experiment with `sphere.fixed: true` measures all frames in one place, whoever taught the light."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from test_fixed_centre import in_its_place

from sphereorient.run import MemoryStore, Request, run
from sphereorient.run.stages import track_movies


def declared(folder: Path) -> tuple[Path, Path]:
    """The same movie, as one of a ball that moves, and declared to be of one that does not."""
    path = in_its_place(folder)
    document = yaml.safe_load(path.read_text())
    document["sphere"]["fixed"] = True
    fixed = path.with_name("fixed.yaml")
    fixed.write_text(yaml.safe_dump(document, sort_keys=False))
    return path, fixed


@pytest.mark.slow
def test_a_ball_declared_fixed_has_one_place_in_its_track(tmp_path_factory):
    path, fixed = declared(tmp_path_factory.getbasetemp() / "in_its_place")
    free = track_movies(path, cameras=["cam1"])
    held = track_movies(fixed, cameras=["cam1"])
    assert held.valid.all()
    spread = [float(np.linalg.norm(track.position - track.position[0], axis=1).max()) for track in (free, held)]
    assert spread[1] < 1e-3 * spread[0], "one place"


@pytest.mark.slow
def test_what_another_run_learnt_measures_in_the_same_place_to_the_last_bit(tmp_path_factory, tmp_path):
    _, fixed = declared(tmp_path_factory.getbasetemp() / "in_its_place")
    known = tmp_path / "learnt.h5"
    first = run(Request(experiment=fixed, cameras=("cam1",), save_learnt=known), MemoryStore())
    again = run(Request(experiment=fixed, cameras=("cam1",), learnt=known), MemoryStore())
    for name in ("position", "orientation"):
        assert np.array_equal(getattr(first, name), getattr(again, name)), name
