"""The recording for Rerun: cameras as pinholes, and a file that Rerun itself finds whole."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from overlay_examples import changed, command, excerpt, true_track

from sphereorient.cameras import load_cameras
from sphereorient.errors import OutputError
from sphereorient.report.recording import SERIES, pinhole_near, series_of, view_track
from sphereorient.trajectory import Trajectory

HEAD = "schema: sphereorient-cameras/1\ncameras:\n"
PLACED = "image_size: [200, 100], R: [[1, 0, 0], [0, 0, -1], [0, 1, 0]]"
PINHOLE = f"  cam: {{model: pinhole, f_px: 300.0, centre: [90, 55], {PLACED}, T: [0, 0, 200]}}\n"
WALL = "port: {normal: [0, -1, 0], offset: 120.0, thickness: 12.0, n_glass: 1.49, n_fluid: 1.36}"
BEHIND = f"  cam: {{model: pinhole, f_px: 300.0, centre: [90, 55], {PLACED}, T: [0, 0, 200], {WALL}}}\n"
PARALLEL = f"  cam: {{model: telecentric, scale: 0.2, {PLACED}, T: [0, 0, 0]}}\n"


def camera(tmp_path, text: str):
    (tmp_path / "cameras.yaml").write_text(HEAD + text)
    return load_cameras(tmp_path / "cameras.yaml")["cam"]


def test_a_pinhole_is_its_own_pinhole(tmp_path):
    K, depth = pinhole_near(camera(tmp_path, PINHOLE), np.array([5.0, 30.0, -2.0]))
    np.testing.assert_allclose(K, [[300, 0, 90], [0, 300, 55], [0, 0, 1]], atol=1e-6)
    assert depth == pytest.approx(230)  # it looks along lab +y from y = -200


def test_the_pinhole_shows_the_ball_where_the_camera_does():
    track = true_track()
    for name, real in excerpt().cameras.items():
        K, _ = pinhole_near(real, track.position.mean(0))
        x_cam = track.position @ real.R_cam_lab.mT.numpy() + real.T_cam_lab_mm.numpy()
        uv = (x_cam / x_cam[:, 2:]) @ K.T
        wrong = np.linalg.norm(uv[:, :2] - real.project(torch.from_numpy(track.position)).numpy(), axis=1)
        assert wrong.max() < 3, name  # distortion


def test_behind_a_wall_the_pinhole_shows_what_lies_at_the_balls_distance(tmp_path):
    wet = camera(tmp_path, BEHIND)
    K, _ = pinhole_near(wet, np.array([5.0, 30.0, -2.0]))
    points = np.array([[x, 30.0, z] for x in (-40.0, 0.0, 40.0) for z in (-20.0, 0.0, 20.0)])
    x_cam = points @ wet.R_cam_lab.mT.numpy() + wet.T_cam_lab_mm.numpy()
    uv = (x_cam / x_cam[:, 2:]) @ K.T
    np.testing.assert_allclose(uv[:, :2], wet.project(torch.from_numpy(points)).numpy(), atol=1)  # the wall bends
    assert 300 < K[0, 0] < 300 * 1.36  # water enlarges


def test_a_camera_without_a_centre_before_the_ball_has_no_pinhole(tmp_path):
    assert pinhole_near(camera(tmp_path, PARALLEL), np.array([0.0, 0.0, 0.0])) is None


def test_every_series_is_there_with_its_standard_deviation():
    track = true_track()
    cov = np.broadcast_to(np.diag([0.01, 0.04, 0.09]), (40, 3, 3))
    series = series_of(replace(track, position_cov=np.array(cov)))
    assert set(series) == {"position, mm", *SERIES}
    np.testing.assert_array_equal(series["omega lab, rad per s"][0], track.omega_lab)
    np.testing.assert_allclose(series["position, mm"][1], np.broadcast_to([0.1, 0.2, 0.3], (40, 3)))


def test_without_rerun_the_remedy_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(OutputError, match=r"package rerun, got none; .*pip install sphereorient\[view\]"):
        view_track(true_track(), save=tmp_path / "v.rrd")


def verified(path) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", str(path)], capture_output=True, text=True, timeout=120
    )
    assert run.returncode == 0, run.stderr


def entities(path) -> str:
    run = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", str(path)], capture_output=True, text=True, timeout=120
    )
    return run.stdout


@pytest.mark.slow
def test_a_recording_holds_cameras_pictures_sphere_and_series(tmp_path):
    pytest.importorskip("rerun")
    out, steps = tmp_path / "v.rrd", []
    track = changed(true_track(), slice(10, 14), position=np.nan, position_smooth=np.nan, valid=False)
    view_track(track, experiment=excerpt(), save=out, every=20, progress=lambda *at: steps.append(at))
    assert steps == [(1, 2), (2, 2)]
    verified(out)
    told = entities(out)
    for place in ("/lab/cam1/picture", "/lab/cam2", "/lab/sphere/ball", "/lab/path", "/plots/state", "/warnings"):
        assert place in told, place


@pytest.mark.parametrize("frames", [0, 3])
def test_tracks_without_experiment_or_measurements_are_shown(tmp_path, frames):
    pytest.importorskip("rerun")
    out = tmp_path / "v.rrd"
    view_track(Trajectory.empty(np.arange(frames) / 600.0, cameras=("cam1",)), save=out)
    verified(out)


def test_another_suffix_is_refused(tmp_path):
    pytest.importorskip("rerun")
    with pytest.raises(OutputError, match=r"expected \.rrd, got '\.mp4'"):
        view_track(true_track(), save=tmp_path / "v.mp4")


def test_the_command_writes_a_recording_without_a_window(tmp_path, monkeypatch, capsys):
    pytest.importorskip("rerun")
    true_track().save(tmp_path / "track.h5")
    code, printed, _ = command(monkeypatch, capsys, "view", tmp_path / "track.h5", "--save", tmp_path / "v.rrd")
    assert code == 0
    assert "40 frames" in printed
    assert sorted(path.name for path in tmp_path.iterdir()) == ["track.h5", "v.rrd"]


def test_without_a_display_one_line_says_so(tmp_path, monkeypatch, capsys):
    """Before: no end. After: refused before a viewer is started."""
    pytest.importorskip("rerun")
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    true_track().save(tmp_path / "track.h5")
    code, _, said = command(monkeypatch, capsys, "view", tmp_path / "track.h5")
    assert code == 2
    assert "expected a display, got none" in said
    assert said.strip().count("\n") == 0


def test_the_viewer_is_the_one_beside_the_interpreter(tmp_path, monkeypatch):
    """Before: a traceback where the environment is not on PATH. After: found; one that does not answer is refused."""
    rerun = pytest.importorskip("rerun")
    (tmp_path / "rerun").write_text("#!/bin/sh\n")
    (tmp_path / "rerun").chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setenv("PATH", "")
    started = []

    def spawn(**given):
        started.append(given["executable_path"])
        raise RuntimeError("the viewer died")

    monkeypatch.setattr(rerun, "spawn", spawn)
    with pytest.raises(OutputError, match="expected a viewer that opens, got 'the viewer died'"):
        view_track(true_track())
    assert started == [str(tmp_path / "rerun")]
