"""What can be wrong with pictures and with what is known of them: names, units, and how bad five levels are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from sphereorient.errors import SettingsError, refusal
from sphereorient.files.yaml_file import refuse_unknown

LEVELS = (1, 2, 3, 4, 5)
Place = Literal["scene", "map", "picture", "movie", "told"]
SHARE = "share of "  # how units of the values begin that lie in 0 .. 1


@dataclass(frozen=True, kw_only=True)
class Degradation:
    """One thing that can be wrong, in five severities; a row of `DEGRADATIONS`."""

    name: str
    unit: str  # of the values
    does: str  # one sentence
    values: tuple[float, float, float, float, float]  # from mild to hard: level 1 .. level 5
    reason: str  # for the values
    nothing: float | None  # the value at which nothing happens; None: the base scene's own value
    where: Place  # scene and map: before the ball is filmed; told: what the method is given, not what is filmed
    still: bool = True  # pictures: the same throughout a movie, and in the picture without the ball

    def check(self, value: float) -> None:
        """Refuse a value that is not a number, below nothing, or a share of 1 or more (SettingsError)."""
        least = 0.0 if self.nothing is None else self.nothing
        most = 1.0 if self.unit.startswith(SHARE) else math.inf
        if not (math.isfinite(value) and least <= value < most):
            expected = f"{least:g} or more" + (f", and below {most:g}" if most < math.inf else "")
            do = f"write the {self.unit}"
            raise SettingsError(refusal(f"degradation {self.name}", expected=expected, got=f"{value:g}", do=do))


_TABLE = (
    Degradation(
        name="ball_size",
        unit="px of diameter",
        does="The same scene filmed with coarser or finer pixels.",
        values=(160.0, 80.0, 50.0, 32.0, 20.0),
        reason="the default ball has 78 px; at 20 px a patch of its paint is 4 px wide",
        nothing=None,
        where="scene",
    ),
    Degradation(
        name="spin",
        unit="degrees per frame, rms",
        does="The ball turns faster; the exposure is shortened so that it smears no more than before.",
        values=(5.0, 10.0, 20.0, 40.0, 60.0),
        reason="the default ball turns by 1.3; at 60 a third of the paint in sight is new in the next frame",
        nothing=None,
        where="scene",
    ),
    Degradation(
        name="motion_blur",
        unit="degrees per exposure, rms",
        does="The shutter stays open longer; where the whole frame is not long enough, the ball turns faster too.",
        values=(1.0, 3.0, 8.0, 16.0, 32.0),
        reason="1.3 is a shutter that never closes on the default ball; 32 is wider than its patches of paint, 24",
        nothing=None,
        where="scene",
    ),
    Degradation(
        name="paint_wear",
        unit="share of the ball's area",
        does="Paint has come off the filmed ball in patches that show bare grey; the map knows nothing of it.",
        values=(0.02, 0.05, 0.12, 0.25, 0.45),
        reason="a scratch after a day of mixing; at 0.45 hardly more than half of the paint is left",
        nothing=0.0,
        where="map",
    ),
    Degradation(
        name="uneven_light",
        unit="ratio of bright to dark limb",
        does="One side of the ball gets less light, falling off exponentially across the disk.",
        values=(1.5, 2.5, 4.0, 8.0, 16.0),
        reason="one lamp of two is dim; from 8 on white paint in the dark is as dim as black paint in the light",
        nothing=1.0,
        where="picture",
    ),
    Degradation(
        name="highlights",
        unit="grey levels of the peak",
        does="Two lamps are mirrored in glossy paint: Gaussian spots, sigma 0.12 radii, that do not turn along.",
        values=(40.0, 80.0, 120.0, 180.0, 255.0),
        reason="varnish instead of matt paint; from 150 on black paint under a spot is as bright as white paint",
        nothing=0.0,
        where="picture",
    ),
    Degradation(
        name="background_clutter",
        unit="grey levels, rms",
        does="Unmoving bright structure behind the ball; the picture without the ball shows it too.",
        values=(4.0, 8.0, 16.0, 28.0, 45.0),
        reason="a wall with stains; at 45 the structure reaches the white paint's level and the outline drowns",
        nothing=0.0,
        where="picture",
    ),
    Degradation(
        name="occlusion",
        unit="share of the disk hidden",
        does="A dark round thing as large as the ball passes before it, on another side in every frame.",
        values=(0.05, 0.12, 0.25, 0.4, 0.6),
        reason="the edge of another particle; above one half the centre itself is hidden",
        nothing=0.0,
        where="picture",
        still=False,
    ),
    Degradation(
        name="bubbles",
        unit="bubbles before the disk",
        does="Bubbles of 0.12 ball radii before the ball, dark rims and a glint each, elsewhere in every frame.",
        values=(2.0, 5.0, 10.0, 18.0, 30.0),
        reason="a leaking seal; 30 cover a third of the disk",
        nothing=0.0,
        where="picture",
        still=False,
    ),
    Degradation(
        name="dirt",
        unit="px of the specks' radius",
        does="Dark specks on the window, 6 in 100 x 100 px, at rest; the picture without the ball shows them too.",
        values=(1.0, 2.0, 4.0, 7.0, 12.0),
        reason="dust on the glass; at 12 px a quarter of the picture is covered",
        nothing=0.0,
        where="picture",
    ),
    Degradation(
        name="contrast_loss",
        unit="share of the contrast lost",
        does="Turbid liquid: all grey levels move towards a veil of 95.",
        values=(0.2, 0.4, 0.6, 0.8, 0.9),
        reason="tracer dust in the tank; at 0.9 white and black paint are 15 levels apart, with noise of 3",
        nothing=0.0,
        where="picture",
    ),
    Degradation(
        name="defocus",
        unit="px of sigma",
        does="The lens is out of focus: a Gaussian on top of the optics' own.",
        values=(0.7, 1.5, 3.0, 6.0, 10.0),
        reason="focus set by view; at 10 patches of 16 px, the default ball's, keep a sixth of their contrast",
        nothing=0.0,
        where="picture",
    ),
    Degradation(
        name="saturation",
        unit="share of white paint clipped",
        does="Too much light: as much that this share of the white paint in sight exceeds 255.",
        values=(0.05, 0.2, 0.5, 0.8, 0.98),
        reason="the lit side clips first; at 0.98 white is flat, and its blurred borders have moved into the black",
        nothing=0.0,
        where="picture",
    ),
    Degradation(
        name="shot_noise",
        unit="grey levels per root of grey level",
        does="Too few photons: noise that grows with the root of the light, on top of the camera's own.",
        values=(0.5, 0.8, 1.2, 2.0, 3.5),
        reason="high gain; at 3.5 the noise of white paint is a third of the step from black to white",
        nothing=0.0,
        where="picture",
        still=False,
    ),
    Degradation(
        name="read_noise",
        unit="grey levels",
        does="A noisy sensor: white noise of this standard deviation, on top of the camera's own.",
        values=(3.0, 6.0, 12.0, 20.0, 35.0),
        reason="a warm sensor; at 35 the noise is a quarter of the step from black to white",
        nothing=0.0,
        where="picture",
        still=False,
    ),
    Degradation(
        name="dropped_frames",
        unit="share of the frames",
        does="Frames of each camera are black, drawn for each camera by itself.",
        values=(0.02, 0.05, 0.15, 0.3, 0.5),
        reason="a slow disk; at 0.5 a quarter of the instants has no picture at all",
        nothing=0.0,
        where="movie",
    ),
    Degradation(
        name="centre_error",
        unit="px",
        does="The cameras' principal points are told wrong, in opposite directions for the two cameras.",
        values=(0.25, 0.5, 1.0, 2.0, 4.0),
        reason="a quarter is a poor calibration; lines of sight miss each other by 1.4 times as much",
        nothing=0.0,
        where="told",
    ),
    Degradation(
        name="radius_error",
        unit="px",
        does="The sphere's diameter is told too large: by this much at the rim of the picture.",
        values=(0.25, 0.5, 1.0, 2.0, 4.0),
        reason="0.25 is 0.1 mm of 18, a coat of varnish; 4 is a tenth of the default ball's",
        nothing=0.0,
        where="told",
    ),
    Degradation(
        name="camera_rotation",
        unit="degrees",
        does="The second camera is told turned about the lab's origin, by equal parts of pan, tilt and roll.",
        values=(0.05, 0.15, 0.5, 1.5, 5.0),
        reason="0.05 is a fair calibration; at 5 the cameras disagree by more than the paper's grid step of 3",
        nothing=0.0,
        where="told",
    ),
    Degradation(
        name="camera_shift",
        unit="mm",
        does="The second camera is told moved sideways, along its own x, which both cameras of the default scene see.",
        values=(0.05, 0.1, 0.3, 1.0, 3.0),
        reason="someone touched the tripod; at 3 lines of sight pass each other by a third of a radius",
        nothing=0.0,
        where="told",
    ),
    Degradation(
        name="texture_error",
        unit="share of the map's area",
        does="The map that the method is given has black and white exchanged in patches.",
        values=(0.01, 0.03, 0.08, 0.18, 0.35),
        reason="a map drawn by hand; at 0.5 it would say nothing at all",
        nothing=0.0,
        where="told",
    ),
)

# In the order in which the light meets them; what the method is told comes last.
DEGRADATIONS: Mapping[str, Degradation] = MappingProxyType({row.name: row for row in _TABLE})


def degradation(name: str) -> Degradation:
    """Return a row of `DEGRADATIONS`.

    Raises:
        SettingsError: an unknown name; the nearest known one is told.
    """
    if name not in DEGRADATIONS:
        raise SettingsError(refuse_unknown(name, DEGRADATIONS, "degradation"))
    return DEGRADATIONS[name]


def severity(name: str, level: int) -> float:
    """Return the physical value of a level.

    Args:
        name: of a degradation.
        level: 1, mild, to 5, hard.

    Raises:
        SettingsError: an unknown name, or another level.
    """
    row = degradation(name)
    if isinstance(level, bool) or level not in LEVELS:
        do = "choose one of them"
        raise SettingsError(refusal(f"level of {name}", expected="1, 2, 3, 4 or 5", got=f"{level!r}", do=do))
    return row.values[int(level) - 1]
