"""One picture of any target: what is to be seen of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sphereorient.calibration.boards import see_charuco, see_chessboard, see_circles
from sphereorient.calibration.dots import DotSettings, find_dots
from sphereorient.calibration.entry import Target
from sphereorient.calibration.grid import index_dots
from sphereorient.calibration.plate import DotPlate
from sphereorient.calibration.targets import CharucoBoard, Chessboard
from sphereorient.calibration.view import PlateView


def see_plate(
    picture: NDArray[np.generic], plate: Target, name: str = "plate picture", settings: DotSettings | None = None
) -> PlateView:
    """Return what one picture shows of a target.

    Args:
        picture: (H, W), grey, any number type.
        plate: the target, as of `plate_from_entry`.
        name: the picture's name, for the reason.
        settings: how dots of a dot plate are found.

    Returns:
        PlateView; a picture that shows nothing usable is data (`refused`, with the reason), not an error.

    Raises:
        CameraError: no grey picture.
    """
    if isinstance(plate, DotPlate):
        return index_dots(find_dots(picture, dark=plate.dark, settings=settings), plate, name)
    if isinstance(plate, Chessboard):
        return see_chessboard(picture, plate, name)
    if isinstance(plate, CharucoBoard):
        return see_charuco(picture, plate, name)
    return see_circles(picture, plate, name)
