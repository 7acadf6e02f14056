"""The result of a measurement: trajectories, their file, rotations as arrays, reasons and flags."""

from sphereorient.errors import Flag, Reason
from sphereorient.trajectory.datasets import runs_of, span_words
from sphereorient.trajectory.trajectory import CameraTrack, Tracks, Trajectory, one_track, quaternions_wxyz
