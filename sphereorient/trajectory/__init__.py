"""The result of a measurement: trajectories, their file, reasons and flags."""

from sphereorient.trajectory.datasets import runs_of
from sphereorient.trajectory.reasons import Flag, Reason
from sphereorient.trajectory.tracks import Tracks, one_track
from sphereorient.trajectory.trajectory import CameraTrack, Trajectory, quaternions_wxyz
