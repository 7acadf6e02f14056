"""Several balls in overlay, report, export and recording: each at its position, nearer first, under its name."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from experiment_file import write_experiment
from overlay_examples import RADIUS_MM, command, excerpt, true_track

from sphereorient.errors import ExperimentError
from sphereorient.experiment import Experiment
from sphereorient.report.build import match_experiments, surroundings_of
from sphereorient.report.overlay import pictures_by_row, prepared
from sphereorient.report.overlay_model import outline_px
from sphereorient.report.overlay_page import OUTLINE, rendered
from sphereorient.trajectory import Tracks, Trajectory

K = 20  # a frame


def several(**sizes: float) -> Experiment:
    """The excerpt with balls of these diameters, all with its texture."""
    known = excerpt()
    return replace(known, spheres=tuple(replace(known.sphere, name=n, diameter_mm=mm) for n, mm in sizes.items()))


def moved(track: Trajectory, by_mm: np.ndarray) -> Trajectory:
    """The track of a ball that is elsewhere."""
    cameras = {}
    for name, seen in track.cameras.items():
        centre = excerpt().cameras[name].project(torch.from_numpy(track.position + by_mm)).numpy()
        cameras[name] = replace(seen, centre_px=centre)
    position = track.position + by_mm
    return replace(track, position=position, position_smooth=position, cameras=cameras)


@pytest.fixture(scope="module")
def tracks() -> Tracks:
    """A ball a, and a ball b half a diameter to its right and behind it, for the first camera."""
    across, _, ahead = excerpt().cameras["cam1"].R_cam_lab.numpy()
    track = true_track()
    return Tracks({"a": track, "b": moved(track, RADIUS_MM * across + 2.5 * RADIUS_MM * ahead)})


@pytest.fixture(scope="module")
def scene(tracks):
    with ExitStack() as opened:
        page, streams = prepared(tracks, several(a=18.0, b=18.0), None, opened)
        _, pictures = next(pictures_by_row(streams, np.array([K])))
        yield page, pictures


def test_every_ball_is_outlined_in_the_frame_of_a_camera(scene):
    page, pictures = scene
    drawn = page.draw(K, pictures)
    assert [side % 2 for side in drawn.shape[:2]] == [0, 0]
    scale = 440 / excerpt().cameras["cam1"].image_size[1]
    for one in page.balls:
        view = one.views[0]
        around = outline_px(view.model.camera, view.model.path, K)
        at = np.round((around + 0.5) * scale - 0.5 + [10, 62]).astype(int)  # the frame's corner on the page
        near = np.abs(drawn[at[:, 1], at[:, 0]].astype(int) - OUTLINE).max(1) < 120
        assert near.mean() > 0.5, one.track.sphere


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_nearer_ball_hides_a_farther_one_in_whatever_order_they_are_given(scene, order):
    page, _ = scene
    near, far = (one.views[0] for one in page.balls)
    assert near.depth_mm(K) < far.depth_mm(K)
    window = far.window(page.balls[1].track.cameras["cam1"], K)
    both = rendered([(near, far)[k] for k in order], K, None, window)
    front, back = rendered([near], K, None, window), rendered([far], K, None, window)
    inside = np.isfinite(front)
    assert 0.05 < inside[np.isfinite(back)].mean() < 0.95
    np.testing.assert_array_equal(both[inside], front[inside])
    np.testing.assert_array_equal(both[~inside], back[~inside])


def test_each_track_of_a_report_gets_its_ball_of_the_experiment(tracks):
    named = {f"track.h5:{name}": track for name, track in tracks.items()}
    found = match_experiments(named, [several(a=18.0, b=14.0)])
    assert {name: one.diameter_mm for name, one in found.items() if one} == {"track.h5:a": 18.0, "track.h5:b": 14.0}
    assert surroundings_of([one for one in found.values() if one]).diameter_mm is None  # they differ
    same = match_experiments(named, [several(a=18.0, b=18.0)])
    assert surroundings_of([one for one in same.values() if one]).diameter_mm == 18.0
    with pytest.raises(ExperimentError, match="a, c, got 'b'"):
        match_experiments(named, [several(a=18.0, c=18.0)])
    with pytest.raises(ExperimentError, match="one without name"):
        match_experiments(named, [excerpt()])


def test_a_table_is_written_of_each_ball_or_of_the_one_that_is_picked(tracks, tmp_path, monkeypatch, capsys):
    tracks.save(tmp_path / "track.h5")
    code, out, err = command(monkeypatch, capsys, "export", tmp_path / "track.h5", "--out", tmp_path / "t.csv")
    assert code == 0, err
    assert "t_a.csv: 40 frames" in out
    assert "# sphere: b\n" in (tmp_path / "t_b.csv").read_text()
    assert not (tmp_path / "t.csv").exists()
    picked = ("export", tmp_path / "track.h5", "--sphere", "b", "--out", tmp_path / "p.csv")
    assert command(monkeypatch, capsys, *picked)[0] == 0
    assert (tmp_path / "p_b.csv").read_bytes() == (tmp_path / "t_b.csv").read_bytes()
    code, _, err = command(monkeypatch, capsys, *picked[:3], "q", *picked[4:])
    assert (code, err) == (2, "sphereorient: --sphere: expected a, b, got 'q'; name one of these.\n")


@pytest.mark.slow
def test_the_report_of_a_file_has_a_part_for_each_ball(tracks, tmp_path, monkeypatch, capsys):
    tracks.save(tmp_path / "track.h5")
    code, _, err = command(monkeypatch, capsys, "report", tmp_path / "track.h5", "--out", tmp_path / "report", "-q")
    assert code == 0, err
    page = (tmp_path / "report" / "index.html").read_text(encoding="utf-8")
    assert "Motion of 2 spheres" in page
    assert "Path of track.h5:a, track.h5:b" in page
    assert {path.name for path in (tmp_path / "report" / "figures").glob("track*.png")} == {"track.png", "track_2.png"}


@pytest.mark.slow
def test_the_overlay_of_several_balls_is_one_movie_and_a_sheet_each(tracks, tmp_path, monkeypatch, capsys):
    tracks.save(tmp_path / "track.h5")
    path = write_experiment(replace(several(a=18.0, b=18.0), path=tmp_path / "experiment.yaml"))
    options = ("--out", tmp_path / "o.mp4", "--worst", tmp_path / "w.png", "--count", 2, "--frames", "3:5", "-q")
    code, _, err = command(monkeypatch, capsys, "overlay", path, tmp_path / "track.h5", *options)
    assert code == 0, err
    assert sorted(one.name for one in Path(tmp_path).glob("[ow]*")) == ["o.mp4", "w_a.png", "w_b.png"]
