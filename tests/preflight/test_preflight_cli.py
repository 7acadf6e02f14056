import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from conftest import REPO
from preflight_examples import PAINTED, Example, checked, clean_example, write  # noqa: F401

from sphereorient.preflight import Severity
from sphereorient.report import preflight_figure

EXCERPT = REPO / "synthetic_data" / "excerpt" / "experiment.yaml"


def check(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sphereorient.cli", "check", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=folder)


@pytest.mark.slow
def test_the_excerpt_passes_and_its_figure_lies_here(tmp_path):
    run = check(tmp_path, EXCERPT)
    assert run.returncode == 0, run.stderr
    assert "faults: 0, warnings: 0" in run.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["experiment.check.png"]
    assert cv2.imread(str(tmp_path / "experiment.check.png")) is not None


@pytest.mark.slow
def test_a_fault_ends_with_1_and_advice(clean, tmp_path):
    shifted = replace(clean, pictures={"cam1": clean.pictures["cam1"][3:], "cam2": clean.pictures["cam2"][:-3]})
    path = write(shifted, tmp_path / "experiment")
    run = check(tmp_path, path, "--out", "seen.png", "--quiet")
    assert run.returncode == 1
    assert run.stderr == ""
    assert "start: {cam1: 0, cam2: 3}" in " ".join(run.stdout.split())
    assert "ok " not in run.stdout  # quiet: nothing but complaints
    assert (tmp_path / "seen.png").is_file()


def test_a_figure_that_cannot_be_written_is_refused_before_the_work(clean, tmp_path):
    run = check(tmp_path, write(clean, tmp_path / "experiment"), "--out", "experiment/experiment.yaml/seen.png")
    assert run.returncode == 2
    assert "a folder to write in" in run.stderr


@pytest.mark.slow
@pytest.mark.parametrize("case", ["one camera", "no ball", "painted"])
def test_the_figure_is_drawn_with_any_part_missing(clean, tmp_path, case):
    keys = {}
    example = clean
    if case == "one camera":
        example = replace(clean, pictures={"cam2": clean.pictures["cam2"][:6]})
        keys = {"backgrounds": None}
    elif case == "no ball":
        example = clean.spoilt(lambda movie: movie[:, ::-1, :] * 0 + 9)
    else:
        keys = {"sphere": PAINTED}
    result = checked(example, tmp_path / "experiment", **keys)
    preflight_figure(result, tmp_path / "seen.png")
    drawn = cv2.imread(str(tmp_path / "seen.png"))
    assert drawn.std() > 10
    if case == "no ball":
        assert result.severity is Severity.FAULT
