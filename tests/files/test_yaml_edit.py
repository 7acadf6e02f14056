"""A value is put into a YAML file that a person wrote; every other character stays."""

from __future__ import annotations

import pytest
import yaml

from sphereorient.files.yaml_file import with_value

POINTS = {"cam1": [[1.0, 2.5], [3.0, 4.0]]}
LINE = "clicked: {cam1: [[1.0, 2.5], [3.0, 4.0]]}"


@pytest.mark.parametrize(
    ("text", "place", "value", "new"),
    [
        ("a: 1\n", ["masks"], {"cam1": "m.png"}, "a: 1\nmasks: {cam1: m.png}\n"),
        ("a: 1", ["b"], {"x": 2}, "a: 1\nb: {x: 2}\n"),
        ("masks: {}\nb: 2\n", ["masks"], {"c": "d"}, "masks: {c: d}\nb: 2\n"),
        ("a: 1\n# masks: {cam2: x}  # so\n# end\n", ["masks"], {"c": "d"}, "a: 1\nmasks: {c: d}\n# end\n"),
        ("masks: {c: e}  # old\nb: 2\n", ["masks"], {"c": "d"}, "masks: {c: d}  # old\nb: 2\n"),
        (
            "# mine\npictures:\n  - {pose: 0, cam1: a.png}  # dusty\n  - {pose: 1, cam1: b.png, }\n",
            ["pictures", 0, "clicked"],
            POINTS,
            f"# mine\npictures:\n  - {{pose: 0, cam1: a.png, {LINE}}}  # dusty\n  - {{pose: 1, cam1: b.png, }}\n",
        ),
        (
            "pictures:\n- pose: 0\n  cam1: a.png  # dusty\n# next\n- pose: 1\n  cam1: b.png\n",
            ["pictures", 0, "clicked"],
            POINTS,
            f"pictures:\n- pose: 0\n  cam1: a.png  # dusty\n  {LINE}\n# next\n- pose: 1\n  cam1: b.png\n",
        ),
        (
            f"pictures:\n- {LINE}  # mine\n  pose: 0\n",
            ["pictures", 0, "clicked"],
            {"c": []},
            "pictures:\n- clicked: {c: []}  # mine\n  pose: 0\n",
        ),
        ("a:\r\n  - b: 1\r\n", ["a", 0, "c"], {}, "a:\r\n  - b: 1\n    c: {}\r\n"),
        ("a: {b: [1,\n 2]}\n", ["a", "c"], {}, "a: {b: [1,\n 2], c: {}}\n"),
    ],
)
def test_a_value_is_put_in_and_all_else_stays(text, place, value, new):
    assert with_value(text, place, value) == new
    data = yaml.safe_load(new)
    for step in place:
        data = data[step]
    assert data == value


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("masks:\n  cam2: other.png\n", ["masks"]),
        ("masks:\n  cam2: other.png  # kept", ["masks"]),
        ("masks: {a: b,  # why\n  c: d}\n", ["masks"]),
        ("a: &x {b: 1}\nc: *x\n", ["c", "d"]),  # would change a as well
        ("pictures: []\n", ["pictures", 0, "clicked"]),
        ("pictures: 3\n", ["pictures", 0, "clicked"]),
        ("a: [\n", ["b"]),
        ("", ["b"]),
    ],
)
def test_an_edit_that_could_lose_text_is_not_made(text, place):
    assert with_value(text, place, {"c": 1}) is None
