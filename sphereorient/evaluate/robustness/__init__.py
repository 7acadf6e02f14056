"""The robustness benchmark: scenes with truth, the results of each method, and the comparison of two runs."""

from sphereorient.evaluate.robustness.results import Results, SceneResult, compare_runs, load_results
from sphereorient.evaluate.robustness.run import run_benchmark, run_benchmarks
from sphereorient.evaluate.robustness.scenes import BenchSettings, scenes_of, write_scene
