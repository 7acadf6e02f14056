"""The result of a measurement: trajectories, their file, reasons and flags."""

from sphereorient.trajectory.reasons import Flag, Reason
from sphereorient.trajectory.tracks import Tracks, one_track
from sphereorient.trajectory.trajectory import CameraTrack, Trajectory, quaternions_wxyz
from sphereorient.trajectory.walk import runs_of
