"""Compiled code is used where it was built for this machine and is of this version; else there is none."""

from __future__ import annotations

import ctypes

import pytest

from sphereorient.files.compiled import WITHOUT, built_for, compiled
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
