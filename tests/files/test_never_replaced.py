"""No output takes the place of an input, a link, a device, or a file that this program did not make."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import h5py
import numpy as np
import pytest
from matplotlib.figure import Figure

from sphereorient.errors import OutputError
from sphereorient.files.hdf5 import whole_hdf5
from sphereorient.files.picture import decoded_grey, write_picture
from sphereorient.files.whole_file import check_target, has_mark, put_aside, unfinished, write_text, writing
from sphereorient.files.yaml_file import write_document
from sphereorient.report.plots.style import write_figure

HTML = "<!doctype html>\n"
OLD_CSV = "# experiment: tank\n# method: precise\n# frame_rate_hz: 600.0\n# cameras: []\ntime_s\n"


def hdf5(path: Path, **attributes: str) -> None:
    with h5py.File(path, "w") as file:
        file.attrs.update(attributes)


def whole_hdf5_of(path: Path) -> None:
    with whole_hdf5(path) as file:
        file["x"] = 1


def figure(path: Path) -> None:
    write_figure(Figure(figsize=(1, 1)), path)


OURS = {
    "track.h5": whole_hdf5_of,
    "old track.h5": lambda path: hdf5(path, schema="sphereorient-track/1"),
    "map.png": lambda path: write_picture(path, np.eye(9, dtype=np.uint8)),
    "figure.png": figure,
    "cameras.yaml": lambda path: write_document(path, "sphereorient-cameras/1", {}),
    "old cameras.yaml": lambda path: path.write_text("# X = R X + T, mm; made by sphereorient calibrate a\n"),
    "old repaired.yaml": lambda path: path.write_text("# repaired by sphereorient calibrate a --refine-with b\n"),
    "track.csv": lambda path: path.write_text("# made by sphereorient\n# experiment: x\ntime_s\n"),
    "old track.csv": lambda path: path.write_text(OLD_CSV),
    "page.md": lambda path: path.write_text("<!-- made by sphereorient -->\n# Page\n"),
    "page.html": lambda path: path.write_text(f'{HTML}<meta name="generator" content="made by sphereorient">'),
    "old page.html": lambda path: path.write_text(HTML + 9999 * " " + '<footer class="faint">sphereorient 0'),
    "spin.json": lambda path: path.write_text('{\n  "command": "sphereorient spin a",\n  "x": 1}'),
}
THEIRS = {
    "experiment.yaml": "schema: sphereorient-experiment/1\nname: x  # made by sphereorient\n",
    "experiment in braces.yaml": '{"schema": "sphereorient-experiment/1"}',
    "commented.yaml": "# my camera\n# the other one was made by sphereorient\n",
    "notes.txt": "made by sphereorient",
    "table.csv": "file,t_s\n",
    "movie.mkv": "\x1a\x45\xdf\xa3",
    "empty.h5": "",
    "damaged.h5": "\x89HDF\r\n\x1a\n and no more",
}


@pytest.mark.parametrize("name", OURS)
def test_a_file_with_our_mark_is_replaced(tmp_path, name):
    path = tmp_path / name
    OURS[name](path)
    os.utime(path, (1, 1))  # changed since this process wrote it: the mark alone decides
    assert has_mark(path)
    write_text(path, "new")
    assert path.read_text() == "new"


@pytest.mark.parametrize("name", THEIRS)
def test_a_file_of_others_stays_unless_forced(tmp_path, name):
    """Before: replaced, exit code 0; 8 of 8 were lost."""
    path = tmp_path / name
    path.write_bytes(THEIRS[name].encode("latin-1"))
    with pytest.raises(OutputError, match="without its mark"):
        write_text(path, "new")
    assert path.read_bytes() == THEIRS[name].encode("latin-1")
    with writing(force=True):
        write_text(path, "new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_pictures_with_the_mark_are_the_same_pictures(tmp_path):
    grey = np.arange(200, dtype=np.uint8).reshape(10, 20)
    write_picture(tmp_path / "a.png", grey)
    content = (tmp_path / "a.png").read_bytes()
    assert content.count(b"tEXtSoftware\0made by sphereorient") == 1
    np.testing.assert_array_equal(decoded_grey(content), grey)
    from PIL import Image

    with Image.open(tmp_path / "a.png") as picture:
        assert picture.text == {"Software": "made by sphereorient"}


@pytest.mark.parametrize("forced", [False, True])
def test_inputs_links_folders_and_devices_are_never_replaced(tmp_path, forced):
    """Before: an input, a pipe and a link were replaced by files, exit code 0."""
    write_document(tmp_path / "input.yaml", "sphereorient-cameras/1", {})  # with our mark
    os.link(tmp_path / "input.yaml", tmp_path / "same.yaml")
    (tmp_path / "link.yaml").symlink_to("input.yaml")
    (tmp_path / "to nothing.yaml").symlink_to("nothing")
    (tmp_path / "folder").mkdir()
    refused = {"input.yaml": "an input", "same.yaml": "an input", "link.yaml": "a link", "to nothing.yaml": "a link"}
    refused |= {"folder": "a folder"}
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        refused |= {"pipe": "a pipe, a socket or a device", "/dev/null": "a pipe, a socket or a device"}
    before = sorted(path.name for path in tmp_path.iterdir())
    with writing([tmp_path / "input.yaml", tmp_path / "not there"], force=forced):
        for name, got in refused.items():
            with pytest.raises(OutputError, match=f"got {got}"):
                write_text(tmp_path / name, "new")
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    write_text(tmp_path / "input.yaml", "new")  # outside of the command


def test_a_linked_folder_is_followed(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    write_text(tmp_path / "link" / "a.txt", "x")
    assert (tmp_path / "real" / "a.txt").read_text() == "x"


def test_a_link_planted_under_the_unfinished_name_is_not_followed(tmp_path, monkeypatch):
    """Before: the name was .NAME.partial, and the file behind a link of that name was overwritten."""
    victim = tmp_path / "victim"
    victim.write_text("precious")
    for name in (".a.partial.txt", unfinished(tmp_path / "a.txt").name):
        (tmp_path / name).symlink_to(victim)
    write_text(tmp_path / "a.txt", "new")
    assert victim.read_text() == "precious"
    monkeypatch.setattr("secrets.token_hex", lambda count: "guessed")
    (tmp_path / ".a.guessed.partial.txt").symlink_to(victim)
    with pytest.raises(OutputError, match="File exists"):
        write_text(tmp_path / "a.txt", "newer")
    assert victim.read_text() == "precious"
    assert (tmp_path / ".a.guessed.partial.txt").is_symlink()
    assert (tmp_path / "a.txt").read_text() == "new"


def test_two_writers_of_one_output_both_write_it_whole(tmp_path):
    """Before: one name for both unfinished files; one writer failed, or a mixed file was put in place."""
    path, gate, failed = tmp_path / "a.txt", threading.Barrier(2), []

    def write(letter: str) -> None:
        try:
            with put_aside(path) as aside:
                gate.wait(30)
                for _ in range(50):
                    with aside.open("a") as file:
                        file.write(1000 * letter)
                gate.wait(30)
        except Exception as error:
            failed.append(error)

    writers = [threading.Thread(target=write, args=(letter,)) for letter in "ab"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert path.read_text() in (50_000 * "a", 50_000 * "b")
    assert len(failed) < 2
    assert all(isinstance(error, OutputError) and "without its mark" in str(error) for error in failed)
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_appears_meanwhile_stays(tmp_path):
    def late() -> None:
        with put_aside(tmp_path / "a.txt") as aside:
            aside.write_text("new")
            (tmp_path / "a.txt").write_text("theirs")

    with pytest.raises(OutputError, match="without its mark"):
        late()
    assert (tmp_path / "a.txt").read_text() == "theirs"
    assert list(tmp_path.iterdir()) == [tmp_path / "a.txt"]


def test_names_that_no_file_can_have_are_one_line(tmp_path):
    for name in ("a" * 300, "zero\0byte"):
        with pytest.raises(OutputError, match="a name to write to"):
            check_target(tmp_path / name)
    write_text(tmp_path / f"{'ü' * 120}.txt", "x")  # 244 bytes: the unfinished name is not longer
