"""The paper's method on the bundled excerpt, through the command line as a user runs it."""

from __future__ import annotations

import csv
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import yaml
from click.testing import Result
from excerpt_examples import EXCERPT, shortened
from typer.testing import CliRunner

from sphereorient.bench import score_track
from sphereorient.cli import app, main
from sphereorient.movies import open_movie, write_ffv1
from sphereorient.run.stages import track_movies
from sphereorient.statistics import StatisticsSettings, ensemble_of
from sphereorient.trajectory import Flag, Trajectory

POSE_ENDS = {"position": 3, "orientation": 1}  # frames that the kernels of the defaults lose at each end


def sphereorient(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "sphereorient.cli", *map(str, arguments)], capture_output=True, text=True, timeout=300
    )


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command in this process, which is refused with exit code 2, and return its one line."""

    def run(*arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", ["sphereorient", *map(str, arguments)])
        monkeypatch.setattr(signal, "signal", lambda *_: None)  # handlers are the test run's own
        with pytest.raises(SystemExit) as end:
            main()
        assert end.value.code == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1, lines
        assert lines[0].startswith("sphereorient: ")
        return lines[0]

    return run


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    out = tmp_path_factory.mktemp("excerpt") / "track.h5"
    words = ["track", EXCERPT / "experiment.yaml", "--method", "paper", "--out", out]
    return out, CliRunner().invoke(app, list(map(str, words)))


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The excerpt in a folder of its own, to be broken."""
    shutil.copytree(EXCERPT, tmp_path / "copy")
    return tmp_path / "copy"


def test_the_excerpt_meets_the_bars_of_the_paper_method(tracked):
    out, run = tracked
    assert run.exit_code == 0, run.stderr
    score = score_track(Trajectory.load(out), EXCERPT / "truth.h5")
    assert score.valid.sum() == 40
    p50, p95, p99, largest = score.percentiles_deg()
    assert p50 <= 1.5
    assert p95 <= 3.0
    assert p99 <= 5.0
    assert largest < 10
    track = Trajectory.load(out)
    assert (track.flags & Flag.CONTRADICTION > 0).sum() <= 2
    assert track.provenance["remarks"] == []
    p50, p95, _, _ = score.percentiles_mm()
    assert p50 <= 0.10
    assert p95 <= 0.30
    assert score.relative_rms["omega_lab"] <= 0.2
    assert score.relative_rms["omega_body"] <= 0.2
    assert score.relative_rms["velocity"] <= 0.05


def test_the_summary_counts_valid_frames_and_the_losses_of_each_camera(tracked):
    _, run = tracked
    assert "40 of 40 frames valid" in run.stdout
    assert "cam1: frames lost: none" in run.stdout
    assert "s  cam1: orient: 40 of 40, " in run.stderr  # a line a stage: there is no terminal


def test_the_file_has_every_dataset_with_units_and_its_provenance(tracked):
    out, _ = tracked
    with h5py.File(out) as file:
        assert file.attrs["schema"] == "sphereorient-track/1"
        assert file.attrs["method"] == "paper"
        assert yaml.safe_load(file.attrs["settings"])["orient"]["fine_step_deg"] == 3.0
        provenance = json.loads(file.attrs["provenance"])
        assert len(provenance["sha256"]["cam1.mkv"]) == 64
        assert np.allclose(file["time"][()], np.arange(40) / 600)
        for name in ("position", "orientation", "omega_lab", "cameras/cam1/centre_px", "cameras/cam2/candidates/score"):
            assert "units" in file[name].attrs, name


def test_smooth_poses_are_there_but_for_the_ends_and_orientations_are_closer_to_the_truth(tracked):
    track = Trajectory.load(tracked[0])
    known = {name: np.isfinite(getattr(track, f"{name}_smooth").reshape(40, -1)).all(1) for name in POSE_ENDS}
    for name, lost in POSE_ENDS.items():
        assert known[name].tolist() == [lost <= k < 40 - lost for k in range(40)]
        assert np.isfinite(getattr(track, f"{name}_smooth_cov")[known[name]]).all()
    np.testing.assert_array_equal(known["position"], np.isfinite(track.velocity).all(1))
    rough, smooth = score_track(track, EXCERPT / "truth.h5"), replace(track, orientation=track.orientation_smooth)
    smooth_deg = score_track(smooth, EXCERPT / "truth.h5").orientation_deg[known["orientation"]]
    assert np.square(smooth_deg).mean() < 0.5 * np.square(rough.orientation_deg).mean()


@pytest.mark.slow
def test_a_track_of_the_paper_has_a_report_with_table_and_figures(tracked, tmp_path):
    settings = StatisticsSettings(max_duration_s=0.03, min_frames=10, resamples=100)
    chosen = settings.model_dump(exclude_unset=True).items()
    more = [word for key, value in chosen for word in ("--set", f"statistics.{key}={value}")]
    run = sphereorient(
        "report", tracked[0], "--experiment", EXCERPT / "experiment.yaml", "--out", tmp_path / "r", *more
    )
    assert run.returncode == 0, run.stderr
    assert "Frame of omega_lab: written in lab components" in run.stdout
    page = (tmp_path / "r" / "index.html").read_text()
    assert all(f"figure-{name}" in page for name in ("densities", "increments", "angles", "correlations", "isotropy"))
    with (tmp_path / "r" / "tables" / "moments.csv").open() as file:
        rows = {(row["quantity"], row["component"]): row for row in csv.DictReader(file)}
    frames = np.rint(600 * ensemble_of(Trajectory.load(tracked[0]), settings).time_s).astype(int)
    with h5py.File(EXCERPT / "truth.h5") as file:
        for quantity in ("velocity", "omega_lab", "omega_body"):
            true = file[quantity][()][frames].std(0)
            measured = [float(rows[quantity, axis]["rms"]) for axis in "xyz"]
            np.testing.assert_allclose(measured, true, atol=0.1 * np.linalg.norm(true))
            assert all(np.isfinite(float(rows[quantity, axis]["rms_low"])) for axis in "xyz")


@pytest.mark.slow
def test_a_track_too_short_for_statistics_has_a_page_with_the_reason(tracked, tmp_path):
    run = sphereorient("report", tracked[0], "--out", tmp_path / "r", "--quiet")
    assert run.returncode == 0, run.stderr
    assert run.stderr.startswith("Segments: none has 50 frames with a motion")
    assert "Warning" not in run.stderr
    page = (tmp_path / "r" / "index.html").read_text()
    assert "figure-track" in page
    assert "No segment is usable" in page


@pytest.mark.slow
def test_the_python_call_gives_the_same_bytes_as_the_command(tmp_path):
    experiment = shortened(tmp_path / "copy", 0, 5)
    assert sphereorient("track", experiment, "--method", "paper", "--out", tmp_path / "track.h5").returncode == 0
    again = track_movies(experiment, method="paper")
    first = Trajectory.load(tmp_path / "track.h5")
    for name in ("position", "orientation", "omega_lab", "segment", "flags"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    for name, camera in first.cameras.items():
        np.testing.assert_array_equal(again.cameras[name].candidate_orientation, camera.candidate_orientation)


@pytest.mark.slow
def test_one_camera_alone_tracks_the_orientation_and_the_flag_is_set(tmp_path):
    out, experiment = tmp_path / "one.h5", shortened(tmp_path / "copy", 0, 12)
    run = sphereorient("track", experiment, "--method", "paper", "--out", out, "--cameras", "cam2", "--quiet")
    assert run.returncode == 0, run.stderr
    assert run.stdout == ""
    track = Trajectory.load(out)
    score = score_track(track, EXCERPT / "truth.h5")
    assert score.percentiles_deg()[0] <= 2.0
    assert list(track.cameras) == ["cam2"]
    assert (track.flags & int(Flag.ONE_CAMERA)).all()
    assert np.isnan(track.orientation_cov).all()  # nothing to measure it by


@pytest.mark.slow
def test_a_part_of_the_frames_keeps_the_experiments_clock(tmp_path):
    track = track_movies(shortened(tmp_path / "copy", 10, 18), method="paper")
    assert np.allclose(track.time, np.arange(10, 18) / 600)
    assert score_track(track, EXCERPT / "truth.h5").percentiles_deg()[3] < 5


@pytest.mark.slow
def test_swapped_cameras_do_not_pass_for_a_measurement(tmp_path):
    """A wrong input must not give a confident wrong output: the rays then miss each other by centimetres."""
    experiment = shortened(tmp_path / "copy", 0, 6)
    for name in ("{}.mkv", "empty_{}.png"):
        first, second = (experiment.with_name(name.format(camera)) for camera in ("cam1", "cam2"))
        aside = first.rename(tmp_path / "aside")
        second.rename(first)
        aside.rename(second)
    track = track_movies(experiment, method="paper")
    assert score_track(track, EXCERPT / "truth.h5").percentiles_mm()[0] > 5


@pytest.mark.slow
def test_a_mirrored_movie_scores_worse_than_the_right_one(copy, tracked):
    """Chirality: the mirror image of a painted sphere is another sphere."""
    for name in ("cam1", "cam2"):
        (copy / f"{name}.mkv").unlink()
        with open_movie(EXCERPT / f"{name}.mkv") as movie:
            write_ffv1(copy / f"{name}.mkv", (frame[:, ::-1] for frame in movie.frames(0, 8)), 600.0)
    experiment = copy / "experiment.yaml"
    experiment.write_text(experiment.read_text().replace("backgrounds", "frames: [0, 8]\nbackgrounds"))
    for name in ("cam1", "cam2"):
        empty = cv2.imread(str(copy / f"empty_{name}.png"), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(copy / f"empty_{name}.png"), empty[:, ::-1])
    mirrored = track_movies(experiment, method="paper")
    right = Trajectory.load(tracked[0])
    for name in ("cam1", "cam2"):
        # Either nothing fits (runaway), or what fits best fits visibly worse.
        best = np.nan_to_num(mirrored.cameras[name].score, nan=0.0).max()
        assert best < np.nanmin(right.cameras[name].score) - 0.05


def _replace(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def replacing(name: str, old: str, new: str) -> Callable[[Path], None]:
    return lambda folder: _replace(folder / name, old, new)


def adding(line: str) -> Callable[[Path], None]:
    return replacing("experiment.yaml", "backgrounds:", f"{line}\nbackgrounds:")


def without_backgrounds(folder: Path) -> None:
    lines = (folder / "experiment.yaml").read_text().splitlines()
    (folder / "experiment.yaml").write_text("\n".join(line for line in lines if not line.startswith("backgrounds")))


def empty(folder: Path) -> None:
    np.save(folder / "none.npy", np.zeros((0, 650, 650), np.uint8))
    _replace(folder / "experiment.yaml", "cam1: cam1.mkv", "cam1: none.npy")


def fixed(folder: Path) -> None:
    without_backgrounds(folder)
    _replace(folder / "experiment.yaml", "{diameter: 18.0", "{fixed: true, diameter: 18.0")


def no_ball(folder: Path) -> None:
    frames = np.random.default_rng(0).integers(10, 14, (12, 650, 650)).astype(np.uint8)
    for name in ("cam1", "cam2"):
        np.save(folder / f"{name}.npy", frames)
        _replace(folder / "experiment.yaml", f"{name}.mkv", f"{name}.npy")
    without_backgrounds(folder)


SPOILT: dict[str, tuple[Callable[[Path], object], list[str]]] = {
    "empty": (empty, ["none.npy"]),
    "other size": (replacing("cameras.yaml", "- 650", "- 640"), ["640 x 640", "650 x 650"]),
    "no frames left": (adding("start: {cam1: 40}"), ["0 (cam1)", "40 (cam2)", "correct start:"]),
    "masks": (adding("masks: {cam1: m.png}"), ["m.png", "no such file", "hides the ball"]),
    "fixed": (fixed, ["a ball that rotates in its place"]),
    "no ball": (no_ball, ["sphere in some frame", "not_found"]),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", SPOILT)
def test_bad_input_is_one_clear_line_and_leaves_no_file(copy, refused, case):
    spoil, words = SPOILT[case]
    spoil(copy)
    line = refused("track", copy / "experiment.yaml", "--out", copy / "track.h5", "--quiet")
    for word in words:
        assert word in line
    assert not list(copy.glob("*track*"))


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--out", "/dev/null/track.h5"], "/dev/null"),
        (["--out", "track.h5", "--method", "paper", "--set", "orient.fine_stp_deg=2"], "fine_step_deg"),
        (["--out", "track.h5", "--method", "paper", "--set", "orient.fine_step_deg=wide"], "wide"),
        (["--out", "track.h5", "--method", "guess"], "paper"),
        (["--out", "track.h5", "--cameras", "cam7"], "cam1 or cam2"),
        (["--out", "track.h5", "--settings", "none.yaml"], "none.yaml"),
    ],
)
def test_bad_arguments_are_one_clear_line(arguments, word, tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    assert word in refused("track", EXCERPT / "experiment.yaml", "--quiet", *arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_ctrl_c_leaves_one_line_and_no_file(tmp_path):
    out = tmp_path / "track.h5"
    command = [sys.executable, "-m", "sphereorient.cli", "track", EXCERPT / "experiment.yaml", "--out", out, "--quiet"]

    # A shell's background jobs, and so perhaps this test, ignore Ctrl-C: the child is started as in the foreground.
    def in_foreground() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=in_foreground)
    _wait_until_it_works(process.pid)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in stderr
    assert "Traceback" not in stderr
    assert not list(tmp_path.iterdir())


def _wait_until_it_works(pid: int) -> None:
    """Wait until torch is loaded, which is after the command began and well before it ends."""
    maps = Path(f"/proc/{pid}/maps")
    for _ in range(600):
        if maps.exists() and "libtorch" in maps.read_text():
            break
        time.sleep(0.1)
    time.sleep(1.0)
