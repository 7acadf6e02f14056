"""Figures of the docs: each page with numbers is named, tables go where they belong, and older ones are reported."""

from __future__ import annotations

import re
from pathlib import Path

import figures
import kept
import pytest
from conftest import REPO

# Pages whose tables hold numbers that were not measured: formats, sources, settings' meanings, lists of findings.
NOT_MEASURED = {
    "check.md", "data-format.md", "export.md", "model.md", "movies.md", "parameters.md", "degradations.md"
}  # fmt: skip


def test_each_page_with_numbers_is_named_in_figures_md():
    named = {page for figure in figures.FIGURES.values() for page in figure.pages}
    text = (REPO / "docs" / "figures.md").read_text()
    for page in sorted((REPO / "docs").glob("*.md")):
        rows = re.findall(r"^\|.*\d\.\d.*\|$", page.read_text(), re.MULTILINE)
        if len(rows) > 1 and page.name not in NOT_MEASURED | {"figures.md"}:
            assert page.name in named, page
            assert f"[{page.name}]" in text, page


def test_each_mark_is_one_pair_and_each_command_is_there():
    for name, figure in figures.FIGURES.items():
        program = figure.command.split()[0]
        assert program == "sphereorient" or (REPO / "scripts" / program).is_file(), name
        text = (REPO / "docs" / figure.pages[0]).read_text()
        for mark in figure.tables:
            assert len(re.findall(rf"<!-- figure {mark} -->\n\|.*?\|\n<!-- end {mark} -->", text, re.DOTALL)) == 1, mark
    marks = {
        mark for page in (REPO / "docs").glob("*.md") for mark in re.findall(r"<!-- figure (\S+) -->", page.read_text())
    }
    assert marks == {mark for figure in figures.FIGURES.values() for mark in figure.tables}


def test_a_table_goes_between_its_marks_and_nowhere_else(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("one\n<!-- figure a -->\n| old |\n<!-- end a -->\ntwo\n")
    (table,) = figures.tables_of("said\n| new | \\1 |\n|---|---|\n| 1 | 2 |\nmore\n")
    figures.insert(page, "a", table)
    assert page.read_text() == f"one\n<!-- figure a -->\n{table}\n<!-- end a -->\ntwo\n"
    with pytest.raises(RuntimeError, match="one pair of marks of figure b"):
        figures.insert(page, "b", table)


def test_the_page_of_figures_is_read_as_it_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "PAGE", tmp_path / "figures.md")
    monkeypatch.setattr(figures, "FIGURES", dict(list(figures.FIGURES.items())[:2]))
    name = next(iter(figures.FIGURES))
    made = figures.Made("2026-11-27", "abc1234", "12", figures.code_of(figures.FIGURES[name]))
    figures.write_page({name: made})
    rows = figures.rows()
    assert rows[name] == made
    assert set(rows) == set(figures.FIGURES)
    older = [line for line in figures.PAGE.read_text().splitlines() if "*older*" in line and line.startswith("|")]
    assert len(older) == len(figures.FIGURES) - 1


def test_code_is_the_same_but_for_what_it_does(tmp_path):
    def digest(text: str) -> str:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}" / "a.py"
        path.parent.mkdir()
        path.write_text(text)
        return kept.digest([path])

    plain = digest('"""Old."""\n\n\ndef f():\n    """Do."""\n    return 1\n')
    assert digest('"""New."""\n\n\ndef f():  # why\n    """Do it."""\n    return 1\n') == plain
    assert digest('"""Old."""\n\n\ndef f():\n    """Do."""\n    return 2\n') != plain
    assert kept.digest([], "a", 1) != kept.digest([], "a", 2)


def test_a_film_depends_on_synth_and_not_on_trackers():
    files = kept.code_of([REPO / "scripts" / "paper_movies.py"])
    rooms = {
        path.relative_to(REPO / "sphereorient").parts[0] for path in files if REPO / "sphereorient" in path.parents
    }
    assert {"synth", "sphere", "cameras", "movies"} <= rooms
    assert not rooms & {"pose", "follow", "search", "methods", "run"}
    assert REPO / "scripts" / "paper_movies.py" in files
    whole = kept.code_of([REPO / "scripts" / "reproduce_paper.py"])
    assert files < whole
    assert REPO / "sphereorient" / "pose" / "refine.c" in whole


def test_a_note_beside_a_file_is_read_back(tmp_path):
    made = tmp_path / "track.h5"
    assert kept.known(made) == {}
    kept.note(made, key="a", cpu_s=3.0)
    assert {"key": "a", "cpu_s": 3.0}.items() <= kept.known(made).items()
    kept.record_of(made).write_text("half a reco")
    assert kept.known(made) == {}
    assert kept.record_of(Path(tmp_path)).name == kept.RECORD
