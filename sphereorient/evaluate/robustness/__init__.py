"""The robustness benchmark: scenes with truth, the results of each method, and the comparison of two runs."""

from sphereorient.evaluate.robustness.results import (
    Change,
    Results,
    SceneResult,
    compare_runs,
    load_results,
    save_results,
)
from sphereorient.evaluate.robustness.run import run_benchmark
from sphereorient.evaluate.robustness.scenes import BenchmarkScene, BenchSettings, scenes_of, write_scene

__all__ = [
    "BenchSettings",
    "BenchmarkScene",
    "Change",
    "Results",
    "SceneResult",
    "compare_runs",
    "load_results",
    "run_benchmark",
    "save_results",
    "scenes_of",
    "write_scene",
]
