"""Time stamps: their units and spacing, and whether their rate is plausible for a camera."""

import re

import numpy as np
from numpy.typing import NDArray

Stamps = NDArray[np.float64]  # (N,), increasing
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # s
_UNIT = re.compile(r"(milli|micro|nano|[mun])?s(ec(ond)?s?)?")
SLOWEST_HZ, FASTEST_HZ = 1.0, 1e5  # of cameras that film a rotating ball
UNEVEN = 1e-3  # of the usual time between frames


def unit_in(text: object) -> str:
    """Return the unit, a key of UNITS, named in an attribute or a heading; empty: none."""
    text = text.decode(errors="replace") if isinstance(text, bytes) else str(text)
    words = re.split(r"[\W_\d]+", re.sub("[\u00b5\u03bc]", "u", text.lower()))
    found = next(filter(None, map(_UNIT.fullmatch, words)), None)
    return "" if found is None else {"micro": "u"}.get(found[1], (found[1] or "")[:1]) + "s"


def rate_of(stamps: Stamps) -> float:
    """Return the usual rate of stamps, Hz for stamps in s; NaN for fewer than two."""
    return 1 / float(np.median(np.diff(stamps))) if len(stamps) > 1 else float("nan")


def doubt(rate_hz: float) -> str:
    """Return why a rate is doubtful, as text; empty for a plausible rate or NaN."""
    doubtful = rate_hz < SLOWEST_HZ or rate_hz > FASTEST_HZ
    return f"{rate_hz:.3g} Hz, which is outside {SLOWEST_HZ:g} to {FASTEST_HZ:,.0f} Hz" if doubtful else ""


def other_units(rate_hz: float) -> str:
    """Return the units in which stamps have a plausible rate, as text; empty if `rate_hz`, in s, is plausible."""
    rates = {unit: rate_hz / size for unit, size in UNITS.items() if doubt(rate_hz) and not doubt(rate_hz / size)}
    return ", ".join(f"{unit} ({rate:,.6g} Hz)" for unit, rate in rates.items())


def spacing(times_s: Stamps, tick_s: float = 0.0) -> tuple[bool, str]:
    """Return whether at least two stamps, rounded to `tick_s`, are evenly spaced, and their rate and gaps as text."""
    steps, rate = np.diff(times_s), f"{rate_of(times_s):.6g} Hz"
    usual, longest = float(np.median(steps)), int(np.argmax(steps))
    off = np.count_nonzero(np.abs(steps - usual) > max(UNEVEN * usual, 1.01 * tick_s))
    gap = f"the longest, {steps[longest]:.6g} s, after frame {longest}"
    uneven = f"not even: usually {rate}, {off} of {len(steps)} steps differ, {gap}"
    return not off, uneven if off else f"even: {rate}"
