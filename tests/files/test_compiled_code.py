"""Compiled code is used where it was built for this machine and is of this version; else there is none."""

from __future__ import annotations

import ctypes

import pytest

from sphereorient.files.compiled import WITHOUT, built_for, compiled, compiled_parts
from sphereorient.pose.compiled import SOURCE, Near


class Longer(ctypes.Structure):
    _fields_ = [*Near._fields_, ("more", ctypes.c_int64)]


@pytest.mark.skipif(compiled(SOURCE, Near) is None, reason="needs compiled code: `make setup` with a compiler")
def test_code_of_another_version_is_not_called():
    assert built_for(SOURCE, Near, "default") is not None
    assert built_for(SOURCE, Longer, "default") is None


def test_there_is_none_where_nothing_was_built_or_the_file_is_no_library(tmp_path, monkeypatch):
    assert built_for(tmp_path / "refine", Near, "default") is None
    (tmp_path / "refine.default.compiled").write_bytes(b"no library")
    assert built_for(tmp_path / "refine", Near, "default") is None
    monkeypatch.setenv(WITHOUT, "1")
    assert compiled(tmp_path / "other", Near) is None


def test_code_that_does_not_load_is_reported_with_its_file_and_absent_code_is_none(tmp_path):
    source = tmp_path / "so3.c"
    source.write_bytes(SOURCE.parents[1].joinpath("so3.c").read_bytes())
    assert compiled_parts(tmp_path) == ({"so3": "torch: slower"}, [])
    (tmp_path / "so3.default.compiled").write_bytes(b"no library")
    used, (fault,) = compiled_parts(tmp_path)
    assert used == {"so3": "torch: slower"}
    assert fault.startswith(f"{tmp_path / 'so3.default.compiled'}: expected code that loads")


@pytest.mark.skipif(compiled(SOURCE, Near) is None, reason="needs compiled code: `make setup` with a compiler")
def test_code_in_use_is_named_by_its_instructions(monkeypatch):
    used, faults = compiled_parts()
    assert set(used) == {"so3", "texture_table", "refine", "paint_cells", "kalman"}
    assert set(used.values()) <= {"avx512", "avx2", "default"}
    assert faults == []
    monkeypatch.setenv(WITHOUT, "1")
    assert set(compiled_parts()[0].values()) == {"torch: slower"}
