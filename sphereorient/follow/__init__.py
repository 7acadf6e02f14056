"""Along time: appearance, initialisation, tracking block by block, one tracker per camera."""

from sphereorient.follow.appearance import Appearance
from sphereorient.follow.initialise import POSE_PARTS, Poses, initialise
from sphereorient.follow.per_camera import PerCameraTracker
from sphereorient.follow.pose_table import PoseTable, joined_tables, pose_table
from sphereorient.follow.tracker import BlockTracker

__all__ = [
    "POSE_PARTS",
    "Appearance",
    "BlockTracker",
    "PerCameraTracker",
    "PoseTable",
    "Poses",
    "initialise",
    "joined_tables",
    "pose_table",
]
