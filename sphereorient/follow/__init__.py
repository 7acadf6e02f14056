"""Tracking along time: appearance, search without history, chunks of frames, one tracker for all balls."""

from sphereorient.follow.appearance import Appearance
from sphereorient.follow.tracker import Tracker
from sphereorient.pose.poses import Poses
