"""Appearance of a movie (light, blur, noise), estimated from a few frames before tracking."""

from sphereorient.follow.appearance.estimate import WIDER, estimate_appearance
from sphereorient.follow.appearance.presence import LOOK_ALIKE, NO_BETTER
from sphereorient.follow.appearance.record import Among, Appearance, Following

__all__ = ["LOOK_ALIKE", "NO_BETTER", "WIDER", "Among", "Appearance", "Following", "estimate_appearance"]
