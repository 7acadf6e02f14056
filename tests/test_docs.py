"""The docs say what is: examples run, tables are those of the code, tests named in them exist."""

from __future__ import annotations

import doctest
import re
import subprocess
import sys

import pytest
from conftest import REPO

DOCS = sorted([*REPO.glob("*.md"), *(REPO / "docs").glob("*.md")])


def test_the_examples_of_the_conventions_run():
    failed, tried = doctest.testfile(str(REPO / "docs" / "conventions.md"), module_relative=False)
    assert tried >= 20
    assert failed == 0


def test_parameters_and_configs_are_those_of_the_code():
    subprocess.run([sys.executable, REPO / "scripts" / "make_parameters.py", "--check"], check=True)


def test_every_test_that_the_paper_map_names_exists():
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", (REPO / "docs" / "paper-map.md").read_text())
    assert len(named) > 25
    for path, test in named:
        assert f"def {test}(" in (REPO / path).read_text(), f"{path}::{test}"


@pytest.mark.parametrize("page", DOCS, ids=lambda path: path.name)
def test_links_between_the_pages_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), f"{page.name} -> {target}"
