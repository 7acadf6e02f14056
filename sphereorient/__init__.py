"""Six-dimensional motion of a painted sphere from high-speed movies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphereorient.experiment import Experiment, load_experiment
    from sphereorient.methods.map import learn_map
    from sphereorient.methods.settings import Settings, load_settings
    from sphereorient.run.stages import track_movies
    from sphereorient.trajectory import Trajectory

__version__ = "0.1.0"
__all__ = ["Experiment", "Settings", "Trajectory", "learn_map", "load_experiment", "load_settings", "track_movies"]

_HOMES = {
    "Experiment": "experiment",
    "Settings": "methods.settings",
    "Trajectory": "trajectory",
    "learn_map": "methods.map",
    "load_experiment": "experiment",
    "load_settings": "methods.settings",
    "track_movies": "run.stages",
}


def __getattr__(name: str) -> Any:
    """Import on first use: torch takes a second, and `sphereorient --help` has no use for it."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
