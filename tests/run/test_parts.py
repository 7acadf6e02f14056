import json
import multiprocessing
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from excerpt_examples import EXCERPT

from sphereorient.cameras.parameters import with_parameters
from sphereorient.cameras.response import Response
from sphereorient.errors import OutputError, TrackError
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.files.hdf5 import digest
from sphereorient.follow.follower import Batch
from sphereorient.methods.method import read_poses
from sphereorient.methods.settings import load_settings
from sphereorient.pose.poses import Poses, blank_parts
from sphereorient.run import FolderStore, Request
from sphereorient.run.store import fingerprint
from sphereorient.trajectory import Reason

BATCH = Batch(first=0, last=3, lengths=(3,))


def request_to(out: Path, **changed: object) -> Request:
    return Request(experiment=EXCERPT / "experiment.yaml", out=out, settings=load_settings(None, []), **changed)


@pytest.fixture
def store(tmp_path) -> FolderStore:
    """Three frames of two poses each, kept."""
    request = request_to(tmp_path / "track.h5")
    store = FolderStore(request.parts)
    parts = blank_parts(2, 2)
    one = Poses(**parts, use=torch.ones(2, dtype=torch.bool), reason=(Reason.OK, Reason.OK))
    with store.held(request, resume=False):
        store.write(BATCH, {"": [one] * 3})
    return store


def test_a_folder_of_the_users_is_refused_and_stays(tmp_path):
    """Before: deleted with its contents, without a look at whose it is."""
    request = request_to(tmp_path / "track.h5")
    request.parts.mkdir()
    (request.parts / "thesis.txt").write_text("years of work")
    (request.parts / "run.json").write_text('{"my": "own"}')
    for resume in (False, True):
        store = FolderStore(request.parts)
        with (
            pytest.raises(OutputError, match="got another folder") as refused,
            store.held(request, resume=resume),
        ):
            pass
        assert "\n" not in str(refused.value)
        store.remove()
    assert {path.name for path in request.parts.iterdir()} == {"thesis.txt", "run.json"}


def test_files_of_others_stay_when_the_folder_of_a_run_is_emptied(store, tmp_path):
    (store.folder / "notes.txt").write_text("mine")
    with store.held(request_to(tmp_path / "track.h5"), resume=False):
        assert store.missing([BATCH]) == [BATCH]
    assert [path.name for path in store.folder.iterdir() if path.name not in ("lock", "process")] == ["notes.txt"]
    (store.folder / "notes.txt").unlink()
    with store.held(request_to(tmp_path / "track.h5"), resume=False):
        pass
    assert not store.folder.exists()


def test_parts_come_back_as_they_were(store):
    (one, _, _) = store.read(BATCH)[""]
    assert torch.equal(one.R_lab_body, torch.eye(3, dtype=torch.float64).expand(2, 3, 3))
    assert one.use.tolist() == [True, True]


def test_parts_of_several_balls_come_back_by_name(store, tmp_path):
    (one, *_) = store.read(BATCH)[""]
    with store.held(request_to(tmp_path / "track.h5"), resume=False):
        single = Poses(**blank_parts(2, 1), use=one.use, reason=one.reason)
        store.write(BATCH, {"a": [one] * 3, "b": [single] * 3})
        found = store.read(BATCH)
    assert list(found) == ["a", "b"]
    assert [len(poses) for poses in found["a"] + found["b"]] == [2, 2, 2, 1, 1, 1]


def damage(path: Path, name: str, values: object, *, sealed: bool) -> None:
    with h5py.File(path, "r+") as file:
        file[name][0] = values
        if sealed:
            file.attrs["sha256"] = digest(file)


@pytest.mark.parametrize(
    ("name", "values", "sealed"),
    [
        ("position_lab_mm", np.nan, False),
        ("score", 0.5, False),
        ("use", False, False),
        ("R_lab_body", np.nan, True),
        ("R_lab_body", 2 * np.eye(3), True),
        ("R_lab_body", -np.eye(3), True),
        ("count", 99, True),
    ],
)
def test_a_damaged_part_is_measured_again(store, name, values, sealed):
    """Before: TypeError or IndexError on every try; -I and 2 I were taken over as rotations."""
    damage(store.poses(BATCH), name, values, sealed=sealed)
    assert read_poses(store.poses(BATCH)) is None
    with pytest.raises(TrackError, match="a damaged file"):
        store.read(BATCH)
    assert store.missing([BATCH]) == [BATCH]


def test_parts_of_another_run_are_refused_with_what_differs(store, tmp_path):
    of_one = request_to(tmp_path / "track.h5", cameras=("cam1",))
    with (
        pytest.raises(TrackError, match=r"another cam2\.mkv, cameras, empty_cam2\.png;"),
        store.held(of_one, resume=True),
    ):
        pass
    saved = json.loads((store.folder / "run.json").read_text())
    (store.folder / "run.json").write_text(json.dumps(saved | {"cam1.mkv": "12 34"}))
    request = request_to(tmp_path / "track.h5")
    with pytest.raises(TrackError, match=r"with another cam1\.mkv;"), store.held(request, resume=True):
        pass


def test_two_runs_do_not_write_one_track(store, tmp_path):
    request = request_to(tmp_path / "track.h5")
    with store.held(request, resume=True):
        with pytest.raises(OutputError, match="another run"), FolderStore(store.folder).held(request, resume=True):
            pass
        assert store.missing([BATCH]) == []


def _hold(out: Path, held: object, done: object) -> None:
    request = request_to(out)
    with FolderStore(request.parts).held(request, resume=False):
        held.set()
        done.wait(60)


@pytest.mark.slow
def test_another_process_cannot_write_the_same_track(tmp_path):
    context = multiprocessing.get_context("spawn")
    held, done = context.Event(), context.Event()
    other = context.Process(target=_hold, args=(tmp_path / "track.h5", held, done))
    other.start()
    try:
        assert held.wait(60)
        request = request_to(tmp_path / "track.h5")
        with (
            pytest.raises(OutputError, match=rf"another run \(process {other.pid}\)"),
            FolderStore(request.parts).held(request, resume=False),
        ):
            pass
    finally:
        done.set()
        other.join(60)
    assert other.exitcode == 0
    assert not request.parts.exists()


CHANGES = {
    "frames": lambda old: replace(old, frames=(8, 16)),
    "rate": lambda old: replace(old, frame_rate_hz=599.0),
    "start": lambda old: replace(old, start={"cam1": 1, "cam2": 0}),
    "response": lambda old: replace(old, response={"cam1": Response(gamma=2.2)}),
    "diameter": lambda old: old.with_sphere(diameter_mm=18.0001),
    "camera": lambda old: replace(
        old, cameras=old.cameras | {"cam1": with_parameters(old.cameras["cam1"], ["T_x"], torch.tensor([1e-5]))}
    ),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_an_experiment_changed_in_python_is_another_run(tmp_path, change):
    """Before: the text of its file counted alone; poses of other frames went into the track."""
    old = load_experiment(EXCERPT / "experiment.yaml")
    kept, same, other = (
        fingerprint(replace(request_to(tmp_path / "track.h5"), experiment=one))
        for one in (EXCERPT / "experiment.yaml", old, change(old))
    )
    assert same == kept
    assert other != kept


def test_the_same_experiment_by_another_path_is_the_same_run(tmp_path, monkeypatch):
    shutil.copytree(EXCERPT, tmp_path / "copy")
    path = tmp_path / "copy" / "experiment.yaml"
    count = len(open_movies(load_experiment(path))["cam1"])
    (tmp_path / "copy" / "times.csv").write_text("\n".join(f"{k / 600}" for k in range(count)))
    path.write_text(path.read_text().replace("frame_rate: 600.0", "times: times.csv"))
    assert load_experiment(path).times is not None
    monkeypatch.chdir(tmp_path)
    one, other = (
        fingerprint(replace(request_to(tmp_path / "track.h5"), experiment=given))
        for given in (path, Path("copy/experiment.yaml"))
    )
    assert one == other
