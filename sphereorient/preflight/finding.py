"""What a check has to say: one finding, in words."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """How bad a finding is."""

    OK = "ok"
    WARNING = "warning"  # the run will do, but less well than it could
    FAULT = "fault"  # the run will fail, or its numbers will be wrong


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing looked at; made by the files of this room, read by the command line and the figure."""

    title: str
    severity: Severity
    measured: str  # what was found, with numbers and units
    advice: str = ""  # what to do, as an imperative; empty where nothing is to be done


def worst(findings: list[Finding]) -> Severity:
    """Return the worst severity of some findings; OK of none."""
    order = list(Severity)
    return max((finding.severity for finding in findings), key=order.index, default=Severity.OK)
