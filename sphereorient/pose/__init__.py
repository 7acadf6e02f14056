"""The measuring model of a picture, and the fit of poses: pixels, model, lights, fit, implicit derivative."""

from sphereorient.pose.camera_view import CameraView, Optics, base_table
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.implicit import ImplicitPose, implicit_pose
from sphereorient.pose.model import Light
from sphereorient.pose.pixels import LinesOfSight
from sphereorient.pose.pose_fitter import PoseFit, PoseFitter
