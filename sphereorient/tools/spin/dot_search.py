"""Attitudes of a ball with dots, from one disk: the search on grey values proposes, the dots decide.

A dot of the table that is not there speaks against an attitude; dark that the table does not have, a maker's name or
dirt, hardly does.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from sphereorient.search import GreySearch, GreySearchSettings
from sphereorient.search.normalisation import Blur, rim_share
from sphereorient.search.proposer import Proposals
from sphereorient.sphere import orthographic_view
from sphereorient.tools.spin.dots import DotTable

EVEN = 0.6  # radii, standard deviation of the neighbourhood that light is taken off by
DARKEST = 0.97  # share of a disk's pixels that are brighter than a dot's middle
CORE, SOFT = 0.8, 0.2  # of a dot's measured radius: where darkness is expected, and how soft this border is
UNKNOWN = 0.25  # weight of dark that the table does not have over that of a dot that is not there
DOT_SEARCH = GreySearchSettings(score_min=0.05, peaks=24, finalists=16)


class DotSearch:
    """Searches all of SO(3) for the views of a table of dots.

    Args:
        table: of the dots.
        settings: of the search that proposes; many finalists, as its own order is not kept.
    """

    def __init__(self, table: DotTable, settings: GreySearchSettings = DOT_SEARCH) -> None:
        self._search = GreySearch(table.texture(), settings)
        size = settings.size_px
        view = orthographic_view(size, torch.float64)
        self._inside, self._normal = view.inside, view.normal_view
        self._even = Blur(size, EVEN)
        self._weight = view.normal_view[:, 2].square() * rim_share(size)[view.inside]
        self._direction = torch.nn.functional.normalize(table.direction_body.double(), dim=-1)
        self._radius = math.radians(table.radius_deg) * CORE

    @property
    def size_px(self) -> int:
        """Side of the disks, px."""
        return self._search.size_px

    def propose(self, disks: Tensor) -> Proposals:
        """Propose attitudes; see `GreySearch.propose`.

        Returns:
            Proposals, best first; the score is 1 where all dark is dots and all dots are there, 1/2 where a ball
            without dots would explain as much.
        """
        found = self._search.propose(disks)
        parts = [Proposals.none(())]
        for f, disk in enumerate(disks):
            rows = slice(int(found.offset[f]), int(found.offset[f + 1]))
            score = self._scores(self._darkness(disk), found.R_view_body[rows])
            order = score.argsort(descending=True, stable=True)
            parts.append(
                replace(
                    found,
                    offset=torch.tensor([0, len(order)]),
                    R_view_body=found.R_view_body[rows][order],
                    score=score[order],
                    reason=(found.reason[f],),
                )
            )
        return Proposals.joined(parts)

    def _darkness(self, disk: Tensor) -> Tensor:
        """How dark each pixel inside is, (P,): 0 the paint around, 1 the middle of a dot."""
        even = (disk / self._even(disk[None].float())[0].clamp_min(1e-6))[self._inside].double()
        return ((1 - even) / (1 - even).quantile(DARKEST).clamp_min(1e-6)).clamp(0, 1)

    def _scores(self, dark: Tensor, R_view_body: Tensor) -> Tensor:
        """Scores (Q,) of attitudes (Q, 3, 3)."""
        away = torch.acos(((self._normal @ R_view_body) @ self._direction.mT).clamp(-1, 1)).amin(-1)
        expected = torch.sigmoid((self._radius - away) / (SOFT * self._radius))
        cost = self._weight * torch.where(expected > dark, 1.0, UNKNOWN) * (expected - dark).square()
        blank = (self._weight * UNKNOWN * dark.square()).sum().clamp_min(1e-12)
        return blank / (blank + cost.sum(-1))
