from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """How bad a finding is."""

    OK = "ok"
    WARNING = "warning"  # the run works, with lower quality
    FAULT = "fault"  # the run fails, or its numbers are wrong


OK, WARNING, FAULT = Severity


@dataclass(frozen=True, kw_only=True)
class Finding:
    """The result of one check; made by this room, read by the command line and the figure."""

    title: str
    severity: Severity
    measured: str  # numbers with units
    advice: str = ""  # what to do, as an imperative; empty if nothing


def judged(title: str, measured: str, *complaints: tuple[bool, Severity, str]) -> Finding:
    """Return a finding with the first complaint that holds; each is (whether it holds, severity, advice)."""
    severity, advice = next((complaint[1:] for complaint in complaints if complaint[0]), (OK, ""))
    return Finding(title=title, severity=severity, measured=measured, advice=advice)


def warning(title: str, measured: str, advice: str) -> Finding:
    """Return a warning."""
    return judged(title, measured, (True, WARNING, advice))
