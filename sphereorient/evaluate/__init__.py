"""Scores against truth, and the lower bound of the errors."""

from sphereorient.evaluate.bound import Bound, cramer_rao_bound
from sphereorient.evaluate.score import Score, score_track
