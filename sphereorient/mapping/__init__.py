"""The texture map from movies or photographs: relative rotations, loops, then orientations, light and map together."""

from sphereorient.mapping.disks import take_crops
from sphereorient.mapping.learn import LearntMap, fit_map
from sphereorient.mapping.settings import MapSettings
