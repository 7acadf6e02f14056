"""What goes in: the experiment, its timeline, camera streams, an opened recording."""

from sphereorient.experiment.experiment import Experiment, Sphere, input_files, load_experiment, open_movies
