"""Check films in which nothing is wrong, and print what the check tells of each: invented faults and warnings.

    scripts/check_films.py EXPERIMENT.yaml ...

That the ball is absent from many frames is no invention: what is told of `ball` is printed and not counted, nor is
`cannot tell`.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

import torch

from sphereorient.errors import SphereOrientError
from sphereorient.files.threads import limit_cores
from sphereorient.preflight import Severity, preflight

TRUE = re.compile(r"ball\b|balls\b")  # titles: where the ball is seen, and how often
UNSURE = re.compile("cannot tell|unknown")


def told_of(experiment: Path) -> tuple[list[str], int, int]:
    """Return what the check tells of a film, and how many invented faults and warnings that is."""
    try:
        findings = preflight(experiment).findings
    except SphereOrientError as error:
        return [f"refused: {error}"], 1, 0
    told = [one for one in findings if one.severity is not Severity.OK]
    invented = [one for one in told if not TRUE.match(one.title) and not UNSURE.match(one.measured)]
    faults = sum(one.severity is Severity.FAULT for one in invented)
    words = [f"{one.severity}, {one.title}: {one.measured} ({one.advice})" for one in told]
    return words, faults, len(invented) - faults


def main() -> int:
    """Check all films, print the table; return 1 for an invented fault or warning."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("experiments", type=Path, nargs="+")
    torch.set_num_threads(1)
    limit_cores(1)
    sums = [0, 0]
    print("| film | invented faults | invented warnings | told |\n|---|---|---|---|", flush=True)
    for path in parser.parse_args().experiments:
        words, faults, warnings = told_of(path)
        sums = [sums[0] + faults, sums[1] + warnings]
        print(f"| {path.parent.name} | {faults} | {warnings} | {'; '.join(words)} |", flush=True)
    print(f"| all | {sums[0]} | {sums[1]} | |")
    return int(any(sums))


if __name__ == "__main__":
    sys.exit(main())
