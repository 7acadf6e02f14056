"""Where is it: background, blob, outline, gaps."""

from sphereorient.locate.background import Background, load_background, load_mask, spread_frames
from sphereorient.locate.expected import check_seen, expected_diameter_px, size_of
from sphereorient.locate.find import Found, find_ball, sightings_of
from sphereorient.locate.gaps import repair
from sphereorient.locate.learn import learn_background
from sphereorient.locate.position import Positions, find_positions
from sphereorient.locate.screen import Shot, screened, uniform
from sphereorient.locate.settings import LocateSettings
from sphereorient.locate.sightings import Sightings

__all__ = [
    "Background",
    "Found",
    "LocateSettings",
    "Positions",
    "Shot",
    "Sightings",
    "check_seen",
    "expected_diameter_px",
    "find_ball",
    "find_positions",
    "learn_background",
    "load_background",
    "load_mask",
    "repair",
    "screened",
    "sightings_of",
    "size_of",
    "spread_frames",
    "uniform",
]
