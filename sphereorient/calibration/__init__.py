"""Cameras from pictures of a plate, from points, and from the sphere itself."""

from sphereorient.calibration.boards import see_plate
from sphereorient.calibration.bundle import disk_centre_shift
from sphereorient.calibration.calibrated import Calibrated, PictureReport
from sphereorient.calibration.document import load_calibration
from sphereorient.calibration.plates import calibrate_cameras
from sphereorient.calibration.self_calibration import check_cameras, refine_with_track
from sphereorient.calibration.systematic import systematic_errors
from sphereorient.calibration.targets import DotPlate, PlateView, placed, plate_from_entry
