"""Files that the commands replace, and their message where memory is short."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import REPO
from overlay_examples import true_track

from sphereorient.cli import main
from sphereorient.cli.app import OUTPUTS, app
from sphereorient.files.picture import write_picture
from sphereorient.files.whole_file import has_mark
from sphereorient.movies import write_movie

EXCERPT = REPO / "synthetic_data" / "excerpt"


@pytest.fixture
def command(monkeypatch, capsys):
    """Run a command in this process; return its exit code and the lines of its errors."""

    def run(*words: object) -> tuple[int, list[str]]:
        monkeypatch.setattr(sys, "argv", ["sphereorient", *map(str, words)])
        with pytest.raises(SystemExit) as stopped:
            main()
        return int(stopped.value.code or 0), capsys.readouterr().err.splitlines()

    return run


@pytest.fixture
def place(tmp_path) -> Path:
    """The excerpt with a map and a background that this program made, and a track of it."""
    folder = tmp_path / "excerpt"
    shutil.copytree(EXCERPT, folder)
    write_picture(folder / "marked.png", np.eye(16, 32, dtype=np.uint8) * 200)
    text = (folder / "experiment.yaml").read_text()
    (folder / "marked.yaml").write_text(text.replace("texture.png", "marked.png"))
    true_track().save(folder / "track.h5")
    for path in folder.iterdir():
        os.utime(path, (1, 1))  # changed since this process wrote it
    return folder


def state(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# Before: exit code 0, and the file was gone, in every one of these.
@pytest.mark.parametrize("force", [(), ("--force",)])
@pytest.mark.parametrize(
    ("words", "got"),
    [
        ("export track.h5 --to csv --out track.h5", "an input"),
        ("overlay marked.yaml track.h5 --worst marked.png", "an input"),
        ("check marked.yaml --out marked.png", "an input"),
        ("compare-maps marked.png texture.png --out marked.png", "an input"),
        ("track experiment.yaml --out track.h5 --learnt track.h5", "an input"),
        ("track marked.yaml --out marked.png", "an input"),
        ("map experiment.yaml --init marked.png --out marked.png", "an input"),
        ("calibrate cameras.yaml --refine-with track.h5 --out cameras.yaml", "an input"),
        ("convert cam1.mkv cam1.mkv", "an input"),
        ("convert-cameras cameras.yaml --out cameras.yaml", "an input"),
        ("report track.h5 --out . -q", "other files in it"),
    ],
)
def test_an_input_is_never_replaced(command, place, monkeypatch, words, got, force):
    monkeypatch.chdir(place)
    before = state(place)
    code, errors = command(*words.split(), *force)
    assert code == 2
    assert len(errors) == 1, errors
    assert f"got {got}" in errors[0]
    assert state(place) == before


@pytest.mark.parametrize("name", ["experiment.yaml", "cam1.mkv", "truth.h5", "texture.png", "card.json"])
def test_a_file_of_others_is_not_replaced_by_a_table(command, place, name):
    """Before: `export` put a table in the place of the experiment and of a movie, exit code 0."""
    before = state(place)
    code, errors = command("export", place / "track.h5", "--to", "csv", "--out", place / name)
    assert code == 2
    assert len(errors) == 1
    assert "without its mark" in errors[0]
    assert state(place) == before
    assert command("export", place / "track.h5", "--to", "csv", "--out", place / name, "--force", "-q") == (0, [])
    assert has_mark(place / name)
    os.utime(place / name, (1, 1))
    assert command("export", place / "track.h5", "--to", "csv", "--out", place / name, "-q") == (0, [])


def test_a_map_takes_the_place_of_the_texture_that_it_makes(command, place, monkeypatch):
    """`map` reads no texture: it may write again what `texture:` names, but no other input."""
    monkeypatch.chdir(place)
    words = ("map", "marked.yaml", "--set", "paint.round=3", "--out")
    assert "write 'rounds'" in command(*words, "marked.png")[1][0]  # the fault of the settings comes next
    write_picture(place / "background.png", np.eye(16, 32, dtype=np.uint8))
    (place / "marked.yaml").write_text((place / "marked.yaml").read_text().replace("empty_cam1.png", "background.png"))
    assert "got an input" in command(*words, "background.png")[1][0]


def test_movies_are_marked_where_their_format_can_be(place, tmp_path):
    frames = np.arange(200, dtype=np.uint8).reshape(2, 10, 10)
    write_movie(tmp_path / "a.h5", frames)
    write_movie(tmp_path / "a.mkv", frames)
    assert has_mark(tmp_path / "a.h5")
    assert not has_mark(tmp_path / "a.mkv")


def test_every_command_that_writes_has_force():
    from typer.main import get_command

    found, left = {}, [get_command(app)]
    while left:
        one = left.pop()
        left += getattr(one, "commands", {}).values()
        found[one.name] = {parameter.name for parameter in one.params}
    writing = {name for name, parameters in found.items() if parameters & OUTPUTS}
    assert {"track", "export", "convert", "overlay", "design", "robustness", "settings"} <= writing
    assert {name for name, parameters in found.items() if "force" in parameters} == writing


@pytest.mark.parametrize(
    "ask",
    [
        lambda: np.empty(1 << 50),
        lambda: torch.empty(1 << 50),
        lambda: bytes(1 << 60),
        lambda: (_ for _ in ()).throw(RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 8")),
    ],
    ids=["numpy", "torch", "python", "torch on Windows"],
)
def test_missing_memory_is_refused_in_one_line(command, monkeypatch, ask):
    """Before: a traceback and exit code 1; so `track` of the excerpt with 1.3 GB (ulimit -v 1300000)."""
    monkeypatch.setattr("sphereorient.files.provenance.versions", lambda: ask() and {})
    code, errors = command("doctor")
    assert code == 2
    assert len(errors) == 1
    assert errors[0].startswith("sphereorient: memory: ")
    assert "fewer --jobs" in errors[0]


def test_other_errors_keep_their_traceback(monkeypatch):
    monkeypatch.setattr("sphereorient.files.provenance.versions", lambda: {}["a key"])
    monkeypatch.setattr(sys, "argv", ["sphereorient", "doctor"])
    with pytest.raises(KeyError, match="a key"):
        main()


def test_folders_of_an_output_are_made(command, tmp_path):
    assert command("settings", "--out", tmp_path / "new" / "one" / "settings.yaml") == (0, [])
    assert (tmp_path / "new" / "one" / "settings.yaml").is_file()
