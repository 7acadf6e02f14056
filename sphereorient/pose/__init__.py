"""The measuring model of a picture, and the fit: pixels, model, light, fit, implicit derivative."""

from sphereorient.pose.fitter import CameraView, Fitter, Optics, PoseFitter, base_table
from sphereorient.pose.implicit import ImplicitPose, implicit_pose
from sphereorient.pose.model import Light
from sphereorient.pose.pixels import LinesOfSight
