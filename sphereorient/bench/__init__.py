"""Benchmarks on synthetic movies with truth: scores, robustness, several balls, and the latency of live tracking."""

from sphereorient.bench.results import Results, SceneResult, compare_runs, load_results
from sphereorient.bench.run import run_benchmark, run_benchmarks
from sphereorient.bench.scenes import BenchSettings, scenes_of, write_scene
from sphereorient.bench.score import Score, score_track
