"""A killed run resumes, and its track is that of an uninterrupted run, to the last bit."""

import os
import random
import shutil
import signal
import subprocess
import time
from pathlib import Path

import h5py
import pytest
from excerpt_examples import shortened
from run_examples import COMMAND, EXCERPT, SHORT, SHORT_BLOCKS, datasets, run

from sphereorient.errors import TrackError
from sphereorient.files.hdf5 import digest
from sphereorient.methods.settings import load_settings
from sphereorient.run import FolderStore, Request
from sphereorient.run import run as run_request


@pytest.fixture(scope="module")
def request_of(tmp_path_factory):
    settings = load_settings(None, SHORT)
    experiment = shortened(tmp_path_factory.mktemp("excerpt") / "copy", 0, 16)

    def make(folder: Path, **changed: object) -> Request:
        return Request(experiment=experiment, out=folder / "track.h5", settings=settings, **changed)

    return make


@pytest.fixture(scope="module")
def whole(tmp_path_factory, request_of) -> Path:
    """An uninterrupted run, its appearance, and its parts halfway."""
    folder = tmp_path_factory.mktemp("whole")
    request = request_of(folder, save_learnt=folder / "learnt.h5")

    def keep(stage: str, done: int, total: int) -> None:
        if stage == "track" and 0 < done < total and not (folder / "half").exists():
            shutil.copytree(request.parts, folder / "half", ignore=shutil.ignore_patterns("lock"))

    tracked(request, progress=keep)
    assert not request.parts.exists()
    return folder


def tracked(request: Request, **more: object) -> None:
    """Track as the command does."""
    run_request(request, FolderStore(request.parts), **more)


def halfway(whole: Path, request: Request) -> FolderStore:
    """Put parts as an interrupted run leaves them."""
    shutil.copytree(whole / "half", request.parts)
    return FolderStore(request.parts)


@pytest.mark.slow
def test_a_run_goes_on_with_what_is_there(whole, tmp_path, request_of):
    request = request_of(tmp_path)
    parts = halfway(whole, request)
    before = {path.name: path.stat().st_mtime_ns for path in parts.folder.iterdir()}
    assert any(name.startswith("poses") for name in before)
    stages: list[tuple[str, int]] = []
    tracked(request, resume=True, progress=lambda stage, done, total: stages.append((stage, done)))
    assert "appearance" not in dict(stages)  # known from before
    assert stages[0] == ("track", 8 * sum(name.startswith("poses") for name in before))
    assert datasets(request.out) == datasets(whole / "track.h5")
    assert not request.parts.exists()


@pytest.mark.slow
def test_without_resume_it_starts_over(whole, tmp_path, request_of):
    request = request_of(tmp_path)
    halfway(whole, request)
    stages: list[str] = []
    tracked(request, progress=lambda stage, done, total: stages.append(stage))
    assert "appearance" in stages
    assert datasets(request.out) == datasets(whole / "track.h5")


@pytest.mark.slow
def test_parts_cut_off_while_written_are_measured_again(whole, tmp_path, request_of):
    request = request_of(tmp_path)
    parts = halfway(whole, request)
    (parts.folder / ".poses-00000016.h5.99.part").write_bytes(b"half of it")
    (parts.folder / "learnt.h5").write_bytes((parts.folder / "learnt.h5").read_bytes()[:5000])
    tracked(request, resume=True)
    assert datasets(request.out) == datasets(whole / "track.h5")


@pytest.mark.slow
def test_a_damaged_part_is_reported_and_measured_again_by_the_next_run(whole, tmp_path, request_of):
    request = request_of(tmp_path)
    parts = halfway(whole, request)
    (part,) = sorted(parts.folder.glob("poses-*"))[:1]
    part.write_bytes(part.read_bytes()[:1000])
    with pytest.raises(TrackError, match="a damaged file"):
        tracked(request, resume=True)
    assert not request.out.exists()
    tracked(request, resume=True)
    assert datasets(request.out) == datasets(whole / "track.h5")


@pytest.mark.slow
def test_a_kept_appearance_measures_the_same_again(whole, tmp_path, request_of):
    again = request_of(tmp_path, learnt=whole / "learnt.h5")
    tracked(again)
    assert datasets(again.out) == datasets(whole / "track.h5")


@pytest.mark.slow  # needs the run that learnt it
def test_knowledge_of_other_cameras_is_refused(whole, tmp_path, request_of):
    other = tmp_path / "other.h5"
    shutil.copy(whole / "learnt.h5", other)
    with h5py.File(other, "r+") as file:
        file.move("cameras/cam2", "cameras/left")
        file.attrs["cameras"] = ["cam1", "left"]
        file.attrs["sha256"] = digest(file)
    with pytest.raises(TrackError, match="learnt results of cam2"):
        tracked(request_of(tmp_path, learnt=other))


@pytest.mark.slow
def test_ten_kills_at_any_moment_leave_the_same_track(tmp_path):
    """kill -9 from the first import to the last write; each run resumes the one before."""
    clean = tmp_path / "clean.h5"
    begin = time.monotonic()
    assert run(EXCERPT, "--out", clean, "-q", *SHORT_BLOCKS).returncode == 0
    lasts = time.monotonic() - begin
    out, kills, draw = tmp_path / "track.h5", 0, random.Random(11)
    command = [*COMMAND, str(EXCERPT), "--out", str(out), "-q", "--resume", *SHORT_BLOCKS]
    expected = datasets(clean)
    while kills < 10:
        process = subprocess.Popen(command, stderr=subprocess.PIPE)
        try:
            process.wait(draw.uniform(0.2, 1.0) * lasts)
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            kills += 1
            assert not out.exists() or datasets(out) == expected
        else:
            assert process.returncode == 0, process.stderr.read().decode()
            assert datasets(out) == expected
            out.unlink()
    assert run(*command[len(COMMAND) :]).returncode == 0
    assert datasets(out) == expected
    # A kill while the track is written leaves a file of a random name.
    left = {path.name for path in tmp_path.iterdir() if not path.match(".track.*.partial.h5")}
    assert left == {"clean.h5", "track.h5"}
