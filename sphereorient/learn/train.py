"""Training of a proposer: from settings to a folder with its checkpoint."""

from __future__ import annotations

import logging
import math
import signal
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import Trainer
from pytorch_lightning.callbacks import EarlyStopping
from pytorch_lightning.loggers import CSVLogger

from sphereorient import __version__
from sphereorient.errors import CheckpointError, OutputError, SettingsError, refusal
from sphereorient.learn.callbacks import LAST, Advance, Clock, Keeper, Row
from sphereorient.learn.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, texture_sha256
from sphereorient.learn.data import LessonData
from sphereorient.learn.judge import Judged, answers_of, fitted_temperature, judge
from sphereorient.learn.module import ProposerModule
from sphereorient.learn.network import Correlator
from sphereorient.learn.settings import ProposerSettings
from sphereorient.sphere import load_texture

CHECKPOINT = "proposer.ckpt"
LENGTH = ("epochs", "minutes", "patience")  # may be others when training goes on


@dataclass(frozen=True, kw_only=True, eq=False)
class Trained:
    """What a training gave; made by `train`."""

    checkpoint: Checkpoint
    judged: Judged  # on the validation pictures, with the temperature
    rows: tuple[Row, ...]  # a row of figures an epoch, as metrics.csv has them; the first before any step


def _silent(stage: str, done: int, total: int) -> None:
    """Show no progress."""


def train(settings: ProposerSettings, out: Path, *, resume: bool = False, advance: Advance = _silent) -> Trained:
    """Train a proposer and write proposer.ckpt, last.ckpt and metrics.csv into a folder.

    Args:
        settings: of network, pictures and training.
        out: folder; made where there is none.
        resume: go on from last.ckpt in the folder, to the same weights that an uninterrupted training gives; where
            `minutes` is set these depend on the clock.
        advance: told stage, steps done and steps at most.

    Raises:
        CheckpointError: training.start, or last.ckpt to go on from, is none that fits.
        TextureError: pictures.texture cannot be read.
        OutputError: the folder cannot be written.
        SettingsError: the training does not converge to finite numbers.
    """
    network = prepare(settings, out, resume)
    clock, keeper = Clock(settings.training.minutes), Keeper(out, advance)
    advance("draw maps", 0, 1)
    data = LessonData(settings)
    advance("draw maps", 1, 1)
    module = ProposerModule(settings, network)
    with _quiet_lightning():
        trainer = _trainer(settings, out, keeper, clock, fresh=not resume)
        _fit(trainer, module, data, out / LAST if resume else None)
    if not keeper.best:
        do = "lower training.learning_rate"
        raise SettingsError(refusal("training", expected="finite losses", got="others in the first epoch", do=do))
    network.load_state_dict(keeper.best)
    trained = _finished(settings, network.cpu().eval(), data, keeper, clock)
    save_checkpoint(out / CHECKPOINT, trained.checkpoint)
    return trained


def prepare(settings: ProposerSettings, out: Path, resume: bool = False) -> Correlator:
    """Refuse at once what would be refused later, make the folder, and return the network to begin with.

    Raises:
        CheckpointError: training.start, or last.ckpt to go on from, is none that fits.
        OutputError: the folder cannot be made.
    """
    if resume:
        _check_last(out / LAST, settings)
    network = _network(settings)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        got = f"'{error.strerror}'"
        raise OutputError(refusal(str(out), expected="a folder", got=got, do="choose another --out")) from error
    return network


def _network(settings: ProposerSettings) -> Correlator:
    """Return a network with random weights, or with those to begin with."""
    start = settings.training.start
    if start is None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.training.seed)
            return Correlator(settings.network)
    checkpoint = load_checkpoint(Path(start))
    if checkpoint.settings.network != settings.network:
        expected, got = "the network of training.start", "other network settings"
        raise CheckpointError(
            refusal(f"checkpoint {start}", expected=expected, got=got, do="copy its settings' branch network")
        )
    network = Correlator(settings.network)
    network.load_state_dict(dict(checkpoint.state))
    return network


def _check_last(last: Path, settings: ProposerSettings) -> None:
    """Refuse to go on from a file of another training, before Lightning reads it."""
    name, do = f"--resume {last}", "train anew without --resume"
    if not last.is_file():
        raise CheckpointError(refusal(name, expected="the file of a training that was cut off", got="none", do=do))
    try:
        # Lightning would execute code that such a file carries; this does not.
        kept = torch.load(last, map_location="cpu", weights_only=True)
        before = ProposerSettings.model_validate(kept["sphereorient_settings"])
    except Exception as error:  # damaged pickles raise nearly anything
        got = "a damaged one, or one of another version"
        raise CheckpointError(refusal(name, expected="a whole last.ckpt", got=got, do=do)) from error
    if _without_length(before) != _without_length(settings):
        got = "other settings than those it began with"
        raise CheckpointError(refusal(name, expected="the same settings", got=got, do="pass settings.yaml beside it"))


def _without_length(settings: ProposerSettings) -> dict[str, Any]:
    tree = settings.model_dump()
    for key in LENGTH:
        tree["training"].pop(key)
    return tree


def _trainer(settings: ProposerSettings, out: Path, keeper: Keeper, clock: Clock, fresh: bool) -> Trainer:
    training = settings.training
    stop = EarlyStopping("validation_nll", patience=training.patience, mode="min")
    return Trainer(
        accelerator="gpu" if torch.cuda.is_available() else "cpu",
        devices=1,
        max_epochs=training.epochs,
        callbacks=[stop, keeper, clock],
        logger=CSVLogger(str(out), name="", version=""),
        default_root_dir=str(out),
        gradient_clip_val=1.0,
        reload_dataloaders_every_n_epochs=1,
        num_sanity_val_steps=-1 if fresh else 0,  # the untrained network is the history's first row
        log_every_n_steps=max(training.steps, 1),
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )


def _fit(trainer: Trainer, module: ProposerModule, data: LessonData, last: Path | None) -> None:
    """Train; Ctrl-C leaves as such, which Lightning would turn into an exit."""
    main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGINT) if main else None
    try:
        trainer.fit(module, datamodule=data, ckpt_path=None if last is None else str(last))
    except SystemExit:
        if trainer.interrupted:
            raise KeyboardInterrupt from None
        raise
    finally:
        if main:
            signal.signal(signal.SIGINT, before)


def _finished(
    settings: ProposerSettings, network: Correlator, data: LessonData, keeper: Keeper, clock: Clock
) -> Trained:
    """Fit the temperature and gather what the checkpoint says of itself."""
    answers = answers_of(network, data.validation)
    temperature = fitted_temperature(answers, network.grid)
    judged = judge(answers, network.grid, math.radians(settings.training.spread_deg), temperature)
    own = settings.pictures.texture
    return Trained(
        checkpoint=Checkpoint(
            settings=settings,
            state={name: tensor.detach().clone() for name, tensor in network.state_dict().items()},
            temperature=temperature,
            texture_sha256=None if own is None else texture_sha256(load_texture(Path(own))),
            about={
                **_versions(),
                "best_step": keeper.best_step,
                "steps": int(keeper.rows[-1]["step"]),
                "minutes": round(clock.elapsed_s / 60, 2),
                "device": "gpu" if torch.cuda.is_available() else "cpu",
                "validation_pictures": judged.pictures,
                "validation_nll": judged.nll,
                "validation_recall_1": judged.recall_1,
                "validation_recall_5": judged.recall_5,
                "validation_ece": judged.ece,
            },
        ),
        judged=judged,
        rows=tuple(keeper.rows),
    )


def _versions() -> dict[str, str]:
    return {
        "sphereorient": __version__,
        "torch": str(torch.__version__),
        "pytorch_lightning": version("pytorch-lightning"),
    }


@contextmanager
def _quiet_lightning() -> Iterator[None]:
    """Silence advice about hardware and data loaders, which the user did not choose."""
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
