"""All outcomes of a run in one JSON, and by degradation and level."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import BenchError, refusal
from sphereorient.evaluate.robustness.measure import FIRST, Outcome
from sphereorient.evaluate.robustness.settings import BenchSettings
from sphereorient.files.outputs import put_aside

SCHEMA = "sphereorient-robustness/1"
Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Results:
    """Outcomes of all scenes and methods; made by `run_benchmark`, read by table, figure and `compare`."""

    settings: BenchSettings
    versions: Mapping[str, str]
    outcomes: Sequence[Outcome]

    def groups(self) -> dict[tuple[str, int, str], list[Outcome]]:
        """Return the outcomes by kind, level and method, in the order of the scenes."""
        found: dict[tuple[str, int, str], list[Outcome]] = {}
        for one in self.outcomes:
            found.setdefault((one.kind, one.level, one.method), []).append(one)
        return found

    @property
    def methods(self) -> list[str]:
        """Names, in the order in which they came."""
        return list(dict.fromkeys(one.method for one in self.outcomes))


@dataclass(frozen=True, kw_only=True)
class Line:
    """All scenes of one kind and level, one method; made by `lines_of`, a row of the table."""

    kind: str
    level: int
    method: str
    scenes: int
    frames: int
    p50_deg: float  # of the frames with an orientation; NaN where there is none
    p95_deg: float
    largest_deg: float
    p50_mm: float
    wrong_before: float  # share of the looks whose best candidate is off by more than 10 degrees
    wrong_after: float  # share of the frames
    lost: float  # share of the frames without an orientation
    recall: Mapping[str, float]
    inside: float  # share of the truths within the stated 95 % region; NaN where nothing is stated
    frames_per_s: float
    refused: str  # what the method said of a scene that it refused


def lines_of(results: Results) -> Iterator[Line]:
    """Yield the rows of the table."""
    for (kind, level, method), outcomes in results.groups().items():
        yield line_of(kind, level, method, outcomes)


def line_of(kind: str, level: int, method: str, outcomes: Sequence[Outcome]) -> Line:
    """Put the scenes of one kind and level together."""
    errors = np.concatenate([one.errors_deg for one in outcomes])
    metres = np.array([x for one in outcomes for x in one.position_mm if x is not None])
    frames = sum(one.frames for one in outcomes)
    looks, stated = sum(one.looks for one in outcomes), sum(one.stated for one in outcomes)
    seen = errors[np.isfinite(errors)]
    p50, p95, largest = np.percentile(seen, (50, 95, 100)) if len(seen) else (np.nan,) * 3
    return Line(
        kind=kind,
        level=level,
        method=method,
        scenes=len(outcomes),
        frames=frames,
        p50_deg=float(p50),
        p95_deg=float(p95),
        largest_deg=float(largest),
        p50_mm=float(np.median(metres)) if len(metres) else float("nan"),
        wrong_before=sum(one.looks_wrong for one in outcomes) / max(looks, 1),
        wrong_after=sum(one.wrong for one in outcomes) / max(frames, 1),
        lost=sum(one.lost for one in outcomes) / max(frames, 1),
        recall={
            str(first): sum(one.recall[str(first)] * one.looks for one in outcomes) / max(looks, 1) for first in FIRST
        },
        inside=sum(one.inside for one in outcomes) / stated if stated else float("nan"),
        frames_per_s=frames / max(sum(one.seconds for one in outcomes), 1e-9),
        refused=next((one.refused for one in outcomes if one.refused), ""),
    )


def save_results(results: Results, path: Path) -> None:
    """Write results as JSON, aside first."""
    tree = {
        "schema": SCHEMA,
        "settings": results.settings.model_dump(),
        "versions": dict(results.versions),
        "outcomes": [as_tree(one) for one in results.outcomes],
    }
    with put_aside(path) as aside:
        aside.write_text(json.dumps(tree, separators=(",", ":")) + "\n", "utf-8")


def load_results(path: Path) -> Results:
    """Read results of `save_results`.

    Raises:
        BenchError: no such file, not JSON, or of another version.
    """
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
        outcomes = [from_tree(one) for one in tree["outcomes"]]
        return Results(settings=BenchSettings(**tree["settings"]), versions=tree["versions"], outcomes=outcomes)
    except (KeyError, TypeError, ValueError) as error:
        got = " ".join(str(error).split())[:120]
        raise BenchError(refusal(str(path), expected="whole results", got=f"'{got}'", do=do)) from None


def as_tree(outcome: Outcome) -> dict[str, Any]:
    """Return an outcome as JSON takes it."""
    return asdict(outcome)


def from_tree(tree: Mapping[str, Any]) -> Outcome:
    """Return an outcome of `as_tree`."""
    lists = ("orientation_deg", "position_mm", "confidence")
    known = {entry.name: tree[entry.name] for entry in fields(Outcome)}
    return Outcome(**(known | {name: tuple(known[name]) for name in lists}))
