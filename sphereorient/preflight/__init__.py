"""The check before a run: it samples a few frames and reports what can go wrong and what to do."""

from sphereorient.preflight.check import Preflight, preflight
from sphereorient.preflight.finding import Finding, Severity

__all__ = ["Finding", "Preflight", "Severity", "preflight"]
