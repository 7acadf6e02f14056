"""The map of the paint from the movies: relative turns, loops, then attitudes, light and map together."""

from sphereorient.paint.footage import Footage, take_footage
from sphereorient.paint.learn import learn_from, learn_map
from sphereorient.paint.record import Closure, LearntMap, Round
from sphereorient.paint.settings import PaintSettings

__all__ = [
    "Closure",
    "Footage",
    "LearntMap",
    "PaintSettings",
    "Round",
    "learn_from",
    "learn_map",
    "take_footage",
]
