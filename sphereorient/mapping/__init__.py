"""The texture map from movies or photographs: relative rotations, loops, then attitudes, light and map together."""

from sphereorient.mapping.footage import take_footage
from sphereorient.mapping.learn import learn_from, learn_map
from sphereorient.mapping.record import LearntMap
from sphereorient.mapping.settings import PaintSettings

__all__ = [
    "LearntMap",
    "PaintSettings",
    "learn_from",
    "learn_map",
    "take_footage",
]
