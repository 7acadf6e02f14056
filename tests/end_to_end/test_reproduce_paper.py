"""The script that redoes the paper: its movies move as stated, unusable ones are refused, and the page is whole."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from types import FrameType, SimpleNamespace

import kept
import numpy as np
import paper_movies
import paper_table
import pytest
import reproduce_paper
import torch
from conftest import REPO
from ensembles import EnsembleSpec, draw_ensemble

from sphereorient import load_experiment, so3, track_movies
from sphereorient.errors import BenchError
from sphereorient.statistics import BootstrapSettings, ensemble_of


def test_the_filmed_motion_has_the_rms_values_of_table_i_and_passes_near_the_middle():
    time_s = torch.arange(0, 375, 5, dtype=torch.float64) / 600
    moved = [paper_movies.tumbling(number, 375 / 600) for number in range(120)]
    for rates, wanted in (
        ([one.path(time_s) / 1000 for one in moved], paper_movies.LAWS.velocity_rms),
        ([one.path(time_s, 1) / 1000 for one in moved], paper_movies.LAWS.acceleration_rms),
        ([one.omega(time_s) for one in moved], paper_movies.LAWS.omega_rms),
        ([one.omega(time_s, 1) for one in moved], paper_movies.LAWS.alpha_rms),
    ):
        np.testing.assert_allclose(torch.stack(rates).square().mean((0, 1)).sqrt(), wanted, rtol=0.12)
    away_mm = torch.stack([one.path(time_s, -1).abs().amax(-1) for one in moved])
    assert away_mm.amin(1).max() < paper_movies.NEAR_MM + 5.0
    assert (away_mm.amax(1) > 75.0).double().mean() > 0.5  # they leave the field


def test_the_filmed_rates_are_the_derivatives_of_the_filmed_pose():
    step_s = 1e-4
    now = paper_movies.tumbling(7, 0.1).at(torch.arange(60, dtype=torch.float64) * step_s)
    speed = (now.position_lab_mm[2:] - now.position_lab_mm[:-2]) / (2 * step_s) / 1000
    torch.testing.assert_close(speed, now.velocity_m_s[1:-1], atol=1e-5, rtol=1e-4)
    turn = so3.log(now.R_lab_body[2:] @ now.R_lab_body[:-2].mT) / (2 * step_s)
    torch.testing.assert_close(turn, now.omega_lab_rad_s[1:-1], atol=1e-3, rtol=1e-3)


def test_impellers_turn_against_each_other_and_their_light_moves():
    first, later = (paper_movies.impellers((200, 160), 0, time_s) for time_s in (0.01, 0.02))
    assert first.shape == (160, 200)
    left, right = first[:, :20].mean(1), first[:, -20:].mean(1)
    assert np.abs(later - first).max() > 20
    assert np.abs(left - right).max() > 20
    assert first[:, 100].max() < first[:, :20].max()  # the disks are at the sides


def test_lamps_stand_still_and_bubbles_change():
    disk = paper_movies.Disk(centre_px=torch.tensor([60.0, 50.0]), radius_px=torch.tensor(30.0))
    lit = [np.full((100, 120), 90.0, np.float32) for _ in range(4)]  # as bright as the ball
    cover = np.ones((60, 60), np.float32)
    window = slice(20, 80), slice(30, 90)
    exposure = paper_movies.Exposure(size=(100, 120), window=window, light=90 * cover, cover=cover)
    for light, frame in zip(lit, (1, 1, 2, 3), strict=True):
        paper_movies.put(light, exposure, disk, (0, 5, frame))
    np.testing.assert_array_equal(lit[0], lit[1])
    assert np.abs(lit[0] - 90).max() > 10
    unlike = [np.abs(lit[0] - other).mean() for other in lit[2:]]
    assert 0 < max(unlike) < np.abs(lit[0] - 90).mean()  # a few bubbles of difference, the same lamps


def test_the_truth_is_read_in_the_frames_of_the_ensemble():
    track = draw_ensemble(EnsembleSpec(segments=4), 3)
    values = {name: getattr(track, name) for name in paper_table.UNITS}
    truth = {name: x + 100 * np.arange(len(track))[:, None] for name, x in values.items()}
    summary = SimpleNamespace(ensemble=ensemble_of(track))
    found = paper_table.Measured(tracks=[track], experiments=[], truths=[truth], scores=[], summary=summary)
    row = np.searchsorted(track.time, summary.ensemble.time_s)
    for name, x in found.true_ensemble.values.items():
        np.testing.assert_allclose(x, truth[name][row])


def test_pooled_flatness_is_that_of_the_law():
    ensemble = ensemble_of(draw_ensemble(EnsembleSpec(segments=150), 1))
    fit, flatness = paper_table.pooled(ensemble, "alpha_lab", BootstrapSettings(resamples=100))
    assert abs(float(flatness.value) - 7.6) < 3 * float(flatness.error) < 4.0
    assert abs(float(fit.a.value) - 0.6) < 0.12


def test_a_stay_lasts_while_some_camera_has_the_whole_sphere():
    camera = SimpleNamespace(image_size=(650, 650))
    experiment = SimpleNamespace(cameras={"a": camera, "b": camera}, frame_rate_hz=600.0)
    inside, outside = [300.0, 300.0], [300.0, 10.0]
    truth = {
        "a": np.array([outside, inside, inside, outside, outside, inside]),
        "b": np.array([outside] * 3 + [inside] + [outside] * 2),
    }
    np.testing.assert_allclose(paper_table.stays(truth, experiment), [3 / 600, 1 / 600])


def test_means_have_the_error_of_resampled_movies():
    rng = np.random.default_rng(5)
    parts = [rng.normal(0.0, 2.0, 50) for _ in range(40)]
    found = paper_table.mean_of(parts, root=True)
    assert abs(float(found.value) - 2.0) < 0.15
    assert 0.01 < float(found.error) < 0.1
    assert paper_table.pm(found) == f"{float(found.value):.3f} ± {float(found.error):.3f}"
    shares = paper_table.wrong([np.array([1.0, 20.0, np.nan, 3.0])])[0]
    np.testing.assert_array_equal(shares, [0.0, 100.0, np.nan, 0.0])


def test_a_broken_folder_of_movies_is_refused_in_one_line(tmp_path, monkeypatch):
    (tmp_path / "movies" / "002").mkdir(parents=True)
    with pytest.raises(BenchError, match="002: expected a movie"):
        reproduce_paper.todo(tmp_path, reproduce_paper.QUICK, ["film"])
    file = tmp_path / "file"
    file.write_text("")
    for out in (file, tmp_path):
        monkeypatch.setattr(sys, "argv", ["reproduce_paper.py", "--out", str(out), "--quick"])
        with pytest.raises(SystemExit) as left:
            reproduce_paper.main()
        line = str(left.value.code)
        assert line.startswith("reproduce_paper.py: ")
        assert "\n" not in line
        assert {"expected", "got"} <= set(re.findall(r"\w+", line))


def test_results_of_a_stage_stay_until_its_own_code_changes(tmp_path, monkeypatch):
    plan = reproduce_paper.QUICK
    for number, stage in ((1, "film"), (2, "film"), (1, "paper"), (1, "precise"), (2, "precise")):
        made = reproduce_paper.made_by(tmp_path, number, stage)
        made.parent.mkdir(parents=True, exist_ok=True)
        made.mkdir() if stage == "film" else made.write_text("")
        kept.note(made, key=reproduce_paper.key_of(number, stage, plan.frames))
    refused = reproduce_paper.made_by(tmp_path, 2, "paper")
    kept.note(refused, key=reproduce_paper.key_of(2, "paper", plan.frames), failed="no ball")
    stages = ("film", *reproduce_paper.METHODS)
    left = [(3, "film"), (3, "paper"), (3, "precise")]
    assert reproduce_paper.todo(tmp_path, plan, stages) == left  # a refusal is a result
    reproduce_paper.made_by(tmp_path, 2, "precise").unlink()
    assert reproduce_paper.todo(tmp_path, plan, stages) == [(2, "precise"), *left]
    now = reproduce_paper.code()
    for changed, stage in (("precise", "precise"), ("paper", "paper"), ("film", None)):
        monkeypatch.setattr(reproduce_paper, "code", lambda changed=changed: now | {changed: "another"})
        again = {name for number, name in reproduce_paper.todo(tmp_path, plan, stages) if number == 1}
        assert again == ({stage} if stage else {"film", "paper", "precise"})


@pytest.mark.slow  # tracks 12 frames
def test_the_paper_runs_nothing_of_what_its_key_leaves_out():
    ran, package = set(), REPO / "sphereorient"

    def look(frame: FrameType, event: str, argument: object) -> None:
        if event == "call":
            ran.add(frame.f_code.co_filename)

    experiment = load_experiment(REPO / "synthetic_data" / "excerpt" / "experiment.yaml")
    track_movies(replace(experiment, frames=(0, 12)), method="paper")  # code that runs at imports does not count
    threading.setprofile(look)
    sys.setprofile(look)
    try:
        track_movies(replace(experiment, frames=(0, 12)), method="paper")
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    files = {path for path in map(Path, ran) if package in path.parents}
    stages = kept.rooms.modules()
    counted = kept.code_of([stages["run.stages"], stages["methods.paper"]], reproduce_paper.NOT_OF_PAPER)
    assert len(files) > 40
    assert files <= counted, files - counted


@pytest.mark.slow  # begins to film
def test_a_full_disk_ends_in_one_line_and_no_movie_is_half_made(tmp_path):
    resource = pytest.importorskip("resource")
    script = [sys.executable, REPO / "scripts" / "reproduce_paper.py", "--out", tmp_path, "--quick"]
    full = {"preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, 500_000))}
    run = subprocess.run(script, capture_output=True, text=True, **full)
    assert run.returncode == 1
    errors = run.stderr.strip().splitlines()
    assert [line for line in errors if line.startswith("reproduce_paper.py: ")] == errors[-1:], errors
    assert [path.name for path in (tmp_path / "movies").iterdir() if not path.name.endswith(".part")] == []


def check_page(out: Path) -> None:
    """Check the page of a quick run: its figures exist, and its numbers are sane."""
    page = (out / "paper.md").read_text()
    shown = re.findall(r"!\[[\w-]+\]\((paper/[\w-]+\.png)\)", page)
    assert [Path(name).stem[:2] for name in shown] == [f"{k:02d}" for k in (*range(1, 12), 11, 12, 12)]
    assert all((out / name).stat().st_size > 5000 for name in shown)
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("| ")]
    rows = {line[0]: dict(zip(lines[0], line, strict=True)) for line in lines}
    truth, paper, precise = lines[0][3:]

    def numbers(quantity: str, column: str) -> list[float]:
        return [float(cell.split(" ±")[0]) for cell in rows[quantity][column].split(", ")]

    assert 0.5 < numbers("error of single noiseless views, rms (°)", paper)[0] < 2.5  # the paper: 2
    assert numbers("error of the orientation from both cameras, rms (°)", paper)[0] < 3.0
    assert numbers("error of the orientation from both cameras, rms (°)", precise)[0] < 0.5
    assert numbers("distance of two cameras below 30°, rms (°)", paper)[0] < 3.5  # the paper: 3.5
    assert numbers("the same without the correction of perspective (°)", paper)[0] > 4.0
    assert numbers("pictures of the whole sphere with candidates (%)", paper)[0] > 90
    assert numbers("candidates per picture", paper)[0] > 1.1
    for quantity, close in (("v (m/s)", 0.05), ("ω lab (rad/s)", 0.15)):
        for column in (paper, precise):
            assert len(numbers(quantity, column)) == 3
            np.testing.assert_allclose(numbers(quantity, column), numbers(quantity, truth), rtol=close)


@pytest.mark.slow  # films and tracks 270 frames
def test_the_quick_run_makes_the_page_its_table_and_all_figures_and_a_second_call_only_the_page(tmp_path):
    script = [sys.executable, REPO / "scripts" / "reproduce_paper.py", "--out", tmp_path, "--quick"]
    subprocess.run(script, check=True)
    check_page(tmp_path)
    tracks = sorted((tmp_path / "tracks").glob("*.h5"))
    assert len(tracks) == 6
    before = [path.stat().st_mtime_ns for path in tracks]
    subprocess.run(script, check=True)
    assert before == [path.stat().st_mtime_ns for path in tracks]
