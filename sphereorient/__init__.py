"""Six-dimensional motion of a painted sphere from high-speed movies."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphereorient import cameras, so3, sphere, synth
    from sphereorient.assemble import PathLayer
    from sphereorient.calibration.plates import calibrate_cameras as calibrate
    from sphereorient.experiment import Experiment, load_experiment
    from sphereorient.methods.map import learn_map
    from sphereorient.methods.settings import Settings, load_settings
    from sphereorient.pose import PoseFitter
    from sphereorient.preflight import preflight as check
    from sphereorient.run.stages import track_movies
    from sphereorient.search import TemplateBank
    from sphereorient.sphere import SphereRenderer, load_texture
    from sphereorient.trajectory import Tracks, Trajectory

__version__ = "0.1.0"
# Public name -> module, and its name there; a room itself has none.
_HOMES = {
    "Experiment": ("experiment", "Experiment"),
    "PathLayer": ("assemble", "PathLayer"),
    "PoseFitter": ("pose", "PoseFitter"),
    "Settings": ("methods.settings", "Settings"),
    "SphereRenderer": ("sphere", "SphereRenderer"),
    "TemplateBank": ("search", "TemplateBank"),
    "Tracks": ("trajectory", "Tracks"),
    "Trajectory": ("trajectory", "Trajectory"),
    "calibrate": ("calibration.plates", "calibrate_cameras"),
    "cameras": ("cameras", ""),
    "check": ("preflight", "preflight"),
    "learn_map": ("methods.map", "learn_map"),
    "load_experiment": ("experiment", "load_experiment"),
    "load_settings": ("methods.settings", "load_settings"),
    "load_texture": ("sphere", "load_texture"),
    "so3": ("so3", ""),
    "sphere": ("sphere", ""),
    "synth": ("synth", ""),
    "track_movies": ("run.stages", "track_movies"),
}
__all__ = [
    "Experiment",
    "PathLayer",
    "PoseFitter",
    "Settings",
    "SphereRenderer",
    "TemplateBank",
    "Tracks",
    "Trajectory",
    "calibrate",
    "cameras",
    "check",
    "learn_map",
    "load_experiment",
    "load_settings",
    "load_texture",
    "so3",
    "sphere",
    "synth",
    "track_movies",
]


def __getattr__(name: str) -> Any:
    """Import on first use: torch takes a second, and `sphereorient --help` does not need it."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    from importlib import import_module

    module, inner = _HOMES[name]
    found = import_module(f"{__name__}.{module}")
    return getattr(found, inner) if inner else found


def __dir__() -> list[str]:
    """Return the public names, for completion."""
    return [*__all__, "__version__"]
