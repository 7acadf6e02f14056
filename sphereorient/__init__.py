"""Six-dimensional motion of a painted sphere from high-speed movies."""

__version__ = "0.1.0"
