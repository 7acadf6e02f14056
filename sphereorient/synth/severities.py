"""Degradations of pictures and reported inputs: names, units, five severities."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

from sphereorient.errors import SettingsError, refusal
from sphereorient.files.yaml_file import refuse_unknown

LEVELS = (1, 2, 3, 4, 5)
_Values = tuple[float, float, float, float, float]
# scene, map: before filming; picture: constant over the movie, also in the background; frame: drawn per frame;
# reported: only in the inputs of the method.
Place = Literal["scene", "map", "picture", "frame", "movie", "reported"]
SHARE = "share of "  # prefix of units with values in 0 .. 1


@dataclass(frozen=True, kw_only=True)
class Degradation:
    """A degradation with five severities; a row of `DEGRADATIONS`."""

    name: str
    unit: str
    does: str
    values: _Values  # level 1 (mild) .. level 5 (hard)
    reason: str
    nothing: float | None  # value without effect; None: the base scene's value
    where: Place

    def check(self, value: float) -> None:
        """Raise SettingsError unless the value is finite, at least `nothing`, and below 1 for a share."""
        least = 0.0 if self.nothing is None else self.nothing
        most = 1.0 if self.unit.startswith(SHARE) else math.inf
        if not (math.isfinite(value) and least <= value < most):
            expected = f"{least:g} or more" + (f", and below {most:g}" if most < math.inf else "")
            do = f"write the {self.unit}"
            raise SettingsError(refusal(f"degradation {self.name}", expected=expected, got=f"{value:g}", do=do))


# Name, place, value without effect, unit, values; effect; reason. In the order of the light path, inputs last.
_ROWS = """
ball_size; scene; ; px of diameter; 160 80 50 32 20
  The same scene filmed with coarser or finer pixels.
  the default ball has 78 px; at 20 px a patch of its paint is 4 px wide
spin; scene; ; degrees per frame, rms; 5 10 20 40 60
  The ball rotates faster; a shorter exposure keeps the motion blur.
  the default ball rotates by 1.3; at 60 a third of the visible paint is new in the next frame
motion_blur; scene; ; degrees per exposure, rms; 1 3 8 16 32
  The exposure is longer; if the whole frame is not long enough, the ball also rotates faster.
  1.3 is the whole frame for the default ball; 32 is wider than its patches of paint, 24
paint_wear; map; 0; share of the ball's area; 0.02 0.05 0.12 0.25 0.45
  Paint has come off the filmed ball in patches that show bare grey; the map does not show this.
  a scratch after a day of mixing; at 0.45 hardly more than half of the paint is left
uneven_light; picture; 1; ratio of bright to dark limb; 1.5 2.5 4 8 16
  One side of the ball gets less light, falling off exponentially across the disk.
  one lamp of two is dim; from 8 on white paint in the dark is as dim as black paint in the light
highlights; picture; 0; grey levels of the peak; 40 80 120 180 255
  Two lamps are mirrored in glossy paint: Gaussian spots, sigma 0.12 radii, that do not rotate with it.
  varnish instead of matt paint; from 150 on black paint under a spot is as bright as white paint
background_clutter; picture; 0; grey levels, rms; 4 8 16 28 45
  Unmoving bright structure behind the ball; the picture without the ball shows it too.
  a wall with stains; at 45 the structure is as bright as white paint and hides the outline
occlusion; frame; 0; share of the disk hidden; 0.05 0.12 0.25 0.4 0.6
  A dark disk as large as the ball hides part of it, on another side in every frame.
  the edge of another particle; above one half the centre itself is hidden
bubbles; frame; 0; bubbles before the disk; 2 5 10 18 30
  Bubbles of 0.12 ball radii in front of the ball, with dark rims and glints, elsewhere in every frame.
  a leaking seal; 30 cover a third of the disk
dirt; picture; 0; px of the specks' radius; 1 2 4 7 12
  Dark specks on the window, 6 in 100 x 100 px, at rest; the picture without the ball shows them too.
  dust on the glass; at 12 px a quarter of the picture is covered
contrast_loss; picture; 0; share of the contrast lost; 0.2 0.4 0.6 0.8 0.9
  Turbid liquid: all grey levels move towards a veil of 95.
  tracer dust in the tank; at 0.9 white and black paint are 15 levels apart, with noise of 3
defocus; picture; 0; px of sigma; 0.7 1.5 3 6 10
  The lens is out of focus: a Gaussian on top of the optics' own.
  focus set by eye; at 10 patches of 16 px, the default ball's, keep a sixth of their contrast
saturation; picture; 0; share of white paint clipped; 0.05 0.2 0.5 0.8 0.98
  Too much light: this share of the visible white paint exceeds 255.
  the lit side clips first; at 0.98 white is flat, and its blurred borders have moved into the black
shot_noise; frame; 0; grey levels per root of grey level; 0.5 0.8 1.2 2 3.5
  Too few photons: noise that grows with the root of the light, on top of the camera's own.
  high gain; at 3.5 the noise of white paint is a third of the step from black to white
read_noise; frame; 0; grey levels; 3 6 12 20 35
  A noisy sensor: white noise of this standard deviation, on top of the camera's own.
  a warm sensor; at 35 the noise is a quarter of the step from black to white
dropped_frames; movie; 0; share of the frames; 0.02 0.05 0.15 0.3 0.5
  Frames of each camera are black, drawn independently for each camera.
  a slow disk; at 0.5 a quarter of the instants have no picture
centre_error; reported; 0; px; 0.25 0.5 1 2 4
  The cameras' principal points are reported wrong, in alternating directions.
  a quarter is a poor calibration; lines of sight miss each other by 1.4 times as much
radius_error; reported; 0; px; 0.25 0.5 1 2 4
  The sphere's diameter is reported too large: by this much at the rim of the picture.
  0.25 is 0.1 mm of 18, a coat of varnish; 4 is a tenth of the default ball's
camera_rotation; reported; 0; degrees; 0.05 0.15 0.5 1.5 5
  One camera (even seeds: the second) is reported rotated about the lab's origin by equal pan, tilt and roll.
  0.05 is a fair calibration; at 5 the cameras disagree by more than the paper's grid step of 3
camera_shift; reported; 0; mm; 0.05 0.1 0.3 1 3
  One camera (even seeds: the second) is reported shifted along its own x, which is visible to the others.
  someone touched the tripod; at 3 lines of sight pass each other by a third of a radius
texture_error; reported; 0; share of the map's area; 0.01 0.03 0.08 0.18 0.35
  The map given to the method has black and white exchanged in patches.
  a map drawn by hand; at 0.5 it would have no information
"""


def _row(head: str, does: str, reason: str) -> Degradation:
    name, where, nothing, unit, values = head.split("; ")
    found: Any = {"where": where, "values": tuple(map(float, values.split()))}
    least = float(nothing) if nothing else None
    return Degradation(name=name, unit=unit, does=does.strip(), reason=reason.strip(), nothing=least, **found)


_LINES = _ROWS.strip().splitlines()
_EVERY = [_row(*three) for three in zip(_LINES[::3], _LINES[1::3], _LINES[2::3], strict=True)]
DEGRADATIONS: Mapping[str, Degradation] = MappingProxyType({row.name: row for row in _EVERY})


def degradation(name: str) -> Degradation:
    """Return a row of `DEGRADATIONS`; raise SettingsError for an unknown name."""
    if name not in DEGRADATIONS:
        raise SettingsError(refuse_unknown(name, DEGRADATIONS, "degradation"))
    return DEGRADATIONS[name]


def check_values(values: Mapping[str, float], known: Iterable[str], do: str) -> None:
    """Raise SettingsError for an unknown name, a name not among `known`, with remedy `do`, or a wrong value."""
    for name, value in values.items():
        row = degradation(name)
        if name not in known:
            raise SettingsError(refusal("degradation", expected=f"one of {', '.join(known)}", got=name, do=do))
        row.check(value)


def severity(name: str, level: int) -> float:
    """Return the physical value of a level, 1 (mild) to 5 (hard); raise SettingsError for an unknown name or level."""
    row = degradation(name)
    if isinstance(level, bool) or level not in LEVELS:
        do = "choose one of them"
        raise SettingsError(refusal(f"level of {name}", expected="1, 2, 3, 4 or 5", got=f"{level!r}", do=do))
    return row.values[int(level) - 1]
