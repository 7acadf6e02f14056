"""Time stamps: their units, how evenly they are spaced, and whether their rate is one of a camera."""

import re

import numpy as np
from numpy.typing import NDArray

Stamps = NDArray[np.float64]  # (N,), increasing
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # s
_LONG = {"sec": "s", "millisec": "ms", "msec": "ms", "microsec": "us", "usec": "us", "nanosec": "ns", "nsec": "ns"}
SLOWEST_HZ, FASTEST_HZ = 1.0, 1e5  # of cameras that film a turning ball
UNEVEN = 1e-3  # of the usual time between frames


def unit_in(text: object) -> str:
    """Return the unit, a key of UNITS, that an attribute or a heading names; empty: none."""
    text = text.decode(errors="replace") if isinstance(text, bytes) else str(text)
    words = re.split(r"[\W_\d]+", re.sub("[\u00b5\u03bc]", "u", text.lower()))
    known = [_LONG.get(re.sub("(onds?|s)$", "", word), word) for word in words]
    return next((word for word in known if word in UNITS), "")


def rate_of(stamps: Stamps) -> float:
    """Return the usual rate of stamps, Hz for stamps in s; NaN for fewer than two."""
    return 1 / float(np.median(np.diff(stamps))) if len(stamps) > 1 else float("nan")


def doubt(rate_hz: float) -> str:
    """Return what makes a rate doubtful, in words, empty for one of a camera or NaN."""
    if not (rate_hz < SLOWEST_HZ or rate_hz > FASTEST_HZ):
        return ""
    return f"{rate_hz:.3g} Hz, which is outside {SLOWEST_HZ:g} to {FASTEST_HZ:,.0f} Hz"


def other_units(rate_hz: float) -> str:
    """Return in which other units stamps, which in s have a doubtful rate, have one of a camera, in words."""
    if not doubt(rate_hz):
        return ""
    rates = {unit: rate_hz / size for unit, size in UNITS.items() if not doubt(rate_hz / size)}
    return ", ".join(f"{unit} ({rate:,.6g} Hz)" for unit, rate in rates.items())


def spacing(times_s: Stamps, tick_s: float = 0.0) -> str:
    """Return the rate of stamps in words, with the uneven steps; `tick_s`: they are rounded to this, s."""
    steps = np.diff(times_s)
    rate, off = f"{rate_of(times_s):.6g} Hz", np.count_nonzero(uneven(times_s, tick_s))
    if not off:
        return f"even: {rate}"
    longest = int(np.argmax(steps))
    gap = f"the longest, {steps[longest]:.6g} s, after frame {longest}"
    return f"not even: usually {rate}, {off} of {len(steps)} steps differ, {gap}"


def uneven(times_s: Stamps, tick_s: float = 0.0) -> NDArray[np.bool_]:
    """Return which steps between stamps, (N - 1,), differ from the usual one, by more than rounding to `tick_s`."""
    steps = np.diff(times_s)
    usual = float(np.median(steps)) if len(steps) else 0.0
    return np.asarray(np.abs(steps - usual) > max(UNEVEN * usual, 1.01 * tick_s))
