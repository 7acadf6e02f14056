"""Results appear whole or not at all, and the old file stays otherwise."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sphereorient.errors import OutputError
from sphereorient.files.hdf5 import GuardedFile
from sphereorient.files.whole_file import put_aside, write_text
from sphereorient.files.yaml_file import read_yaml, write_document


def test_a_file_takes_its_place_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")
    with put_aside(path) as aside:
        aside.write_text("new")
        assert path.read_text() == "old"
        assert aside.suffix == path.suffix
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyError("other")])
def test_after_an_error_the_old_file_is_kept(tmp_path: Path, error: Exception) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")
    wanted = OutputError if isinstance(error, OSError) else KeyError

    def fail() -> None:
        with put_aside(path) as aside:
            aside.write_text("new")
            raise error

    with pytest.raises(wanted):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_writes_after_an_error_are_ignored_and_the_error_is_kept(tmp_path: Path) -> None:
    with GuardedFile(tmp_path / "a") as guarded:
        assert guarded.write(b"abc") == 3
        guarded.check()
        os.close(guarded.fileno())  # the disk is gone
        assert guarded.write(b"def") == 3
        assert guarded.truncate(1) == 1
        with pytest.raises(OSError, match="Bad file descriptor"):
            guarded.check()
        os.dup2(os.open(tmp_path / "a", os.O_RDWR), guarded.fileno())  # so that it can be closed
    assert (tmp_path / "a").read_bytes() == b"abc"


def test_a_document_can_be_read_by_others(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    write_document(path, "sphereorient-test/1", {"small": 1.0e-7}, "two\nlines")
    assert path.read_text().startswith("# made by sphereorient\n# two\n# lines\n{schema: sphereorient-test/1")
    assert read_yaml(path, OutputError)["small"] == 1.0e-7
    umask = os.umask(0)
    os.umask(umask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask
    write_document(tmp_path / "new" / "a.yaml", "sphereorient-test/1", {})
    assert (tmp_path / "new" / "a.yaml").is_file()
    with pytest.raises(OutputError, match="Not a directory"):
        write_document(path / "a.yaml", "sphereorient-test/1", {})
