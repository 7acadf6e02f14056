"""Time the report of a long ensemble: a million frames in thousands of segments.

    scripts/bench_report.py FOLDER [--segments 7000]

Draws the ensemble once (FOLDER/long.h5, a minute), then runs `sphereorient report` on it and prints time and peak
memory.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
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
    if not path.exists():
        filtered_track(draw_ensemble(EnsembleSpec(segments=options.segments), 1), 0.1, 0.05, 1).save(path)
    frames = len(Trajectory.load(path))
    command = [sys.executable, "-m", "sphereorient.cli", "report", path, "--out", options.folder / "page"]
    begin = time.perf_counter()
    subprocess.run(list(map(str, command)), check=True)
    took_s = time.perf_counter() - begin
    peak_mib = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"{frames:,} frames: {took_s:.0f} s, peak {peak_mib:.0f} MiB")


if __name__ == "__main__":
    main()
