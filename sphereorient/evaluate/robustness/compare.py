"""What got worse from one run to another, by more than its own scatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import BenchError, refusal
from sphereorient.evaluate.robustness.measure import Outcome
from sphereorient.evaluate.robustness.results import Results

SIGMAS = 3.0  # of the difference's own scatter: less is no change
LEAST_RATIO = 1.1  # of the median errors: less is no matter
LEAST_FRAMES = 0.02  # of wrong or lost frames
BLOCK = 4  # frames: neighbours err alike
DRAWS, SEED = 400, 2011
Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Change:
    """One number of one kind, level and method in two runs; made by `compare`."""

    kind: str
    level: int
    method: str
    what: str  # "median error, degrees", "wrong frames", "lost frames"
    before: float
    now: float
    scatter: float  # standard deviation of the difference; of the medians: of the logarithm of their ratio

    @property
    def worse(self) -> bool:
        """Whether it got worse by more than its scatter, and by enough to matter."""
        return self._size > 0 and self._matters

    @property
    def better(self) -> bool:
        """Whether it got better by more than its scatter, and by enough to matter."""
        return self._size < 0 and self._matters

    @property
    def _is_error(self) -> bool:
        return self.what.startswith("median")

    @property
    def _size(self) -> float:
        return float(np.log(self.now / self.before)) if self._is_error else self.now - self.before

    @property
    def _matters(self) -> bool:
        least = np.log(LEAST_RATIO) if self._is_error else LEAST_FRAMES
        return bool(abs(self._size) > max(least, SIGMAS * self.scatter))


def compare(now: Results, baseline: Results) -> list[Change]:
    """Compare two runs scene by scene.

    Args:
        now: the newer one.
        baseline: the older one; scenes or methods that only one of them has are left out.

    Returns:
        All numbers that both have, in the order of the scenes; ask each whether it is `worse`.

    Raises:
        BenchError: they have no scene in common.
    """
    known = {(one.scene, one.method): one for one in baseline.outcomes if _same_scene(now, baseline)}
    groups: dict[tuple[str, int, str], list[tuple[Outcome, Outcome]]] = {}
    for one in now.outcomes:
        if (before := known.get((one.scene, one.method))) is not None and before.frames == one.frames:
            groups.setdefault((one.kind, one.level, one.method), []).append((before, one))
    if not groups:
        do = "run the benchmark with the baseline's settings"
        raise BenchError(refusal("baseline", expected="scenes of the same plan", got="none in common", do=do))
    return [change for key, pairs in groups.items() for change in _changes(key, pairs)]


def _same_scene(now: Results, baseline: Results) -> bool:
    """Say whether scenes of one name are the same in both."""
    same = ("frames", "at_once", "degradations")
    return all(getattr(now.settings, key) == getattr(baseline.settings, key) for key in same)


def _changes(key: tuple[str, int, str], pairs: Sequence[tuple[Outcome, Outcome]]) -> list[Change]:
    kind, level, method = key
    before, now = (np.concatenate([pair[k].errors_deg for pair in pairs]) for k in (0, 1))
    found = []
    p50 = [float(np.nanmedian(x)) if np.isfinite(x).any() else np.nan for x in (before, now)]
    if np.isfinite(p50).all() and min(p50) > 0:
        scatter = _log_scatter(before, now)
        what = "median error, degrees"
        found.append(
            Change(kind=kind, level=level, method=method, what=what, before=p50[0], now=p50[1], scatter=scatter)
        )
    for what, count in (("wrong frames", "wrong"), ("lost frames", "lost")):
        shares = [sum(getattr(pair[k], count) for pair in pairs) / len(now) for k in (0, 1)]
        scatter = float(np.sqrt(sum(p * (1 - p) for p in shares) * BLOCK / len(now)))
        found.append(
            Change(kind=kind, level=level, method=method, what=what, before=shares[0], now=shares[1], scatter=scatter)
        )
    return found


def _log_scatter(before: Floats, now: Floats) -> float:
    """Return the standard deviation of ln(median now / median before), by resampled blocks of the same frames."""
    rng = np.random.default_rng(SEED)
    blocks = np.arange(len(now)) // BLOCK
    count = int(blocks[-1]) + 1
    ratios = []
    for _ in range(DRAWS):
        drawn = rng.integers(0, count, count)
        rows = (drawn[:, None] * BLOCK + np.arange(BLOCK)).ravel()
        rows = rows[rows < len(now)]
        a, b = before[rows], now[rows]
        if np.isfinite(a).any() and np.isfinite(b).any():
            ratios.append(np.log(np.nanmedian(b) / np.nanmedian(a)))
    return float(np.std(ratios)) if len(ratios) > 1 else np.inf
