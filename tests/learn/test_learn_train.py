"""Training in small: it learns, the same seed gives the same weights, and a resumed training has the same result."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from learn_examples import TINY, Writer, state_of, tiny, untrained

from sphereorient.errors import CheckpointError, SettingsError
from sphereorient.learn.checkpoint import Checkpoint, correlator_of, load_checkpoint, save_checkpoint, texture_sha256
from sphereorient.learn.metrics import Predictions, fitted_temperature, metrics_of
from sphereorient.learn.settings import ProposerSettings
from sphereorient.learn.train import ProposerModule, Trained, train_proposer
from sphereorient.sphere import load_texture
from sphereorient.synth import random_texture

SHORT = {"epochs": 3, "steps": 4}


def same(one: Checkpoint, other: Checkpoint) -> bool:
    return all(torch.equal(one.state[name], tensor) for name, tensor in other.state.items())


def rows_of(folder: Path) -> list[dict[str, float]]:
    with (folder / "metrics.csv").open() as file:
        return [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Trained, Path]:
    """A hundred steps: eight seconds on one slow core. It gets better all the time, so `patience` has no effect."""
    folder = tmp_path_factory.mktemp("trained") / "proposer"
    return train_proposer(tiny(patience=1), folder), folder


@pytest.fixture(scope="module")
def short(tmp_path_factory) -> tuple[Trained, Path]:
    folder = tmp_path_factory.mktemp("short")
    return train_proposer(tiny(**SHORT), folder), folder


@pytest.mark.slow
def test_training_finds_what_the_untrained_network_does_not(trained):
    rows = trained[0].rows
    assert rows[0]["step"] == 0
    assert rows[0]["validation_recall_1"] < 0.1
    assert rows[-1]["validation_recall_1"] > 0.6
    assert rows[-1]["validation_recall_5"] > 0.7
    assert rows[-1]["validation_nll"] < rows[0]["validation_nll"] - 3
    assert rows[-1]["train_nll"] < rows[1]["train_nll"] - 2
    assert trained[0].metrics.recall_1 > 0.6


@pytest.mark.slow
def test_the_checkpoint_is_that_of_the_best_validation_and_holds_its_description(trained):
    result, folder = trained
    loaded = load_checkpoint(folder / "proposer.ckpt")
    assert same(loaded, result.checkpoint)
    assert loaded.settings == tiny(patience=1)
    assert loaded.texture_sha256 is None
    best = min(result.rows, key=lambda row: row["validation_nll"])
    assert loaded.about["best_step"] == best["step"]
    assert math.isclose(loaded.about["validation_nll"], best["validation_nll"], rel_tol=1e-4)
    assert loaded.about["steps"] == 100


@pytest.mark.slow
def test_the_log_has_a_row_an_epoch(trained):
    result, folder = trained
    rows = rows_of(folder)
    assert [row["step"] for row in rows] == [0, 25, 50, 75, 100]
    assert [row["epoch"] for row in rows] == [0, 1, 2, 3, 4]
    for row, kept in zip(rows, result.rows, strict=True):
        assert row == pytest.approx(kept)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_weights_and_another_does_not(short, tmp_path):
    torch.manual_seed(99)  # earlier draws do not matter
    again = train_proposer(tiny(**SHORT), tmp_path / "again")
    assert same(again.checkpoint, short[0].checkpoint)
    assert again.rows == short[0].rows
    assert (tmp_path / "again" / "proposer.ckpt").stat().st_size == (short[1] / "proposer.ckpt").stat().st_size
    other = train_proposer(tiny(**SHORT, seed=1), tmp_path / "other")
    assert not same(other.checkpoint, short[0].checkpoint)


@pytest.mark.slow
@pytest.mark.parametrize("cut", [5, 8, 9])
def test_an_interrupted_training_goes_on_to_the_same_weights(short, tmp_path, cut):
    """Cut off in the second epoch, at its very end, in the third."""

    def interrupt(stage: str, done: int, total: int) -> None:
        if stage == "train" and done == cut:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_proposer(tiny(**SHORT), tmp_path, progress=interrupt)
    assert not (tmp_path / "proposer.ckpt").exists()
    calls: list[tuple[str, int]] = []
    resumed = train_proposer(
        tiny(**SHORT), tmp_path, resume=True, progress=lambda stage, done, total: calls.append((stage, done))
    )
    steps = [done for stage, done in calls if stage == "train"]
    assert steps[0] == cut - (cut - 1) % 4  # the epoch that was cut off begins again
    assert same(resumed.checkpoint, short[0].checkpoint)
    assert resumed.checkpoint.temperature == short[0].checkpoint.temperature
    assert resumed.rows == short[0].rows
    assert rows_of(tmp_path) == rows_of(short[1])


@pytest.mark.slow
def test_a_training_that_is_finished_can_be_resumed_and_stays(tmp_path):
    settings = tiny(**{**SHORT, "epochs": 2})
    first = train_proposer(settings, tmp_path)
    assert same(train_proposer(settings, tmp_path, resume=True).checkpoint, first.checkpoint)


@pytest.mark.slow
def test_a_training_resumes_with_the_same_settings_only_but_may_be_longer(short, tmp_path):
    (tmp_path / "last.ckpt").write_bytes((short[1] / "last.ckpt").read_bytes())
    with pytest.raises(CheckpointError, match="same settings"):
        train_proposer(tiny(**SHORT, learning_rate=1e-3), tmp_path, resume=True)
    assert train_proposer(tiny(**{**SHORT, "epochs": 4}), tmp_path, resume=True).rows[-1]["step"] == 16


@pytest.mark.parametrize("kind", ["none", "text", "half", "code", "of ours"])
def test_a_file_that_is_no_checkpoint_to_resume_from_is_refused_and_nothing_executed(short, tmp_path, kind):
    last, mark = tmp_path / "last.ckpt", tmp_path / "mark.txt"
    whole = (short[1] / "last.ckpt").read_bytes()
    if kind == "text":
        last.write_text("none")
    elif kind == "half":
        last.write_bytes(whole[: len(whole) // 2])
    elif kind == "code":
        tree = torch.load(short[1] / "last.ckpt", weights_only=True)
        torch.save({**tree, "more": Writer(mark)}, last)
    elif kind == "of ours":
        last.write_bytes((short[1] / "proposer.ckpt").read_bytes())
    with pytest.raises(CheckpointError) as caught:
        train_proposer(tiny(**SHORT), tmp_path, resume=True)
    assert "\n" not in str(caught.value)
    assert not mark.exists()


@pytest.mark.slow
def test_a_checkpoint_to_begin_with_gives_its_weights(short, tmp_path):
    """A learning rate of nearly zero: the weights stay, with any seed."""
    start = str(short[1] / "proposer.ckpt")
    changed = {"epochs": 1, "steps": 1, "learning_rate": 1e-12, "weight_decay": 0.0}
    tuned = train_proposer(tiny(seed=5, start=start, **changed), tmp_path)
    for name, tensor in short[0].checkpoint.state.items():
        assert (tuned.checkpoint.state[name] - tensor).abs().max() < 1e-6


def test_a_checkpoint_of_another_network_is_refused_as_a_start(short, tmp_path):
    tree = {**TINY, "network": {**TINY["network"], "width": 12}, "training": {"start": str(short[1] / "proposer.ckpt")}}
    with pytest.raises(CheckpointError, match="other network settings"):
        train_proposer(ProposerSettings.model_validate(tree), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_fine_tuning_on_one_map_binds_the_checkpoint_to_it(short, tmp_path):
    path = tmp_path / "texture.png"
    cv2.imwrite(str(path), (255 * random_texture("dots", 4, 128)).round().numpy().astype(np.uint8))
    tree = tiny(epochs=1, steps=2, start=str(short[1] / "proposer.ckpt")).model_dump()
    tree["pictures"]["texture"] = str(path)
    tuned = train_proposer(ProposerSettings.model_validate(tree), tmp_path / "tuned").checkpoint
    assert tuned.texture_sha256 == texture_sha256(load_texture(path))


@pytest.mark.slow
def test_training_ends_when_its_time_is_over(tmp_path):
    """Even before an epoch is done, with a checkpoint."""
    result = train_proposer(tiny(epochs=100, steps=1000, minutes=0.02), tmp_path)
    assert 0 < result.rows[-1]["step"] < 500
    assert result.rows[-1]["learning_rate"] < 1e-4  # fallen with the time, not with the steps
    assert (tmp_path / "proposer.ckpt").exists()


@pytest.mark.slow
def test_training_ends_when_validations_get_no_better(tmp_path):
    """Weights that hardly move: the second validation is not better by more than nothing, nor the third."""
    result = train_proposer(tiny(epochs=30, steps=1, learning_rate=1e-15, patience=2), tmp_path)
    assert result.rows[-1]["epoch"] <= 6


@pytest.mark.slow
def test_weights_that_got_worse_are_not_kept(trained, tmp_path):
    """A learning rate that destroys the weights: the best are those of the beginning."""
    start = trained[1] / "proposer.ckpt"
    result = train_proposer(tiny(epochs=1, steps=3, learning_rate=0.5, start=str(start)), tmp_path)
    assert result.rows[-1]["validation_nll"] > result.rows[0]["validation_nll"] + 0.1
    assert result.checkpoint.about["best_step"] == 0
    assert same(result.checkpoint, load_checkpoint(start))


@pytest.mark.slow
def test_a_training_that_explodes_is_refused_in_one_line(tmp_path):
    start = {**state_of(untrained()), "gain": torch.tensor(300.0)}  # exp of it is infinite
    save_checkpoint(tmp_path / "start.ckpt", Checkpoint(settings=tiny(), state=start))
    with pytest.raises(SettingsError, match="learning_rate") as caught:
        train_proposer(tiny(**SHORT, start=str(tmp_path / "start.ckpt")), tmp_path / "out")
    assert "\n" not in str(caught.value)


def test_the_learning_rate_rises_and_falls(monkeypatch):
    module = ProposerModule(tiny(epochs=10, steps=100), untrained())
    rates = []
    for step in range(1000):
        monkeypatch.setattr(ProposerModule, "global_step", step)
        rates.append(module.learning_rate())
    assert np.argmax(rates) in range(90, 110)
    assert rates[0] < 0.02 * max(rates)
    assert rates[-1] < 1e-4 * max(rates)
    assert math.isclose(rates[500], 0.5 * 5e-3, rel_tol=1e-6)
    assert (np.diff(rates[110:]) < 0).all()


@pytest.mark.slow
def test_a_temperature_that_was_planted_is_found(rng):
    """Logits of half the size get half the temperature, and then probabilities are those of the outcomes."""
    grid = untrained().grid
    logits = 14.0 * torch.nn.functional.normalize(torch.randn(200, 9, generator=rng), dim=1) @ grid.flatten(1).T
    truth = grid[torch.multinomial(logits.softmax(1), 1, generator=rng)[:, 0]]
    full, half = (Predictions(logits=factor * logits, R_view_body=truth) for factor in (1.0, 0.5))
    temperatures = [fitted_temperature(answers, grid) for answers in (full, half)]
    assert 1.6 < temperatures[0] / temperatures[1] < 2.5
    plain, fitted = (metrics_of(half, grid, math.radians(8), temperature) for temperature in (0.25, temperatures[1]))
    assert fitted.ece < 0.08
    assert fitted.ece < 0.5 * plain.ece


def test_judging_counts_right_and_wrong(rng):
    grid = untrained().grid
    k = torch.randperm(len(grid), generator=rng)[:40]
    logits = torch.full((40, len(grid)), -40.0)
    logits[torch.arange(40), k] = 0.0
    R = grid[k].clone()
    R[:10] = R[:10] @ torch.diag(torch.tensor([1.0, -1.0, -1.0]))  # ten are half a turn away
    found = metrics_of(Predictions(logits=logits, R_view_body=R), grid, math.radians(8))
    assert (found.pictures, found.recall_1, found.recall_5) == (40, 0.75, 0.75)
    assert found.probability == pytest.approx(1.0, abs=1e-6)
    assert found.ece == pytest.approx(0.25, abs=1e-6)


@pytest.mark.slow
def test_the_network_of_the_checkpoint_is_as_good_as_in_the_log(trained):
    """Loaded anew, on the same validation pictures."""
    from sphereorient.learn.metrics import joined_predictions, predict
    from sphereorient.learn.train import TrainingData

    loaded = load_checkpoint(trained[1] / "proposer.ckpt")
    network = correlator_of(loaded)
    predictions = joined_predictions([predict(network, batch) for batch in TrainingData(tiny()).validation])
    found = metrics_of(predictions, network.grid, math.radians(8), loaded.temperature)
    assert found.recall_1 == pytest.approx(loaded.about["validation_recall_1"])
    assert found.ece == pytest.approx(loaded.about["validation_ece"], abs=1e-6)
