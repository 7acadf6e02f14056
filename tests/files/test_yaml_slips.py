"""A fault of a YAML file is one line with the line of the file and the likely slip."""

from __future__ import annotations

from pathlib import Path

import pytest

from sphereorient.errors import ExperimentError
from sphereorient.files.yaml_file import read_yaml

HEAD = "schema: a/1\nname: tank\n"


@pytest.mark.parametrize(
    ("text", "slip", "line"),
    [
        ("sphere:\n\tdiameter: 18\n", "a tab", 4),
        ("sphere:\n  fixed: true\n\tdiameter: 18\n", "a tab", 5),
        ("sphere:\n  diameter:18\n  fixed: true\n", "no space after the colon", 4),
        ("frame_rate:600\nsphere: {}\n", "no space after the colon", 3),
        ("sphere:\n  diameter: 18\n   fixed: true\n", "an indent", 5),
        ("sphere:\n   diameter: 18\n  fixed: true\n", "an indent", 5),
        ("sphere:\n  diameter: 18\n fixed: true\n", "an indent", 5),
        ("movies: {cam1: a.mkv\ncameras: c.yaml\nframe_rate: 3\n", "a bracket", 3),
        ("frames: [0, 300\n", "a bracket", 3),
        ("movies: {cam1: a.mkv cam2: b.mkv}\n", "a comma", 3),
        ('texture: "map.png\ncameras: c.yaml\n', "a quote", 3),
        ("movies: {cam1: 'a.mkv}  # the ball's\n", "a quote", 3),
        ("comment: of the tank: dusty\n", "needs quotes", 3),
        ("cameras: c.yaml\nmine: C:\\data: 3\n", "needs quotes", 4),
    ],
)
def test_the_line_and_the_likely_slip_are_named(tmp_path: Path, text: str, slip: str, line: int):
    path = tmp_path / "experiment.yaml"
    path.write_text(HEAD + text)
    with pytest.raises(ExperimentError) as refused:
        read_yaml(path, ExperimentError)
    message = str(refused.value)
    assert "\n" not in message
    assert slip in message
    assert f"line {line}" in message


def test_right_files_are_read_and_other_faults_keep_their_words(tmp_path: Path):
    path = tmp_path / "experiment.yaml"
    path.write_text(HEAD + "url: http://a.b:80/c\ntime: 12:30\nwhat: 'a: b'\nmore: \"don't\"  # it's: so\n")
    assert read_yaml(path, ExperimentError)["what"] == "a: b"
    for text, word in (("name: 2\n", "twice"), ("x: !tag 3\n", "a tag"), ("x: @3\n", "cannot start")):
        path.write_text(HEAD + text)
        with pytest.raises(ExperimentError, match=f"{word}.* in line 3"):
            read_yaml(path, ExperimentError)
