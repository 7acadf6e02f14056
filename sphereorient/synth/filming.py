"""What may befall a synthetic experiment between the scene and its files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera


@dataclass(frozen=True, kw_only=True, eq=False)
class Shown:
    """The ball in one picture; made by `write_experiment`, read by `Filming.picture`."""

    name: str  # of the camera
    camera: Camera
    frame: int | None  # its number; None for the picture without the ball
    cover: NDArray[np.float32]  # (H, W), share of each pixel that the ball fills
    position_lab_mm: Tensor  # (3,) float64, its centre in the middle of the exposure


class Filming:
    """What befalls an experiment while it is filmed, and what is then told of it: here nothing, and the truth."""

    def paint(self, texture: Tensor) -> Tensor:
        """Return the map on the filmed ball, (H, 2 H), from a new one, 0 black .. 1 white."""
        return texture

    def picture(self, picture: NDArray[np.float32], shown: Shown) -> NDArray[np.float32]:
        """Return grey levels (H, W) before noise, from those that camera and optics make of the scene."""
        return picture

    def lost(self, name: str, frames: int) -> frozenset[int]:
        """Return which of the frames 0 .. frames - 1 of a camera come out black."""
        return frozenset()

    def told_texture(self, texture: Tensor) -> Tensor:
        """Return the map, (H, 2 H), that the experiment's files hold."""
        return texture

    def told_cameras(self, cameras: Mapping[str, Camera]) -> Mapping[str, Camera]:
        """Return the cameras that the experiment's files hold."""
        return cameras

    def told_diameter_mm(self, diameter_mm: float) -> float:
        """Return the sphere's diameter that the experiment's files hold."""
        return diameter_mm
