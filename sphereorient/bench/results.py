import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from sphereorient.bench.scenes import BenchSettings
from sphereorient.errors import BenchError, refusal
from sphereorient.files.hdf5 import UNNAMED
from sphereorient.files.whole_file import write_text

SCHEMA = "sphereorient-robustness/1"
WRONG_DEG = 10.0  # a larger error is a wrong orientation, from which the fit does not converge
FIRST = (1, 3, 10)  # numbers of candidates for the recall
SIGMAS = 3.0  # a smaller difference, in its own standard deviations, is no change
LEAST_RATIO = 1.1  # of the median errors; less is no change
LEAST_FRAMES = 0.02  # of wrong or lost frames; less is no change
BLOCK = 4  # frames: errors of neighbours are correlated
DRAWS, SEED = 400, 2011
MORE_OR_FEWER = {"levels", "seeds", "together"}  # settings without effect on scenes of one name
Floats = NDArray[np.float64]
_Key = tuple[str, int, str]  # kind, level, method


@dataclass(frozen=True, kw_only=True)
class SceneResult:
    """One method on one ball of a scene; made by `track_scene`, kept as JSON. None: not measured."""

    scene: str
    kind: str
    level: int
    seed: int
    degradations: Mapping[str, int]
    method: str
    refused: str  # the message, if the method gave no track
    frames: int
    orientation_deg: tuple[float | None, ...]  # error after assembly, frame by frame
    position_mm: tuple[float | None, ...]
    confidence: tuple[float | None, ...]  # of the chosen orientation
    looks: int  # cameras times frames
    looks_wrong: int  # of these, without a best candidate within 10 degrees of the truth
    recall: Mapping[str, float]  # share of the looks with the right orientation among the first K candidates, by K
    stated: int  # frames with a covariance of the orientation
    inside: int  # of these, with the truth inside the 95 % region
    seconds: float
    over_stated: float | None = None  # rms of these errors over their stated sigmas; None: older version
    ball: str = UNNAMED  # name
    given: int = 0  # frames with the position of another ball
    exchanges: int = 0  # number of such changes
    hidden: float = 0.0  # share of its pictures more than half hidden by nearer balls

    @property
    def key(self) -> _Key:
        """Kind, level and method."""
        return self.kind, self.level, self.method

    @property
    def errors_deg(self) -> Floats:
        """Errors (frames,), degrees; NaN: no orientation."""
        return np.array([np.nan if x is None else x for x in self.orientation_deg], np.float64)

    @property
    def wrong(self) -> int:
        """Frames with an error of more than 10 degrees after assembly."""
        return int((np.nan_to_num(self.errors_deg) > WRONG_DEG).sum())

    @property
    def lost(self) -> int:
        """Frames without an orientation."""
        return int(np.isnan(self.errors_deg).sum())


@dataclass(frozen=True, kw_only=True, eq=False)
class Results:
    """All scenes and methods of a run; made by `run_benchmark`, read by table, figure and `compare_runs`."""

    settings: BenchSettings
    versions: Mapping[str, str]
    outcomes: Sequence[SceneResult]

    @property
    def methods(self) -> list[str]:
        """Names, in the order of the run."""
        return list(dict.fromkeys(one.method for one in self.outcomes))


@dataclass(frozen=True, kw_only=True)
class ResultSummary:
    """All scenes of one kind and level, one method; made by `summarised`, a row of the table."""

    kind: str
    level: int
    method: str
    scenes: int
    frames: int
    p50_deg: float  # of the frames with an orientation; NaN: none
    p95_deg: float
    largest_deg: float
    p50_mm: float
    p95_mm: float
    wrong_before: float  # share of the looks without a best candidate within 10 degrees of the truth
    wrong_after: float  # share of the frames
    lost: float  # share of the frames without an orientation
    recall: Mapping[str, float]
    inside: float  # share of the truths within the stated 95 % region; NaN: no region stated
    over_stated: float  # rms of the errors over the stated sigmas; NaN: not measured
    frames_per_s: float
    refused: str  # message of the first scene that the method refused
    given: float = 0.0  # share of the frames given to another ball
    exchanges: int = 0
    hidden: float = 0.0  # share of the pictures of balls hidden by more than half


def summaries(results: Results) -> list[ResultSummary]:
    """Return the rows of the table, in the order of the scenes."""
    groups: dict[_Key, list[SceneResult]] = {}
    for one in results.outcomes:
        groups.setdefault(one.key, []).append(one)
    return [summarised(group) for group in groups.values()]


def summarised(group: Sequence[SceneResult]) -> ResultSummary:
    """Summarise the scenes of one kind, level and method."""
    errors = np.concatenate([one.errors_deg for one in group])
    distances_mm = np.array([x for one in group for x in one.position_mm if x is not None])
    frames, looks, stated = (sum(getattr(one, key) for one in group) for key in ("frames", "looks", "stated"))
    seen = errors[np.isfinite(errors)]
    known = [(one.stated, one.over_stated) for one in group if one.over_stated is not None]
    squares = sum(count * over**2 for count, over in known)
    p50, p95, largest = np.percentile(seen, (50, 95, 100)) if len(seen) else (np.nan,) * 3
    p50_mm, p95_mm = np.percentile(distances_mm, (50, 95)) if len(distances_mm) else (np.nan,) * 2
    kind, level, method = group[0].key
    return ResultSummary(
        kind=kind,
        level=level,
        method=method,
        scenes=len({one.scene for one in group}),
        frames=frames,
        p50_deg=float(p50),
        p95_deg=float(p95),
        largest_deg=float(largest),
        p50_mm=float(p50_mm),
        p95_mm=float(p95_mm),
        wrong_before=sum(one.looks_wrong for one in group) / max(looks, 1),
        wrong_after=sum(one.wrong for one in group) / max(frames, 1),
        lost=sum(one.lost for one in group) / max(frames, 1),
        recall={str(k): sum(one.recall[str(k)] * one.looks for one in group) / max(looks, 1) for k in FIRST},
        inside=sum(one.inside for one in group) / stated if stated else float("nan"),
        over_stated=math.sqrt(squares / sum(count for count, _ in known)) if known else float("nan"),
        frames_per_s=frames / max(sum(one.seconds for one in group), 1e-9),
        refused=next((one.refused for one in group if one.refused), ""),
        given=sum(one.given for one in group) / max(frames, 1),
        exchanges=sum(one.exchanges for one in group),
        hidden=sum(one.hidden for one in group) / len(group),
    )


def save_results(results: Results, path: Path) -> None:
    """Write results as JSON, whole or not at all."""
    tree = {
        "schema": SCHEMA,
        "settings": results.settings.model_dump(),
        "versions": dict(results.versions),
        "outcomes": [asdict(one) for one in results.outcomes],
    }
    write_text(path, json.dumps(tree, separators=(",", ":")) + "\n")


def load_results(path: Path) -> Results:
    """Read results of `save_results`; raise BenchError if the file is missing, not JSON, or of another version."""
    do = "pass a results.json of `sphereorient bench robustness`"
    try:
        tree = json.loads(path.read_text("utf-8"))
        schema = tree["schema"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        got = "no file" if isinstance(error, FileNotFoundError) else "something else"
        raise BenchError(refusal(str(path), expected="results of a benchmark", got=got, do=do)) from None
    if schema != SCHEMA:
        do = "run the benchmark again with this version"
        raise BenchError(refusal(f"{path}: schema", expected=SCHEMA, got=str(schema)[:60], do=do))
    try:
        return TypeAdapter(Results).validate_python(tree)
    except ValueError as error:
        got = " ".join(str(error).split())[:120]
        raise BenchError(refusal(str(path), expected="whole results", got=f"'{got}'", do=do)) from None


@dataclass(frozen=True, kw_only=True)
class Change:
    """One number of one kind, level and method in two runs; made by `compare_runs`."""

    kind: str
    level: int
    method: str
    what: str  # "median error, degrees", "wrong frames", "lost frames"
    before: float
    now: float
    scatter: float  # standard deviation of the difference; of medians: of the logarithm of their ratio

    @property
    def worse(self) -> bool:
        """Whether the number grew significantly."""
        return self._significant() > 0

    @property
    def better(self) -> bool:
        """Whether the number fell significantly."""
        return self._significant() < 0

    def _significant(self) -> float:
        relative = self.what.startswith("median")
        size = float(np.log(self.now / self.before)) if relative else self.now - self.before
        least = np.log(LEAST_RATIO) if relative else LEAST_FRAMES
        return size if abs(size) > max(least, SIGMAS * self.scatter) else 0.0


def compare_runs(now: Results, baseline: Results) -> list[Change]:
    """Compare the common scenes and methods of two runs. Raises BenchError if there are none."""
    plans = [run.settings.model_dump(exclude=MORE_OR_FEWER) for run in (now, baseline)]
    same = plans[0] == plans[1]
    known = {(one.scene, one.ball, one.method): one for one in baseline.outcomes if same}
    groups: dict[_Key, list[tuple[SceneResult, SceneResult]]] = {}
    for one in now.outcomes:
        if (before := known.get((one.scene, one.ball, one.method))) is not None and before.frames == one.frames:
            groups.setdefault(one.key, []).append((before, one))
    if not groups:
        do = "run the benchmark with the baseline's settings"
        raise BenchError(refusal("baseline", expected="scenes of the same plan", got="none in common", do=do))
    return [change for key, pairs in groups.items() for change in _changes(key, pairs)]


def _changes(key: _Key, pairs: Sequence[tuple[SceneResult, SceneResult]]) -> list[Change]:
    errors = [np.concatenate([pair[k].errors_deg for pair in pairs]) for k in (0, 1)]
    numbers = []
    p50 = [float(np.nanmedian(x)) if np.isfinite(x).any() else np.nan for x in errors]
    if np.isfinite(p50).all() and min(p50) > 0:
        numbers.append(("median error, degrees", p50, _log_scatter(*errors)))
    frames = len(errors[1])
    for what, count in (("wrong frames", "wrong"), ("lost frames", "lost")):
        shares = [sum(getattr(pair[k], count) for pair in pairs) / frames for k in (0, 1)]
        numbers.append((what, shares, float(np.sqrt(sum(p * (1 - p) for p in shares) * BLOCK / frames))))
    kind, level, method = key
    return [
        Change(kind=kind, level=level, method=method, what=what, before=before, now=now, scatter=scatter)
        for what, (before, now), scatter in numbers
    ]


def _log_scatter(before: Floats, now: Floats) -> float:
    """Return the standard deviation of ln(median now / median before), from resampled blocks of frames."""
    rng = np.random.default_rng(SEED)
    count = (len(now) - 1) // BLOCK + 1
    ratios = []
    for _ in range(DRAWS):
        drawn = rng.integers(0, count, count)
        rows = (drawn[:, None] * BLOCK + np.arange(BLOCK)).ravel()
        a, b = (x[rows[rows < len(now)]] for x in (before, now))
        if np.isfinite(a).any() and np.isfinite(b).any():
            ratios.append(np.log(np.nanmedian(b) / np.nanmedian(a)))
    return float(np.std(ratios)) if len(ratios) > 1 else np.inf
