"""The figures of the paper's section IV: each function returns a figure, `write_figure` writes it."""

from sphereorient.report.plots.angles import angles_figure
from sphereorient.report.plots.cameras import camera_distance_figure
from sphereorient.report.plots.correlations import correlations_figure
from sphereorient.report.plots.densities import densities_figure
from sphereorient.report.plots.durations import durations_figure
from sphereorient.report.plots.increments import increments_figure
from sphereorient.report.plots.isotropy import isotropy_figure
from sphereorient.report.plots.noise import noise_figure
from sphereorient.report.plots.path import path_figure
from sphereorient.report.plots.style import write_figure
from sphereorient.report.plots.track import track_figure
from sphereorient.report.plots.widths import widths_figure

__all__ = [
    "angles_figure",
    "camera_distance_figure",
    "correlations_figure",
    "densities_figure",
    "durations_figure",
    "increments_figure",
    "isotropy_figure",
    "noise_figure",
    "path_figure",
    "track_figure",
    "widths_figure",
    "write_figure",
]
