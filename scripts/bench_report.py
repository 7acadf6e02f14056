"""Time the report of a long ensemble: a million frames in thousands of segments.

    scripts/bench_report.py FOLDER [--segments 7000]

Draws the ensemble once (FOLDER/long.h5, a minute), then runs `sphereorient report` on it and prints time and peak
memory.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from multiprocessing import get_context
from pathlib import Path

from ensembles import EnsembleSpec, draw_ensemble, filtered_track

from sphereorient.trajectory import Trajectory


def main() -> None:
    """Read the options, draw, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--segments", type=int, default=7000)
    options = parser.parse_args()
    path = options.folder / "long.h5"
    if not path.exists():  # in a process of its own: the peak of a child counts what its parent holds at the start
        with get_context("spawn").Pool(1) as pool:
            pool.apply(draw, (path, options.segments))
    command = [sys.executable, "-m", "sphereorient.cli", "report", path, "--out", options.folder / "page"]
    begin = time.perf_counter()
    report = subprocess.Popen(list(map(str, command)))
    _, status, used = os.wait4(report.pid, 0)
    took_s = time.perf_counter() - begin
    if status:
        sys.exit("bench_report.py: the report failed; see above")
    print(f"{len(Trajectory.load(path)):,} frames: {took_s:.0f} s, peak {used.ru_maxrss / 1024:.0f} MiB")


def draw(path: Path, segments: int) -> None:
    """Write the track of an ensemble."""
    filtered_track(draw_ensemble(EnsembleSpec(segments=segments), 1), 0.1, 0.05, 1).save(path)


if __name__ == "__main__":
    main()
