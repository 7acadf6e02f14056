"""A ball with dots: table of directions, map, size in pictures, and search for orientations."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sphereorient.errors import PaintError, check_tail, refusal
from sphereorient.search import GreySearch, GreySearchSettings
from sphereorient.search.candidates import Candidates, Proposer
from sphereorient.search.normalisation import Blur, rim_share
from sphereorient.sphere import orthographic_view
from sphereorient.sphere.texture import map_directions

HEIGHT = 256  # of maps: 0.7 degree
LENGTH_TOLERANCE = 0.05  # of the directions of a table
LIMB = 0.6  # least cosine between a measured dot and the line of sight
BIN_RAD = math.radians(1.0)  # of the profile
REACH = 3.0  # length of the profile in radii of the first guess; white begins at 2
EVEN = 0.6  # radii of the disk, standard deviation of the neighbourhood that removes the light; dots are smaller
RADII_DEG = (0.5, 45.0)  # of dots
DARKEST = 0.97  # share of a disk's pixels brighter than a dot's centre
CORE, SOFT = 0.8, 0.2  # of a dot's measured radius: extent of expected darkness, and width of its border
UNKNOWN = 0.25  # weight of unexpected dark over that of a missing dot
DOT_SEARCH = GreySearchSettings(score_min=0.05, peaks=24, finalists=16)


@dataclass(frozen=True, kw_only=True, eq=False)
class DotTable:
    """Directions of a ball's dots, right-handed, and their radius; a left-handed table fits no picture.
    Raise PaintError for no dots, lengths over 5 % from 1, or a radius out of range; ShapeError if not (D, 3).
    """

    direction_body: Tensor  # (D, 3), centres of the dots
    radius_deg: float = 6.0  # angle at the ball's centre between a dot's centre and border

    def __post_init__(self) -> None:
        check_tail("direction_body", self.direction_body, 3)
        length = self.direction_body.reshape(-1, 3).double().norm(dim=-1)
        if not len(length) or not bool(((length - 1).abs() < LENGTH_TOLERANCE).all()):
            got = f"one of {float(length[(length - 1).abs().argmax()]):.3g}" if len(length) else "no rows"
            do = "divide each row by its length"
            raise PaintError(refusal("table of dots", expected="directions of length 1", got=got, do=do))
        low, high = RADII_DEG
        if not low <= self.radius_deg <= high:
            expected, got = f"{low:g} .. {high:g} degrees", f"{self.radius_deg:.3g}"
            do = "give the angle at the ball's centre between a dot's centre and border"
            raise PaintError(refusal("radius of dots", expected=expected, got=got, do=do))

    def unit(self) -> Tensor:
        """Return the directions (D, 3) float64 with length 1."""
        return torch.nn.functional.normalize(self.direction_body.reshape(-1, 3).double(), dim=-1)

    def texture(self, height: int = HEIGHT) -> Tensor:
        """Return the map (height, 2 height) float32: black dots on white, borders one texel wide."""
        away = torch.acos((map_directions(height) @ self.unit().mT).clamp(-1, 1)).amin(-1)
        return (0.5 + (away - math.radians(self.radius_deg)) * height / math.pi).clamp(0, 1).float()

    def mirrored(self) -> "DotTable":
        """Return the table of the mirror image, body y reversed."""
        return replace(self, direction_body=self.direction_body * self.direction_body.new_tensor([1.0, -1.0, 1.0]))

    def measured(self, disks: Tensor, R_view_body: Tensor) -> "DotTable":
        """Return the table with the radius measured in disks (F, S, S) at R_view_body (F, 3, 3), blur included.
        R_view_body must be right to half a dot, the present radius to a factor of 2. Raise PaintError if no dot is
        darker than the white around it.
        """
        direction, guess_deg = self.unit(), self.radius_deg
        view = orthographic_view(disks.shape[-1], torch.float64)
        R, grey = R_view_body.double(), disks.float()
        even = (grey / Blur(disks.shape[-1], EVEN)(grey).clamp_min(1e-6))[:, view.inside].double()
        away, nearest = torch.acos(((view.normal_view @ R) @ direction.mT).clamp(-1, 1)).min(-1)  # (F, P)
        facing = -(R @ direction.mT)[:, 2]  # (F, D), cosine to the line of sight
        used = (facing.gather(1, nearest) > LIMB) & (away < math.radians(REACH * guess_deg))
        bins = (away[used] / BIN_RAD).long()
        profile = torch.bincount(bins, even[used]) / torch.bincount(bins).clamp_min(1)
        outer = profile[round(2 * guess_deg) :]
        half = 0.5 * float(profile[0] + outer.median()) if len(outer) else -math.inf
        k = int((profile > half).long().argmax()) if len(profile) else 0  # the first brighter one
        if k == 0:
            do = "check that orientations and table belong to the pictures"
            raise PaintError(refusal("dots", expected="dark dots at the table's directions", got="none", do=do))
        low, high = float(profile[k - 1]), float(profile[k])
        return replace(self, radius_deg=math.degrees(BIN_RAD) * (k - 0.5 + (half - low) / (high - low)))


class DotSearch(Proposer):
    """Search of all SO(3) for a table of dots, among candidates of the grey search; other dark has little weight."""

    def __init__(self, table: DotTable, settings: GreySearchSettings = DOT_SEARCH) -> None:
        super().__init__()
        self.size_px = size = settings.size_px
        self._search, self._even, self._direction = (
            GreySearch(table.texture(), settings),
            Blur(size, EVEN),
            table.unit(),
        )
        view = orthographic_view(size, torch.float64)
        self._inside, self._normal = view.inside, view.normal_view
        self._weight = view.normal_view[:, 2].square() * rim_share(size)[view.inside]
        self._radius = math.radians(table.radius_deg) * CORE

    def propose(self, disks: Tensor, least: float | None = None) -> Candidates:
        """Propose orientations; see `GreySearch.propose`.

        Returns:
            Candidates, best first; the score is 1 where all dark is dots and all dots are visible, 1/2 where a ball
            without dots would explain as much.
        """
        found = self._search.propose(disks, least)
        score, order = torch.zeros_like(found.score), torch.arange(len(found.score))
        for f, disk in enumerate(disks):
            rows = slice(int(found.offset[f]), int(found.offset[f + 1]))
            score[rows] = self._scores(disk, found.R_view_body[rows])
            order[rows] = order[rows][score[rows].argsort(descending=True, stable=True)]
        return replace(found, R_view_body=found.R_view_body[order], score=score[order])

    def _scores(self, disk: Tensor, R_view_body: Tensor) -> Tensor:
        even = (disk / self._even(disk[None].float())[0].clamp_min(1e-6))[self._inside].double()
        dark = ((1 - even) / (1 - even).quantile(DARKEST).clamp_min(1e-6)).clamp(0, 1)
        away = torch.acos(((self._normal @ R_view_body) @ self._direction.mT).clamp(-1, 1)).amin(-1)
        expected = torch.sigmoid((self._radius - away) / (SOFT * self._radius))
        cost = self._weight * torch.where(expected > dark, 1.0, UNKNOWN) * (expected - dark).square()
        blank = (self._weight * UNKNOWN * dark.square()).sum().clamp_min(1e-12)
        return blank / (blank + cost.sum(-1))
