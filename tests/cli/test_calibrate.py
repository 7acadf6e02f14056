from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import calibration_examples
import numpy as np
import pytest
import torch
from calibrate_examples import document, write, write_tables
from calibration_examples import cameras, vector
from conftest import REPO
from overlay_examples import command

from sphereorient import so3
from sphereorient.calibration.self_calibration import (
    check_cameras,
    check_lines,
    contradiction_lines,
    observations_of,
    refine_with_track,
    repair_lines,
)
from sphereorient.cameras import load_cameras, save_cameras
from sphereorient.errors import CameraError, TrackError
from sphereorient.trajectory import CameraTrack, Reason, Trajectory

FRAMES = 120


def bumped(calibrated):
    turn = torch.deg2rad(vector(0.2, -0.15, 0.1))
    return calibrated | {"cam2": calibration_examples.bumped(calibrated["cam2"], turn, vector(0.0, 0.0, 0.0))}


def track_of(calibrated, truly, contradicts=0):
    """The track, made with `calibrated`, of a ball that cameras `truly` filmed."""
    rng = torch.Generator().manual_seed(6)
    places = 20 * (2 * torch.rand(FRAMES, 3, generator=rng).double() - 1)
    R = so3.exp(2 * torch.randn(FRAMES, 3, generator=rng).double())
    alone = {}
    for name, true in truly.items():
        centre = true.project(places) + 0.02 * torch.randn(FRAMES, 2, generator=rng).double()
        turn = calibrated[name].R_cam_lab.mT @ true.R_cam_lab
        wobble = so3.exp(5e-4 * torch.randn(FRAMES, 3, generator=rng).double())
        reason = [Reason.OK] * FRAMES
        if name == "cam2":
            reason[:contradicts] = [Reason.CONTRADICTS] * contradicts
        alone[name] = replace(
            CameraTrack.empty(FRAMES),
            centre_px=centre.numpy(),
            orientation=(wobble @ turn @ R).numpy(),
            reason=tuple(str(why) for why in reason),
        )
    empty = Trajectory.empty(np.arange(FRAMES) / 600.0, cameras=tuple(alone), frame_rate=600.0, experiment="test")
    return replace(empty, cameras=alone)


@pytest.mark.slow
def test_calibrate_writes_cameras_and_a_picture_and_prints_tables(tmp_path, monkeypatch, capsys):
    source = write_tables(tmp_path)
    before = {path.name for path in tmp_path.iterdir()}
    code, out, _ = command(monkeypatch, capsys, "calibrate", source, "--out", tmp_path / "cameras.yaml")
    assert code == 0
    assert {path.name for path in tmp_path.iterdir()} - before == {"cameras.yaml", "cameras.png"}
    assert list(load_cameras(tmp_path / "cameras.yaml")) == ["cam1", "cam2"]
    for words in ("kappa1", "cam1: rms 0.0", "axes at ", "cam2.csv", "Wrote"):
        assert words in out
    assert "sphereorient calibrate" in (tmp_path / "cameras.yaml").read_text().splitlines()[0]


def test_a_fault_that_a_user_can_mend_is_one_line_and_nothing_is_written(tmp_path, monkeypatch, capsys):
    path = write(tmp_path, {"surveyed": document()["surveyed"] | {"pose": 99}}, drawn=False)
    code, out, err = command(monkeypatch, capsys, "calibrate", path, "--out", tmp_path / "cameras.yaml")
    assert code == 2
    assert out == ""
    assert err.strip().startswith("sphereorient: ")  # the bar of progress leaves an empty line
    assert err.strip().count("\n") == 0
    assert [path.name for path in tmp_path.iterdir()] == ["calibration.yaml"]


@pytest.mark.slow
def test_a_fault_while_writing_leaves_the_old_files(tmp_path, monkeypatch, capsys):
    source = write_tables(tmp_path)
    (tmp_path / "cameras.yaml").write_text("old")
    (tmp_path / "cameras.png").write_text("old")

    def full(*_, **__):
        raise CameraError("no room left on the disk")

    monkeypatch.setattr("sphereorient.cameras.save_cameras", full)
    code, _, err = command(
        monkeypatch, capsys, "calibrate", source, "--out", tmp_path / "cameras.yaml", "-q", "--force"
    )
    assert code == 2
    assert "no room" in err
    assert (tmp_path / "cameras.png").read_text() == (tmp_path / "cameras.yaml").read_text() == "old"
    assert not list(tmp_path.glob("*partial*"))


@pytest.mark.parametrize(
    ("out", "words"),
    [
        ("cameras.png", "expected .yaml"),
        ("calibration.yaml", "an input"),
        ("calibration.yaml/cameras.yaml", "a folder to write in"),
    ],
)
def test_an_output_that_would_harm_is_refused_before_any_work(tmp_path, monkeypatch, capsys, out, words):
    source = write_tables(tmp_path)
    text = source.read_text()
    code, _, err = command(monkeypatch, capsys, "calibrate", source, "--out", tmp_path / out)
    assert code == 2
    assert words in err
    assert source.read_text() == text


@pytest.mark.slow
def test_refine_with_a_track_repairs_bumped_cameras(tmp_path, monkeypatch, capsys):
    calibrated = cameras()
    truly = bumped(calibrated)
    save_cameras(tmp_path / "cameras.yaml", calibrated)
    track_of(calibrated, truly).save(tmp_path / "track.h5")
    repaired = tmp_path / "repaired.yaml"
    given = ("calibrate", tmp_path / "cameras.yaml", "--refine-with", tmp_path / "track.h5", "--out", repaired)
    code, out, _ = command(monkeypatch, capsys, *given)
    assert code == 0
    assert "cam2: rotated by 0.2" in out
    assert "not determined by the sphere, kept: cam1: all (the lab frame)" in out
    found = load_cameras(repaired)
    between = [rig["cam2"].R_cam_lab @ rig["cam1"].R_cam_lab.mT for rig in (found, truly)]
    assert float(so3.geodesic_distance(*between)) < np.deg2rad(0.05)
    result = refine_with_track(tmp_path / "cameras.yaml", tmp_path / "track.h5")
    assert result.gap_after_mm < 0.3 * result.gap_before_mm
    assert any("mm rms" in line for line in repair_lines(result))


def test_a_track_of_other_cameras_or_of_one_is_refused(tmp_path):
    calibrated = cameras()
    track = track_of(calibrated, calibrated)
    with pytest.raises(TrackError, match="cam3"):
        observations_of([track], {"cam3": calibrated["cam1"]})
    save_cameras(tmp_path / "cameras.yaml", calibrated)
    replace(track, cameras={"cam1": track.cameras["cam1"]}).save(tmp_path / "one.h5")
    with pytest.raises(CameraError, match="two or more"):
        refine_with_track(tmp_path / "cameras.yaml", tmp_path / "one.h5")


def test_check_cameras_prints_gaps_of_lines_of_sight_in_mm_and_px():
    calibrated = cameras()
    (right,) = check_cameras(calibrated, track_of(calibrated, calibrated))
    (wrong,) = check_cameras(calibrated, track_of(calibrated, bumped(calibrated)))
    assert right.percentile(50)[0] < 0.02
    assert 0.02 < right.percentile(95)[1] < 0.06  # the noise is 0.02 px, and half of it meets in the middle
    assert wrong.percentile(50)[1] > 3 * right.percentile(50)[1]
    assert len(right.gap_mm) == FRAMES
    (line,) = check_lines([wrong])
    assert line.startswith("cam1 and cam2: lines of sight miss each other by ")
    assert "px" in line


def test_only_frames_that_both_cameras_measured_are_counted():
    calibrated = cameras()
    track = track_of(calibrated, calibrated)
    reason = ("not_found",) * 50 + track.cameras["cam1"].reason[50:]
    seen = track.cameras | {"cam1": replace(track.cameras["cam1"], reason=reason)}
    (check,) = check_cameras(calibrated, replace(track, cameras=seen))
    assert len(check.gap_mm) == FRAMES - 50


@pytest.mark.parametrize(("contradicts", "reported"), [(0, False), (20, False), (100, True)])
def test_cameras_that_contradict_each_other_most_of_the_time_are_reported(contradicts, reported):
    calibrated = cameras()
    lines = contradiction_lines(track_of(calibrated, calibrated, contradicts))
    assert bool(lines) is reported
    if reported:
        assert f"in {contradicts} of the {FRAMES} frames" in lines[0]
        assert "--refine-with" in lines[1]


@pytest.mark.parametrize(("contradicts", "reported"), [(8, False), (90, True)])
def test_contradictions_of_three_cameras_are_compared_with_frames_that_two_see(contradicts, reported):
    calibrated = cameras()
    track = track_of(calibrated, calibrated, contradicts)
    third = replace(track.cameras["cam1"], reason=("not_found",) * (FRAMES - 10) + ("ok",) * 10)
    lines = contradiction_lines(replace(track, cameras=track.cameras | {"cam3": third}))
    assert bool(lines) is reported
    if reported:
        assert f"in {contradicts} of the {FRAMES} frames in which two or more see" in lines[0]


def test_the_command_check_cameras_reads_a_track(tmp_path, monkeypatch, capsys):
    experiment = REPO / "synthetic_data"
    (path,) = sorted(experiment.rglob("experiment.yaml"))[:1]
    from sphereorient.experiment import load_experiment

    calibrated = load_experiment(path).cameras
    track_of(calibrated, calibrated, contradicts=100).save(tmp_path / "track.h5")
    code, out, _ = command(monkeypatch, capsys, "check-cameras", path, "--track", tmp_path / "track.h5")
    assert code == 0
    assert "lines of sight miss each other by 0.0" in out
    assert "--refine-with" in out
    code, _, err = command(monkeypatch, capsys, "check-cameras", path, "--track", Path("nothing.h5"))
    assert code == 2
    assert err.count("\n") == 1
