"""Pictures of tracks and calibrations; figures, tables and the page of a report; export to other programs."""

from sphereorient.report.inputs import calibration_figure, preflight_figure
