"""The check before a run: sample a few frames, report problems and advice."""

from sphereorient.preflight.check import Preflight, preflight
from sphereorient.preflight.finding import Finding, Severity
