"""One camera's scene: what it shows without the ball, and how large the ball is in it."""

from __future__ import annotations

from dataclasses import dataclass

from sphereorient.experiment.given import given_scene
from sphereorient.experiment.recording import Recording
from sphereorient.experiment.stream import CameraStream
from sphereorient.locate.background import Background
from sphereorient.locate.expected import expected_diameter_px
from sphereorient.locate.fixed import fixed_ball
from sphereorient.locate.learn import learn_background
from sphereorient.locate.settings import LocateSettings


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """What one camera shows without the ball; made by `find_scene`."""

    background: Background
    diameter_px: float  # expected, of the ball's picture


def known_diameter_px(recording: Recording, name: str, settings: LocateSettings) -> float | None:
    """Return the expected diameter of the ball's picture in a camera; None where only the movie can show it.

    Raises:
        SettingsError: see `expected_diameter_px`.
    """
    if settings.diameter_px is None and recording.experiment.fixed and recording.experiment.diameter_mm is None:
        return None
    return settings.diameter_px or expected_diameter_px(name, recording.cameras, recording.experiment.diameter_mm)


def find_scene(recording: Recording, stream: CameraStream, count: int, settings: LocateSettings) -> Scene:
    """Estimate what one camera shows without the ball, from `count` frames or from the experiment's own picture.

    Raises:
        ExperimentError: a ball that is said to be fixed does not turn in one place.
        SettingsError: the ball's diameter is unknown.
    """
    empty = given_scene(recording.experiment, stream.name, stream.movie.frame_shape)
    diameter_px = known_diameter_px(recording, stream.name, settings)
    if recording.experiment.fixed and (empty is None or diameter_px is None):
        fixed = fixed_ball(stream.spread(settings.background_frames), settings, empty, stream.shown)
        diameter_px = diameter_px or 2 * fixed.outline.radius_px
        if empty is None:
            return Scene(background=fixed.scene, diameter_px=diameter_px)
    assert diameter_px is not None  # a ball that moves has one, or is refused
    background = learn_background(stream.spread(count), diameter_px, settings, empty, stream.shown)
    return Scene(background=background, diameter_px=diameter_px)
