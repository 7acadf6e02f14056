"""The figures of the paper's section IV; `figures` of each file yields those of a report."""

from collections.abc import Iterator

from sphereorient.report.plots import distributions, quality, track
from sphereorient.report.plots.distributions import (
    correlations_figure,
    densities_figure,
    durations_figure,
    increments_figure,
)
from sphereorient.report.plots.quality import (
    angles_figure,
    camera_distance_figure,
    isotropy_figure,
    noise_figure,
    widths_figure,
)
from sphereorient.report.plots.style import Plan, Reported, write_figure
from sphereorient.report.plots.track import path_figure, track_figure


def report_figures(of: Reported) -> Iterator[Plan]:
    """Yield the figures of a report in order."""
    for file in (track, quality, distributions):
        yield from file.figures(of)
