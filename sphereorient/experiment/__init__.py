"""The input of a measurement: experiment, timeline, camera streams, open recording."""

from sphereorient.experiment.experiment import (
    MOVIES_OWN,
    Experiment,
    ExperimentKeys,
    input_files,
    load_experiment,
    open_movies,
    outside_paths,
    write_experiment,
)

__all__ = [
    "MOVIES_OWN",
    "Experiment",
    "ExperimentKeys",
    "input_files",
    "load_experiment",
    "open_movies",
    "outside_paths",
    "write_experiment",
]
