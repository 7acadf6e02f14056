"""Scores against truth."""

from sphereorient.evaluate.score import Score, score_track

__all__ = ["Score", "score_track"]
