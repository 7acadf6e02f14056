from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """How bad a finding is."""

    OK = "ok"
    WARNING = "warning"  # the run works, but less well than it could
    FAULT = "fault"  # the run fails, or its numbers are wrong


@dataclass(frozen=True, kw_only=True)
class Finding:
    """The result of one check; made by this room, read by the command line and the figure."""

    title: str
    severity: Severity
    measured: str  # numbers with units
    advice: str = ""  # what to do, as an imperative; empty if nothing


def ok(title: str, measured: str) -> Finding:
    """Return a finding without a complaint."""
    return Finding(title=title, severity=Severity.OK, measured=measured)


def warning(title: str, measured: str, advice: str) -> Finding:
    """Return a warning."""
    return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)


def fault(title: str, measured: str, advice: str) -> Finding:
    """Return a fault."""
    return Finding(title=title, severity=Severity.FAULT, measured=measured, advice=advice)


def worst(findings: Sequence[Finding]) -> Severity:
    """Return the worst severity; OK if there are no findings."""
    return max((finding.severity for finding in findings), key=list(Severity).index, default=Severity.OK)
