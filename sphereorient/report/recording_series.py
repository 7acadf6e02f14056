"""Time series of a track in a Rerun recording: values with their standard deviations, states, doubts in words."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.report.doubts import doubts
from sphereorient.report.overlay_canvas import AXES
from sphereorient.trajectory import Trajectory

FADED = 90  # opacity of the lines a standard deviation above and below, of 255
# name of the plot, dataset, its standard deviation; position has a covariance instead
SERIES = (
    ("velocity, m per s", "velocity", "velocity_sigma"),
    ("acceleration, m per s2", "acceleration", "acceleration_sigma"),
    ("omega lab, rad per s", "omega_lab", "omega_lab_sigma"),
    ("alpha lab, rad per s2", "alpha_lab", "alpha_lab_sigma"),
)
PLOTS = ("position, mm", *(name for name, _, _ in SERIES), "state")


def series_of(track: Trajectory) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return values and standard deviations, (N, 3) each, by the name of their plot."""
    spread = np.sqrt(np.diagonal(track.position_cov, axis1=1, axis2=2))
    found = {"position, mm": (track.position, spread)}
    for name, values, sigma in SERIES:
        found[name] = getattr(track, values), getattr(track, sigma)
    return found


def log_series(recording: Any, track: Trajectory, when: Callable[[Any], Any]) -> None:
    """Log every series as nine lines (value, and one standard deviation above and below), states and doubts.

    Args:
        recording: a Rerun recording.
        track: what was measured.
        when: gives the time columns of some rows of the track.
    """
    import rerun as rr

    names = [f"{axis}{more}" for axis in "xyz" for more in ("", " + sigma", " - sigma")]
    colours = [(*colour, opacity) for colour in AXES for opacity in (255, FADED, FADED)]
    widths = [2.0, 1.0, 1.0] * 3
    rows = np.arange(len(track))
    for name, (values, sigma) in series_of(track).items():
        lines = np.stack([values, values + sigma, values - sigma], axis=-1).reshape(len(track), 9)
        _send(rr, recording, name, lines, rr.SeriesLines(names=names, colors=colours, widths=widths), when(rows))
    in_doubt = [float(bool(doubts(track, int(k)))) for k in rows]
    states = np.stack([track.valid.astype(float), in_doubt], axis=-1)
    style = rr.SeriesLines(names=["valid", "in doubt"], colors=[AXES[1], AXES[0]])
    _send(rr, recording, "state", states, style, when(rows))
    told = [(int(k), ", ".join(doubts(track, int(k)))) for k in rows if in_doubt[k]]
    if told:
        levels = ["WARN" if track.valid[k] else "ERROR" for k, _ in told]
        columns = rr.TextLog.columns(text=[words for _, words in told], level=levels)
        recording.send_columns("doubts", when(np.array([k for k, _ in told])), columns)


def _send(rr: Any, recording: Any, name: str, lines: NDArray[np.float64], style: Any, when: Any) -> None:
    """Log several lines of one plot."""
    place = ["plots", name]
    recording.log(place, style, static=True)
    if len(lines):
        columns = rr.Scalars.columns(scalars=lines.ravel()).partition([lines.shape[1]] * len(lines))
        recording.send_columns(rr.new_entity_path(place), when, columns)
