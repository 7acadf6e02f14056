"""Check short pieces of movies, correct ones and ones with a planted fault; count false alarms and faults named.

    scripts/check_pieces.py [--keep DIR] [--jobs 2] [--correct 50] [--faults 20]

Pieces of 20 to 60 frames are cut out of the large data sets, where they are there, and out of rendered movies.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from silent_wrong import Case, film, turned, wide_pixels

from sphereorient.cameras import load_cameras, save_cameras
from sphereorient.movies import open_movie
from sphereorient.preflight import Severity, preflight

SHARED = Path(__file__).resolve().parents[2] / "shared"
RENDERED = {f"render_{seed}": Case(name="clean", what="", scene={"frames": 90, "seed": seed}) for seed in (21, 22, 23)}
LENGTHS = (20, 30, 40, 50, 60)
LATE = 2
FAULTS = {  # of a piece, and how its cause begins
    "late": f"the movie of cam2 {LATE} frames",
    "swapped": "swap cam1 and cam2",
    "diameter": "sphere.diameter",
    "turned": r"cam\d turned by 1\.[3-7] degrees",
    "wide": "pixels of cam1 and cam2 -[2-4]",  # of what is reported: pixels as wide as high
}
JUDGED = ("lines of sight", "movies in step", "size of the ball", "cameras agree", "one ball")


@dataclass(frozen=True, kw_only=True)
class Piece:
    """Some frames of one movie, and what is wrong with it."""

    source: Path  # an experiment.yaml
    first: int
    last: int  # + 1
    fault: str = ""
    number: int = 0

    def write(self, folder: Path) -> Path:
        """Write the experiment of the piece."""
        document: dict[str, Any] = yaml.safe_load(self.source.read_text())
        there = self.source.parent.resolve()
        cameras = load_cameras(there / document["cameras"])
        for kind in ("movies", "backgrounds"):
            document[kind] = {name: str(there / path) for name, path in document.get(kind, {}).items()}
        document["sphere"]["texture"] = str(there / document["sphere"]["texture"])
        document["frames"] = [self.first, self.last]
        if self.fault == "late":
            document["start"] = {"cam1": 0, "cam2": LATE}
        if self.fault == "swapped":
            document["movies"] = dict(zip(document["movies"], reversed(document["movies"].values()), strict=True))
        if self.fault == "diameter":
            document["sphere"]["diameter"] *= 1.05 if self.number % 2 else 0.95
        if self.fault == "turned":
            cameras = turned(("cam1", "cam2")[self.number % 2], 1.5, self.number % 3)(cameras)
        if self.fault == "wide":
            cameras = wide_pixels(0.03)(cameras)
        save_cameras(folder / "cameras.yaml", cameras, comment="of a piece")
        document["cameras"] = "cameras.yaml"
        path = folder / "experiment.yaml"
        path.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
        return path


def verdict(piece: Piece) -> tuple[str, str]:
    """Return what the check makes of a piece (right, cannot tell, false alarm, missed, wrong cause), and its words."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        findings = preflight(piece.write(Path(folder))).findings
    judged = [one for one in findings if one.title in JUDGED and one.severity is not Severity.OK]
    words = "; ".join(f"{one.title}: {one.measured} ({one.advice})" for one in judged)
    alarms = [one for one in judged if not re.match("cannot tell|unknown", one.measured)]
    if not piece.fault:
        return "false alarm" if alarms else "cannot tell" if judged else "right", words
    cause = next((one.advice for one in alarms if one.title == "cameras agree"), "")
    named = bool(re.match(FAULTS[piece.fault], cause))
    return "right" if named else "wrong cause" if alarms else "missed", words


def pieces(folder: Path, correct: int, faults: int) -> list[Piece]:
    """Cut pieces, the same for each call."""
    sources = [path for name in ("experiment", "tank", "gloss") if (path := SHARED / name / "experiment.yaml").exists()]
    for name, case in RENDERED.items():
        if not (folder / name / "experiment.yaml").exists():
            (folder / name).mkdir(parents=True, exist_ok=True)
            film(folder / name, case)
        sources.append(folder / name / "experiment.yaml")
    counts = {}
    for source in sources:
        movie = next(iter(yaml.safe_load(source.read_text())["movies"].values()))
        with open_movie(source.parent / movie) as opened:
            counts[source] = len(opened)
    rng = np.random.default_rng(26)
    found = []
    for k in range(correct + faults):
        source = sources[k % len(sources)]
        length = LENGTHS[k // len(sources) % len(LENGTHS)] if k < correct else LENGTHS[-1]
        first = int(rng.integers(0, counts[source] - length - LATE))
        fault = "" if k < correct else list(FAULTS)[k % len(FAULTS)]
        found.append(Piece(source=source, first=first, last=first + length, fault=fault, number=k))
    return found


def main() -> int:
    """Check all pieces and print the table; return 1 for a false alarm or a fault that is not named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", type=Path, help="folder for the rendered movies, used again by the next call")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--correct", type=int, default=50)
    parser.add_argument("--faults", type=int, default=20)
    given = parser.parse_args()
    chosen = pieces(given.keep or Path(tempfile.mkdtemp()), given.correct, given.faults)
    counts: dict[str, int] = {}
    with ProcessPoolExecutor(given.jobs) as pool:
        for piece, (result, words) in zip(chosen, pool.map(verdict, chosen), strict=True):
            name = f"{piece.source.parent.name} {piece.first}..{piece.last - 1} {piece.fault}"
            print(f"{name:32} {result:12} {words[:300]}", flush=True)
            kind = "faults" if piece.fault else "60 frames" if piece.last - piece.first == 60 else "shorter"
            counts[f"{kind}: {result}"] = counts.get(f"{kind}: {result}", 0) + 1
    print(", ".join(f"{name} {count}" for name, count in sorted(counts.items())))
    return int(any("right" not in name and "cannot" not in name for name in counts))


if __name__ == "__main__":
    sys.exit(main())
