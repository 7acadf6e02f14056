from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from bench_robustness import markdown
from overlay_examples import command
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from sphereorient.bench import (
    BenchSettings,
    Results,
    SceneResult,
    compare_runs,
    load_results,
    scenes_of,
    write_scene,
)
from sphereorient.bench.figures import robustness_figure, worst_first, write_table
from sphereorient.bench.results import save_results, summaries, summarised
from sphereorient.bench.run import (
    measure,
    no_track,
    run_benchmark,
    run_scene,
    track_scene,
    trackers_of,
)
from sphereorient.bench.score import aligned_errors_deg, orientations_at, read_fictrac, true_orientations
from sphereorient.cli import app
from sphereorient.errors import BenchError, OutputError, SettingsError, TrackError
from sphereorient.trajectory import CameraTrack, Trajectory

FRAMES = 24


@pytest.fixture
def truth(tmp_path) -> tuple[Path, np.ndarray]:
    R = Rotation.random(FRAMES, np.random.default_rng(1)).as_matrix()
    path = tmp_path / "truth.h5"
    with h5py.File(path, "w") as file:
        file["time"] = np.arange(FRAMES) / 600
        file["orientation"] = R
        file["position"] = np.zeros((FRAMES, 3))
        for name in ("velocity", "acceleration", "omega_lab", "omega_body", "alpha_lab", "alpha_body"):
            file[name] = np.ones((FRAMES, 3))
    return path, R


def turned(R: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    axis = np.random.default_rng(2).standard_normal((len(R), 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return Rotation.from_rotvec(np.deg2rad(degrees)[:, None] * axis).as_matrix() @ R


def planted(R: np.ndarray) -> Trajectory:
    """One degree off, two frames by 30, one lost; a camera whose best candidates are wrong in six frames."""
    off = np.full(FRAMES, 1.0)
    off[[3, 4]] = 30.0
    measured = turned(R, off)
    measured[7] = np.nan
    places = np.array([0] * 18 + [1, 1, 2, 2, 5, 11])  # of the right one among twelve
    candidates = turned(np.repeat(R, 12, axis=0), np.full(12 * FRAMES, 90.0)).reshape(FRAMES, 12, 3, 3)
    candidates[np.arange(FRAMES), places] = turned(R, np.full(FRAMES, 4.0))
    score = np.tile(np.linspace(0.9, 0.5, 12), (FRAMES, 1))
    order = np.random.default_rng(3).permuted(np.tile(np.arange(12), (FRAMES, 1)), axis=1)  # stored in any order
    rows = np.arange(FRAMES)[:, None]
    camera = replace(
        CameraTrack.empty(FRAMES),
        candidate_offset=12 * np.arange(FRAMES + 1),
        candidate_orientation=candidates[rows, order].reshape(-1, 3, 3),
        candidate_score=score[rows, order].reshape(-1),
    )
    blank = Trajectory.empty(np.arange(FRAMES) / 600, cameras=["cam1"], frame_rate=600.0, method="precise")
    return replace(
        blank,
        valid=np.arange(FRAMES) != 7,
        position=np.full((FRAMES, 3), 0.1),
        orientation=measured,
        orientation_cov=np.tile(np.eye(3) * np.deg2rad(0.5) ** 2, (FRAMES, 1, 1)),
        confidence=np.full(FRAMES, 0.9),
        cameras={"cam1": camera},
    )


def outcome(**changes: object) -> SceneResult:
    numbers = (
        no_track(FRAMES, "") | {"seconds": 1.0} | {"orientation_deg": (0.02,) * FRAMES, "stated": FRAMES, "inside": 23}
    )
    about = {"scene": "defocus-1-0-0", "kind": "defocus", "level": 1, "seed": 0, "degradations": {"defocus": 1}}
    return SceneResult(**(about | {"method": "precise"} | numbers | changes))


def results(*outcomes: SceneResult) -> Results:
    return Results(settings=BenchSettings(), versions={}, outcomes=outcomes)


def test_planted_values_are_measured(truth):
    path, R = truth
    found = SceneResult(scene="s", kind="k", level=1, seed=0, degradations={}, method="m",
                    seconds=2.0, **measure(planted(R), path))  # fmt: skip
    assert found.wrong == 2
    assert found.lost == 1
    assert np.nanmedian(found.errors_deg) == pytest.approx(1.0, abs=1e-4)
    assert found.looks == FRAMES
    assert found.looks_wrong == 6
    assert found.recall == pytest.approx({"1": 18 / 24, "3": 22 / 24, "10": 23 / 24})
    assert found.stated == 23
    assert found.inside == 21  # 1 degree is two of its sigmas, 4 < 7.81; 30 is not
    assert found.over_stated == pytest.approx(np.sqrt((21 * 2**2 + 2 * 60**2) / 23 / 3), rel=1e-3)
    assert found.position_mm[0] == pytest.approx(0.1 * np.sqrt(3), abs=1e-4)
    assert found.position_mm[7] is None


def test_the_row_of_a_table_is_that_of_its_frames(truth):
    path, R = truth
    one = outcome(seconds=2.0, **measure(planted(R), path))
    line = summarised([one, outcome(seed=1)])
    assert line.frames == 48
    assert line.wrong_after == pytest.approx(2 / 48)
    assert line.lost == pytest.approx(1 / 48)
    assert line.inside == pytest.approx(44 / 47)
    assert line.over_stated == one.over_stated  # the other one, of an older version, has none
    assert line.wrong_before == pytest.approx((6 + 48) / (24 + 48))
    assert line.frames_per_s == pytest.approx(48 / 3)


def test_a_refusal_is_a_scene_without_orientations():
    line = summarised([outcome(level=5, **no_track(FRAMES, "movies: expected a ball"))])
    assert line.lost == 1.0
    assert np.isnan(line.p50_deg)
    assert line.refused == "movies: expected a ball"


def test_there_is_a_scene_for_everything_and_always_the_same():
    settings = BenchSettings(degradations=("defocus", "spin", "dirt"), levels=(2, 4), seeds=(0, 1), together=2)
    scenes = scenes_of(settings)
    assert len(scenes) == 2 * (1 + 3 * 2 + 2 * 2)
    assert len({scene.name for scene in scenes}) == len(scenes)
    assert scenes == scenes_of(settings)
    mixed = [scene for scene in scenes if scene.kind == "together"]
    assert all(len(scene.degradations) == 3 and set(scene.degradations.values()) == {scene.level} for scene in mixed)
    assert [scene.degradations for scene in scenes[:2]] == [{}, {"defocus": 2}]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"degradations": ("defocuss",)}, "defocus"),
        ({"levels": (0,)}, "levels 1 .. 5"),
        ({"levels": ()}, "at least one"),
    ],
)
def test_plans_that_cannot_be_are_refused(wrong, words):
    with pytest.raises((SettingsError, ValueError), match=words):
        BenchSettings(**wrong)


def test_results_come_back_from_their_file(tmp_path):
    whole = results(outcome(), outcome(method="paper", orientation_deg=(None,) * FRAMES))
    save_results(whole, tmp_path / "results.json")
    again = load_results(tmp_path / "results.json")
    assert list(again.outcomes) == list(whole.outcomes)
    assert again.settings == whole.settings
    assert "NaN" not in (tmp_path / "results.json").read_text()


@pytest.mark.parametrize(
    ("text", "words"),
    [("", "something else"), ('{"schema": "sphereorient-robustness/9"}', "got sphereorient-robustness/9"),
     ('{"schema": "sphereorient-robustness/1"}', "whole results")],
)  # fmt: skip
def test_other_files_and_versions_are_refused(tmp_path, text, words):
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(BenchError, match=words):
        load_results(tmp_path / "results.json")
    with pytest.raises(BenchError, match="no file"):
        load_results(tmp_path / "none.json")


def noisy(size: float, seed: int) -> tuple[float, ...]:
    return tuple((size * np.random.default_rng(seed).rayleigh(1.0, FRAMES)).tolist())


def test_worse_results_are_named_and_scatter_is_not():
    before = results(outcome(orientation_deg=noisy(0.02, 1)), outcome(scene="spin-1-0-0", kind="spin"))
    same = results(outcome(orientation_deg=noisy(0.02, 2)), outcome(scene="spin-1-0-0", kind="spin"))
    assert not [change for change in compare_runs(same, before) if change.worse or change.better]
    now = results(outcome(orientation_deg=noisy(0.06, 2)), outcome(scene="spin-1-0-0", kind="spin"))
    (worse,) = [change for change in compare_runs(now, before) if change.worse]
    assert (worse.kind, worse.what) == ("defocus", "median error, degrees")
    (better,) = [change for change in compare_runs(before, now) if change.better]
    assert better.before > better.now


def test_lost_and_wrong_frames_count_as_worse():
    before = results(outcome())
    lost = results(outcome(orientation_deg=(0.02,) * 8 + (None,) * 16))
    assert [change.what for change in compare_runs(lost, before) if change.worse] == ["lost frames"]
    wrong = results(outcome(orientation_deg=(0.02,) * 6 + (50.0,) * 18))
    assert "wrong frames" in [change.what for change in compare_runs(wrong, before) if change.worse]


def test_clean_scenes_alone_are_drawn():
    """Before: an error of the figure, after all scenes had been tracked."""
    clean = outcome(scene="clean-0-0-0", kind="clean", level=0, degradations={})
    figure = robustness_figure(results(clean))
    assert [axes.get_title() for axes in figure.subfigs[0].axes] == ["clean", ""]
    assert len(figure.subfigs[0].axes[0].lines) == 2
    mixed = robustness_figure(results(clean, outcome()))
    assert mixed.subfigs[0].axes[0].get_title() == "defocus"


def test_runs_of_other_plans_have_nothing_to_compare_runs():
    other = Results(settings=BenchSettings(frames=30), versions={}, outcomes=[outcome()])
    with pytest.raises(BenchError, match="none in common"):
        compare_runs(results(outcome()), other)


def never(experiment: Path) -> Trajectory:
    raise TrackError("movies: expected a ball, got none; look at them")


def test_a_refusal_by_a_method_is_an_outcome(tmp_path):
    (scene,) = scenes_of(BenchSettings(degradations=(), seeds=(0,), frames=12, together=0))
    (found,) = track_scene(write_scene(tmp_path, scene), scene, "never", never)
    assert found.refused.startswith("movies: expected a ball")
    assert found.lost == 12


@pytest.mark.slow
def test_a_run_goes_on_and_another_run_is_left_alone(tmp_path):
    settings = BenchSettings(degradations=(), seeds=(0,), frames=12, together=0)
    (scene,) = scenes_of(settings)
    (tmp_path / "run" / "scenes").mkdir(parents=True)
    run_scene(tmp_path / "run", scene, {"never": never})
    kept = (tmp_path / "run" / "scenes" / "clean-0-0-0.never.json").read_bytes()
    found = run_benchmark(tmp_path / "run", settings, {"never": never})  # nothing is missing: no worker is needed
    assert [one.scene for one in found.outcomes] == ["clean-0-0-0"]
    assert (tmp_path / "run" / "scenes" / "clean-0-0-0.never.json").read_bytes() == kept
    assert load_results(tmp_path / "run" / "results.json").outcomes[0].frames == 12
    with pytest.raises(OutputError, match="another run's"):
        run_benchmark(
            tmp_path / "run", BenchSettings(degradations=(), seeds=(0,), frames=13, together=0), {"never": never}
        )


@pytest.mark.slow
def test_the_papers_method_on_a_small_run(tmp_path):
    settings = BenchSettings(degradations=("read_noise",), levels=(1,), seeds=(0,), frames=12, together=0)
    seen = []
    found = run_benchmark(tmp_path, settings, trackers_of(["paper"]), jobs=2, progress=lambda *at: seen.append(at))
    assert seen[0] == (0, 2)
    assert seen[-1] == (2, 2)
    for line in summaries(found):
        assert line.lost == 0
        assert 0.1 < line.p50_deg < 3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--degradations", "defocuss"], "defocus"),
        (["--levels", "7"], "levels 1 .. 5"),
        (["--levels", "a"], "whole numbers"),
        (["--methods", "magic"], "precise, paper"),
        (["--baseline", "none.json"], "no file"),
    ],
)
def test_bad_input_is_one_line(tmp_path, monkeypatch, capsys, arguments, words):
    code, _, errors = command(monkeypatch, capsys, "bench", "robustness", "--out", tmp_path / "run", *arguments)
    assert code == 2
    assert len(errors.strip().splitlines()) == 1
    assert words in errors


def test_a_file_names_the_scenes_and_an_option_wins(tmp_path, monkeypatch, capsys):
    config = tmp_path / "bench.yaml"
    config.write_text("degradations: [defocus]\nlevels: [2]\nseeds: [0]\ntogether: 0\nframes: 12\n")
    seen = []
    monkeypatch.setattr("sphereorient.bench.write_scene", lambda folder, scene: seen.append(scene))
    out = tmp_path / "scenes"
    out.mkdir()
    assert command(monkeypatch, capsys, "bench", "scenes", "--out", out, "--settings", config)[0] == 0
    assert [(scene.name, scene.plan.frames) for scene in seen] == [("clean-0-0-0", 12), ("defocus-2-0-0", 12)]
    seen.clear()
    command(
        monkeypatch, capsys, "bench", "scenes", "--out", out, "--settings", config, "--levels", "4", "--frames", "15"
    )
    assert [(scene.name, scene.plan.frames) for scene in seen] == [("clean-0-0-0", 15), ("defocus-4-0-0", 15)]
    config.write_text("level: [2]\n")
    code, _, errors = command(monkeypatch, capsys, "bench", "scenes", "--out", out, "--settings", config)
    assert (code, len(errors.strip().splitlines())) == (2, 1)
    assert "write 'levels'" in errors


def test_compare_as_a_command(tmp_path, monkeypatch, capsys):
    save_results(results(outcome()), tmp_path / "old.json")
    save_results(results(outcome(orientation_deg=(0.2,) * FRAMES)), tmp_path / "new.json")
    code, printed, _ = command(monkeypatch, capsys, "bench", "compare", tmp_path / "new.json", tmp_path / "old.json")
    assert code == 1
    assert "worse: defocus 1, precise: median error, degrees 0.02 -> 0.2" in printed
    assert command(monkeypatch, capsys, "bench", "compare", tmp_path / "old.json", tmp_path / "old.json")[0] == 0


def test_fictracs_file_is_read_and_scored(truth, tmp_path):
    path, R = truth
    own = Rotation.from_matrix(R[0]).inv()
    rows = np.zeros((FRAMES, 25))
    rows[:, 0] = np.arange(FRAMES)
    rows[:, 8:11] = (Rotation.from_rotvec([0.0, 0.02, 0.0]) * Rotation.from_matrix(R) * own).as_rotvec()
    np.savetxt(tmp_path / "out.dat", rows, delimiter=", ")
    frame, measured, _ = read_fictrac(tmp_path / "out.dat")
    true = orientations_at(path, frame)
    assert np.median(aligned_errors_deg(measured, true)) > 10
    np.testing.assert_allclose(aligned_errors_deg(measured, true, "both"), 0, atol=1e-5)
    assert aligned_errors_deg(measured, true, "body").max() > 0.3
    run = CliRunner().invoke(app, ["score", str(tmp_path / "out.dat"), str(path), "--align", "both"])
    assert run.exit_code == 0
    assert "24 of 24 frames" in run.output
    with pytest.raises(BenchError, match="numbers between commas"):
        read_fictrac(path)


def test_alignment_takes_off_constant_turns_and_no_more():
    rng = np.random.default_rng(6)
    true = Rotation.random(200, rng)
    noise = Rotation.from_rotvec(0.01 * rng.standard_normal((200, 3)))
    A, B = Rotation.random(2, rng)
    measured = (A.inv() * noise * true * B.inv()).as_matrix()
    left = aligned_errors_deg(measured, true.as_matrix(), "both")
    assert np.median(left) == pytest.approx(np.rad2deg(np.median(noise.magnitude())), rel=0.05)
    missing = measured.copy()
    missing[5] = np.nan
    assert np.flatnonzero(np.isnan(aligned_errors_deg(missing, true.as_matrix(), "both"))).tolist() == [5]


def test_the_truth_is_found_by_times(truth):
    path, R = truth
    np.testing.assert_array_equal(true_orientations(path, np.array([2, 5]) / 600 + 1e-4), R[[2, 5]])
    with pytest.raises(TrackError, match="times of the track"):
        true_orientations(path, np.array([1.0]))
    with pytest.raises(TrackError, match=r"frames 0 \.\. 23"):
        orientations_at(path, np.array([24]))


def test_the_figure_shows_the_hardest_first_and_all_methods(tmp_path):
    hard = {"scene": "spin-1-0-0", "kind": "spin", "degradations": {"spin": 1}}
    whole = results(
        outcome(), outcome(method="paper", orientation_deg=(1.5,) * FRAMES),
        outcome(**hard, orientation_deg=(0.02,) * 12 + (40.0,) * 12), outcome(**hard, method="paper"),
    )  # fmt: skip
    assert worst_first(summaries(whole), ["precise"]) == ["spin", "defocus"]
    figure = robustness_figure(whole)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles == ["spin", "defocus"]
    above, below = figure.axes[0], figure.axes[1]
    assert below.get_lines()[0].get_ydata().tolist() == [50.0]
    assert above.get_lines()[2].get_ydata().tolist() == [0.02]
    assert "wrong" in below.get_ylabel()
    page = markdown(whole)
    assert "| defocus | 0.02 | 1.5 |" in page
    assert "| spin | 20 (50, 0) |" in page  # median, and shares that are wrong and lost
    write_table([whole], tmp_path / "results.csv")
    assert (tmp_path / "results.csv").read_text().count("\n") == 5
