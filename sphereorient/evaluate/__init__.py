"""Scores against truth, and the bound that no method can beat."""

from sphereorient.evaluate.bound import Bound, cramer_rao_bound
from sphereorient.evaluate.score import Score, score_track

__all__ = ["Bound", "Score", "cramer_rao_bound", "score_track"]
