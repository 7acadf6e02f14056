"""Calibration: targets in pictures, and the cameras that follow from them. Arrays in, cameras out."""

from sphereorient.cameras.calibration.bias import disk_centre_shift
from sphereorient.cameras.calibration.entry import plate_from_entry
from sphereorient.cameras.calibration.placing import placed
from sphereorient.cameras.calibration.plate import DotPlate
from sphereorient.cameras.calibration.see import see_plate
from sphereorient.cameras.calibration.systematic import Systematic, systematic_errors
from sphereorient.cameras.calibration.view import PlateView

__all__ = [
    "DotPlate",
    "PlateView",
    "Systematic",
    "disk_centre_shift",
    "placed",
    "plate_from_entry",
    "see_plate",
    "systematic_errors",
]
