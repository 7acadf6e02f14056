"""Each tutorial runs from its first line to its last and asserts its own statements."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPO

TUTORIALS = sorted((REPO / "docs" / "tutorials").glob("*.py"))


@pytest.mark.slow  # two of them learn a map
@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_runs(path: Path, tmp_path: Path):
    result = subprocess.run(
        [sys.executable, str(path)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=900,
        env=os.environ | {"MPLBACKEND": "agg"},
    )
    assert result.returncode == 0, result.stderr
    assert not list(tmp_path.iterdir())  # it leaves nothing behind


def test_every_page_of_the_site_exists_and_every_page_is_in_it():
    nav = (REPO / "mkdocs.yml").read_text().partition("\nnav:\n")[2]
    named = set(re.findall(r"[\w/-]+\.(?:md|py)$", nav, re.MULTILINE))
    docs = REPO / "docs"
    assert named == {path.relative_to(docs).as_posix() for path in docs.rglob("*") if path.suffix in (".md", ".py")}
