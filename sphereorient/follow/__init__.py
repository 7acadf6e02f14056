"""Tracking along time: appearance, initialisation, chunks of frames, one tracker per camera."""

from sphereorient.follow.appearance import Appearance
from sphereorient.follow.initialise import Initialiser
from sphereorient.follow.per_camera import PerCameraTracker
from sphereorient.follow.poses import Poses, PoseTable, joined_tables, pose_table
from sphereorient.follow.tracker import ChunkTracker
from sphereorient.pose.fit import POSE_PARTS

__all__ = [
    "POSE_PARTS",
    "Appearance",
    "ChunkTracker",
    "Initialiser",
    "PerCameraTracker",
    "PoseTable",
    "Poses",
    "joined_tables",
    "pose_table",
]
