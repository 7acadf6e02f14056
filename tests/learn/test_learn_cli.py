"""`sphereorient train` and `evaluate`: files, messages, and refusals of one line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
import torch
import yaml
from conftest import REPO
from learn_examples import TINY, state_of, tiny, untrained
from typer.testing import CliRunner

from sphereorient.cli import app
from sphereorient.errors import SphereOrientError
from sphereorient.learn.checkpoint import Checkpoint, save_checkpoint
from sphereorient.learn.metrics import LEVELS
from sphereorient.learn.settings import ProposerSettings
from sphereorient.methods.settings import model_yaml, read_model

LENGTH = ["--set", "training.epochs=2", "--set", "training.steps=3", "--set", "pictures.validation=32"]


@pytest.fixture(scope="module")
def config(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("config") / "tiny.yaml"
    path.write_text(yaml.safe_dump(tiny().model_dump(mode="json")))
    return path


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("checkpoint") / "proposer.ckpt"
    save_checkpoint(path, Checkpoint(settings=tiny(), state=state_of(untrained())))
    return path


@pytest.fixture(scope="module")
def trained(config, tmp_path_factory) -> tuple[Path, str]:
    out = tmp_path_factory.mktemp("cli") / "out"
    run = CliRunner().invoke(app, ["train", str(config), "--out", str(out), *LENGTH])
    assert run.exit_code == 0, run.exception
    return out, run.output


def refused(*arguments: object) -> str:
    """Return the refusal, which must be one line."""
    run = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert isinstance(run.exception, SphereOrientError), (run.exception, run.output)
    text = str(run.exception)
    assert "\n" not in text
    return text


def test_a_training_leaves_the_files_that_the_docs_name(trained):
    out, words = trained
    names = {entry.name for entry in out.iterdir()}
    assert names == {
        "proposer.ckpt", "last.ckpt", "metrics.csv", "learning_curve.png", "examples.png", "settings.yaml"
    }  # fmt: skip
    assert "proposer.ckpt" in words
    assert "calibration error" in words
    text = (REPO / "docs" / "proposer.md").read_text()
    assert all(f"`{name}`" in text for name in names)


def test_the_settings_beside_it_are_those_that_were_used(trained, config):
    again = read_model(ProposerSettings, trained[0] / "settings.yaml")
    assert again.training.epochs == 2
    assert again.network == tiny().network
    assert again.pictures.disks == tiny().pictures.disks


def test_the_figures_are_pictures_with_something_on_them(trained):
    for name in ("learning_curve.png", "examples.png"):
        picture = cv2.imread(str(trained[0] / name))
        assert min(picture.shape[:2]) > 250
        assert picture.std() > 10


@pytest.mark.slow
def test_quiet_prints_nothing_and_resume_goes_on(trained, tmp_path):
    out = trained[0]
    (tmp_path / "last.ckpt").write_bytes((out / "last.ckpt").read_bytes())
    arguments = ["train", out / "settings.yaml", "--out", tmp_path, "--resume", "--quiet", "--set", "training.epochs=3"]
    run = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert run.exit_code == 0
    assert run.output == ""
    assert [line.split(",")[0] for line in (tmp_path / "metrics.csv").read_text().splitlines()[1:]] == [
        "0.0", "1.0", "2.0", "3.0"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("training.step=3", "write 'steps'"),
        ("network.chanels=3", "write 'channels'"),
        ("pictures.disks.size=3", "write 'size_px'"),
        ("trainig.steps=3", "write 'training'"),
        ("training.steps=0", "greater than or equal to 1"),
        ("network.size_px=32", "pictures.disks.size_px"),
        ("pictures.kinds=[stripes]", "blobs, dots, patches"),
        ("steps=3", "room.key=value"),
        ("pictures.texture=none.png", "none.png"),
        ("training.start=none.ckpt", "none.ckpt"),
    ],
)
def test_impossible_settings_are_one_line_and_leave_nothing(config, tmp_path, override, words):
    out = tmp_path / "out"
    assert words in refused("train", config, "--out", out, "--set", override, "--quiet")
    assert not (out / "proposer.ckpt").exists()


def test_a_config_that_is_none_is_one_line(tmp_path):
    assert "none.yaml" in refused("train", tmp_path / "none.yaml", "--out", tmp_path / "out")
    path = tmp_path / "odd.yaml"
    path.write_text("training: {step: 3}\n")
    assert "write 'steps'" in refused("train", path, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_resuming_nothing_and_an_impossible_folder_are_one_line(config, tmp_path):
    assert "last.ckpt" in refused("train", config, "--out", tmp_path / "out", "--resume")
    (tmp_path / "file").write_text("")
    assert "a folder to write in" in refused("train", config, "--out", tmp_path / "file" / "out")
    assert "file" in refused("train", config, "--out", tmp_path / "file", *LENGTH)


@pytest.mark.slow
def test_evaluating_gives_recall_of_each_degradation_and_level(checkpoint):
    run = CliRunner().invoke(app, ["evaluate", str(checkpoint), "--pictures", "2", "--json", "--quiet"])
    assert run.exit_code == 0, run.exception
    found = json.loads(run.output)
    pairs = [(one["family"], one["level"]) for one in found["families"]]
    assert pairs == [(name, level) for name in tiny().pictures.degradations for level in LEVELS]
    assert all(one["pictures"] == 2 and 0 <= one["recall_1"] <= one["recall_5"] <= 1 for one in found["families"])
    assert found["mixed"]["pictures"] == 20
    assert found["pictures_per_s"] > 0
    table = CliRunner().invoke(app, ["evaluate", str(checkpoint), "--pictures", "2", "--quiet"]).output
    assert all(word in table for word in (*tiny().pictures.degradations, "level 5", "pictures/s"))


def test_a_config_gives_the_degradations_of_an_evaluation(checkpoint, tmp_path):
    path = tmp_path / "other.yaml"
    path.write_text(
        yaml.safe_dump({**TINY, "pictures": {**TINY["pictures"], "degradations": ["bubbles"]}, "training": {}})
    )
    run = CliRunner().invoke(
        app, ["evaluate", str(checkpoint), "--config", str(path), "--pictures", "1", "--json", "-q"]
    )
    assert {one["family"] for one in json.loads(run.output)["families"]} == {"bubbles"}


def test_impossible_inputs_of_evaluate_are_one_line(checkpoint, config, tmp_path):
    assert "none.ckpt" in refused("evaluate", tmp_path / "none.ckpt")
    assert "yaml" in refused("evaluate", config)
    (tmp_path / "empty.yaml").write_text("")  # the default: disks of 40 px
    assert "24 px" in refused("evaluate", checkpoint, "--config", tmp_path / "empty.yaml")


def test_a_checkpoint_of_one_ball_is_tried_on_that_ball_alone(tmp_path):
    path, texture = tmp_path / "tuned.ckpt", 255 * torch.rand(32, 64, generator=torch.Generator().manual_seed(1))
    cv2.imwrite(str(tmp_path / "other.png"), texture.round().numpy().astype("uint8"))
    save_checkpoint(path, Checkpoint(settings=tiny(), state=state_of(untrained()), texture_sha256="ab" * 32))
    assert "pictures.texture" in refused("evaluate", path)
    tree = tiny().model_dump(mode="json")
    tree["pictures"]["texture"] = str(tmp_path / "other.png")
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(tree))
    assert "fine-tuned" in refused("evaluate", path, "--config", tmp_path / "config.yaml")


def test_settings_written_are_settings_read(tmp_path):
    path = tmp_path / "settings.yaml"
    for settings in (ProposerSettings(), tiny(minutes=3.5, start="a: b.ckpt")):
        path.write_text(model_yaml("Training", settings))
        assert read_model(ProposerSettings, path) == settings


def test_the_committed_settings_are_the_defaults():
    assert read_model(ProposerSettings, REPO / "configs" / "train_proposer.yaml") == ProposerSettings()


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["settings"], ["evaluate", "none.ckpt"]])
def test_only_training_waits_for_lightning(arguments):
    code = (
        f"import sys; sys.argv = ['sphereorient', *{arguments}]\nfrom sphereorient import cli\ntry:\n    cli.main()\n"
    )
    code += "except SystemExit:\n    pass\nassert 'pytorch_lightning' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
