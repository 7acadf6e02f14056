"""The robustness benchmark: scenes with truth, what a method makes of them, and whether it got worse."""

from sphereorient.evaluate.robustness.compare import Change, compare
from sphereorient.evaluate.robustness.measure import Outcome, measure
from sphereorient.evaluate.robustness.results import Results, load_results, save_results
from sphereorient.evaluate.robustness.run import run_benchmark
from sphereorient.evaluate.robustness.scenes import Scene, scenes_of, write_scene
from sphereorient.evaluate.robustness.settings import BenchSettings

__all__ = [
    "BenchSettings",
    "Change",
    "Outcome",
    "Results",
    "Scene",
    "compare",
    "load_results",
    "measure",
    "run_benchmark",
    "save_results",
    "scenes_of",
    "write_scene",
]
