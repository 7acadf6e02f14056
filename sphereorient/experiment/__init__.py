"""The inputs: the experiment, its timeline, camera streams, and the opened recording."""

from sphereorient.experiment.experiment import Experiment, Sphere, input_files, load_experiment, open_movies
