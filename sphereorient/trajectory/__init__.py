"""The result of a measurement: the trajectory, its file, reasons and flags."""

from sphereorient.trajectory.reasons import Flag, Reason
from sphereorient.trajectory.trajectory import CameraTrack, Trajectory, quaternions_wxyz
