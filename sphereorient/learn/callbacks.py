"""What goes on beside the training: the best weights, the history, the file to go on from, progress and the clock."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pytorch_lightning import Callback, LightningModule, Trainer
from torch import Tensor

from sphereorient.files.outputs import put_aside
from sphereorient.learn.module import ProposerModule

LAST = "last.ckpt"
Row = dict[str, float]
Advance = Callable[[str, int, int], None]


class Keeper(Callback):
    """Keeps the history, the weights of the best validation, and after each epoch the file to go on from.

    Args:
        out: folder.
        advance: told the steps that are done.
    """

    def __init__(self, out: Path, advance: Advance) -> None:
        self._out, self._advance = out, advance
        self.rows: list[Row] = []
        self.best: dict[str, Tensor] = {}
        self.best_nll = float("inf")
        self.best_step = 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Give the logger the history of the part before, which it would forget."""
        if trainer.global_step:
            for row in self.rows:
                _log(trainer, row)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Tell the progress."""
        training = _own(pl_module).settings.training
        self._advance("train", trainer.global_step, training.epochs * training.steps)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write a row of the history, and keep the weights where they are better."""
        module = _own(pl_module)
        judged = module.judged
        assert judged is not None
        row: Row = {
            "epoch": float(trainer.current_epoch + (not trainer.sanity_checking)),
            "step": float(trainer.global_step),
            "learning_rate": 0.0 if trainer.sanity_checking else module.learning_rate(),
            **module.trained_figures(),
            "validation_nll": judged.nll,
            "validation_recall_1": judged.recall_1,
            "validation_recall_5": judged.recall_5,
            "validation_probability": judged.probability,
            "validation_ece": judged.ece,
        }
        self.rows.append(row)
        _log(trainer, row)
        if judged.nll < self.best_nll:
            self.best_nll, self.best_step = judged.nll, trainer.global_step
            self.best = {name: tensor.detach().cpu().clone() for name, tensor in module.network.state_dict().items()}

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the file to go on from, whole or not at all."""
        with put_aside(self._out / LAST, also=(RuntimeError,)) as aside:
            trainer.save_checkpoint(aside)

    def state_dict(self) -> dict[str, Any]:
        """Return what belongs into the file to go on from."""
        return {"rows": self.rows, "best": self.best, "best_nll": self.best_nll, "best_step": self.best_step}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take it back."""
        self.rows, self.best = state_dict["rows"], state_dict["best"]
        self.best_nll, self.best_step = state_dict["best_nll"], state_dict["best_step"]


class Clock(Callback):
    """Ends the training when its time is over, and tells the learning rate how much of it is gone.

    Args:
        minutes: None: no limit.
    """

    def __init__(self, minutes: float | None) -> None:
        self._seconds = None if minutes is None else 60 * minutes
        self._before, self._began = 0.0, time.monotonic()

    @property
    def elapsed_s(self) -> float:
        """Time of the training, parts before a resumption included."""
        return self._before + time.monotonic() - self._began

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Look at the clock."""
        if self._seconds is not None:
            _own(pl_module).share_of_time = self.elapsed_s / self._seconds
            if self.elapsed_s >= self._seconds:
                trainer.should_stop = True

    def state_dict(self) -> dict[str, Any]:
        """Return what belongs into the file to go on from."""
        return {"elapsed_s": self.elapsed_s}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take it back."""
        self._before, self._began = float(state_dict["elapsed_s"]), time.monotonic()


def _own(module: LightningModule) -> ProposerModule:
    assert isinstance(module, ProposerModule)
    return module


def _log(trainer: Trainer, row: Row) -> None:
    if trainer.logger is not None:
        trainer.logger.log_metrics(dict(row), step=int(row["step"]))
        trainer.logger.save()
