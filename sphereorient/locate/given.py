"""What an experiment itself says of a camera's scene: its picture without the ball, and what hides the ball."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sphereorient.experiment import Experiment
from sphereorient.locate.background import load_background, load_mask
from sphereorient.movies import flipped_picture


def given_scene(experiment: Experiment, name: str, frame_shape: tuple[int, int]) -> NDArray[np.float32] | None:
    """Return the experiment's own picture of a camera's scene without the ball, None where it gives none."""
    path = experiment.background_paths.get(name)
    if path is None:
        return None
    # It is a frame of the movie as its file holds it.
    return flipped_picture(load_background(path, frame_shape), experiment.flip.get(name, "none"))


def given_mask(experiment: Experiment, name: str, frame_shape: tuple[int, int]) -> NDArray[np.bool_] | None:
    """Return where a camera sees the ball, (H, W), None where nothing hides it."""
    path = experiment.mask_paths.get(name)
    if path is None:
        return None
    # It is painted on a frame of the movie as its file holds it.
    return flipped_picture(load_mask(path, frame_shape), experiment.flip.get(name, "none"))
