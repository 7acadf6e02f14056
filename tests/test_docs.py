"""The docs are right: examples run, tables are those of the code, tests named in them exist."""

import contextlib
import doctest
import io
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from functools import cache
from itertools import pairwise
from pathlib import Path

import cv2
import docs_words
import pytest
import typer
import yaml
from conftest import REPO
from packaging.requirements import Requirement

import sphereorient
from sphereorient.calibration.document import CalibrationKeys, load_calibration
from sphereorient.calibration.targets import KINDS, target_keys
from sphereorient.cameras import load_cameras
from sphereorient.cameras.io.cameras_yaml import ENTRIES, MODELS, PortEntry
from sphereorient.cameras.parameters import PORT_NUMBERS, PORT_TILT, parameter_names
from sphereorient.cli import app
from sphereorient.experiment import load_experiment
from sphereorient.experiment.experiment import ExperimentKeys
from sphereorient.learn.settings import ProposerSettings
from sphereorient.methods.settings import DEFAULTS, load_settings, read_model
from sphereorient.synth import SynthSettings
from sphereorient.trajectory import Flag, Reason, Trajectory

DOCS = sorted([*REPO.glob("*.md"), *(REPO / "docs").glob("*.md")])


def blocks(page: str, language: str) -> list[str]:
    """Fenced blocks of a language in a page of docs/."""
    text = (REPO / "docs" / page).read_text()
    found = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [block for kind, block in found if kind == language]


@pytest.mark.parametrize(("page", "least"), [("conventions.md", 30), ("cameras.md", 15)])
def test_the_examples_of_a_page_run(page, least):
    failed, tried = doctest.testfile(str(REPO / "docs" / page), module_relative=False)
    assert tried >= least
    assert failed == 0


def test_the_cameras_of_the_page_load_and_no_key_or_parameter_of_any_model_is_missing(tmp_path):
    (tmp_path / "cameras.yaml").write_text(blocks("cameras.md", "yaml")[0])
    cameras = load_cameras(tmp_path / "cameras.yaml")
    assert {type(getattr(camera, "camera", camera)) for camera in cameras.values()} == set(MODELS.values())
    text = (REPO / "docs" / "cameras.md").read_text()
    names = {key for entry in (PortEntry, *ENTRIES.values()) for key in entry.model_fields}
    for name in names.union(*map(parameter_names, cameras.values())):
        assert f"`{name}`" in text, name


def test_the_calibration_file_of_the_page_loads_and_all_its_keys_are_there(tmp_path):
    path = tmp_path / "calibration.yaml"
    path.write_text(blocks("calibration.md", "yaml")[0])
    assert load_calibration(path).cameras == ("cam1", "cam2")
    text = (REPO / "docs" / "calibration.md").read_text()
    plates = {key for kind in KINDS.values() for key in target_keys(kind)}
    for key in {*CalibrationKeys.model_fields, *plates, *KINDS, *PORT_NUMBERS, *PORT_TILT}:
        assert f"`{key}`" in text, key


@pytest.mark.slow  # the calibration draws and finds 14 pictures
@pytest.mark.parametrize(
    ("script", "out", "names"),
    [
        ("figure_calibration.py", "calibration.png", ("calibration.png",)),
        ("figure_conventions.py", "", ("conventions.png", "animal.png")),
    ],
)
def test_figures_are_drawn_by_their_scripts(tmp_path, script, out, names):
    subprocess.run([sys.executable, REPO / "scripts" / script, "--out", tmp_path / out], check=True)
    for name in names:
        drawn, committed = (cv2.imread(str(folder / name)) for folder in (tmp_path, REPO / "docs"))
        assert drawn.shape == committed.shape
        # Fonts and line ends differ between versions of matplotlib, the panels do not.
        assert abs(drawn.astype(float) - committed).mean() < 10


def test_parameters_and_configs_are_those_of_the_code(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["make_parameters.py", "--check"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(REPO / "scripts" / "make_parameters.py"), run_name="__main__")
    assert (ended.value.code, capsys.readouterr().out) == (0, "")


@cache
def defined(folder: Path) -> set[str]:
    """Names of the functions and classes that a room, a folder or one file, defines."""
    files = folder.rglob("*.py") if folder.is_dir() else [folder.with_suffix(".py")]
    text = "\n".join(path.read_text() for path in files)
    return set(re.findall(r"^(?:def|class) (\w+)", text, re.MULTILINE))


# Sentences of each paragraph of the paper's sections III and IV, counted in the paper.
SENTENCES = {
    "III A": (4, 11, 2),
    "III B 0": (2,),
    "III B 1": (2, 6, 2, 3, 4, 3, 5),
    "III B 2": (8, 5, 9, 7, 4),
    "III C": (8, 6),
    "IV": (5, 4, 2, 13, 6, 6),
}


def rows_of_paper_map() -> list[list[str]]:
    """The cells of each row of the page's tables of sentences."""
    lines = (REPO / "docs" / "paper-map.md").read_text().partition("\n## Departures\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| ")]


def test_every_sentence_of_sections_iii_and_iv_stands_in_one_row_of_the_paper_map():
    found = []
    for section, paragraph, first, last in (
        re.fullmatch(r"(I[IV]+[ ABC012]*), (\d+)\.(\d+)(?:-(\d+))?", row[0]).groups()
        for row in rows_of_paper_map()
        if re.match(r"I[IV]+( [A-C])?( \d)?, ", row[0])
    ):
        found += [(section, int(paragraph), n) for n in range(int(first), int(last or first) + 1)]
    expected = [
        (section, paragraph, n)
        for section, counts in SENTENCES.items()
        for paragraph, count in enumerate(counts, 1)
        for n in range(1, count + 1)
    ]
    assert found == expected


def test_every_test_that_the_paper_map_names_exists():
    named = re.findall(r"`(tests/\w+)::(\w+)`", (REPO / "docs" / "paper-map.md").read_text())
    assert len(named) > 120
    for folder, test in named:
        assert test in defined(REPO / folder), f"{folder}::{test}"


def test_every_function_that_the_paper_map_names_exists():
    named = [name for row in rows_of_paper_map() if len(row) > 3 for name in re.findall(r"`(\w+)\.(\w+)`", row[2])]
    assert len(named) > 100
    for room, name in named:
        assert name in defined(REPO / "sphereorient" / room), f"{room}.{name}"


def test_every_setting_of_the_paper_map_exists_and_those_of_the_method_are_all_there():
    keys = {key for row in rows_of_paper_map() if len(row) == 5 for key in re.findall(r"`(\w+\.\w+)`", row[4])}
    assert keys <= set(DEFAULTS), keys - set(DEFAULTS)
    own = {key for key in DEFAULTS if key.startswith(("orient.", "assemble."))}
    assert own <= keys, own - keys


def test_every_departure_of_the_paper_map_is_in_its_list_and_the_other_way_round():
    text = (REPO / "docs" / "paper-map.md").read_text()
    sentences, departures = text.split("\n## Departures\n")
    marks = re.findall(r"\*\*departures? ([\d, ]+)\*\*", sentences, re.IGNORECASE)
    named = {int(number) for mark in marks for number in mark.split(",")}
    listed = [int(number) for number in re.findall(r"^\| (\d+) \|", departures, re.MULTILINE)]
    assert listed == sorted(named) == list(range(1, len(listed) + 1))


def sources() -> list[Path]:
    """The modules of the package."""
    return sorted((REPO / "sphereorient").rglob("*.py"))


def test_every_correction_that_the_package_cites_is_in_the_errata():
    text = (REPO / "docs" / "errata.md").read_text()
    used = {code for path in sources() for code in re.findall(r"\b([AE](?:10|[1-9]))\b", path.read_text())}
    assert len(used) > 10
    for code in used:
        assert f"\n| {code} | " in text, code
    for path in sources():
        for cited in re.findall(r"errata\.md,? ([\w ]*)", path.read_text(), re.IGNORECASE):
            first = cited.split()[0] if cited.split() else ""
            section = re.match(r"(the )?(bound|settings of the paper)", cited, re.IGNORECASE)
            assert f"\n| {first} | " in text or section, f"{path.name}: errata.md {cited}"


def test_the_package_cites_only_pages_that_exist():
    for path in sources():
        text = path.read_text()
        assert not re.search(r"\bDESIGN\b|\bERRATA\b", text), (
            f"{path.name}: cite docs/conventions.md, docs/errata.md E1, ..."
        )
        for page in re.findall(r"docs/([\w-]+\.md)", text):
            assert (REPO / "docs" / page).is_file(), f"{path.name}: docs/{page}"


def test_the_keys_of_an_experiment_are_all_in_the_data_format():
    text = (REPO / "docs" / "data-format.md").read_text()
    example = yaml.safe_load(blocks("data-format.md", "yaml")[0])
    assert example.pop("schema") == "sphereorient-experiment/1"
    keys = ExperimentKeys.model_validate(example)
    for key in [*type(keys).model_fields, *(f"sphere.{name}" for name in type(keys.sphere).model_fields)]:
        assert f"`{key}`" in text or f"\n{key}:" in text, key


def test_flags_reasons_and_datasets_are_all_in_the_data_format():
    text = (REPO / "docs" / "data-format.md").read_text()
    for flag in Flag:
        assert re.search(rf"^\|[ \d,]*\b{flag.value}\b[ \d,]*\|", text, re.MULTILINE), flag
    for reason in Reason:
        assert f"`{reason}`" in text, reason
    track = Trajectory.__dataclass_fields__
    for name in (name for name in track if "column" in track[name].metadata and not name.endswith(("_sigma", "_cov"))):
        assert f"`{name}`" in text, name


def test_the_files_of_the_walkthrough_load(tmp_path):
    experiment, cameras = blocks("walkthrough.md", "yaml")
    (tmp_path / "cameras.yaml").write_text(cameras)
    (tmp_path / "experiment.yaml").write_text(experiment)
    assert list(load_experiment(tmp_path / "experiment.yaml").cameras) == ["cam1", "cam2"]


def cells(line: str) -> str:
    """The words of a printed line, without borders of tables and spaces."""
    return " ".join(re.sub("[│┃|]", " ", line).split())


@pytest.mark.slow  # renders 60 frames and tracks them twice: a minute
def test_the_commands_and_the_python_of_the_walkthrough_print_its_output(tmp_path, monkeypatch):
    # A copy of the project's folder, so that its own out/ stays as it is.
    (tmp_path / ".venv").symlink_to(sys.prefix)
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path)
    commands = [line for block in blocks("walkthrough.md", "") for line in block.splitlines()]
    assert len(commands) == 7
    printed = ""
    for command in commands:
        run = subprocess.run(command.split(), check=True, capture_output=True, text=True)
        printed += run.stdout
    names: dict[str, object] = {}
    with contextlib.redirect_stdout(io.StringIO()) as python:
        for block in blocks("walkthrough.md", "python"):
            exec(block, names)
    shown = {cells(line) for line in (printed + python.getvalue()).splitlines()}
    for block in blocks("walkthrough.md", "text"):
        for line in block.splitlines():
            assert cells(line) in shown, line
    for name in ("track.csv", "report/index.html", "overlay.mp4"):
        assert (tmp_path / "out" / "try" / name).is_file()


@pytest.mark.parametrize("page", DOCS, ids=lambda path: path.name)
def test_every_command_of_a_page_exists_with_its_options_and_settings(page):
    fenced = re.findall(r"^```\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)
    for line in "".join(fenced).replace("\\\n", " ").splitlines():
        found = re.match(r"(?:\.venv/bin/)?sphereorient (.*)", line)
        if not found:
            continue
        words, command = shlex.split(found[1], comments=True), typer.main.get_command(app)
        while hasattr(command, "commands"):
            assert words[0] in command.commands, line
            command = command.commands[words.pop(0)]
        options = {option for one in command.params for option in (*one.opts, *one.secondary_opts)}
        assert {word for word in words if word.startswith("-")} <= options, line
        changed = [value for option, value in pairwise(words) if option == "--set" and command.name != "init"]
        model = {"synth": SynthSettings, "train": ProposerSettings}.get(command.name)
        read_model(model, None, changed) if model else load_settings(None, changed)


@pytest.mark.parametrize("page", DOCS, ids=lambda path: path.name)
def test_every_file_of_the_project_that_a_page_names_exists(page):
    if page.name == "CHANGELOG.md":  # names the past
        return
    rooms = "|".join(path.parent.name for path in (REPO / "sphereorient").glob("*/__init__.py"))
    text = page.read_text()
    for name in re.findall(r"(?:scripts|tests|configs|sphereorient)/[\w/]+\.(?:py|yaml)", text):
        assert (REPO / name).is_file(), name
    for name in re.findall(rf"`((?:{rooms})/[\w/]+\.py)", text):
        assert (REPO / "sphereorient" / name).is_file(), name


@pytest.mark.parametrize("page", DOCS, ids=lambda path: path.name)
def test_links_between_the_pages_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), f"{page.name} -> {target}"


def test_the_oldest_versions_are_tried_of_every_dependency():
    workflow = (REPO / ".github" / "workflows" / "tests.yml").read_text()
    (code,) = re.findall(r'python -c "(.*)" > oldest.txt', workflow)
    tried = subprocess.run([sys.executable, "-c", code], cwd=REPO, capture_output=True, text=True, check=True).stdout
    allowed = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]["dependencies"]
    assert len(tried.splitlines()) == len(allowed)
    for one, line in zip(map(Requirement, tried.splitlines()), map(Requirement, allowed), strict=True):
        assert one.name == line.name
        (lowest,) = line.specifier
        assert one.specifier.contains(lowest.version)


def test_no_sentence_of_the_docs_stands_twice_and_words_do_not_grow(capsys):
    assert docs_words.main() == 0, capsys.readouterr().out


def test_a_sentence_that_stands_twice_is_found_with_any_marks():
    once = "The ball is found by its outline in each picture."
    first = f"# Title\n\n{once}\n\n```\n{once}\n```\n\n| {once} |\n"
    second = "- The **ball** is found\n  by [its outline](a.md) in each picture. A short one."
    assert docs_words.twice({"a.md": first, "b.md": "A short one. A short one."}) == {}
    assert list(docs_words.twice({"a.md": first, "b.md": second}).values()) == [["a.md", "b.md"]]


def test_version_citation_and_changelog_are_of_one_release():
    cited = yaml.safe_load((REPO / "CITATION.cff").read_text())
    sections = re.findall(r"^## \[(\d\S*)\] - (\S+)$", (REPO / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert sections[0] == (sphereorient.__version__, str(cited["date-released"]))
    assert cited["version"] == sphereorient.__version__
