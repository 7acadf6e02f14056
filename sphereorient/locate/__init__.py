"""Where is it: background, blob, outline, gaps."""

from sphereorient.locate.background import Background, measure_background, spread_frames
from sphereorient.locate.find import find_ball, sightings_of
from sphereorient.locate.gaps import repair
from sphereorient.locate.settings import LocateSettings
from sphereorient.locate.sightings import Sightings

__all__ = [
    "Background",
    "LocateSettings",
    "Sightings",
    "find_ball",
    "measure_background",
    "repair",
    "sightings_of",
    "spread_frames",
]
