"""Where is it: background, blob, outline, gaps."""

from sphereorient.locate.background import Background
from sphereorient.locate.expected import check_seen, expected_diameter_px, size_of
from sphereorient.locate.find import Found, find_ball, sightings_of
from sphereorient.locate.gaps import repair
from sphereorient.locate.learn import learn_background
from sphereorient.locate.position import Positions, find_positions
from sphereorient.locate.scene import Scene, find_scene, known_diameter_px
from sphereorient.locate.screen import Shot, screened, screened_frames
from sphereorient.locate.settings import LocateSettings
from sphereorient.locate.sightings import Sightings

__all__ = [
    "Background",
    "Found",
    "LocateSettings",
    "Positions",
    "Scene",
    "Shot",
    "Sightings",
    "check_seen",
    "expected_diameter_px",
    "find_ball",
    "find_positions",
    "find_scene",
    "known_diameter_px",
    "learn_background",
    "repair",
    "screened",
    "screened_frames",
    "sightings_of",
    "size_of",
]
