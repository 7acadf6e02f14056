"""What goes in: the experiment, its timeline, camera streams, an opened recording."""

from sphereorient.experiment.experiment import (
    Experiment,
    ExperimentKeys,
    Sphere,
    input_files,
    load_experiment,
    open_movies,
    outside_paths,
    write_experiment,
)
