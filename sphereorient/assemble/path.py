"""From candidates to one orientation a frame: the cheapest path of each camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from sphereorient import so3
from sphereorient.assemble.segments import find_spikes, number_segments
from sphereorient.assemble.settings import AssembleSettings
from sphereorient.assemble.trellis import edge_costs, shortest_path
from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.search import Candidates


@dataclass(frozen=True, kw_only=True, eq=False)
class Path:
    """One camera's chosen orientations in N frames; made by assemble, read by the fusion and the pipeline.

    xi belongs to a link between two frames; it stands at the frame that the link enters, and so does its spike.
    """

    choice: Tensor  # (N,) int64, row within the frame's candidates; -1 where there is none
    R_lab_body: Tensor  # (N, 3, 3), NaN where there is none
    score: Tensor  # (N,), T of the choice, NaN where there is none
    xi: Tensor  # (N,), rad/s, cost of the link that enters the frame; NaN where none does
    spike: Tensor  # (N,) bool, that link is a spike
    segment: Tensor  # (N,) int64, -1 outside any

    def __post_init__(self) -> None:
        """Compare the lengths of the parts."""
        for entry in fields(self):
            tail = (3, 3) if entry.name == "R_lab_body" else ()
            check_tail(f"Path.{entry.name}", getattr(self, entry.name), len(self.choice), *tail)

    @property
    def present(self) -> Tensor:
        """Frames with an orientation, (N,) bool."""
        return self.choice >= 0


Graph = Sequence[Tensor]  # R (N, C, 3, 3), score (N, C), mask (N, C)


def assemble_paths(candidates: Mapping[str, Candidates], time_s: Tensor, settings: AssembleSettings) -> dict[str, Path]:
    """Choose one candidate a frame for each camera so that the whole movie's cost is least; all cameras in one batch.

    Args:
        candidates: of each camera, N frames; those below `quality_min` do not take part.
        time_s: (N,), increasing.
        settings: of the room.

    Returns:
        Name -> path. Frames without candidates are skipped: the link over them is divided by the time it takes.

    Raises:
        ShapeError: a camera has another number of frames than there are times.

    Source: the paper's assembly of III (directed graph between direct neighbours); ERRATA A6 for its hole.
    """
    for name, each in candidates.items():
        if len(each) != len(time_s):
            do = "give every camera the experiment's frames"
            expected, got = f"{len(time_s)} frames", f"{len(each)}"
            raise ShapeError(refusal(f"candidates of {name!r}", expected=expected, got=got, do=do))
    graphs = {name: graph_of(each, settings.quality_min) for name, each in candidates.items()}
    best = _cheapest(graphs, time_s)
    return {
        name: _path(graph, choice, time_s, settings) for (name, graph), choice in zip(graphs.items(), best, strict=True)
    }


def assemble_path(candidates: Candidates, time_s: Tensor, settings: AssembleSettings) -> Path:
    """Choose one candidate a frame for a single camera; as `assemble_paths`."""
    return assemble_paths({"": candidates}, time_s, settings)[""]


def graph_of(candidates: Candidates, quality_min: float) -> Graph:
    """Return the candidates of one camera that may be chosen: R (N, C, 3, 3), score (N, C) and mask (N, C)."""
    R, score, mask = candidates.padded()
    return R, score, mask & (score >= quality_min)


def _cheapest(graphs: Mapping[str, Graph], time_s: Tensor) -> list[Tensor]:
    """Choices of each camera in the frames that it visits; its empty frames are left out and the rest is padded."""
    visited = [torch.nonzero(mask.any(1))[:, 0] for _, _, mask in graphs.values()]
    steps = max(map(len, visited), default=0)
    if steps == 0:
        return visited
    width = max(mask.shape[1] for _, _, mask in graphs.values())
    R, score, mask = (
        pad_sequence(
            [_widen(graph[part], width)[frames] for graph, frames in zip(graphs.values(), visited, strict=True)],
            batch_first=True,
        )
        for part in range(3)
    )
    time = pad_sequence([time_s[frames] for frames in visited], batch_first=True)
    # Behind a movie's end stand zeros, times too: the mask keeps these edges out, whatever their costs.
    choice = shortest_path(edge_costs(R, score, time), mask).choice
    return [row[: len(frames)] for row, frames in zip(choice, visited, strict=True)]


def _widen(part: Tensor, width: int) -> Tensor:
    """Add empty places to the candidates' axis, (N, C, ...) to (N, width, ...)."""
    missing = part.new_zeros(len(part), width - part.shape[1], *part.shape[2:])
    return torch.cat([part, missing], dim=1)


def _path(graph: Graph, choice: Tensor, time_s: Tensor, settings: AssembleSettings) -> Path:
    """Read the chosen orientations, their links, spikes and segments."""
    R_all, score_all, mask = graph
    frames = torch.nonzero(mask.any(1))[:, 0]
    R = torch.full_like(R_all[:, 0], torch.nan)
    score = torch.full_like(score_all[:, 0], torch.nan)
    chosen = torch.full_like(score, -1, dtype=torch.int64)
    chosen[frames] = choice
    R[frames], score[frames] = R_all[frames, choice], score_all[frames, choice]
    xi, turn = links(R, score, time_s)
    spike = find_spikes(xi, turn, settings)
    segment = number_segments(chosen >= 0, spike, settings.gap_frames_max)
    return Path(choice=chosen, R_lab_body=R, score=score, xi=xi, spike=spike, segment=segment)


def links(R_lab_body: Tensor, score: Tensor, time_s: Tensor) -> tuple[Tensor, Tensor]:
    """Return cost xi (rad/s) and angle (rad) of the link that enters each frame, (N,) each; NaN where none does.

    Args:
        R_lab_body: (N, 3, 3), NaN in frames that are skipped.
        score: (N,), T, NaN in the same frames.
        time_s: (N,).
    """
    frame = torch.nonzero(torch.isfinite(score))[:, 0]
    xi = torch.full_like(score, torch.nan)
    turn = torch.full_like(score, torch.nan)
    R, T = R_lab_body[frame], score[frame]
    dt = time_s[frame].diff().to(score)  # in this order: single precision does not tell apart late times
    turn[frame[1:]] = so3.geodesic_distance(R[:-1], R[1:])
    xi[frame[1:]] = turn[frame[1:]] * (2 - T[:-1] - T[1:]) / dt
    return xi, turn
