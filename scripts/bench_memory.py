"""Peak memory and time of `sphereorient track` for a movie and for the same movie played several times in a row.

    scripts/bench_memory.py EXPERIMENT.yaml [--times 1 5]

The movies are written as .npy into a temporary folder, repeated `times` times, to show memory that grows with the
length. Prints one line per length; the whole process is measured, start-up included.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from experiment_file import write_experiment

from sphereorient.experiment import Experiment, load_experiment, open_movies


def lengthened(experiment: Experiment, times: int, folder: Path) -> Path:
    """Write the experiment with its movies played `times` times in a row."""
    paths = {}
    for name, movie in open_movies(experiment).items():
        paths[name] = folder / f"{name}.npy"
        header = {
            "descr": np.lib.format.dtype_to_descr(movie.dtype),
            "fortran_order": False,
            "shape": (times * len(movie), *movie.frame_shape),
        }
        # Written in pieces: a child's peak starts at its parent's memory, which a mapped file would enlarge.
        with paths[name].open("wb") as file:
            np.lib.format.write_array_header_2_0(file, header)
            for _ in range(times):
                for frame in movie.frames():
                    file.write(frame.tobytes())
    return write_experiment(replace(experiment, path=folder / "experiment.yaml", movie_paths=paths))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("experiment", type=Path)
    parser.add_argument("--times", type=int, nargs="+", default=[1, 5])
    arguments = parser.parse_args()
    experiment = load_experiment(arguments.experiment)
    for times in arguments.times:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            path = lengthened(experiment, times, folder)
            begin = time.perf_counter()
            command = [sys.executable, "-m", "sphereorient.cli", "track", path, "--out", folder / "track.h5", "-q"]
            process = subprocess.Popen(command)
            # wait4 returns the peak of this child; getrusage(RUSAGE_CHILDREN) the largest of all children.
            _, status, usage = resource_of(process)
            frames = np.load(folder / f"{next(iter(experiment.movie_paths))}.npy", mmap_mode="r").shape[0]
            seconds = time.perf_counter() - begin
            print(
                f"{frames:6d} frames: exit {status}, peak {usage.ru_maxrss / 1024:.0f} MiB, {seconds:.0f} s wall, "
                f"{usage.ru_utime + usage.ru_stime:.0f} s CPU"
            )


def resource_of(process: subprocess.Popen[bytes]) -> tuple[int, int, resource.struct_rusage]:
    """Wait for a process; return its id, exit status and use of resources."""
    return os.wait4(process.pid, 0)


if __name__ == "__main__":
    main()
