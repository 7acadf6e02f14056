import logging
import math
import signal
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import Trainer
from pytorch_lightning.callbacks import EarlyStopping

from sphereorient import __version__
from sphereorient.errors import CheckpointError, OutputError, SettingsError, refusal
from sphereorient.experiment.recording import Progress, silent
from sphereorient.learn.checkpoint import Checkpoint, correlator_of, load_checkpoint, save_checkpoint, texture_sha256
from sphereorient.learn.metrics import Metrics, fitted_temperature, metrics_of, predict_all
from sphereorient.learn.module import LAST, CheckpointCallback, ProposerModule, Row, TrainingData, TrainingTimer
from sphereorient.learn.network import Correlator
from sphereorient.learn.settings import ProposerSettings
from sphereorient.sphere import load_texture

CHECKPOINT = "proposer.ckpt"
LENGTH = ("epochs", "minutes", "patience")  # may change when training is resumed


@dataclass(frozen=True, kw_only=True, eq=False)
class Trained:
    """The result of a training; made by `train_proposer`."""

    checkpoint: Checkpoint
    metrics: Metrics  # on the validation pictures, with the temperature
    rows: tuple[Row, ...]  # metrics of each epoch, as in metrics.csv; the first is the untrained network


def train_proposer(
    settings: ProposerSettings, out: Path, *, resume: bool = False, progress: Progress = silent
) -> Trained:
    """Train a proposer and write proposer.ckpt, last.ckpt and metrics.csv into the folder `out`, created if missing.

    `resume` continues from last.ckpt, to the same weights unless `minutes` is set; `progress` gets stage, done, total.

    Raises:
        CheckpointError: training.start or last.ckpt cannot be used.
        TextureError: pictures.texture cannot be read.
        OutputError: the folder cannot be written.
        SettingsError: the training does not converge to finite numbers.
    """
    network, minutes = prepare(settings, out, resume), settings.training.minutes
    timer = TrainingTimer(None if minutes is None else timedelta(minutes=minutes), verbose=False)
    kept = CheckpointCallback(out, progress)
    progress("draw maps", 0, 1)
    data = TrainingData(settings)
    progress("draw maps", 1, 1)
    with _quiet_lightning():
        stop = EarlyStopping("validation_nll", patience=settings.training.patience, mode="min")
        trainer = Trainer(
            accelerator="gpu" if torch.cuda.is_available() else "cpu",
            devices=1,
            max_epochs=settings.training.epochs,
            callbacks=[stop, kept, timer],
            logger=False,
            default_root_dir=str(out),
            gradient_clip_val=1.0,
            reload_dataloaders_every_n_epochs=1,
            num_sanity_val_steps=0 if resume else -1,  # the untrained network is the first row of the history
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        _fit(trainer, ProposerModule(settings, network), data, str(out / LAST) if resume else None)
    if not kept.best:
        do = "lower training.learning_rate"
        raise SettingsError(refusal("training", expected="finite losses", got="others in the first epoch", do=do))
    network.load_state_dict(kept.best)
    network.cpu().eval()
    predictions = predict_all(network, data.validation)
    temperature = fitted_temperature(predictions, network.grid)
    metrics = metrics_of(predictions, network.grid, math.radians(settings.training.spread_deg), temperature)
    own = settings.pictures.texture
    checkpoint = Checkpoint(
        settings=settings,
        state={name: tensor.detach().clone() for name, tensor in network.state_dict().items()},
        temperature=temperature,
        texture_sha256=None if own is None else texture_sha256(load_texture(Path(own))),
        about={
            "sphereorient": __version__,
            "torch": str(torch.__version__),
            "pytorch_lightning": version("pytorch-lightning"),
            "best_step": kept.best_step,
            "steps": int(kept.rows[-1]["step"]),
            "minutes": round(timer.time_elapsed() / 60, 2),
            "device": "gpu" if torch.cuda.is_available() else "cpu",
            "validation_pictures": metrics.pictures,
            "validation_nll": metrics.nll,
            "validation_recall_1": metrics.recall_1,
            "validation_recall_5": metrics.recall_5,
            "validation_ece": metrics.ece,
        },
    )
    save_checkpoint(out / CHECKPOINT, checkpoint)
    return Trained(checkpoint=checkpoint, metrics=metrics, rows=tuple(kept.rows))


def prepare(settings: ProposerSettings, out: Path, resume: bool = False) -> Correlator:
    """Check the inputs as `train_proposer`, create the folder, and return the initial network."""
    if resume:
        _check_last(out / LAST, settings)
    network = _initial_network(settings)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        got = f"'{error.strerror}'"
        raise OutputError(refusal(str(out), expected="a folder", got=got, do="choose another --out")) from error
    return network


def _initial_network(settings: ProposerSettings) -> Correlator:
    start = settings.training.start
    if start is None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.training.seed)
            return Correlator(settings.network)
    checkpoint = load_checkpoint(Path(start))
    if checkpoint.settings.network != settings.network:
        expected, do = "the network of training.start", "copy the branch network of its settings"
        raise CheckpointError(refusal(f"checkpoint {start}", expected=expected, got="other network settings", do=do))
    return correlator_of(checkpoint).train().requires_grad_(True)


def _check_last(last: Path, settings: ProposerSettings) -> None:
    """Refuse to resume another training, before Lightning reads the file."""
    name, do = f"--resume {last}", "train anew without --resume"
    if not last.is_file():
        raise CheckpointError(refusal(name, expected="the last.ckpt of an interrupted training", got="none", do=do))
    try:
        # Lightning would execute code in the file; weights_only does not.
        saved = torch.load(last, map_location="cpu", weights_only=True)
        before = ProposerSettings.model_validate(saved["sphereorient_settings"])
    except Exception as error:  # damaged pickles raise nearly anything
        got = "a damaged file, or one of another version"
        raise CheckpointError(refusal(name, expected="a whole last.ckpt", got=got, do=do)) from error
    if _without_length(before) != _without_length(settings):
        do = "pass settings.yaml beside it"
        raise CheckpointError(refusal(name, expected="the same settings", got="other settings", do=do))


def _without_length(settings: ProposerSettings) -> dict[str, Any]:
    return settings.model_dump(exclude={"training": set(LENGTH)})


def _fit(trainer: Trainer, module: ProposerModule, data: TrainingData, last: str | None) -> None:
    """Train; raise KeyboardInterrupt on Ctrl-C, where Lightning would exit."""
    main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGINT) if main else None
    try:
        trainer.fit(module, datamodule=data, ckpt_path=last)
    except SystemExit:
        if trainer.interrupted:
            raise KeyboardInterrupt from None
        raise
    finally:
        if main:
            signal.signal(signal.SIGINT, before)


@contextmanager
def _quiet_lightning() -> Iterator[None]:
    loggers = [logging.getLogger(name) for name in ("pytorch_lightning", "lightning_fabric", "lightning")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"(pytorch_lightning|lightning_fabric|lightning)\b.*")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
