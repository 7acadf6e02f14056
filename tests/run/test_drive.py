"""Workers: same bytes as one process, failures stay with their experiment, the dead are replaced."""

import os
import shutil
import signal
import threading
import time
from pathlib import Path

import pytest
from run_examples import EXCERPT, SHORT, SHORT_BLOCKS, datasets, run

from sphereorient.errors import SettingsError
from sphereorient.methods.settings import Settings, load_settings
from sphereorient.run import Request, run_many
from sphereorient.run.many import ProcessExecutor, dask_executor, tracks_of


@pytest.fixture(scope="module")
def settings() -> Settings:
    return load_settings(None, SHORT)


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> dict[str, tuple[str, tuple[int, ...], bytes]]:
    """The excerpt tracked by one process."""
    out = tmp_path_factory.mktemp("alone") / "track.h5"
    ended = run(EXCERPT, "--out", out, "-q", *SHORT_BLOCKS)
    assert ended.returncode == 0, ended.stderr
    return datasets(out)


def broken(folder: Path) -> Path:
    """An experiment whose texture is none."""
    shutil.copytree(EXCERPT.parent, folder)
    (folder / "texture.png").write_bytes(b"no picture")
    return folder / "experiment.yaml"


def test_tracks_of_several_experiments_have_the_names_of_their_folders(tmp_path):
    one, two, other = (tmp_path / name for name in ("a/experiment.yaml", "b/experiment.yaml", "b/second.yaml"))
    out = tmp_path / "out"
    assert tracks_of([one], out / "t.h5") == [out / "t.h5"]
    assert tracks_of([one, two], out) == [out / "a.h5", out / "b.h5"]
    assert tracks_of([one, two, other], out) == [out / f"{n}.h5" for n in ("a-experiment", "b-experiment", "b-second")]


def test_one_track_for_two_experiments_is_refused(tmp_path, settings):
    request = Request(experiment=EXCERPT, out=tmp_path / "track.h5", settings=settings)
    with pytest.raises(SettingsError, match="track for each"):
        run_many([request, request], ProcessExecutor(1))


@pytest.mark.slow
def test_two_workers_give_the_bytes_of_one(tmp_path, alone):
    out = tmp_path / "track.h5"
    ended = run(EXCERPT, "--out", out, "--jobs", 2, *SHORT_BLOCKS)
    assert ended.returncode == 0, ended.stderr
    assert datasets(out) == alone
    assert not out.with_name("track.h5.parts").exists()


@pytest.mark.slow
def test_an_experiment_that_fails_does_not_stop_the_others(tmp_path, alone):
    bad, good = broken(tmp_path / "bad"), tmp_path / "good"
    shutil.copytree(EXCERPT.parent, good)
    out = tmp_path / "out"
    out.mkdir()
    ended = run(bad, tmp_path / "none" / "experiment.yaml", good / "experiment.yaml", "-o", out, "-j", 2, *SHORT_BLOCKS)
    assert ended.returncode == 1
    assert datasets(out / "good.h5") == alone
    lines = ended.stderr.splitlines()
    assert [line.split(":")[1].strip() for line in lines if line.startswith("sphereorient")] == ["bad", "none"]
    assert "Traceback" not in ended.stderr
    assert "40" in ended.stdout
    assert "failed" in ended.stdout
    assert not (out / "bad.h5").exists()


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced_and_its_experiment_goes_on(tmp_path, settings, alone):
    """Killed after the first window: finished windows are not computed again."""
    request = Request(experiment=EXCERPT, out=tmp_path / "track.h5", settings=settings)
    executor = ProcessExecutor(1)
    killed: list[tuple[int, set[str]]] = []

    def kill() -> None:
        deadline = time.monotonic() + 100
        while time.monotonic() < deadline:
            there = {path.name for path in request.parts.glob("poses-*")} if request.parts.exists() else set()
            if there:
                (pid,) = executor.workers[0]._processes
                os.kill(pid, signal.SIGKILL)
                killed.append((pid, there))
                return
            time.sleep(0.005)

    killer = threading.Thread(target=kill)
    killer.start()
    (outcome,) = run_many([request], executor)
    killer.join()
    assert len(killed) == 1
    assert outcome.error is None
    assert (outcome.frames, outcome.valid) == (40, 40)
    assert datasets(request.out) == alone


@pytest.mark.slow
def test_an_experiment_that_kills_every_worker_is_given_up(tmp_path, settings):
    request = Request(experiment=EXCERPT, out=tmp_path / "track.h5", settings=settings)
    executor = ProcessExecutor(1)
    stop = threading.Event()

    def kill() -> None:
        while not stop.wait(0.05):
            for pid in list(executor.workers[0]._processes or {}):
                os.kill(pid, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    (outcome,) = run_many([request], executor)
    stop.set()
    killer.join()
    assert outcome.error is not None
    assert "worker 0 died 3 times" in outcome.error
    assert "\n" not in outcome.error
    assert not request.out.exists()


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same_bytes_and_survives_a_dead_worker(tmp_path, settings, alone):
    pytest.importorskip("distributed", exc_type=ImportError)
    bad = broken(tmp_path / "bad")
    requests = [
        Request(experiment=experiment, out=tmp_path / f"{name}.h5", settings=settings)
        for name, experiment in (("good", EXCERPT), ("bad", bad))
    ]
    executor = dask_executor("local", 2)
    assert executor.size == 2
    killed: list[int] = []

    def kill() -> None:
        deadline = time.monotonic() + 100
        while time.monotonic() < deadline and not killed:
            if requests[0].parts.exists() and list(requests[0].parts.glob("poses-*")):
                nanny = next(iter(executor.cluster.workers.values()))
                os.kill(nanny.pid, signal.SIGKILL)
                killed.append(nanny.pid)
            time.sleep(0.005)

    killer = threading.Thread(target=kill)
    killer.start()
    good, failed = run_many(requests, executor)
    killer.join()
    assert killed
    assert good.error is None
    assert datasets(requests[0].out) == alone
    assert failed.error is not None
    assert "texture.png" in failed.error


def test_a_cluster_that_is_not_there_is_one_line():
    pytest.importorskip("distributed", exc_type=ImportError)
    with pytest.raises(SettingsError, match=r"Dask scheduler.*docs/long-runs\.md") as refused:
        dask_executor("nonsense://nowhere")
    assert "\n" not in str(refused.value)
