from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import ExperimentError, refusal
from sphereorient.experiment.experiment import Experiment
from sphereorient.files.picture import claimed_pixels, decoded_grey
from sphereorient.files.whole_file import read_whole
from sphereorient.movies import flipped_picture

BYTES_A_PIXEL, HEADER_BYTES = 8, 1_000_000  # uncompressed, and its header


def given_scene(experiment: Experiment, name: str, frame_shape: tuple[int, int]) -> NDArray[np.float32] | None:
    """Return a camera's background, (H, W) grey levels, flipped as its movie; None if not given."""
    path = experiment.background_paths.get(name)
    if path is None:
        return None
    return flipped_picture(load_background(path, frame_shape), experiment.flip.get(name, "none"))


def given_mask(experiment: Experiment, name: str, frame_shape: tuple[int, int]) -> NDArray[np.bool_] | None:
    """Return a camera's mask, (H, W), False where the sphere is hidden, flipped as its movie; None if not given."""
    path = experiment.mask_paths.get(name)
    if path is None:
        return None
    return flipped_picture(load_mask(path, frame_shape), experiment.flip.get(name, "none"))


def load_background(path: Path, frame_shape: tuple[int, int]) -> NDArray[np.float32]:
    """Read a background, (H, W), grey levels; raise ExperimentError unless it is a picture of the movie's size."""
    do = "save a frame without the ball as PNG, in the movie's own grey levels"
    return np.asarray(_picture(path, f"background {path}", frame_shape, do), np.float32)


def load_mask(path: Path, frame_shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Read a mask, (H, W), True (white) where the sphere is visible, False (black) where something hides it.

    Raises:
        ExperimentError: missing, not a picture, not of the movie's size, or all black.
    """
    name, do = f"mask {path}", "paint what hides the ball black, all else white, on a frame of the movie"
    picture = _picture(path, name, frame_shape, do)
    shown = np.asarray(picture > np.iinfo(picture.dtype).max // 2)
    if not shown.any():
        raise ExperimentError(refusal(name, expected="white where the ball is seen", got="black only", do=do))
    return shown


def _picture(path: Path, name: str, frame_shape: tuple[int, int], do: str) -> NDArray[Any]:
    height, width = frame_shape
    content = read_whole(path, BYTES_A_PIXEL * height * width + HEADER_BYTES, "a picture", ExperimentError, do)
    claimed, expected = claimed_pixels(content), f"{width} x {height} px as the movie"
    if claimed is not None and claimed > height * width:  # before allocating memory
        raise ExperimentError(refusal(name, expected=expected, got=f"{claimed} px", do=do))
    picture = None if claimed is None else decoded_grey(content)
    if picture is None:
        raise ExperimentError(refusal(name, expected="a picture", got="a file that cannot be decoded", do=do))
    if picture.shape != frame_shape:
        got = f"{picture.shape[1]} x {picture.shape[0]} px"
        raise ExperimentError(refusal(name, expected=expected, got=got, do=do))
    return picture
