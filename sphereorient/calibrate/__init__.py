"""Cameras from pictures of a plate, from points, and from the sphere itself: files in, files out."""

from sphereorient.calibrate.document import CalibrationDocument, load_calibration
from sphereorient.calibrate.plates import Calibrated, PictureReport, calibrate_cameras

__all__ = ["Calibrated", "CalibrationDocument", "PictureReport", "calibrate_cameras", "load_calibration"]
