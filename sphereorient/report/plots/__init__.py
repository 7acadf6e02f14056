"""The figures of the paper's section IV: each function returns a figure, `write_figure` writes it."""

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
from sphereorient.report.plots.style import write_figure
from sphereorient.report.plots.track import path_figure, track_figure
