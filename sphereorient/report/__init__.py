"""Pictures of tracks and calibrations."""

from sphereorient.report.calibration import calibration_figure
from sphereorient.report.figure import demo_figure
from sphereorient.report.preflight import preflight_figure

__all__ = ["calibration_figure", "demo_figure", "preflight_figure"]
