"""`sphereorient map` from movies to a map that `track` reads; an old map corrected; bad input in one line."""

import json
import shutil
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import h5py
import numpy as np
import pytest
import torch
from map_examples import QUICK, rewrite, save_map, true_attitudes, unpainted, warped
from overlay_examples import command as run
from renders import error_deg

from sphereorient import so3
from sphereorient.cli.app import progress_bar
from sphereorient.cli.map import print_map
from sphereorient.experiment.recording import open_recording
from sphereorient.files.whole_file import writing
from sphereorient.mapping import MapSettings
from sphereorient.methods.map import learn_map
from sphereorient.methods.settings import Settings
from sphereorient.movies import open_movie
from sphereorient.report.texture_map import shares_seen, write_seen, write_texture
from sphereorient.sphere import load_texture, read_seen, seen_path
from sphereorient.sphere.compare import compare_maps
from sphereorient.sphere.texture import map_directions, random_texture
from sphereorient.trajectory import Trajectory


def refused(monkeypatch, capsys, *arguments: object) -> str:
    """Run a command that must be refused, and return its line."""
    code, out, err = run(monkeypatch, capsys, *arguments, "--quiet")
    assert code == 2, out + err
    lines = err.strip().splitlines()
    assert len(lines) == 1, err
    assert lines[0].startswith("sphereorient: ")
    return lines[0]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Path:
    """An experiment without map; its true map and the truth lie beside it."""
    return unpainted(tmp_path_factory.mktemp("unpainted") / "scene")


@pytest.fixture
def copy(rendered, tmp_path) -> Path:
    shutil.copytree(rendered.parent, tmp_path / "scene")
    return tmp_path / "scene" / "experiment.yaml"


def attitude_errors_deg(track: Path, experiment: Path) -> np.ndarray:
    """Angles to the truth, the best rotation of the body frame taken off."""
    R = torch.from_numpy(Trajectory.load(track).orientation)
    assert torch.isfinite(R).all()
    return error_deg(R, true_attitudes(experiment)).numpy()


@pytest.mark.slow
def test_a_map_is_learnt_written_and_tracked_with(rendered, tmp_path_factory, monkeypatch, capsys):
    scene = tmp_path_factory.mktemp("learnt")
    out = scene / "learnt.png"
    code, output, err = run(monkeypatch, capsys, "map", rendered, "--out", out, *QUICK)
    assert code == 0, err
    for words in ("seen:", "loops:", "iterations: 4", "correlation", "texture: learnt.png"):
        assert words in output
    texture, seen = load_texture(out), read_seen(seen_path(out))
    assert seen is not None
    assert seen.shape == texture.shape
    assert shares_seen(seen, (1,))[0] > 0.85
    comparison = compare_maps(texture, load_texture(rendered.parent / "texture.png"))
    assert comparison.correlation > 0.9
    with h5py.File(scene / "learnt_map.h5") as file:
        assert file["map/rounds"].shape[0] == 4
        assert np.isnan(file["map/texture"][()]).sum() == (file["map/seen"][()] == 0).sum()
    assert np.percentile(attitude_errors_deg(scene / "learnt_map.h5", rendered), 95) < 1.0
    assert cv2.imread(str(scene / "learnt_map.png")).shape[1] > 500
    # `track` by this map, frame by frame.
    shutil.copytree(rendered.parent, scene / "scene")
    shutil.copy(out, scene / "scene" / "learnt.png")
    rewrite(scene / "scene" / "experiment.yaml", texture="learnt.png")
    code, _, err = run(monkeypatch, capsys, "track", scene / "scene/experiment.yaml", "--out", scene / "t.h5", "-q")
    assert code == 0, err
    assert np.median(attitude_errors_deg(scene / "t.h5", rendered)) < 0.3


@pytest.mark.slow
def test_an_old_map_is_corrected_and_keeps_its_frame_and_what_is_never_seen(copy, monkeypatch, capsys):
    folder = copy.parent
    true = load_texture(folder / "texture.png")
    save_map(warped(true, 1.5), folder / "old.png")
    rewrite(copy, frames=[0, 12])  # too few for all of the ball
    options = ("--init", folder / "old.png", "--out", folder / "new.png", *QUICK)
    code, output, err = run(monkeypatch, capsys, "map", copy, *options)
    assert code == 0, err
    assert "against" in output
    assert "from the old map" in output
    assert (folder / "new_moved.png").is_file()
    new, seen = load_texture(folder / "new.png"), read_seen(folder / "new_seen.png")
    assert seen is not None
    old = load_texture(folder / "old.png")
    assert len(new) == max(64, len(old))
    # The frame is the old map's: no rotation is left to be found.
    known = torch.where(seen > 0, new, torch.nan)
    against_old, against_true = (compare_maps(known, each) for each in (old, true))
    assert float(so3.angle(against_old.R_other_reference)) < np.deg2rad(0.3)
    assert against_true.rms_rad < 0.6 * against_old.rms_rad
    # Paint that no picture shows comes from the old map and counts as unseen.
    assert 0.02 < float((seen == 0).float().mean()) < 0.8
    left = (new - old)[seen == 0].abs()
    assert float(left.median()) < 0.15  # its grey levels are fitted to the new ones


def test_without_a_terminal_each_stage_prints_a_line(monkeypatch, capsys):
    """Before: 16 minutes of silence."""
    clock = iter((100.0, 100.0, 112.0, 150.0, 175.0))
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    with progress_bar(unit="iterations") as advance:
        for stage, done, total in (("chain", 0, 1), ("map", 0, 9), ("map", 1, 9), ("map", 3, 9)):
            advance(stage, done, total)
    lines = capsys.readouterr().err.splitlines()
    assert [line.strip() for line in lines] == ["0 s  chain", "12 s  map: 0 of 9", "75 s  map: 3 of 9, 2 min left"]


def test_a_movie_of_one_frame_is_refused(copy, tmp_path, monkeypatch, capsys):
    rewrite(copy, frames=[0, 1])
    line = refused(monkeypatch, capsys, "map", copy, "--out", tmp_path / "map.png")
    assert "2 frames" in line
    assert not (tmp_path / "map.png").exists()


@pytest.mark.slow
def test_a_ball_that_does_not_turn_is_refused(copy, tmp_path, monkeypatch, capsys):
    rng = np.random.default_rng(0)
    for name in ("cam1", "cam2"):
        first = next(iter(open_movie(copy.parent / f"{name}.mkv").frames(0, 1))).astype(np.float64)
        still = np.clip(first + rng.normal(0, 1, (8, *first.shape)), 0, 255).astype(np.uint8)
        np.save(copy.parent / f"{name}.npy", still)
    rewrite(copy, movies={"cam1": "cam1.npy", "cam2": "cam2.npy"})
    line = refused(monkeypatch, capsys, "map", copy, "--out", tmp_path / "map.png")
    assert "rotates" in line


def test_bad_arguments_are_refused_before_any_work(copy, tmp_path, monkeypatch, capsys):
    cv2.imwrite(str(tmp_path / "square.png"), np.eye(64, dtype=np.uint8))
    out = ("--out", tmp_path / "map.png")
    for more, words in (
        (("--out", copy / "map.png"), "a folder to write in"),
        (("--out", tmp_path / "map.jpg"), ".png"),
        ((*out, "--init", tmp_path / "none.png"), "no such file"),
        ((*out, "--init", tmp_path / "square.png"), "twice as wide"),
        ((*out, "--cameras", "cam3"), "cam1 or cam2"),
        ((*out, "--set", "paint.round=3"), "write 'rounds'"),
    ):
        assert words in refused(monkeypatch, capsys, "map", copy, *more)


def test_track_without_a_map_does_not_write_over_a_file_of_its_name(copy, tmp_path, monkeypatch, capsys):
    assert "no map there yet" in refused(monkeypatch, capsys, "track", copy, "--out", tmp_path / "t.h5")


def test_a_recording_without_map_has_none_and_one_with_a_map_is_not_looked_at(copy):
    with open_recording(copy, textured=False) as recording:
        assert recording.texture.shape == (0, 0)
    rewrite(copy, texture="missing.png")
    with open_recording(copy, textured=False) as recording:
        assert len(recording.streams) == 2
    rewrite(copy, texture="texture.png")
    with open_recording(copy) as recording:
        assert recording.texture.shape[1] == 2 * recording.texture.shape[0]


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (None, "no such file"),
        (np.full((90, 180), 255, np.uint8), "180 x 180"),
        (np.zeros((180, 180), np.uint8), "black"),
    ],
)
def test_masks_that_are_none_are_refused(copy, tmp_path, monkeypatch, capsys, mask, words):
    if mask is not None:
        cv2.imwrite(str(copy.parent / "mask.png"), mask)
    rewrite(copy, masks={"cam1": "mask.png"})
    assert words in refused(monkeypatch, capsys, "map", copy, "--out", tmp_path / "map.png")


def test_maps_on_disk_mark_unseen_paint(tmp_path):
    texture = torch.tensor([[0.0, 1.0, 0.25, torch.nan]] * 2).repeat(4, 4)
    counts = torch.tensor([[3, 300, 1, 0]] * 2).repeat(4, 4)
    write_texture(texture, tmp_path / "map.png")
    write_seen(counts, tmp_path / "map.png")
    assert cv2.imread(str(tmp_path / "map.png"), cv2.IMREAD_UNCHANGED)[0, :4].tolist() == [0, 255, 64, 128]
    seen = read_seen(seen_path(tmp_path / "map.png"))
    assert seen is not None
    assert seen[0, :4].tolist() == [3, 255, 1, 0]
    assert shares_seen(seen, (1, 2, 255)) == pytest.approx([0.75, 0.5, 0.25])


def test_shares_are_of_the_sphere_not_of_the_picture():
    north = torch.zeros(4, 8, dtype=torch.int64)
    north[0] = 1  # latitude 45 to 90: (1 - sin 45 degrees) / 2 of the sphere
    assert shares_seen(north, (1,))[0] == pytest.approx((1 - 0.5**0.5) / 2)


@pytest.mark.slow
def test_two_maps_are_compared_and_wear_is_drawn(tmp_path, monkeypatch, capsys):
    paint = random_texture("dots", 3, 96)
    Q = so3.exp(torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64))
    from sphereorient.sphere.compare import turned_map

    save_map(paint, tmp_path / "old.png")
    save_map(turned_map(paint, Q.mT), tmp_path / "new.png")
    arguments = ("compare-maps", tmp_path / "new.png", tmp_path / "old.png", "--out", tmp_path / "moved.png")
    code, output, err = run(monkeypatch, capsys, *arguments, "--json")
    assert code == 0, err
    printed = json.loads(output)
    assert np.allclose(printed["R_new_old"], Q.numpy(), atol=2e-3)
    assert printed["moved_rms_deg"] < 0.2
    assert printed["changed_share"] < 0.01
    assert cv2.imread(str(tmp_path / "moved.png")).shape[1] > 500
    write_seen(torch.zeros(96, 192), tmp_path / "new.png")
    assert run(monkeypatch, capsys, *arguments)[0] == 2  # one is all unseen: nothing to compare


def test_frames_are_named_by_the_numbers_of_the_experiment(capsys):
    """Before: by the rows, 0 for the first frame of the part that was used."""
    position = torch.zeros(6, 3)
    learnt = SimpleNamespace(
        seen=torch.ones(4, 8, dtype=torch.int64),
        closure=SimpleNamespace(closed=0, loops=0, drift_before_rad=0.0, drift_after_rad=0.0),
        rounds=[SimpleNamespace(moved_rad=0.0)],
        arrived=True,
        valid=torch.tensor([True, True, False, True, True, True]),
        fitted=torch.ones(6, dtype=torch.bool),
        position_lab_mm=position,
        paint=torch.ones(6, 1),
        jumps=torch.tensor([4]),
    )
    track = Trajectory.empty(np.arange(20, 26) / 100.0, cameras=("cam1",), frame_rate=100.0)
    print_map(SimpleNamespace(learnt=learnt, track=track))
    output = capsys.readouterr().out
    assert "too little: frames 22\n" in output
    assert "jumps at 1 frames: 24\n" in output


@pytest.mark.slow
def test_unknown_paint_of_an_old_map_spoils_nothing_of_the_new_one(copy):
    """Before: one unknown texel in a tensor made the whole map unknown; a file's were taken for grey paint."""
    folder = copy.parent
    true = load_texture(folder / "texture.png")
    old = torch.where(map_directions(len(true))[..., 2] > 0.5, torch.nan, true)
    with writing(force=False):
        write_texture(old, folder / "old.png")
        write_seen(old.isfinite().long(), folder / "old.png")
    rewrite(copy, frames=[0, 12])
    quick = Settings(paint=MapSettings(rounds=1, pixels=400, height=64))
    maps = [learn_map(copy, quick, init=init) for init in (old, folder / "old.png")]
    for one in maps:
        assert bool(one.texture[one.seen > 0].isfinite().all())
        assert compare_maps(one.texture, true).correlation > 0.8
        unknown = (one.seen == 0) & old.isnan()
        assert 0.01 < float(unknown.float().mean()) < 0.5
        assert float(one.texture[unknown].isnan().float().mean()) > 0.9
