"""Settings and provenance: defaults, files, overrides, and refusals of one line that name the nearest known key."""

import hashlib
import json
import re
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import yaml
from conftest import REPO
from pydantic import BaseModel, ValidationError

from sphereorient.bench import BenchSettings
from sphereorient.errors import SettingsError
from sphereorient.experiment import input_files, load_experiment
from sphereorient.files.provenance import provenance, versions
from sphereorient.learn.settings import ProposerSettings
from sphereorient.locate import LocateSettings
from sphereorient.methods.settings import (
    DEFAULT_METHOD,
    DEFAULTS,
    METHODS,
    READERS,
    Settings,
    check_settings,
    is_read,
    load_settings,
    model_yaml,
    read_model,
    read_settings,
    settings_yaml,
)
from sphereorient.run import MemoryStore, Request, run
from sphereorient.synth.settings import SynthSettings

ROOMS = [
    *("locate", "propose", "search", "refine", "path", "smooth"),
    *("orient", "assemble", "motion", "paint", "statistics"),
]
CHANGES = [
    "locate.diameter_px=78.5",
    "locate.gap_frames_max=0",
    "orient.fine_step_deg=2.5",
    "motion.separations=[1, 3]",
    "motion.min_separations=1",
]
load_synth = partial(read_model, SynthSettings)
LOADERS = {
    "synth": load_synth,
    "train": partial(read_model, ProposerSettings),
    "robustness": partial(read_model, BenchSettings),
}


def write(folder: Path, text: str) -> Path:
    path = folder / "settings.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def refused(*overrides: str, path: Path | None = None, load=load_settings) -> str:
    """Return the refusal, which must be one line."""
    with pytest.raises(SettingsError) as caught:
        load(path, overrides)
    text = str(caught.value)
    assert "\n" not in text
    assert text.endswith(".")
    return text


def test_without_a_file_all_settings_are_the_defaults_of_the_rooms():
    assert load_settings() == Settings()
    assert load_settings().locate == LocateSettings()
    assert list(Settings.model_fields) == ROOMS
    assert load_synth() == SynthSettings()
    assert DEFAULT_METHOD in METHODS


def test_a_file_changes_what_it_names_and_nothing_else(tmp_path):
    loaded = load_settings(write(tmp_path, "locate:\n  gap_frames_max: 2\n"))
    assert loaded.locate == LocateSettings(gap_frames_max=2)
    assert loaded.orient == Settings().orient


@pytest.mark.parametrize("text", ["", "# nothing\n", "{}\n", "locate: {}\n"])
def test_an_empty_file_is_the_defaults(tmp_path, text):
    assert load_settings(write(tmp_path, text)) == Settings()


def test_an_override_wins_over_the_file_and_a_later_one_over_an_earlier(tmp_path):
    path = write(tmp_path, "locate:\n  gap_frames_max: 2\n  reduction: 3\n")
    loaded = load_settings(path, ["locate.gap_frames_max=1", "locate.gap_frames_max=3"])
    assert (loaded.locate.gap_frames_max, loaded.locate.reduction) == (3, 3)


def test_values_are_read_as_yaml():
    loaded = load_settings(None, ["locate.diameter_px=null", "motion.separations=[1, 2, 4]", " locate.reduction = 4"])
    assert loaded.locate.diameter_px is None
    assert loaded.motion.separations == (1, 2, 4)
    assert loaded.locate.reduction == 4
    assert load_synth(None, ["image_size=[320, 240]", "name=a test"]).image_size == (320, 240)
    assert load_synth(None, ["name=a=b"]).name == "a=b"


@pytest.mark.parametrize(
    ("override", "near"),
    [
        ("locate.gap_frame_max=2", "locate: .*write 'gap_frames_max'"),
        ("orient.fine_stp_deg=2", "orient: .*write 'fine_step_deg'"),
        ("locat.reduction=2", "write 'locate'"),
        ("motion.seperations=[1]", "motion: .*write 'separations'"),
    ],
)
def test_an_unknown_key_is_refused_with_the_nearest_known_one(override, near):
    text = refused(override)
    assert re.search(near, text)
    assert override.partition("=")[0].partition(".")[0] in text


def test_an_unknown_key_like_no_other_is_refused_with_all_there_are(tmp_path):
    text = refused("zzz.q=1")
    assert all(room in text for room in ROOMS)
    assert "synth" not in text
    assert "frame_rate" in refused("zzz=1", load=load_synth)
    assert "gap_frames_max, spline_knot_frames" in refused(path=write(tmp_path, "locate: {zzz: 1}\n"))


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("locate.gap_frames_max=-1", ["locate.gap_frames_max", "-1", "greater than or equal to 0"]),
        ("locate.gap_frames_max=2.5", ["locate.gap_frames_max", "2.5"]),
        ("locate.reduction=two", ["locate.reduction", "'two'"]),
        ("locate.coverage_min=1", ["locate.coverage_min", "less than 1"]),
        ("locate.noise_factor=.nan", ["locate.noise_factor", "nan"]),
        ("locate.diameter_px=[1, 2]", ["locate.diameter_px", "[1, 2]"]),
        ("motion.separations=[1, x]", ["motion.separations.1", "'x'"]),
        ("motion.separations=[]", ["motion.separations"]),
    ],
)
def test_an_impossible_value_is_one_line_with_its_key(override, words):
    text = refused(override)
    assert all(word in text for word in words)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("motion.separations=[1, 1]", ["motion.separations", "different numbers from 1 up", "got (1, 1)"]),
        ("motion.separations=[1, 2]", ["motion.min_separations", "at most 2", "got 3"]),
    ],
)
def test_values_that_do_not_fit_each_other_are_refused_in_the_rooms_own_words(override, words):
    text = refused(override)
    assert all(word in text for word in words)
    assert text.count("expected") == 1
    assert "Value error" not in text


def test_an_override_of_another_form_or_of_a_room_that_the_file_spoils_is_refused(tmp_path):
    for override in ("locate.reduction", "reduction=2", "a.b.c=1", "", "=", "locate.=3", "locate"):
        refused(override)
    for override in ("locate.frames=3", "frames", ""):  # a synthetic experiment has no rooms
        refused(override, load=load_synth)
    assert "a YAML value" in refused("locate.reduction=[1, 2")
    assert "locate" in refused("locate.reduction=2", path=write(tmp_path, "locate: 5\n"))


@pytest.mark.parametrize("text", ["- 1\n- 2\n", "just words\n", "7\n", "a: [1\n", "a: b: c\n", "\tx: 1\n"])
def test_a_file_that_is_no_tree_is_refused(tmp_path, text):
    assert "settings.yaml" in refused(path=write(tmp_path, text))


def test_a_file_that_is_not_there_or_no_text_is_refused_and_a_value_with_its_file(tmp_path):
    assert "none.yaml" in refused(path=tmp_path / "none.yaml")
    refused(path=tmp_path)
    (tmp_path / "bytes.yaml").write_bytes(b"\xff\xfe\x00locate")
    assert "bytes.yaml" in refused(path=tmp_path / "bytes.yaml")
    assert "settings.yaml, locate.reduction" in refused(path=write(tmp_path, "locate: {reduction: 99}\n"))


@pytest.mark.parametrize("overrides", [[], CHANGES], ids=["defaults", "changed"])
def test_settings_written_are_settings_read(tmp_path, overrides):
    settings = load_settings(None, overrides)
    assert load_settings(write(tmp_path, settings_yaml(settings))) == settings


def test_small_and_large_numbers_are_read_back_as_numbers(tmp_path):
    """The usual YAML reader takes 1e-3 for text."""
    settings = load_settings(None, ["locate.outlier_px=1.0e-7", "locate.noise_factor=3.0e+20"])
    again = load_settings(write(tmp_path, settings_yaml(settings)))
    assert again.locate.outlier_px == 1e-7
    assert again.locate.noise_factor == 3e20


def test_synthetic_settings_written_are_settings_read(tmp_path):
    text = model_yaml("A synthetic experiment", SynthSettings())
    assert load_synth(write(tmp_path, text)) == SynthSettings()
    assert yaml.safe_load(text).keys() == SynthSettings.model_fields.keys()


def test_the_file_names_and_explains_every_setting():
    tree, text = yaml.safe_load(settings_yaml()), settings_yaml()
    lines = [line.strip() for line in text.splitlines()]
    assert list(tree) == ROOMS
    for room in ROOMS:
        model = Settings.model_fields[room].annotation
        assert tree[room].keys() == model.model_fields.keys()
        for key, field in model.model_fields.items():
            first = next(k for k, line in enumerate(lines) if line.startswith(f"{room}:"))
            before = lines[next(k for k, line in enumerate(lines) if k > first and line.startswith(f"{key}:")) - 1]
            assert before.startswith("# ")
            assert before.removeprefix("# ").split()[-1] == field.description.split()[-1]
    assert max(map(len, text.splitlines())) <= 120


def models() -> list[type[BaseModel]]:
    return [Settings, SynthSettings, *(Settings.model_fields[room].annotation for room in ROOMS)]


@pytest.mark.parametrize("model", models(), ids=lambda model: model.__name__)
def test_all_settings_have_a_default_and_a_description_and_are_frozen(model):
    settings = model()
    for name, field in model.model_fields.items():
        assert field.description, name
    with pytest.raises(ValidationError):
        setattr(settings, next(iter(model.model_fields)), 1)


def test_the_committed_settings_are_accepted():
    for path in sorted((REPO / "configs").glob("*.yaml")):
        LOADERS.get(path.stem.partition("_")[0], load_settings)(path)


@pytest.mark.parametrize("method", ["paper", "precise"])
def test_the_file_of_a_method_holds_the_defaults_of_all_keys_that_it_reads_and_no_other(method):
    path = REPO / "configs" / f"{method}.yaml"
    assert path.read_text() == settings_yaml(method=method)
    assert read_settings(path, [], method)[1] == []
    tree = yaml.safe_load(path.read_text())
    assert {f"{branch}.{name}" for branch in tree for name in tree[branch]} == {
        key for key in DEFAULTS if is_read(key, method)
    }
    assert Settings.model_validate(tree) == Settings()
    assert LOADERS["robustness"](REPO / "configs" / "robustness.yaml") == BenchSettings()


@pytest.mark.parametrize(
    ("method", "other", "aside"),
    [
        ("paper", "precise", "path, refine, search, smooth"),
        (
            "precise",
            "paper",
            "assemble, locate.gap_frames_max, locate.outlier_factor, locate.outlier_px, "
            "locate.spline_knot_frames, motion, orient",
        ),
    ],
)
def test_the_file_of_the_other_method_is_left_aside_with_one_remark_and_refused_once_it_is_changed(
    tmp_path, method, other, aside
):
    path = REPO / "configs" / f"{other}.yaml"
    settings, remarks = read_settings(path, [], method)
    assert settings == Settings()
    assert remarks == [f"{path}: method {method} does not read {aside}: ignored"]
    key, before, after = {
        "precise": ("search.step_deg", "step_deg: 12.0", "step_deg: 10.0"),
        "paper": ("orient.fine_step_deg", "fine_step_deg: 3.0", "fine_step_deg: 2.0"),
    }[other]
    text = path.read_text()
    assert before in text
    changed = write(tmp_path, text.replace(before, after))
    assert f"{key}: expected a key that method {method} reads" in refused(
        path=changed, load=lambda path, overrides: read_settings(path, overrides, method)
    )


@pytest.mark.parametrize(
    ("override", "method", "near"),
    [
        ("orient.fine_step_deg=2", "precise", "search.step_deg"),
        ("search.step_deg=10", "paper", "orient.coarse_step_deg"),
        ("locate.outlier_px=2", "precise", "smooth.outlier_sigma"),
        ("refine.blur_px=0.7", "map", "paint.blur_px"),
    ],
)
def test_a_key_that_the_method_does_not_read_is_refused_with_the_nearest_one_that_it_reads(override, method, near):
    key = override.partition("=")[0]
    with pytest.raises(SettingsError, match=f"--set {key}: expected a key that method {method} reads") as caught:
        read_settings(None, [override], method)
    named = [word.strip(",") for word in str(caught.value).split() if "." in word]
    assert any(is_read(word, method) for word in named if word != f"{key}:"), str(caught.value)
    if near.partition(".")[2].rpartition("_")[2] == key.rpartition("_")[2]:
        assert near in str(caught.value) or "use " in str(caught.value)
    # The same value from the Python API.
    with pytest.raises(SettingsError, match=f"settings, {key}"):
        check_settings(load_settings(None, [override]), method)


def test_every_key_is_read_by_a_method_and_each_method_accepts_the_defaults():
    assert METHODS == ("precise", "paper", "map", "report")
    assert set(READERS) == set(DEFAULTS)
    assert all(READERS.values())
    for method in METHODS:
        check_settings(Settings(), method)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["precise", "paper"])
def test_a_method_reads_the_keys_that_the_settings_name_for_it_and_no_other(method, monkeypatch):
    """All attributes of settings are noted while the excerpt is tracked."""
    models = {type(part): (branch, set(type(part).model_fields)) for branch, part in Settings()}
    read = set()

    def noting(self, name):
        checks = sys._getframe(1).f_globals["__name__"].endswith("settings")  # or writes them into the track
        if name in models[type(self)][1] and not checks:
            read.add(f"{models[type(self)][0]}.{name}")
        return object.__getattribute__(self, name)

    for model in models:
        monkeypatch.setattr(model, "__getattribute__", noting)
    excerpt = REPO / "synthetic_data" / "excerpt" / "experiment.yaml"
    run(Request(experiment=excerpt, method=method), MemoryStore())
    stated = {key for key in READERS if is_read(key, method)}
    assert read - stated == set()
    # Not needed by this movie: no checkpoint, no ball that is held in place, no gap in which cameras change places.
    assert {key for key in stated - read if key.partition(".")[0] != "propose"} <= {
        "locate.background_frames",
        "assemble.repair_margin",
    }


def two_folders(folder: Path):
    """An experiment whose two movies share a name, as cameras write them."""
    experiment = load_experiment(REPO / "synthetic_data" / "excerpt" / "experiment.yaml")
    files = {"experiment.yaml": b"e", "cameras.yaml": b"c", "left/movie.mkv": b"left", "right/movie.mkv": b"right"}
    files |= {"texture.png": b"t", "left/empty.png": b"empty left", "right/empty.png": b"empty right"}
    for name, content in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    sides = {"cam1": "left", "cam2": "right"}
    return files, replace(
        experiment.with_sphere(texture_path=folder / "texture.png"),
        path=folder / "experiment.yaml",
        cameras_path=folder / "cameras.yaml",
        movie_paths={name: folder / side / "movie.mkv" for name, side in sides.items()},
        background_paths={name: folder / side / "empty.png" for name, side in sides.items()},
    )


def test_every_input_has_its_fingerprint(tmp_path):
    files, experiment = two_folders(tmp_path)
    kept = provenance(input_files(experiment), tmp_path, "sphereorient track x")
    assert kept["sha256"] == {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    assert kept["command"] == "sphereorient track x"
    assert json.loads(json.dumps(kept)) == kept


def test_only_the_cameras_that_were_used_have_fingerprints_and_inputs_elsewhere_the_way_to_them(tmp_path):
    _, experiment = two_folders(tmp_path)
    kept = provenance(input_files(experiment.with_sphere(texture_path=None), ["cam2"]), tmp_path, "")
    assert set(kept["sha256"]) == {"experiment.yaml", "cameras.yaml", "right/movie.mkv", "right/empty.png"}

    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "experiment.yaml").write_bytes(b"e")
    there = replace(experiment, path=tmp_path / "here" / "experiment.yaml")
    kept = provenance(input_files(there, ["cam1"]), there.folder, "")
    assert "../left/movie.mkv" in kept["sha256"]
    assert "experiment.yaml" in kept["sha256"]


def test_versions_name_all_packages_that_enter_the_numbers():
    found = versions()
    assert {"python", "sphereorient", "torch", "kornia", "numpy"} <= found.keys()
    assert all(isinstance(number, str) and number for number in found.values())
