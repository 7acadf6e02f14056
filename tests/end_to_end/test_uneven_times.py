"""Uneven times: gaps count in time, not in frames, for prediction, path, smoother and derivatives."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from precise_examples import Movies, mean_turn, render, turned_off, write

from sphereorient.errors import ExperimentError
from sphereorient.run.stages import track_movies
from sphereorient.trajectory import Trajectory

RATE = 2400.0  # of the rendered movie, from which frames are taken at uneven steps


@pytest.fixture(scope="module")
def fast(tmp_path_factory: pytest.TempPathFactory) -> Movies:
    """Four times the usual rate, half a degree a frame."""
    return render(tmp_path_factory.mktemp("fast"), frames=220, frame_rate=RATE, omega_rms=mean_turn(0.5, RATE), seed=8)


def taken(movies: Movies, rows: np.ndarray, folder: Path, method: str) -> tuple[Trajectory, Movies, np.ndarray]:
    some = movies.frames(rows)
    time_s = rows / RATE
    path = write(some, folder, frame_rate=None, times="times.csv")
    (folder / "times.csv").write_text("time (s)\n" + "".join(f"{time!r}\n" for time in time_s.tolist()))
    with h5py.File(movies.folder / "truth.h5") as truth:
        omega = truth["omega_lab"][()][rows]
    return track_movies(path, method=method), some, omega


def relative_error(track: Trajectory, omega: np.ndarray) -> float:
    there = np.isfinite(track.omega_lab).all(1)
    assert there.mean() > 0.8
    off = (track.omega_lab - omega)[there]
    return float(np.sqrt(np.mean(off**2) / np.mean(omega[there] ** 2)))


@pytest.mark.slow
def test_jittered_and_dropped_frames_are_tracked_by_their_times(fast, tmp_path):
    """Steps of 3, 4 or 5 fast frames, and some of 8 and 12: by count omega would be wrong by a quarter and more."""
    steps = np.random.default_rng(2).choice([3, 4, 4, 5, 8, 12], 60)
    rows = np.concatenate([[0], np.cumsum(steps)])
    rows = rows[rows < len(fast)]
    track, some, omega = taken(fast, rows, tmp_path, "precise")
    assert track.valid.all()
    assert np.isnan(track.frame_rate)
    assert track.time.tolist() == (rows / RATE).tolist()
    assert len(np.unique(track.segment)) == 1
    assert np.nanmax(turned_off(track, some)) < 0.2
    assert relative_error(track, omega) < 0.05
    counted = np.gradient(np.arange(len(rows))) / np.gradient(rows / RATE) * np.median(np.diff(rows / RATE))
    assert np.abs(counted - 1).mean() > 0.2  # omega if frames were counted as even


@pytest.mark.slow
def test_a_pause_of_the_camera_is_a_pause(fast, tmp_path):
    rows = np.concatenate([np.arange(0, 90, 4), np.arange(150, 220, 4)])
    track, some, omega = taken(fast, rows, tmp_path, "precise")
    assert track.valid.all()
    assert np.nanmax(turned_off(track, some)) < 0.2
    assert relative_error(track, omega) < 0.08


@pytest.mark.slow
def test_the_paper_takes_dropped_frames_for_gaps_and_refuses_jitter(fast, tmp_path):
    rows = np.setdiff1d(np.arange(0, 220, 4), [40, 44, 120, 200])
    track, _, omega = taken(fast, rows, tmp_path / "dropped", "paper")
    assert track.time.tolist() == (rows / RATE).tolist()
    assert len(track.cameras["cam1"].reason) == len(rows)
    assert set(track.cameras["cam1"].reason) <= {"ok", "low_score", "outline"}
    off = (track.omega_lab - omega)[np.isfinite(track.omega_lab).all(1)]
    assert np.sqrt(np.mean(off**2) / np.mean(omega**2)) < 0.5
    jitter = np.cumsum(np.random.default_rng(3).choice([3, 4, 5], 40))
    with pytest.raises(ExperimentError, match=r"even grid.*--method precise"):
        taken(fast, jitter, tmp_path / "jitter", "paper")
