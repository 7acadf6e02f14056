"""Shared by all tests: seeded tensors, tolerances by dtype, folders of the data."""

from __future__ import annotations

import os
import sys
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:
    # Two workers with two threads each wait for each other's cores; the commands that tests start inherit this.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# No test may read files that another run kept, or fill the folder of the user.
os.environ["SPHEREORIENT_NO_CACHE"] = "1"

import pytest
import torch
from torch import Tensor

REPO = Path(__file__).resolve().parents[1]
# Examples of one room serve the tests of others, and so do scripts.
sys.path[:0] = sorted(str(folder) for folder in Path(__file__).parent.rglob("*/") if folder.name != "__pycache__")
sys.path.append(str(REPO / "scripts"))
SHARED = REPO.parent / "shared"
TOLERANCE = {torch.float32: 2e-6, torch.float64: 1e-12}
BATCHES: list[tuple[int, ...]] = [(), (0,), (1,), (2, 1, 3)]


def slow(*values: object) -> object:
    """One more case of a test whose first cases already show the same in `make test`."""
    return pytest.param(*values, marks=pytest.mark.slow)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if not SHARED.is_dir():
        skip = pytest.mark.skip(reason="the large data sets (../shared) are not here")
        for item in items:
            if item.get_closest_marker("shared"):
                item.add_marker(skip)


@pytest.fixture
def rng() -> torch.Generator:
    return torch.Generator().manual_seed(20110)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["f32", "f64"])
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    return request.param


@pytest.fixture
def tolerance(dtype: torch.dtype) -> float:
    return TOLERANCE[dtype]


@pytest.fixture(params=BATCHES, ids=str)
def batch(request: pytest.FixtureRequest) -> tuple[int, ...]:
    return request.param


def assert_close(got: Tensor, expected: Tensor, atol: float = 1e-12) -> None:
    torch.testing.assert_close(got, expected, atol=atol, rtol=0.0, equal_nan=True)
