from enum import IntFlag
from typing import Any

from sphereorient.errors import Reason


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


def reasons_of(texts: Any) -> tuple[str, ...]:
    """Return stored texts (N,), bytes, as reasons; texts of newer files stay texts."""
    known = {str(reason): reason for reason in Reason}
    return tuple(known.get(text, text) for text in (each.decode() for each in texts.tolist()))
