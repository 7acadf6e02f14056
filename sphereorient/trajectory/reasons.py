from enum import IntFlag, StrEnum
from typing import Any


class Flag(IntFlag):
    """Bits of the dataset `flags`."""

    POSITION_INTERPOLATED = 1
    POSITION_OUTLIER_REPLACED = 2
    ONE_CAMERA = 4
    REPAIRED_FROM_OTHER_CAMERA = 8
    AMBIGUOUS = 16
    DOUBTFUL_FIT = 32
    RECOVERED = 64
    SPIKE = 128
    EXTRAPOLATED = 256
    CONTRADICTION = 512
    IDENTITY = 1024  # of several spheres: it may be another one, see the dataset `identity`


class Reason(StrEnum):
    """Why a camera has no orientation in a frame; `OK` if it has one."""

    OK = "ok"
    NOT_FOUND = "not_found"
    OUTLINE = "outline"
    DARK = "dark"
    SATURATED = "saturated"
    REPEATED = "repeated"
    RUNAWAY = "runaway"
    LOW_SCORE = "low_score"
    UNSEEN = "unseen"  # it shows paint that the texture map does not know
    AMBIGUOUS = "ambiguous"
    CONTRADICTS = "contradicts"  # its line of sight misses the other camera's sphere
    SECOND_BALL = "second_ball"  # likewise, in a movie with two balls: it may show the other one
    HIDDEN = "hidden"  # another sphere covers it
    UNDECODABLE = "undecodable"
    MISSING = "missing"


def reasons_of(texts: Any) -> tuple[str, ...]:
    """Return stored texts (N,), bytes, as reasons; texts of newer files stay texts."""
    known = {str(reason): reason for reason in Reason}
    return tuple(known.get(text, text) for text in (each.decode() for each in texts.tolist()))
