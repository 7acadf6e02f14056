"""Print how far a track is from the truth of a synthetic experiment.

scripts/score.py TRACK.h5 TRUTH.h5
"""

from __future__ import annotations

import argparse
from pathlib import Path

from demo import error_table
from rich.console import Console

from sphereorient.evaluate import score_track
from sphereorient.trajectory import Trajectory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("track", type=Path)
    parser.add_argument("truth", type=Path)
    arguments = parser.parse_args()
    Console().print(error_table(score_track(Trajectory.load(arguments.track), arguments.truth)))


if __name__ == "__main__":
    main()
