import math
from functools import cache

import pytest
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.search import Candidates, OrientSettings, TemplateBank
from sphereorient.sphere import orthographic_view, reduced_texture
from sphereorient.synth import random_texture

SIZE = 48
SEEDS = {"blobs": 1, "patches": 2, "dots": 3}
# One paint in the quick tests; each of them fills tables of seconds.
KINDS = ["dots", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("blobs", "patches"))]


@cache
def texture_of(kind: str) -> Tensor:
    return random_texture(kind, SEEDS[kind], 128)


@cache
def search_of(kind: str) -> TemplateBank:
    return TemplateBank(texture_of(kind), SIZE, OrientSettings())


def attitudes(count: int, seed: int = 1) -> Tensor:
    return so3.random_rotations(count, generator=torch.Generator().manual_seed(seed))


def clean_disks(kind: str, R_view_body: Tensor, size_px: int = SIZE) -> Tensor:
    """Grey levels 20 (black paint) to 170 (white), orthographic."""
    texture = reduced_texture(texture_of(kind), size_px)
    return 20 + 150 * orthographic_view(size_px).render(texture, R_view_body.float())


def of_disk(found: Candidates, disk: int) -> tuple[Tensor, Tensor]:
    """Orientations and scores of one disk."""
    rows = slice(int(found.offset[disk]), int(found.offset[disk + 1]))
    return found.R_view_body[rows], found.score[rows]


def best_errors_deg(found: Candidates, R_true: Tensor) -> Tensor:
    """Angle of each disk's first proposal from the truth; every disk must have one."""
    assert (found.offset.diff() > 0).all(), [why.value for why in found.reason]
    return so3.geodesic_distance(found.R_view_body[found.offset[:-1]], R_true) * (180 / math.pi)
