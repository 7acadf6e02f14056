"""Several balls against the truth: names, what is hidden, and the curve against number density."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
import yaml
from overlay_examples import command
from scipy.spatial.transform import Rotation
from test_robustness import outcome

from sphereorient.bench import BenchSettings, Results, run_benchmarks, scenes_of
from sphereorient.bench.figures import density_figure, write_table
from sphereorient.bench.results import compare_runs, summaries
from sphereorient.bench.run import track_scene
from sphereorient.bench.scenes import BenchmarkScene
from sphereorient.bench.score import given_to_others, named_as_true, score_track
from sphereorient.cameras import PinholeCamera, save_cameras
from sphereorient.errors import BenchError, SettingsError, TrackError
from sphereorient.synth.scene import hidden_shares
from sphereorient.synth.write import default_cameras, experiment_document
from sphereorient.trajectory import Tracks, Trajectory

FRAMES = 12


def write_truth(path: Path, names: str, apart_mm: float = 30.0) -> dict[str, dict[str, np.ndarray]]:
    """Balls on a line along x, each with another rotation."""
    rng = np.random.default_rng(3)
    truth = {
        name: {
            "time": np.arange(FRAMES) / 600,
            "position": np.array([k * apart_mm, 0.0, 0.0]) + rng.uniform(-1, 1, (FRAMES, 3)),
            "orientation": Rotation.random(FRAMES, rng).as_matrix(),
        }
        for k, name in enumerate(names)
    }
    with h5py.File(path, "w") as file:
        file.attrs["schema"] = "sphereorient-truth/1"
        for name, values in truth.items():
            for key, value in values.items():
                file[f"spheres/{name}/{key}"] = value
    return truth


def tracks_of(truth: dict[str, dict[str, np.ndarray]], named: dict[str, str]) -> Tracks:
    """Tracks with the true poses of other balls: `named` holds the ball behind each name."""
    time_s = next(iter(truth.values()))["time"]
    empty = Trajectory.empty(time_s, cameras=("cam1",), frame_rate=600.0, method="precise")
    empty = replace(empty, valid=np.ones(FRAMES, bool))
    return Tracks(
        {
            name: replace(empty, position=truth[ball]["position"], orientation=truth[ball]["orientation"])
            for name, ball in named.items()
        }
    )


def test_eight_balls_that_look_alike_get_the_names_of_the_truth(tmp_path):
    truth = write_truth(tmp_path / "truth.h5", "abcdefgh")
    order = np.random.default_rng(1).permutation(8)
    wrong = tracks_of(truth, {name: "abcdefgh"[k] for name, k in zip("abcdefgh", order, strict=True)})
    right = named_as_true(wrong, tmp_path / "truth.h5", list("abcdefgh"))
    assert list(right) == list("abcdefgh")
    assert all(score_track(track, tmp_path / "truth.h5").orientation_deg.max() < 1e-5 for track in right.values())
    assert set(given_to_others(right, tmp_path / "truth.h5").values()) == {(0, 0)}


def test_only_balls_that_look_alike_are_exchanged_and_one_without_frames_takes_what_is_left(tmp_path):
    truth = write_truth(tmp_path / "truth.h5", "abcd")
    tracks = tracks_of(truth, {"a": "c", "b": "d", "c": "a", "d": "b"})
    lost = replace(tracks["c"], valid=np.zeros(FRAMES, bool))
    tracks = Tracks(dict(tracks) | {"c": lost})
    found = named_as_true(tracks, tmp_path / "truth.h5", ["a", "c"])
    assert not found["a"].valid.any()
    given = given_to_others(found, tmp_path / "truth.h5")
    assert given == {"a": (0, 0), "b": (FRAMES, 0), "c": (0, 0), "d": (FRAMES, 0)}
    assert named_as_true(tracks, tmp_path / "truth.h5", [])["a"].valid.all()


def test_a_track_of_one_ball_is_no_track_of_several(tmp_path):
    truth = write_truth(tmp_path / "truth.h5", "ab")
    track = replace(tracks_of(truth, {"a": "a"})["a"], sphere="")
    with pytest.raises(TrackError, match="that of a, b"):
        score_track(track, tmp_path / "truth.h5")


def test_the_part_that_nearer_balls_hide_is_the_lens_that_two_circles_share():
    """By hand: circles whose centres are a radius apart share 2/3 - sqrt(3) / (2 pi), 0.391, of each."""
    far, radius = 1e6, 9.0  # so far away that depth changes no size
    lens = PinholeCamera(
        image_size=(640, 480),
        R_cam_lab=torch.eye(3, dtype=torch.float64),
        T_cam_lab_mm=torch.tensor([0.0, 0.0, far], dtype=torch.float64),
        centre_px=torch.tensor([319.5, 239.5], dtype=torch.float64),
        f_px=torch.tensor(5.0 * far, dtype=torch.float64),
    )
    places = {"a": [0.0, 0.0, 0.0], "b": [radius, 0.0, -40.0], "c": [-3 * radius, 0.0, -80.0], "d": [0.0, 0.0, 50.0]}
    found = hidden_shares(
        {name: np.array([place]) for name, place in places.items()}, {"cam1": lens}, dict.fromkeys(places, radius)
    )
    assert found["a"].shape == (1, 1)
    assert found["a"][0, 0] == pytest.approx(2 / 3 - np.sqrt(3) / (2 * np.pi), abs=0.02)  # b covers it
    assert found["b"][0, 0] == found["c"][0, 0] == 0.0
    assert found["d"][0, 0] == 1.0  # a is before it


def test_a_scene_has_as_many_balls_cameras_and_paints_as_its_plan(tmp_path):
    plan = BenchSettings(degradations=(), seeds=(0,), balls=4, paints=3, cameras=3, volume_mm=45.0, frames=30)
    (scene,) = scenes_of(plan)
    base = scene.base
    assert (base.balls, base.paints, base.cameras, base.volume_mm, base.frames) == (4, 3, 3, 45.0, 30)
    assert list(default_cameras(base)) == ["cam1", "cam2", "cam3"]
    assert plan.per_litre == pytest.approx(4 / 0.38170, rel=1e-4)  # a sphere of 45 mm: 0.3817 l
    with pytest.raises((SettingsError, ValueError), match="uneven_light, highlights"):
        BenchSettings(balls=2)
    alone = Results(settings=BenchSettings(degradations=(), frames=30), versions={}, outcomes=[])
    with pytest.raises(BenchError, match="none in common"):
        compare_runs(Results(settings=plan, versions={}, outcomes=[outcome()]), alone)


def test_each_ball_of_a_scene_is_measured_and_alike_ones_by_the_names_of_the_truth(tmp_path):
    """Balls a and c have the same paint and are exchanged; b, of another paint, is taken for a in three frames."""
    (scene,) = scenes_of(BenchSettings(degradations=(), seeds=(0,), balls=3, paints=2, frames=FRAMES))
    truth = write_truth(tmp_path / "truth.h5", "abc")
    write_experiment(tmp_path, scene)

    def exchanged(experiment: Path) -> Tracks:
        tracks = tracks_of(truth, {"a": "c", "b": "b", "c": "a"})
        position = tracks["b"].position.copy()
        position[4:7] = truth["a"]["position"][4:7]
        return Tracks(dict(tracks) | {"b": replace(tracks["b"], position=position)})

    found = track_scene(tmp_path / "experiment.yaml", scene, "exchanged", exchanged)
    assert [one.ball for one in found] == ["a", "b", "c"]
    assert [one.given for one in found] == [0, 3, 0]
    assert [one.exchanges for one in found] == [0, 2, 0]
    assert all(one.errors_deg.max() < 1e-4 for one in found)
    (line,) = summaries(Results(settings=BenchSettings(), versions={}, outcomes=found))
    assert (line.scenes, line.frames, line.given) == (1, 3 * FRAMES, 3 / (3 * FRAMES))

    def never(experiment: Path) -> Tracks:
        raise TrackError("movies: expected balls, got none; look at them")

    refused = track_scene(tmp_path / "experiment.yaml", scene, "never", never)
    assert [one.lost for one in refused] == [FRAMES] * 3


def write_experiment(folder: Path, scene: BenchmarkScene) -> None:
    """An experiment.yaml and cameras.yaml of a scene, without movies."""
    cameras = default_cameras(scene.base)
    save_cameras(folder / "cameras.yaml", cameras)
    (folder / "experiment.yaml").write_text(yaml.safe_dump(experiment_document(scene.base, cameras), sort_keys=False))


def curve() -> list[Results]:
    """Two and three cameras, one and four balls: each hundredth of a degree is a ball, a third of it per camera."""
    return [
        Results(
            settings=BenchSettings(degradations=(), balls=balls, cameras=cameras, volume_mm=45.0),
            versions={},
            outcomes=[
                outcome(ball=name, orientation_deg=(0.01 * balls / cameras,) * 24, given=6 * (name == "b"), hidden=0.25)
                for name in "abcd"[:balls]
            ],
        )
        for cameras in (2, 3)
        for balls in (4, 1)
    ]


def test_the_figure_shows_a_curve_for_each_number_of_cameras_in_the_order_of_density(tmp_path):
    turn, _, shares = density_figure(curve()).axes[:3]
    labels = [line.get_label() for line in turn.get_lines()]
    assert labels == ["2 cameras, median", "2 cameras, 95 %", "3 cameras, median", "3 cameras, 95 %"]
    np.testing.assert_allclose(turn.get_lines()[0].get_xdata(), [1 / 0.38170, 4 / 0.38170], rtol=1e-4)
    np.testing.assert_allclose(turn.get_lines()[2].get_ydata(), [0.01 / 3, 0.04 / 3])
    assert [line.get_label() for line in shares.get_lines()[:3]] == [
        "lost",
        "given to another",
        "more than half hidden",
    ]
    np.testing.assert_allclose(shares.get_lines()[1].get_ydata(), [0.0, 100 * 6 / 96])
    write_table(curve(), tmp_path / "results.csv")
    head, first, *_ = (tmp_path / "results.csv").read_text().splitlines()
    assert head.startswith("cameras,balls,per_litre,kind")
    assert first.startswith("2,4,10.47")


def test_plans_run_one_after_the_other_in_folders_of_their_names(tmp_path, monkeypatch):
    def run(folder, plan, trackers, *, jobs, progress):
        progress(1, 2)
        progress(2, 2)
        return folder.name, plan.balls

    monkeypatch.setattr("sphereorient.bench.run.run_benchmark", run)
    plans = {str(n): BenchSettings(degradations=(), seeds=(0, 1), balls=n, volume_mm=45.0) for n in (1, 3)}
    seen: list[tuple[int, int]] = []
    assert run_benchmarks(tmp_path, plans, {}, progress=lambda *at: seen.append(at)) == [("1", 1), ("3", 3)]
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_the_command_writes_table_and_figure_and_prints_a_row_for_each_point(tmp_path, monkeypatch, capsys):
    asked: dict[str, BenchSettings] = {}

    def planned(folder, plans, trackers, *, jobs, progress):
        asked.update(plans)
        return curve()

    monkeypatch.setattr("sphereorient.bench.run_benchmarks", planned)
    code, printed, _ = command(monkeypatch, capsys, "bench", "balls", "--out", tmp_path / "run", "--balls", "1,4")
    assert code == 0
    assert "density.png" in printed
    assert len([line for line in printed.splitlines() if "2.6" in line or "10.5" in line]) == 4
    assert {name: (plan.balls, plan.cameras, plan.paints, plan.volume_mm) for name, plan in asked.items()} == {
        "1-balls-2-cameras": (1, 2, 2, 45.0),
        "4-balls-2-cameras": (4, 2, 2, 45.0),
        "1-balls-3-cameras": (1, 3, 2, 45.0),
        "4-balls-3-cameras": (4, 3, 2, 45.0),
    }
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"results.csv", "density.png", "density.pdf"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--balls", "1;2"], "whole numbers between commas"),
        (["--balls", "9"], "balls: expected less than or equal to 8, got 9"),
        (["--cameras", "5"], "cameras: expected less than or equal to 4, got 5"),
        (["--balls", ""], "whole numbers between commas"),
    ],
)
def test_bad_numbers_are_one_line(tmp_path, monkeypatch, capsys, arguments, words):
    code, _, errors = command(monkeypatch, capsys, "bench", "balls", "--out", tmp_path / "run", *arguments)
    assert code == 2, errors
    assert len(errors.strip().splitlines()) == 1
    assert words in errors
