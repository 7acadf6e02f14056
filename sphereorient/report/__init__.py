"""Pictures of tracks."""

from sphereorient.report.figure import demo_figure

__all__ = ["demo_figure"]
