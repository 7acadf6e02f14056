"""The training of a proposer with Lightning: data, loss and learning rate, checkpoints, time limit."""

import csv
import logging
import math
import signal
import threading
import warnings
from dataclasses import asdict, dataclass
from datetime import timedelta
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import Callback, LightningDataModule, LightningModule, Trainer
from pytorch_lightning.callbacks import EarlyStopping, Timer
from torch import Tensor
from torch.utils.data import DataLoader

from sphereorient import __version__
from sphereorient.errors import CheckpointError, SettingsError, refusal
from sphereorient.files.threads import Progress, silent
from sphereorient.files.whole_file import make_folder, put_aside, writing
from sphereorient.learn import metrics
from sphereorient.learn.checkpoint import Checkpoint, correlator_of, load_checkpoint, save_checkpoint, texture_sha256
from sphereorient.learn.metrics import WITHIN_DEG, Metrics, Predictions
from sphereorient.learn.network import Correlator, find_modes, first_right
from sphereorient.learn.pictures import MAPS, VALIDATION_SEED, TrainingBatch, draw_batch, generator_of, make_textures
from sphereorient.learn.settings import ProposerSettings
from sphereorient.sphere import load_texture

CHECKPOINT = "proposer.ckpt"
LENGTH = ("epochs", "minutes", "patience")  # may change when training is resumed
LAST = "last.ckpt"
TRAINING, VALIDATION = 0, 1  # random streams, without common pictures
VALIDATION_SHAPE = 1, 2, 8  # of a validation batch: maps, groups of each, pictures of a group
WARM_UP_STEPS = 100  # of the learning rate; at most a tenth of all steps
RECALL_EVERY = 10  # steps between measurements of the recall on training pictures
_Row = dict[str, float]


class TrainingData(LightningDataModule):
    """Training pictures, a function of seed, epoch and step only; validation pictures, drawn once."""

    def __init__(self, settings: ProposerSettings) -> None:
        super().__init__()
        pictures, nodes = settings.pictures, settings.network.nodes
        self._settings = settings
        self.textures = make_textures(pictures, nodes, count=pictures.textures, first_seed=0)
        unseen = make_textures(pictures, nodes, count=MAPS, first_seed=VALIDATION_SEED)
        rng = generator_of(settings.training.seed, VALIDATION)
        count = -(-pictures.validation // math.prod(VALIDATION_SHAPE))
        self.validation = [draw_batch(unseen, pictures, rng, VALIDATION_SHAPE) for _ in range(count)]

    def training_batch(self, epoch: int, step: int) -> TrainingBatch:
        """Draw the batch of a step."""
        of = self._settings.training
        rng = generator_of(of.seed, TRAINING, epoch, step)
        return draw_batch(self.textures, self._settings.pictures, rng, (of.maps, of.groups, of.group))

    def train_dataloader(self) -> DataLoader[int]:
        """Return the batches of the coming epoch; Lightning calls this in every epoch."""
        epoch = self.trainer.current_epoch if self.trainer is not None else 0
        steps: Any = range(self._settings.training.steps)
        return DataLoader(steps, batch_size=None, collate_fn=partial(self.training_batch, epoch))

    def val_dataloader(self) -> DataLoader[TrainingBatch]:
        """Return the validation batches."""
        batches: Any = self.validation
        return DataLoader(batches, batch_size=None)


class ProposerModule(LightningModule):
    """A `Correlator` with its loss, learning rate and validation."""

    def __init__(self, settings: ProposerSettings, network: Correlator) -> None:
        super().__init__()
        self.settings, self.network = settings, network
        self.spread_rad = math.radians(settings.training.spread_deg)
        self.metrics: Metrics | None = None  # of the last validation
        self.share_of_time = 0.0  # elapsed, of the time limit
        self._losses: list[Tensor] = []
        self._right: list[Tensor] = []
        self._predictions: list[Predictions] = []

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return the optimiser; `on_train_batch_start` sets its learning rate."""
        of = self.settings.training
        return torch.optim.AdamW(self.network.parameters(), lr=of.learning_rate, weight_decay=of.weight_decay)

    def learning_rate(self) -> float:
        """Return the rate of the next step: a linear rise, then a cosine of the finished share of steps or time."""
        training = self.settings.training
        total = training.epochs * training.steps
        warm = min(WARM_UP_STEPS, max(total // 10, 1))
        share = min(max(self.global_step / total, self.share_of_time), 1.0)
        return training.learning_rate * min(1.0, (self.global_step + 1) / warm) * 0.5 * (1 + math.cos(math.pi * share))

    def on_train_batch_start(self, batch: TrainingBatch, batch_idx: int) -> None:
        """Set the learning rate."""
        optimizer: Any = self.optimizers()
        for group in optimizer.param_groups:
            group["lr"] = self.learning_rate()

    def training_step(self, batch: TrainingBatch, batch_idx: int) -> Tensor:
        """Return the loss of a batch."""
        predictions = metrics.predict(self.network, batch)
        loss = metrics.cross_entropy(predictions, self.network.grid, self.spread_rad).mean()
        self._losses.append(loss.detach())
        if batch_idx % RECALL_EVERY == 0:
            modes = find_modes(predictions.logits.detach(), self.network.grid, 1)
            self._right.append(first_right(modes, predictions.R_view_body, WITHIN_DEG) < 1)
        return loss

    def validation_step(self, batch: TrainingBatch, batch_idx: int) -> None:
        """Keep the predictions for a batch."""
        self._predictions.append(metrics.predict(self.network, batch))

    def on_validation_epoch_end(self) -> None:
        """Compute the metrics."""
        predictions = metrics.joined_predictions(self._predictions)
        self.metrics = metrics.metrics_of(predictions, self.network.grid, self.spread_rad)
        self._predictions = []
        self.log("validation_nll", self.metrics.nll, logger=False)

    def training_metrics(self) -> _Row:
        """Return loss and recall on training pictures since the last call."""
        if not self._losses:
            return {}
        recall = torch.cat(self._right).double().mean()
        row = {"train_nll": float(torch.stack(self._losses).mean()), "train_recall_1": float(recall)}
        self._losses, self._right = [], []
        return row

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the settings, which must be the same on resuming."""
        checkpoint["sphereorient_settings"] = self.settings.model_dump(mode="json")


class CheckpointCallback(Callback):
    """Keeps the history, the weights of the best validation, and last.ckpt after each epoch, in the folder `out`."""

    def __init__(self, out: Path, progress: Progress, timer: Timer) -> None:
        self.out, self._progress, self._timer = out, progress, timer
        self.rows: list[_Row] = []
        self.best: dict[str, Tensor] = {}
        self.best_nll = math.inf
        self.best_step = 0

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, *_: Any) -> None:
        """Report the progress, and pass the share of the time to the learning rate."""
        training = pl_module.settings.training
        self._progress("train", trainer.global_step, training.epochs * training.steps)
        if training.minutes is not None:
            pl_module.share_of_time = self._timer.time_elapsed() / (60 * training.minutes)

    def on_validation_end(self, trainer: Trainer, pl_module: Any) -> None:
        """Add a row to the history, and keep the weights if they are the best."""
        module: ProposerModule = pl_module
        assert module.metrics is not None
        row = {
            "epoch": float(trainer.current_epoch + (not trainer.sanity_checking)),
            "step": float(trainer.global_step),
            "learning_rate": 0.0 if trainer.sanity_checking else module.learning_rate(),
            **module.training_metrics(),
        }
        row |= {f"validation_{name}": value for name, value in asdict(module.metrics).items() if name != "pictures"}
        self.rows.append(row)
        with put_aside(self.out / "metrics.csv") as aside, aside.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, sorted({key for row in self.rows for key in row}))
            writer.writeheader()
            writer.writerows({**row, "step": int(row["step"])} for row in self.rows)
        if module.metrics.nll < self.best_nll:
            self.best_nll, self.best_step = module.metrics.nll, trainer.global_step
            self.best = {name: tensor.detach().cpu().clone() for name, tensor in module.network.state_dict().items()}

    def on_train_epoch_end(self, trainer: Trainer, pl_module: Any) -> None:
        """Write last.ckpt atomically."""
        with put_aside(self.out / LAST, also=(RuntimeError,)) as aside:
            trainer.save_checkpoint(aside)

    def state_dict(self) -> dict[str, Any]:
        """Return the state for last.ckpt."""
        return {key: getattr(self, key) for key in ("rows", "best", "best_nll", "best_step")}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state."""
        vars(self).update(state_dict)


@dataclass(frozen=True, kw_only=True, eq=False)
class Trained:
    """The result of a training; made by `train_proposer`."""

    checkpoint: Checkpoint
    metrics: Metrics  # on the validation pictures, with the temperature
    rows: tuple[_Row, ...]  # metrics of each epoch, as in metrics.csv; first the untrained network


def train_proposer(
    settings: ProposerSettings, out: Path, *, resume: bool = False, progress: Progress = silent
) -> Trained:
    """Train a proposer and write proposer.ckpt, last.ckpt and metrics.csv into the folder `out`, created if missing.
    `resume` continues from last.ckpt, to the same weights unless `minutes` is set; `progress` gets stage, done, total.
    Raises CheckpointError: training.start or last.ckpt cannot be used; TextureError: pictures.texture cannot be read;
    OutputError: the folder cannot be written; SettingsError: the training does not converge to finite numbers.
    """
    network, minutes = prepare(settings, out, resume), settings.training.minutes
    timer = Timer(None if minutes is None else timedelta(minutes=minutes), verbose=False)
    kept = CheckpointCallback(out, progress, timer)
    progress("draw maps", 0, 1)
    data = TrainingData(settings)
    progress("draw maps", 1, 1)
    with writing(force=resume):  # last.ckpt proves that training made the folder
        _fit(ProposerModule(settings, network), data, kept, timer, resume)
    if not kept.best:
        do = "lower training.learning_rate"
        raise SettingsError(refusal("training", expected="finite losses", got="others in the first epoch", do=do))
    network.load_state_dict(kept.best)
    network.cpu().eval()
    with torch.no_grad():
        predictions = metrics.joined_predictions([metrics.predict(network, batch) for batch in data.validation])
    temperature = metrics.fitted_temperature(predictions, network.grid)
    measured = metrics.metrics_of(predictions, network.grid, math.radians(settings.training.spread_deg), temperature)
    own = settings.pictures.texture
    checkpoint = Checkpoint(
        settings=settings,
        state=kept.best,
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
            **{f"validation_{name}": value for name, value in asdict(measured).items() if name != "probability"},
        },
    )
    with writing(force=resume):
        save_checkpoint(out / CHECKPOINT, checkpoint)
    return Trained(checkpoint=checkpoint, metrics=measured, rows=tuple(kept.rows))


def prepare(settings: ProposerSettings, out: Path, resume: bool = False) -> Correlator:
    """Check the inputs as `train_proposer`, create the folder, and return the initial network."""
    if resume:
        _check_last(out / LAST, settings)
    if (start := settings.training.start) is None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.training.seed)
            network = Correlator(settings.network)
    else:
        checkpoint = load_checkpoint(Path(start))
        if checkpoint.settings.network != settings.network:
            expected, got = "the network of training.start", "other network settings"
            do = "copy the branch network of its settings"
            raise CheckpointError(refusal(f"checkpoint {start}", expected=expected, got=got, do=do))
        network = correlator_of(checkpoint).train().requires_grad_(True)
    make_folder(out, str(out))
    return network


def _check_last(last: Path, settings: ProposerSettings) -> None:
    """Refuse to resume another training, before Lightning reads the file."""
    name, do = f"--resume {last}", "train again without --resume"
    if not last.is_file():
        raise CheckpointError(refusal(name, expected="the last.ckpt of an interrupted training", got="none", do=do))
    try:
        # Lightning would execute code in the file; weights_only does not.
        saved = torch.load(last, map_location="cpu", weights_only=True)
        before = ProposerSettings.model_validate(saved["sphereorient_settings"])
    except Exception as error:  # damaged pickles raise nearly anything
        got = "a damaged file, or one of another version"
        raise CheckpointError(refusal(name, expected="a whole last.ckpt", got=got, do=do)) from error
    old, new = (one.model_dump(exclude={"training": set(LENGTH)}) for one in (before, settings))
    if old != new:
        do = "pass settings.yaml beside it"
        raise CheckpointError(refusal(name, expected="the same settings", got="other settings", do=do))


def _fit(module: ProposerModule, data: TrainingData, kept: CheckpointCallback, timer: Timer, resume: bool) -> None:
    """Train without Lightning's messages; raise KeyboardInterrupt on Ctrl-C, where Lightning would exit."""
    main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGINT) if main else None
    training = module.settings.training
    loggers = [logging.getLogger(name) for name in ("pytorch_lightning", "lightning_fabric")]
    levels = [logger.level for logger in loggers]
    try:
        with warnings.catch_warnings():
            for logger in loggers:
                logger.setLevel(logging.ERROR)
            warnings.filterwarnings("ignore", module=r"(pytorch_lightning|lightning_fabric|lightning)\b.*")
            trainer = Trainer(
                accelerator="gpu" if torch.cuda.is_available() else "cpu",
                devices=1,
                max_epochs=training.epochs,
                callbacks=[EarlyStopping("validation_nll", patience=training.patience, mode="min"), kept, timer],
                logger=False,
                default_root_dir=str(kept.out),
                gradient_clip_val=1.0,
                reload_dataloaders_every_n_epochs=1,
                num_sanity_val_steps=0 if resume else -1,  # first row of the history: the untrained network
                enable_checkpointing=False,
                enable_progress_bar=False,
                enable_model_summary=False,
            )
            trainer.fit(module, datamodule=data, ckpt_path=str(kept.out / LAST) if resume else None)
    except SystemExit:
        if trainer.interrupted:
            raise KeyboardInterrupt from None
        raise
    finally:
        if main:
            signal.signal(signal.SIGINT, before)
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
