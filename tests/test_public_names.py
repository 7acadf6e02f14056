"""What `import sphereorient` offers: every name is there, completes, and is what its page says."""

import inspect
import subprocess
import sys

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
