"""The noun that comes out: reasons and flags, HDF5, tables."""

from sphereorient.trajectory.trajectory import CameraTrack, Flag, Reason, Trajectory

__all__ = [
    "CameraTrack",
    "Flag",
    "Reason",
    "Trajectory",
]
