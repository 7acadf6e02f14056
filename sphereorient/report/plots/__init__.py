"""The figures of the paper's section IV; `report_figures` yields those on the page of a report."""

from collections.abc import Iterator

from sphereorient.report.plots.distributions import (
    correlations_figure,
    densities_figure,
    distribution_figures,
    durations_figure,
    increments_figure,
)
from sphereorient.report.plots.quality import (
    angles_figure,
    camera_distance_figure,
    isotropy_figure,
    noise_figure,
    quality_figures,
    widths_figure,
)
from sphereorient.report.plots.style import Plan, Reported, write_figure
from sphereorient.report.plots.track import path_figure, track_figure, track_figures


def report_figures(of: Reported) -> Iterator[Plan]:
    """Yield the figures of a report in order."""
    for figures in (track_figures, quality_figures, distribution_figures):
        yield from figures(of)
