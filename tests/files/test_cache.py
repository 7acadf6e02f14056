"""Kept arrays are the same or made again; never wrong; no fault of the folder ends a run."""

from __future__ import annotations

import os
import threading
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from sphereorient.files import cache
from sphereorient.files.cache import WITHOUT, cached
from sphereorient.methods.proposers import finest_table, precise_proposer
from sphereorient.methods.settings import Settings

ARRAYS = {"a": np.arange(5000.0), "b": np.array([1, 2], np.int8)}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv(WITHOUT)
    monkeypatch.setattr(cache.platformdirs, "user_cache_path", lambda *_, **__: tmp_path / "kept")
    cache.warn_once.cache_clear()
    return tmp_path / "kept"


class Maker:
    def __init__(self, arrays: dict = ARRAYS) -> None:
        self.made, self.arrays = 0, arrays

    def __call__(self) -> dict:
        self.made += 1
        return self.arrays


def assert_same(found) -> None:
    assert {name: array.dtype for name, array in found.items()} == {name: array.dtype for name, array in ARRAYS.items()}
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(found[name], array)


def test_arrays_are_made_once_for_the_same_inputs(folder: Path) -> None:
    make = Maker()
    inputs = torch.arange(4.0), "x", 0.5, None
    for _ in range(3):
        assert_same(cached("kind", inputs, make))
    assert make.made == 1
    assert not [path for path in folder.iterdir() if path.suffix != ".npz"]


@pytest.mark.parametrize(
    "others",
    [(torch.arange(5.0), 0.5), (torch.arange(4), 0.5), (torch.arange(4.0)[None], 0.5), (torch.arange(4.0), 0.5000001)],
    ids=["values", "dtype", "shape", "number"],
)
def test_other_inputs_are_not_taken_for_these(folder: Path, others: tuple) -> None:
    make = Maker()
    cached("kind", (torch.arange(4.0), 0.5), make)
    cached("kind", others, make)
    assert make.made == 2


def test_other_code_is_another_version(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = Maker()
    cached("kind", (), make)
    monkeypatch.setattr(cache, "_code", lambda: b"of another release")
    cached("kind", (), make)
    assert make.made == 2


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "text"])
def test_a_damaged_file_is_made_again_with_a_warning(folder: Path, damage: str) -> None:
    make = Maker()
    cached("kind", (), make)
    (path,) = folder.iterdir()
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes({"cut": bytes(content[:3000]), "flip": bytes(content), "empty": b"", "text": b"hello"}[damage])
    with pytest.warns(UserWarning, match="damaged"):
        assert_same(cached("kind", (), make))
    assert make.made == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_same(cached("kind", (), make))
    assert make.made == 2


def test_a_folder_that_cannot_be_written_is_warned_of_once(folder: Path) -> None:
    folder.write_text("a file")
    make = Maker()
    with pytest.warns(UserWarning, match="nothing is kept") as caught:
        found = [cached("kind", (), make) for _ in range(2)]
    assert_same(found[1])
    assert make.made == 2
    assert len([one for one in caught if "nothing is kept" in str(one.message)]) == 1


def test_without_the_cache_nothing_is_read_or_written(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(WITHOUT, "1")
    make = Maker()
    cached("kind", (), make)
    cached("kind", (), make)
    assert make.made == 2
    assert not folder.exists()


def test_the_least_recently_used_go_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "LARGEST_BYTES", 3 * 41_000)
    for k in range(3):
        cached("kind", (k,), Maker())
    files = {path: k for k, path in enumerate(sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime_ns))}
    for path, k in files.items():
        os.utime(path, ns=(k * 10**9, k * 10**9))
    make = Maker()
    cached("kind", (0,), make)  # used: now the youngest
    cached("kind", (3,), Maker())
    assert make.made == 0
    left = set(folder.iterdir())
    assert len(left) == 3
    assert {k for path, k in files.items() if path in left} == {0, 2}


def test_two_writers_leave_one_whole_file(folder: Path) -> None:
    barrier = threading.Barrier(2)

    def make() -> dict:
        barrier.wait()
        return ARRAYS

    threads = [threading.Thread(target=cached, args=("kind", (), make)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(list(folder.iterdir())) == 1
    assert_same(cached("kind", (), lambda: pytest.fail("made again")))


def test_table_and_search_are_the_same_from_the_cache(folder: Path) -> None:
    texture = torch.rand(32, 64, generator=torch.Generator().manual_seed(1))
    unseen = torch.zeros(32, 64, dtype=torch.bool)
    unseen[:8] = True
    settings = Settings()
    settings = settings.model_copy(update={"search": settings.search.model_copy(update={"step_deg": 30.0})})
    first, second = (finest_table(texture, 40.0, unseen) for _ in range(2))
    assert torch.equal(first.rows, second.rows)
    assert first.blur_rad == second.blur_rad
    assert first.unseen is not None
    assert second.unseen is not None
    assert torch.equal(first.unseen.rows, second.unseen.rows)
    found, again = (precise_proposer(texture, settings) for _ in range(2))
    size = found.size_px
    disks = torch.rand(2, size, size, generator=torch.Generator().manual_seed(2))
    assert torch.equal(found.score(disks), again.score(disks))
    assert torch.equal(found.propose(disks).R_view_body, again.propose(disks).R_view_body)
    assert {path.name.split("-")[0] for path in folder.iterdir()} == {"bank", "table"}
