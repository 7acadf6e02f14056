"""The model of a picture at a pose, and the fit: pixels, model, light, fit, implicit derivative."""

from sphereorient.pose.defocus import estimate_blur_px
from sphereorient.pose.fitter import CameraView, Fitter, Optics, base_table
from sphereorient.pose.light import Light
from sphereorient.pose.pixels import LinesOfSight

__all__ = [
    "CameraView",
    "Fitter",
    "Light",
    "LinesOfSight",
    "Optics",
    "base_table",
    "estimate_blur_px",
]
