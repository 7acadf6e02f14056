"""A ball whose paint is dots: from a table of where they are to a map, and how large they are in pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sphereorient.errors import PaintError, check_tail, refusal
from sphereorient.search.normalisation import Blur
from sphereorient.sphere import orthographic_view
from sphereorient.synth.textures import map_directions

HEIGHT = 256  # of maps: 0.7 degree
LENGTH_OFF = 0.05  # by which a direction of a table may miss length 1
LIMB = 0.6  # cosine between a dot and the line of sight below which its picture is too narrow to be measured
BIN_RAD = math.radians(1.0)  # of the profile
REACH = 3.0  # radii of the first guess to which the profile goes; the paint around begins at 2
EVEN = 0.6  # radii of the disk, standard deviation of the neighbourhood: light changes over it, dots are smaller
RADII_DEG = (0.5, 45.0)  # of dots that a map can hold


@dataclass(frozen=True, kw_only=True, eq=False)
class DotTable:
    """Where the dots of a ball are and how large; made by whoever printed the stencil.

    Raises:
        PaintError: no dots, lengths that are not 1 to 5 %, or radii that are none.
    """

    direction_body: Tensor  # (D, 3), middles of the dots
    radius_deg: float = 6.0  # angle at the ball's centre between a dot's middle and its border

    def __post_init__(self) -> None:
        """Refuse what is no table."""
        _checked(self.direction_body, self.radius_deg)

    def texture(self, height: int = HEIGHT) -> Tensor:
        """Return the map (height, 2 height); see `dots_texture`."""
        return dots_texture(self.direction_body, self.radius_deg, height)

    def mirrored(self) -> DotTable:
        """Return the table of the mirror image, body y reversed: no turn makes one of the other."""
        return replace(self, direction_body=self.direction_body * self.direction_body.new_tensor([1.0, -1.0, 1.0]))

    def measured(self, disks: Tensor, R_view_body: Tensor) -> DotTable:
        """Return the table with the radius that pictures show; see `measured_dot_radius_deg`."""
        radius = measured_dot_radius_deg(disks, R_view_body, self.direction_body, self.radius_deg)
        return replace(self, radius_deg=radius)


def dots_texture(direction_body: Tensor, radius_deg: float | Tensor, height: int = HEIGHT) -> Tensor:
    """Draw the map of a white ball with round black dots.

    Args:
        direction_body: (D, 3), middles of the dots, body frame, of length 1 to 5 %. A table in a left-handed frame
            gives the mirror image of the ball, and no attitude fits its pictures.
        radius_deg: of the dots, degrees on the sphere, one for all or (D,).
        height: of the map.

    Returns:
        (height, 2 height) float32, 0 black .. 1 white, borders one texel wide.

    Raises:
        PaintError: no dots, lengths that are not 1, or radii that are none.
        ShapeError: directions that do not end in 3.
    """
    direction, radius = _checked(direction_body, radius_deg)
    away = torch.acos((map_directions(height) @ direction.mT).clamp(-1, 1)) - radius
    return (0.5 + away.amin(-1) * height / math.pi).clamp(0, 1).float()


def measured_dot_radius_deg(
    disks: Tensor, R_view_body: Tensor, direction_body: Tensor, guess_deg: float = 6.0
) -> float:
    """Measure how large the dots are: the angle at which the mean dot is half as dark as in its middle.

    Args:
        disks: (F, S, S), grey levels, the outline touching the borders; far cameras.
        R_view_body: (F, 3, 3), attitudes, to half a dot.
        direction_body: (D, 3), middles of the dots.
        guess_deg: radius, degrees, to a factor of 2.

    Returns:
        The radius, degrees, that of the dot as blurred: motion during the exposure is in it.

    Raises:
        PaintError: no dot is darker in its middle than the paint around it.
    """
    direction, _ = _checked(direction_body, guess_deg)
    size = disks.shape[-1]
    view = orthographic_view(size, torch.float64)
    R = R_view_body.double()
    grey = disks.float()
    even = (grey / Blur(size, EVEN)(grey).clamp_min(1e-6))[:, view.inside].double()
    away, nearest = torch.acos(((view.normal_view @ R) @ direction.mT).clamp(-1, 1)).min(-1)  # (F, P)
    facing = -(R @ direction.mT)[:, 2]  # (F, D), cosine to the line of sight
    used = (facing.gather(1, nearest) > LIMB) & (away < math.radians(REACH * guess_deg))
    bins = (away[used] / BIN_RAD).long()
    return _half_width_deg(torch.bincount(bins, even[used]) / torch.bincount(bins).clamp_min(1), guess_deg)


def _half_width_deg(profile: Tensor, guess_deg: float) -> float:
    """Where a profile by angle, degrees, has climbed half of the way from its middle to the paint around."""
    outer = profile[round(2 * guess_deg) :]
    around = float(outer.median()) if len(outer) else math.nan
    middle = float(profile[0]) if len(profile) else math.nan
    half = 0.5 * (middle + around)
    above = torch.nonzero(profile > half)[:, 0]
    if not around > middle or not len(above) or int(above[0]) == 0:
        do = "check that the attitudes and the table belong to the pictures"
        raise PaintError(refusal("dots", expected="dark dots where the table has them", got="none", do=do))
    k = int(above[0])
    low, high = float(profile[k - 1]), float(profile[k])
    return math.degrees(BIN_RAD) * (k - 0.5 + (half - low) / (high - low))


def _checked(direction_body: Tensor, radius_deg: float | Tensor) -> tuple[Tensor, Tensor]:
    """Directions (D, 3) of length 1 and radii, rad, float64."""
    check_tail("direction_body", direction_body, 3)
    direction = direction_body.reshape(-1, 3).double()
    length = direction.norm(dim=-1)
    if not len(length) or not bool(((length - 1).abs() < LENGTH_OFF).all()):
        got = f"one of {float(length[(length - 1).abs().argmax()]):.3g}" if len(length) else "no rows"
        do = "divide each row by its length"
        raise PaintError(refusal("table of dots", expected="directions of length 1", got=got, do=do))
    radius = torch.as_tensor(radius_deg, dtype=torch.float64)
    low, high = RADII_DEG
    if not bool(((radius >= low) & (radius <= high)).all()):
        expected, got = f"{low:g} .. {high:g} degrees", f"{float(radius.flatten()[0]):.3g}"
        do = "give the angle at the ball's centre between a dot's middle and its border"
        raise PaintError(refusal("radius of dots", expected=expected, got=got, do=do))
    return direction / length[:, None], torch.deg2rad(radius)
