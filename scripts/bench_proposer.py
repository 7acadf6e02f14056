"""Compare the learned proposer with the template search on degraded pictures of balls that neither has seen.

    scripts/bench_proposer.py [--checkpoint FILE] [--pictures 2000] [--out out/proposer-bench]

Measures for each degradation of single pictures, at levels 3 to 5 in equal parts: how often the right orientation,
within 10 degrees, is among the first five candidates, with 95 % intervals, and CPU time per picture on one thread. Maps
are of the kinds that the network learnt from, with other seeds, and of one kind that it has not seen, strokes. Then
pictures with two or three degradations at once, and the calibration of the probabilities. Writes
docs/proposer-bench.csv and docs/proposer.png, and the table in docs/proposer.md. Half an hour on two cores.
"""

from __future__ import annotations

import argparse
import csv
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from textwrap import fill

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.cli.app import progress_bar
from sphereorient.files.whole_file import writing
from sphereorient.learn.checkpoint import correlator_of, load_checkpoint
from sphereorient.learn.metrics import Z95, reliability, wilson
from sphereorient.learn.network import DEFAULT_CHECKPOINT, LearnedProposer, probability_of
from sphereorient.report.plots.style import write_figure
from sphereorient.search import (
    Candidates,
    FallbackProposer,
    GreySearch,
    GreySearchSettings,
    Proposer,
    ProposeSettings,
)
from sphereorient.search.candidates import resized
from sphereorient.sphere.texture import map_directions, random_directions
from sphereorient.synth import random_texture
from sphereorient.synth.degrade_scene import misdrawn, worn
from sphereorient.synth.disks import DISK_DEGRADATIONS, DiskSettings, film_disks
from sphereorient.synth.severities import severity

DOCS = Path(__file__).resolve().parents[1] / "docs"
BEGIN, END = "<!-- table: scripts/bench_proposer.py -->", "<!-- end of the table -->"
LEVELS = (3, 4, 5)
KINDS = ("blobs", "patches", "dots", "strokes")
FIRST_SEED, ROWS = 3_000_000, 256  # of the maps: training begins at 0, its validation at 2^20
BALL = 42  # pictures of one map
WITHIN_DEG, FIRST = 10.0, 5
MIXED = "two or three at once"
CLEAN = "none"
Bools = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """Result of a method for some pictures."""

    right: Bools  # among the first five
    best: Bools  # the first one
    score: NDArray[np.float64]  # of the first one; NaN without one
    seconds: float  # CPU


def main() -> None:
    """Read the options, run, write, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, default=DEFAULT_CHECKPOINT)
    parser.add_argument("--pictures", type=int, default=2000, help="number for each degradation")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--docs", action="store_true", help="write the table and the picture into docs")
    parser.add_argument("--families", default=",".join((CLEAN, *DISK_DEGRADATIONS, MIXED)))
    options = parser.parse_args()
    families = options.families.split(",")
    balls = math.ceil(options.pictures / BALL)
    with (
        progress_bar(unit="") as advance,
        ProcessPoolExecutor(options.jobs, get_context("spawn"), one_thread) as pool,
    ):
        tasks = [pool.submit(ball, k, families, options.checkpoint) for k in range(balls)]
        parts = []
        for done, task in enumerate(tasks, start=1):
            parts.append(task.result())
            advance("balls", done, balls)
    found = {
        family: {name: joined([part[family][name] for part in parts]) for name in parts[0][family]}
        for family in families
    }
    for family in families:
        print_row(family, found[family])
    if MIXED in found:
        print_calibration(found[MIXED])
    if options.docs:
        write_docs(found)


def one_thread() -> None:
    """Keep a worker to one core."""
    torch.set_num_threads(1)


class Smaller:
    """A proposer that searches disks with fewer pixels."""

    def __init__(self, proposer: Proposer, size_px: int) -> None:
        self._proposer, self.size_px = proposer, size_px

    def propose(self, disks: Tensor, least: float | None = None) -> Candidates:
        """Propose for (F, S, S) disks."""
        return self._proposer.propose(resized(disks, self._proposer.size_px), least)


class Remembering:
    """A proposer that keeps the candidates of its last pictures."""

    def __init__(self, proposer: Proposer) -> None:
        self._proposer, self.size_px = proposer, proposer.size_px
        self._disks: Tensor | None = None
        self._candidates = Candidates.none(())

    def propose(self, disks: Tensor, least: float | None = None) -> Candidates:
        """Propose for (F, S, S) disks."""
        if disks is not self._disks:
            self._candidates, self._disks = self._proposer.propose(disks, least), disks
        return self._candidates


def methods(texture: Tensor, checkpoint: Path) -> Iterator[tuple[str, Proposer]]:
    """Yield the proposers that are compared, with their names."""
    settings = GreySearchSettings()
    search = Remembering(GreySearch(texture, settings))
    yield "template search", search
    # As fast as the network: smaller pictures, a coarser bank, fewer climbs.
    quick = settings.model_copy(update={"size_px": 24, "step_deg": 15.0, "peaks": 4, "finalists": 2, "rough_steps": 2})
    yield "template search, quick", Smaller(GreySearch(texture, quick), settings.size_px)
    learnt = load_checkpoint(checkpoint)
    network = LearnedProposer(correlator_of(learnt), texture, temperature=learnt.temperature)
    yield "network", network
    yield "both", FallbackProposer(search, network, ProposeSettings().sure)


def ball(number: int, families: Sequence[str], checkpoint: Path) -> dict[str, dict[str, Found]]:
    """Film one ball with each family of degradations and let all methods propose."""
    rng = torch.Generator().manual_seed(FIRST_SEED + 1000 * number + 7)
    kind = KINDS[number % len(KINDS)]
    texture = strokes(ROWS, rng) if kind == "strokes" else random_texture(kind, FIRST_SEED + number, ROWS)
    compared = dict(methods(texture, checkpoint))
    found = {}
    for family in families:
        R = so3.random_rotations(BALL, generator=rng).float()
        pictures = filmed(texture, R, family, rng)
        found[family] = {name: proposed(proposer, pictures, R) for name, proposer in compared.items()}
        # The candidates of the templates were kept: their time is added.
        first = found[family]["template search"].seconds
        found[family]["both"] = replace(found[family]["both"], seconds=found[family]["both"].seconds + first)
    return found


def filmed(texture: Tensor, R: Tensor, family: str, rng: torch.Generator) -> Tensor:
    """Film a ball of this map, a third of the pictures at each level."""
    disks = []
    for share, level in zip(torch.tensor_split(R, len(LEVELS)), LEVELS, strict=True):
        values = drawn(family, level, rng)
        paint = misdrawn(worn(texture, values.get("paint_wear", 0.0), rng), values.get("texture_error", 0.0), rng)
        disks.append(film_disks(paint, share, values, rng, DiskSettings()))
    return torch.cat(disks)


def drawn(family: str, level: int, rng: torch.Generator) -> Mapping[str, float]:
    """Return the degradations of a family at a level."""
    if family == CLEAN:
        return {}
    if family != MIXED:
        return {family: severity(family, level)}
    count = 2 + int(torch.randint(2, (), generator=rng))
    chosen = torch.randperm(len(DISK_DEGRADATIONS), generator=rng)[:count].tolist()
    return {DISK_DEGRADATIONS[k]: severity(DISK_DEGRADATIONS[k], level - 1) for k in chosen}


def strokes(height: int, rng: torch.Generator) -> Tensor:
    """Draw a kind of paint that no network has seen: white strokes, arcs of circles on the sphere, on black."""
    body = map_directions(height)
    white = torch.zeros(height, 2 * height, dtype=torch.bool)
    poles, starts = random_directions(40, rng), random_directions(40, rng)
    for pole, start in zip(poles, starts, strict=True):
        beside = (body @ pole - start @ pole).abs() < 0.07
        white |= beside & (body @ start > 0.75)
    return white.float()


def proposed(proposer: Proposer, pictures: Tensor, R: Tensor) -> Found:
    """Run a proposer, and compare its candidates with the truth."""
    begin = time.process_time()
    proposals = proposer.propose(pictures)
    seconds = time.process_time() - begin
    return judged(proposals, R, seconds)


def judged(proposals: Candidates, R: Tensor, seconds: float) -> Found:
    """Find the pictures with the right orientation among their candidates."""
    counts = proposals.offset.diff()
    frame = torch.repeat_interleave(torch.arange(len(R)), counts)
    place = torch.arange(len(frame)) - proposals.offset[:-1][frame]
    off = torch.rad2deg(so3.geodesic_distance(proposals.R_view_body, R.double()[frame]))
    right = off <= WITHIN_DEG
    among, best = torch.zeros(len(R)), torch.zeros(len(R))
    among.index_add_(0, frame, (right & (place < FIRST)).float())
    best.index_add_(0, frame, (right & (place == 0)).float())
    score = torch.full((len(R),), torch.nan, dtype=torch.float64)
    score[counts > 0] = proposals.score[proposals.offset[:-1][counts > 0]]
    return Found(right=(among > 0).numpy(), best=(best > 0).numpy(), score=score.numpy(), seconds=seconds)


def joined(parts: list[Found]) -> Found:
    """Return all pictures of a family."""
    return Found(
        right=np.concatenate([part.right for part in parts]),
        best=np.concatenate([part.best for part in parts]),
        score=np.concatenate([part.score for part in parts]),
        seconds=sum(part.seconds for part in parts),
    )


def interval(right: Bools) -> tuple[float, float, float]:
    """Return a share and its 95 % interval (Wilson 1927)."""
    share = float(right.mean())
    low, high = wilson(np.array([share]), np.array([len(right)]))
    return share, float(low[0]), float(high[0])


def gain(one: Bools, other: Bools) -> tuple[float, float]:
    """Return the difference of two shares of right pictures, on the same pictures, and half its 95 % interval."""
    difference = one.astype(float) - other.astype(float)
    return float(difference.mean()), Z95 * float(difference.std()) / math.sqrt(len(difference))


def row(family: str, found: Mapping[str, Found]) -> list[str]:
    """Return a line of the table."""
    cells = [family.replace("_", " ")]
    for one in found.values():
        share, low, high = interval(one.right)
        cells.append(f"{100 * share:.1f} ({100 * low:.1f} to {100 * high:.1f})")
    for name in ("network", "both"):
        more, half = gain(found[name].right, found["template search"].right)
        cells.append(f"{100 * more:+.1f} ± {100 * half:.1f}")
    cells += [f"{1e3 * one.seconds / len(one.right):.1f}" for one in found.values()]
    return cells


def print_row(family: str, found: Mapping[str, Found]) -> None:
    """Print a row of the table."""
    print(" | ".join(row(family, found)), flush=True)


def print_calibration(found: Mapping[str, Found]) -> None:
    """Print how well the network's probabilities are calibrated."""
    print(calibration(found))


def calibration(found: Mapping[str, Found]) -> str:
    """Return a sentence about the calibration of the network."""
    one = found["network"]
    known = np.isfinite(one.score)
    stated = probability_of(torch.from_numpy(one.score[known])).clamp(0, 1).numpy()
    measured = reliability(stated, one.best[known])
    return (
        f"On {known.sum()} pictures with two or three degradations at once the network's first candidate is right in "
        f"{100 * one.best[known].mean():.1f} %, claims {100 * stated.mean():.1f} %; expected calibration "
        f"error {measured.error:.3f}, {measured.chance:.3f} by chance."
    )


def write_docs(found: Mapping[str, Mapping[str, Found]]) -> None:
    """Write table, figures as CSV, and the picture."""
    names = list(next(iter(found.values())))
    header = ["degradation", *(f"{name}, %" for name in names), "network less template", "both less template"]
    header += [f"{name}, ms" for name in names]
    rows = [row(family, one) for family, one in found.items()]
    with (DOCS / "proposer-bench.csv").open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    columns = [0, *(1 + k for k, name in enumerate(names) if not name.endswith("quick"))]  # all are in the CSV
    short = [[cells[k].split(" (")[0] for k in columns] for cells in [header, *rows]]
    short.insert(1, ["---"] * len(short[0]))
    lines = ["| " + " | ".join(cells) + " |" for cells in short]
    page = DOCS / "proposer.md"
    text = page.read_text("utf-8")
    head, tail = text.split(BEGIN)[0], text.split(END)[1]
    sentence = f"\n\n{fill(calibration(found[MIXED]), 120)}\n" if MIXED in found else "\n"
    page.write_text(f"{head}{BEGIN}\n" + "\n".join(lines) + sentence + f"{END}{tail}", "utf-8")
    place = DOCS.parent / "out" / "proposer-bench"
    place.parent.mkdir(exist_ok=True)
    with writing(force=True):
        write_figure(figure(found), place)
    (DOCS / "proposer.png").write_bytes(place.with_suffix(".png").read_bytes())


def figure(found: Mapping[str, Mapping[str, Found]]) -> Figure:
    """Draw recall by degradation, hardest first."""
    order: list[str] = sorted(found, key=lambda name: found[name]["template search"].right.mean())
    drawn_on = Figure(figsize=(7.2, 0.32 * len(order) + 1.2), layout="constrained")
    axes = drawn_on.subplots()
    marks: Callable[..., object] = partial(axes.errorbar, fmt="o", ms=4, capsize=2, lw=1)
    for k, (name, colour) in enumerate({"template search": "#4477aa", "network": "#ee6677", "both": "#228833"}.items()):
        shares = np.array([interval(found[family][name].right) for family in order]) * 100
        at = np.arange(len(order)) + 0.22 * (k - 1)
        bars = (shares[:, 0] - shares[:, 1], shares[:, 2] - shares[:, 0])
        marks(shares[:, 0], at, xerr=bars, color=colour, label=name)
    axes.set_yticks(np.arange(len(order)), [name.replace("_", " ") for name in order])
    axes.set(xlabel=f"right orientation among the first {FIRST} candidates, % of pictures (95 % intervals)")
    axes.set_ylim(-0.6, len(order) - 0.4)
    axes.grid(axis="x", alpha=0.3)
    axes.legend(loc="upper left")
    return drawn_on


if __name__ == "__main__":
    main()
