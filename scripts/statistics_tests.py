"""Size and power of the tests that a report makes, on attitudes and ensembles whose law is known.

    scripts/statistics_tests.py [--repetitions 1000] [--ensembles 100]

Prints how often the test of uniformity on SO(3) rejects at 5 %: independent uniform attitudes and tracks of uniform
attitudes (its size), the same tracks with all frames taken as independent, and sets that are biased a little (its
power). Then it prints the frame in which an ensemble is found to prefer directions, for ensembles that do so in the lab
or in the body. Seven minutes.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable

import numpy as np
from ensembles import EnsembleSpec, draw_ensemble
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track as shown
from rich.table import Table
from scipy.spatial.transform import Rotation

from sphereorient.statistics.isotropy import anisotropic_frame, isotropy, uniformity
from sphereorient.statistics.segments import ensemble_of
from sphereorient.statistics.settings import BootstrapSettings

Floats = NDArray[np.float64]
Attitudes = tuple[Floats, NDArray[np.int64] | None]
UNEQUAL = (6.0, 14.0, 7.0)  # rms of omega by component, rad/s


def independent(rng: np.random.Generator) -> Attitudes:
    """Return 200 uniform attitudes."""
    return Rotation.random(200, rng).as_matrix(), None


def tracked(rng: np.random.Generator) -> Attitudes:
    """Return attitudes along 120 segments with exponential durations."""
    true = draw_ensemble(EnsembleSpec(segments=120, mean_frames=90.0), int(rng.integers(2**31)))
    return true.orientation, true.segment


def pretended(rng: np.random.Generator) -> Attitudes:
    """Return the same tracks with every frame taken as independent."""
    return tracked(rng)[0], None


def near_one(rng: np.random.Generator) -> Attitudes:
    """Return 600 attitudes of which 14 % lie within 20 degrees or so of one."""
    R, near = Rotation.random(600, rng).as_matrix(), Rotation.from_rotvec(0.35 * rng.standard_normal((600, 3)))
    return np.where((rng.uniform(size=600) < 0.14)[:, None, None], near.as_matrix(), R), None


def axial(rng: np.random.Generator) -> Attitudes:
    """Return attitudes whose body axis prefers the vertical, up and down alike: half as likely when level."""
    R = Rotation.random(1500, rng).as_matrix()
    return R[rng.uniform(size=1500) < (0.5 + 0.5 * R[:, 2, 2] ** 2)], None


CASES: dict[str, tuple[Callable[[np.random.Generator], Attitudes], str]] = {
    "200 independent uniform attitudes": (independent, "3 to 7 %"),
    "120 segments of uniform attitudes": (tracked, "3 to 7 %"),
    "the same, frames taken as independent": (pretended, "near 100 %: why segments count"),
    "600 attitudes, 14 % of them near one": (near_one, "near 100 %"),
    "1000 attitudes, an axis half as often level": (axial, "near 100 %"),
}


def seen_frames(frame: str, count: int) -> Counter[str]:
    """Count the frames in which ensembles are found to prefer directions."""
    spec = EnsembleSpec(segments=200, mean_frames=90.0, frame="lab" if frame == "lab" else "body", omega_rms=UNEQUAL)
    few, seen = BootstrapSettings(resamples=100), Counter[str]()
    for seed in shown(range(count), f"prefers {frame}", transient=True):
        ensemble = ensemble_of(draw_ensemble(spec, seed))
        seen[anisotropic_frame(isotropy(ensemble, "omega_lab", few), isotropy(ensemble, "omega_body", few), 0.001)] += 1
    return seen


def main() -> None:
    """Read the options, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=1000)
    parser.add_argument("--ensembles", type=int, default=100)
    options = parser.parse_args()
    table = Table("attitudes", "rejected at 5 %", "should be", title="Uniformity on SO(3)")
    for name, (draw, wanted) in CASES.items():
        seeds = shown(range(options.repetitions), name, transient=True)
        rejected = [not uniformity(*draw(np.random.default_rng([seed, 1]))).uniform for seed in seeds]
        table.add_row(name, f"{100 * np.mean(rejected):.1f} %", wanted)
    Console().print(table)
    table = Table("omega is unequal in", "found: lab", "body", "both", "neither", title="Frames, p below 0.001 counts")
    for frame in ("lab", "body"):
        seen = seen_frames(frame, options.ensembles)
        table.add_row(frame, *(str(seen[name]) for name in ("lab", "body", "both", "neither")))
    Console().print(table)


if __name__ == "__main__":
    main()
