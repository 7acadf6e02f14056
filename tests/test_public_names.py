"""Names of `import sphereorient`: each exists, completes, and is that of its page; one name, one meaning."""

import ast
import inspect
import subprocess
import sys

import names
import pytest
import torch

import sphereorient

NAMES = [
    "track_movies",
    "learn_map",
    "calibrate",
    "check",
    "load_experiment",
    "load_settings",
    "load_texture",
    "Experiment",
    "Tracks",
    "Trajectory",
    "Settings",
    "so3",
    "cameras",
    "sphere",
    "synth",
    "SphereRenderer",
    "TemplateBank",
    "PoseFitter",
    "PathLayer",
]


def test_all_public_names_complete():
    assert sorted(sphereorient.__all__) == sorted(NAMES)
    assert set(NAMES) <= set(dir(sphereorient))


@pytest.mark.parametrize("name", NAMES)
def test_a_public_name_is_there_with_a_docstring(name):
    assert inspect.getdoc(getattr(sphereorient, name))


@pytest.mark.parametrize("name", ["SphereRenderer", "TemplateBank", "PoseFitter", "PathLayer"])
def test_the_toolkit_is_modules(name):
    assert issubclass(getattr(sphereorient, name), torch.nn.Module)


@pytest.mark.slow
def test_names_come_in_a_fresh_process_in_any_order():
    code = f"import sphereorient\nfor name in {NAMES[::-1]!r}: getattr(sphereorient, name)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'track_movie'"):
        _ = sphereorient.track_movie


def test_a_public_name_has_one_meaning_a_term_is_in_the_glossary_and_no_retired_word_is_used():
    assert not any(names.wrong().values()), "see `python scripts/names.py`"


def test_each_list_of_names_finds_what_it_is_for():
    first, second = "Rows = list[int]\ndef fit(told): ...\nclass _Part: ...", "Rows = list[str]\nclass OuterShell: ..."
    trees = {
        "a.py": ast.parse(first),
        "b.py": ast.parse(second),
        "c.py": ast.parse("Rows = list[int]\ndef _fit(): ..."),
    }
    assert names.meanings(trees) == {"Rows": ["a.py", "b.py"]}
    assert names.unexplained(trees, "- **core**: not a shell\n") == {"shell": ["OuterShell"]}
    assert names.unexplained(trees, "- **shells** (`Shell`): around a core\n") == {}
    assert names.retired(trees) == {"told": ["a.py"]}
