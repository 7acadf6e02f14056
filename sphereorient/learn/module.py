"""The training for Lightning: data, loss and learning rate, checkpoints, time limit."""

import csv
import math
from functools import partial
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import Callback, LightningDataModule, LightningModule, Trainer
from pytorch_lightning.callbacks import Timer
from torch import Tensor
from torch.utils.data import DataLoader

from sphereorient.experiment.recording import Progress
from sphereorient.files.outputs import put_aside
from sphereorient.learn.density import find_modes, first_right
from sphereorient.learn.metrics import WITHIN_DEG, Metrics, Predictions, cross_entropy, metrics_of, predict
from sphereorient.learn.network import Correlator
from sphereorient.learn.pictures import VALIDATION_SEED, TrainingBatch, draw_batch, generator_of, make_textures
from sphereorient.learn.settings import ProposerSettings

LAST = "last.ckpt"
VALIDATION_MAPS = 24
TRAINING, VALIDATION = 0, 1  # random streams: no picture occurs in both
VALIDATION_GROUPS, VALIDATION_GROUP = 2, 8  # pictures of a validation batch, which has one map
WARM_UP_STEPS = 100  # of the learning rate; at most a tenth of all steps
RECALL_EVERY = 10  # steps between measurements of the recall on training pictures
Row = dict[str, float]


class TrainingData(LightningDataModule):
    """Training pictures, a function of seed, epoch and step alone, and validation pictures, drawn once."""

    def __init__(self, settings: ProposerSettings) -> None:
        super().__init__()
        pictures, nodes = settings.pictures, settings.network.nodes
        self._settings = settings
        self.textures = make_textures(pictures, nodes, count=pictures.textures, first_seed=0)
        unseen = make_textures(pictures, nodes, count=VALIDATION_MAPS, first_seed=VALIDATION_SEED)
        rng = generator_of(settings.training.seed, VALIDATION)
        shape = 1, VALIDATION_GROUPS, VALIDATION_GROUP
        count = -(-pictures.validation // math.prod(shape))
        self.validation = [draw_batch(unseen, pictures, rng, shape) for _ in range(count)]

    def training_batch(self, epoch: int, step: int) -> TrainingBatch:
        """Draw the batch of a step."""
        training = self._settings.training
        rng = generator_of(training.seed, TRAINING, epoch, step)
        return draw_batch(self.textures, self._settings.pictures, rng, (training.maps, training.groups, training.group))

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
        training = self.settings.training
        return torch.optim.AdamW(
            self.network.parameters(), lr=training.learning_rate, weight_decay=training.weight_decay
        )

    def learning_rate(self) -> float:
        """Return the rate of the next step: a linear rise, then a cosine of the share of steps or time that is done."""
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
        predictions = predict(self.network, batch)
        loss = cross_entropy(predictions, self.network.grid, self.spread_rad).mean()
        self._losses.append(loss.detach())
        if batch_idx % RECALL_EVERY == 0:
            modes = find_modes(predictions.logits.detach(), self.network.grid, 1)
            self._right.append(first_right(modes, predictions.R_view_body, WITHIN_DEG) < 1)
        return loss

    def validation_step(self, batch: TrainingBatch, batch_idx: int) -> None:
        """Keep the predictions for a batch."""
        self._predictions.append(predict(self.network, batch))

    def on_validation_epoch_end(self) -> None:
        """Compute the metrics."""
        self.metrics = metrics_of(Predictions.joined(self._predictions), self.network.grid, self.spread_rad)
        self._predictions = []
        self.log("validation_nll", self.metrics.nll, logger=False)

    def training_metrics(self) -> Row:
        """Return loss and recall on training pictures since the last call."""
        row: Row = {}
        if self._losses:
            row["train_nll"] = float(torch.stack(self._losses).mean())
        if self._right:
            row["train_recall_1"] = float(torch.cat(self._right).double().mean())
        self._losses, self._right = [], []
        return row

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the settings: training is resumed only with the same ones."""
        checkpoint["sphereorient_settings"] = self.settings.model_dump(mode="json")


class TrainingTimer(Timer):
    """Ends training at its time limit; reads the elapsed time of old checkpoints too."""

    state_key = "Clock"  # its name in checkpoints

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Check the time, and pass the elapsed share to the learning rate."""
        super().on_train_batch_end(trainer)
        minutes = _own(pl_module).settings.training.minutes
        if minutes is not None:
            _own(pl_module).share_of_time = self.time_elapsed() / (60 * minutes)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the elapsed time."""
        old = state_dict.get("elapsed_s")
        super().load_state_dict(state_dict if old is None else {"time_elapsed": {"train": old}})


class CheckpointCallback(Callback):
    """Keeps the history, the weights of the best validation, and last.ckpt after each epoch, in the folder `out`."""

    state_key = "Keeper"  # its name in checkpoints

    def __init__(self, out: Path, progress: Progress) -> None:
        self._out, self._progress = out, progress
        self.rows: list[Row] = []
        self.best: dict[str, Tensor] = {}
        self.best_nll = float("inf")
        self.best_step = 0

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Report the progress."""
        training = _own(pl_module).settings.training
        self._progress("train", trainer.global_step, training.epochs * training.steps)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Add a row to the history, and keep the weights if they are the best."""
        module = _own(pl_module)
        assert module.metrics is not None
        self.rows.append(
            {
                "epoch": float(trainer.current_epoch + (not trainer.sanity_checking)),
                "step": float(trainer.global_step),
                "learning_rate": 0.0 if trainer.sanity_checking else module.learning_rate(),
                **module.training_metrics(),
                "validation_nll": module.metrics.nll,
                "validation_recall_1": module.metrics.recall_1,
                "validation_recall_5": module.metrics.recall_5,
                "validation_probability": module.metrics.probability,
                "validation_ece": module.metrics.ece,
            }
        )
        with put_aside(self._out / "metrics.csv") as aside, aside.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, sorted({key for row in self.rows for key in row}))
            writer.writeheader()
            writer.writerows({**row, "step": int(row["step"])} for row in self.rows)
        if module.metrics.nll < self.best_nll:
            self.best_nll, self.best_step = module.metrics.nll, trainer.global_step
            self.best = {name: tensor.detach().cpu().clone() for name, tensor in module.network.state_dict().items()}

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write last.ckpt atomically."""
        with put_aside(self._out / LAST, also=(RuntimeError,)) as aside:
            trainer.save_checkpoint(aside)

    def state_dict(self) -> dict[str, Any]:
        """Return the state for last.ckpt."""
        return {key: getattr(self, key) for key in ("rows", "best", "best_nll", "best_step")}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state."""
        for key, value in state_dict.items():
            setattr(self, key, value)


def _own(module: LightningModule) -> ProposerModule:
    assert isinstance(module, ProposerModule)
    return module
