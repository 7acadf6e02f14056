"""Cameras from pictures of a plate, from points, and from the sphere itself: files in, files out."""

from sphereorient.calibrate.document import CalibrationDocument, load_calibration
from sphereorient.calibrate.plates import Calibrated, PictureReport, calibrate_cameras
from sphereorient.calibrate.sphere import CameraCheck, check_cameras, refine_with_track

__all__ = [
    "Calibrated",
    "CalibrationDocument",
    "CameraCheck",
    "PictureReport",
    "calibrate_cameras",
    "check_cameras",
    "load_calibration",
    "refine_with_track",
]
