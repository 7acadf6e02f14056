"""The network as Lightning trains it: loss, learning rate, and the look at the validation pictures."""

from __future__ import annotations

import math
from typing import Any

import torch
from pytorch_lightning import LightningModule
from torch import Tensor

from sphereorient.learn.density import first_right, tops_of
from sphereorient.learn.judge import WITHIN_DEG, Answers, Judged, cross_entropy, judge, logits_of
from sphereorient.learn.network import Correlator
from sphereorient.learn.pictures import Lesson
from sphereorient.learn.settings import ProposerSettings

WARM_UP_STEPS = 100  # while the learning rate rises; a tenth of all steps where that is less
LOOKED_AT = 10  # every so many steps the recall on the training's own pictures is looked at


class ProposerModule(LightningModule):
    """A `Correlator` that learns where balls point.

    Args:
        settings: of the training.
        network: with the weights that it begins with.
    """

    def __init__(self, settings: ProposerSettings, network: Correlator) -> None:
        super().__init__()
        self.settings, self.network = settings, network
        self.spread_rad = math.radians(settings.training.spread_deg)
        self.judged: Judged | None = None  # of the last validation
        self.share_of_time = 0.0  # that has gone by, where time is limited
        self._losses: list[Tensor] = []
        self._right: list[Tensor] = []
        self._answers: list[Answers] = []

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return the optimiser; `on_train_batch_start` gives it its learning rate."""
        training = self.settings.training
        return torch.optim.AdamW(
            self.network.parameters(), lr=training.learning_rate, weight_decay=training.weight_decay
        )

    def learning_rate(self) -> float:
        """Return the rate of the step that comes: rising, then falling like a cosine with the share that is done."""
        training = self.settings.training
        total = training.epochs * training.steps
        warm = min(WARM_UP_STEPS, max(total // 10, 1))
        share = min(max(self.global_step / total, self.share_of_time), 1.0)
        return training.learning_rate * min(1.0, (self.global_step + 1) / warm) * 0.5 * (1 + math.cos(math.pi * share))

    def on_train_batch_start(self, batch: Lesson, batch_idx: int) -> None:
        """Set the learning rate."""
        optimizer = self.optimizers()
        assert isinstance(optimizer, torch.optim.Optimizer) or hasattr(optimizer, "param_groups")
        for group in optimizer.param_groups:
            group["lr"] = self.learning_rate()

    def training_step(self, batch: Lesson, batch_idx: int) -> Tensor:
        """Return the loss of a lesson."""
        logits, truth = logits_of(self.network, batch), batch.R_view_body.flatten(0, 1)
        loss = cross_entropy(logits, truth, self.network.grid, self.spread_rad).mean()
        self._losses.append(loss.detach())
        if batch_idx % LOOKED_AT == 0:
            tops = tops_of(logits.detach(), self.network.grid, 1)
            self._right.append(first_right(tops, truth, WITHIN_DEG) < 1)
        return loss

    def validation_step(self, batch: Lesson, batch_idx: int) -> None:
        """Keep what the network says of a lesson."""
        self._answers.append(
            Answers(logits=logits_of(self.network, batch), R_view_body=batch.R_view_body.flatten(0, 1))
        )

    def on_validation_epoch_end(self) -> None:
        """Judge what was said."""
        self.judged = judge(joined(self._answers), self.network.grid, self.spread_rad)
        self._answers = []
        self.log("validation_nll", self.judged.nll, logger=False)

    def trained_figures(self) -> dict[str, float]:
        """Return the figures of the steps since the last call, of the training's own pictures."""
        figures: dict[str, float] = {}
        if self._losses:
            figures["train_nll"] = float(torch.stack(self._losses).mean())
        if self._right:
            figures["train_recall_1"] = float(torch.cat(self._right).double().mean())
        self._losses, self._right = [], []
        return figures

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the settings beside the weights, so that training goes on with the same ones only."""
        checkpoint["sphereorient_settings"] = self.settings.model_dump(mode="json")


def joined(parts: list[Answers]) -> Answers:
    """Return the answers of all parts as one."""
    return Answers(
        logits=torch.cat([part.logits for part in parts]), R_view_body=torch.cat([part.R_view_body for part in parts])
    )
