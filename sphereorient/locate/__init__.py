"""Locating the sphere: background, blob, outline, gaps, position in the lab."""

from sphereorient.locate.background import Background, Frame, screened, screened_frames
from sphereorient.locate.disks import find_disks
from sphereorient.locate.position import Match, Positions, assigned, find_positions, match_disks, places_of
from sphereorient.locate.scene import (
    CameraScene,
    expected_diameter_px,
    find_scenes,
    known_diameter_px,
    learn_background,
)
from sphereorient.locate.settings import LocateSettings
from sphereorient.locate.sightings import (
    Found,
    Sightings,
    ball_at,
    check_seen,
    fill_gaps,
    find_ball,
    sightings_of,
    size_of,
    smoothed,
)
