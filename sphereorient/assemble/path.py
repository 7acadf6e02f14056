"""The paper's path of one camera: `PathLayer` of first order chooses; xi, spikes and segments of what was chosen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.assemble.layer import PathLayer
from sphereorient.assemble.segments import find_spikes, links, number_segments
from sphereorient.assemble.settings import AssembleSettings
from sphereorient.errors import ShapeError, refusal
from sphereorient.search import Candidates

Graph = Sequence[Tensor]  # R (N, C, 3, 3), score (N, C), mask (N, C)


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """Orientations of one camera in N frames, NaN where it has none."""

    R_lab_body: Tensor  # (N, 3, 3)
    score: Tensor  # (N,)

    @property
    def present(self) -> Tensor:
        """Frames with an orientation, (N,) bool."""
        return torch.isfinite(self.score)

    def part(self, frames: Tensor) -> "Track":
        """Return some frames of the track."""
        return Track(R_lab_body=self.R_lab_body[frames], score=self.score[frames])

    def with_part(self, frames: Tensor, other: "Track") -> "Track":
        """Return the track with some frames from another one."""
        R = self.R_lab_body.index_copy(0, frames, other.R_lab_body)
        return Track(R_lab_body=R, score=self.score.index_copy(0, frames, other.score))


@dataclass(frozen=True, kw_only=True, eq=False)
class Path(Track):
    """Chosen orientations of one camera in N frames; xi and spike of a link stand at the frame that it enters."""

    choice: Tensor  # (N,) int64, row within the frame's candidates; -1 without any
    xi: Tensor  # (N,), rad/s, angle over time of the link that enters the frame; NaN without a link
    spike: Tensor  # (N,) bool, that link is a spike
    segment: Tensor  # (N,) int64, -1 outside any


def assemble_paths(candidates: Mapping[str, Candidates], time_s: Tensor, settings: AssembleSettings) -> dict[str, Path]:
    """Return the path of each camera, as `assemble_path`."""
    return {name: assemble_path(each, time_s, settings, name) for name, each in candidates.items()}


def assemble_path(candidates: Candidates, time_s: Tensor, settings: AssembleSettings, name: str = "") -> Path:
    """Choose one candidate of each frame of a camera, by the least cost over the whole movie; time_s (N,) increases.
    Frames without candidates of `quality_min` are skipped: the cost of the link over them is divided by its time.
    Raises ShapeError (another number of frames than there are times).
    Source: the paper's assembly of III (directed graph between direct neighbours); docs/errata.md A6.
    """
    if len(candidates) != len(time_s):
        expected, got, do = f"{len(time_s)} frames", f"{len(candidates)}", "give every camera the experiment's frames"
        raise ShapeError(refusal(f"candidates of {name!r}", expected=expected, got=got, do=do))
    R_all, score_all, mask = graph_of(candidates, settings.quality_min)
    choice = PathLayer(1, settings=settings)(R_all, score_all, time_s, mask=mask).choice
    there = choice >= 0
    R = torch.full((len(choice), 3, 3), torch.nan).to(R_all)
    score = torch.full((len(choice),), torch.nan).to(score_all)
    R[there], score[there] = R_all[there, choice[there]], score_all[there, choice[there]]
    xi, turn = links(R, time_s)
    spike = find_spikes(xi, turn, settings)
    segment = number_segments(there, spike, settings.gap_frames_max)
    return Path(choice=choice, R_lab_body=R, score=score, xi=xi, spike=spike, segment=segment)


def graph_of(candidates: Candidates, quality_min: float) -> Graph:
    """Return the candidates of one camera that may be chosen: R (N, C, 3, 3), score (N, C) and mask (N, C)."""
    R, score, mask = candidates.padded()
    return R, score, mask & (score >= quality_min)
