"""Along time: appearance, initialisation, chunks of frames, one tracker per camera."""

from sphereorient.follow.appearance import Appearance
from sphereorient.follow.poses import Poses
from sphereorient.follow.tracker import Tracker
