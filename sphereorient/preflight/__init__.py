"""The check before a run: a few frames looked at, what could go wrong told, and what to do."""

from sphereorient.preflight.check import Preflight, preflight
from sphereorient.preflight.finding import Finding, Severity

__all__ = ["Finding", "Preflight", "Severity", "preflight"]
