"""Lessons for Lightning: what a step of the training sees depends on the seed, the epoch and the step alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from pytorch_lightning import LightningDataModule
from torch.utils.data import DataLoader, Dataset

from sphereorient.learn.draws import generator_of
from sphereorient.learn.pictures import VALIDATION_SEED, Balls, Lesson, draw_lesson, make_balls
from sphereorient.learn.settings import ProposerSettings

VALIDATION_MAPS = 24
TRAINING, VALIDATION = 0, 1  # streams of random numbers, so that no picture of the one comes again in the other
VALIDATION_GROUPS, VALIDATION_GROUP = 2, 8  # of the pictures of a validation lesson, which is of one map


class Lessons(Dataset[Lesson]):
    """Lessons by their number, drawn when they are asked for."""

    def __init__(self, draw: Callable[[int], Lesson], count: int) -> None:
        self._draw, self._count = draw, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, k: int) -> Lesson:
        return self._draw(k)


class LessonData(LightningDataModule):
    """Pictures to train on, drawn on the fly, and to validate with, drawn once.

    Args:
        settings: of the training.

    Raises:
        TextureError: the one map that is to be learnt cannot be read.
    """

    def __init__(self, settings: ProposerSettings) -> None:
        super().__init__()
        pictures, nodes = settings.pictures, settings.network.nodes
        self._settings = settings
        self.balls = make_balls(pictures, nodes, count=pictures.textures, first_seed=0)
        self.unseen = make_balls(pictures, nodes, count=VALIDATION_MAPS, first_seed=VALIDATION_SEED)
        self.validation = validation_lessons(self.unseen, settings)

    def lesson(self, epoch: int, step: int) -> Lesson:
        """Draw what a step of the training sees."""
        training = self._settings.training
        rng = generator_of(training.seed, TRAINING, epoch, step)
        return draw_lesson(
            self.balls, self._settings.pictures, rng, maps=training.maps, groups=training.groups, group=training.group
        )

    def train_dataloader(self) -> DataLoader[Lesson]:
        """Return the lessons of the epoch that begins; the trainer asks anew in every epoch."""
        epoch = self.trainer.current_epoch if self.trainer is not None else 0
        lessons = Lessons(lambda step: self.lesson(epoch, step), self._settings.training.steps)
        return DataLoader(lessons, batch_size=None, collate_fn=_same)

    def val_dataloader(self) -> DataLoader[Lesson]:
        """Return the lessons of the validation."""
        lessons = Lessons(self.validation.__getitem__, len(self.validation))
        return DataLoader(lessons, batch_size=None, collate_fn=_same)

    def transfer_batch_to_device(self, batch: Lesson, device: torch.device, dataloader_idx: int) -> Lesson:
        """Return a lesson on a device."""
        return Lesson(
            textures=batch.textures.to(device),
            blurs=batch.blurs.to(device),
            disks=batch.disks.to(device),
            R_view_body=batch.R_view_body.to(device),
        )


def validation_lessons(unseen: Balls, settings: ProposerSettings) -> list[Lesson]:
    """Draw the lessons of the validation, at least as many pictures as the settings say."""
    each = VALIDATION_GROUPS * VALIDATION_GROUP
    count = -(-settings.pictures.validation // each)
    rng = generator_of(settings.training.seed, VALIDATION)
    some = {"maps": 1, "groups": VALIDATION_GROUPS, "group": VALIDATION_GROUP}
    return [draw_lesson(unseen, settings.pictures, rng, **some) for _ in range(count)]


def _same(lesson: Any) -> Any:
    return lesson
