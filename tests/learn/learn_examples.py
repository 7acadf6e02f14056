"""A proposer small enough to be trained in seconds, that the tests of this room share."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sphereorient.learn.network import Correlator
from sphereorient.learn.settings import ProposerSettings

TINY = {
    "network": {"size_px": 24, "width": 8, "channels": 6, "hidden": 16, "step_deg": 18.0, "nodes": 32},
    "pictures": {
        "disks": {"size_px": 24, "diameter_px": 32.0, "centre_sigma_px": 0.2},
        "kinds": ("blobs",),
        "textures": 12,
        "texture_rows": 48,
        "degradations": ("uneven_light", "read_noise"),
        "at_once": 1,
        "hardest": 2.0,
        "validation": 128,
    },
    "training": {"epochs": 4, "steps": 25, "maps": 2, "groups": 2, "group": 16, "learning_rate": 5e-3},
}


def tiny(**changes: object) -> ProposerSettings:
    """The settings, with changes of training's."""
    tree = {**TINY, "training": {**TINY["training"], **changes}}
    return ProposerSettings.model_validate(tree)


@cache
def untrained() -> Correlator:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        return Correlator(tiny().network).eval()


def state_of(network: Correlator) -> dict[str, Tensor]:
    return {name: tensor.clone() for name, tensor in network.state_dict().items()}


class Writer:
    """A pickle of this writes a file when it is loaded with code."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.write_text, (self.path, "executed")
