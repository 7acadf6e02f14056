"""Three cameras: a camera that contradicts the others is found by majority and reported by name."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from precise_examples import SMALL

from sphereorient import so3
from sphereorient.bench import score_track
from sphereorient.cameras import TsaiCamera, load_cameras, save_cameras
from sphereorient.movies import open_movie, write_ffv1
from sphereorient.run.stages import track_movies
from sphereorient.synth import SynthSettings, write_synthetic_experiment
from sphereorient.trajectory import Flag, Reason, Trajectory

pytestmark = pytest.mark.slow
FRAMES = 60
Change = Callable[[TsaiCamera], TsaiCamera]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("three")
    return write_synthetic_experiment(folder, SynthSettings(**SMALL | {"frames": FRAMES, "cameras": 3})).parent


def tracked(rendered: Path, tmp_path: Path, name: str = "", change: Change | None = None, **keys: object) -> Trajectory:
    """Track a copy of the experiment in which one camera of cameras.yaml, or a key, is another."""
    folder = tmp_path / "copy"
    if not folder.exists():
        shutil.copytree(rendered, folder)
    if change is not None:
        cameras = load_cameras(folder / "cameras.yaml")
        one = cameras[name]
        assert isinstance(one, TsaiCamera)
        save_cameras(folder / "cameras.yaml", cameras | {name: change(one)})
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | keys))
    return track_movies(path)


def reasons(track: Trajectory) -> dict[str, list[str]]:
    return {name: list(camera.reason) for name, camera in track.cameras.items()}


def only_blames(track: Trajectory, wrong: str, frames: slice = slice(None)) -> None:
    for name, why in reasons(track).items():
        expected = Reason.CONTRADICTS if name == wrong else Reason.OK
        assert set(why[frames]) == {expected}, name
    assert not (track.flags & (Flag.CONTRADICTION | Flag.ONE_CAMERA)).any()
    (remark,) = (text for text in track.provenance["remarks"] if "contradict" in text)
    assert wrong in remark
    assert not any(name in remark for name in track.cameras if name != wrong)


def test_three_cameras_are_better_than_two_of_them(rendered, tmp_path):
    truth = rendered / "truth.h5"
    three = score_track(tracked(rendered, tmp_path), truth)
    two = score_track(track_movies(tmp_path / "copy" / "experiment.yaml", cameras=["cam1", "cam2"]), truth)
    assert three.valid.all()
    assert three.percentiles_deg()[0] < two.percentiles_deg()[0]
    assert three.percentiles_mm()[0] < two.percentiles_mm()[0]


@pytest.mark.parametrize("name", ["cam1", "cam3"])
def test_a_moved_camera_is_left_out_and_reported(rendered, tmp_path, name):
    off = torch.tensor([1.5, 0.0, 0.0], dtype=torch.float64)
    track = tracked(rendered, tmp_path, name, lambda one: replace(one, T_cam_lab_mm=one.T_cam_lab_mm + off))
    only_blames(track, name)
    assert score_track(track, rendered / "truth.h5").percentiles_mm()[1] < 0.03


def test_a_turned_camera_is_left_out_and_reported(rendered, tmp_path):
    turn = so3.exp(torch.deg2rad(torch.tensor([0.8, 0.8, 0.8], dtype=torch.float64)))
    track = tracked(rendered, tmp_path, "cam2", lambda one: replace(one, R_cam_lab=one.R_cam_lab @ turn))
    only_blames(track, "cam2")
    assert score_track(track, rendered / "truth.h5").percentiles_deg()[1] < 0.15


def test_a_movie_out_of_step_is_left_out_and_reported(rendered, tmp_path):
    track = tracked(rendered, tmp_path, start={"cam1": 1})
    only_blames(track, "cam1", slice(FRAMES - 1))
    assert score_track(track, rendered / "truth.h5").percentiles_deg()[1] < 0.15


def test_where_one_camera_shows_other_frames_the_two_others_go_on_together(rendered, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(rendered, folder)
    with open_movie(rendered / "cam2.mkv") as movie:
        pictures = np.stack(list(movie.frames()))
    pictures[20:30] = pictures[30:20:-1]
    (folder / "cam2.mkv").unlink()
    write_ffv1(folder / "cam2.mkv", iter(pictures), 600.0)
    track = tracked(rendered, tmp_path)
    why = reasons(track)
    assert set(why["cam1"]) == set(why["cam3"]) == {Reason.OK}
    assert set(why["cam2"][20:25] + why["cam2"][26:30]) == {Reason.CONTRADICTS}  # 25 is in its place
    assert set(why["cam2"][:20] + why["cam2"][31:]) == {Reason.OK}
    assert not (track.flags & Flag.ONE_CAMERA).any()
    assert score_track(track, rendered / "truth.h5").percentiles_deg()[3] < 0.3
