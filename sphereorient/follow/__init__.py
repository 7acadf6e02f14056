"""Along time: appearance, initialisation, tracking block by block, one tracker per camera."""

from sphereorient.follow.appearance import Appearance
from sphereorient.follow.initialise import initialise
from sphereorient.follow.per_camera import PerCameraTracker
from sphereorient.follow.poses import Poses, PoseTable, joined_tables, pose_table
from sphereorient.follow.tracker import BlockTracker
from sphereorient.pose.fit import POSE_PARTS

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
