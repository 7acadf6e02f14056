"""Do probabilities keep what they promise; it lives in the room statistics, which the training reads too."""

from __future__ import annotations

from sphereorient.statistics.reliability import Reliability, reliability

__all__ = ["Reliability", "reliability"]
