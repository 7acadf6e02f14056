"""From candidates to one orientation a frame: the cheapest path of each camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from sphereorient import so3
from sphereorient.assemble.segments import find_spikes, number_segments
from sphereorient.assemble.settings import AssembleSettings
from sphereorient.assemble.trellis import edge_costs, shortest_path
from sphereorient.orient import Candidates


@dataclass(frozen=True, kw_only=True, eq=False)
class Path:
    """One camera's chosen orientations in N frames; made by assemble, read by the fusion and the pipeline."""

    choice: Tensor  # (N,) int64, row within the frame's candidates; -1 where there is none
    R_lab_body: Tensor  # (N, 3, 3), NaN where there is none
    score: Tensor  # (N,), T of the choice, NaN where there is none
    xi: Tensor  # (N,), rad/s, cost of the link that enters the frame; NaN where none does
    spike: Tensor  # (N,) bool, that link is a spike
    segment: Tensor  # (N,) int64, -1 outside any

    @property
    def present(self) -> Tensor:
        """Frames with an orientation, (N,) bool."""
        return self.choice >= 0


def assemble_paths(candidates: Mapping[str, Candidates], time_s: Tensor, settings: AssembleSettings) -> dict[str, Path]:
    """Choose one candidate a frame for each camera so that the whole movie's cost is least; all cameras in one batch.

    Args:
        candidates: of each camera, N frames; those below `quality_min` do not take part.
        time_s: (N,), increasing.
        settings: of the room.

    Returns:
        Name -> path. Frames without candidates are skipped: the link over them is divided by the time it takes.

    Source: paper section III D (directed graph between direct neighbours).
    """
    padded = {name: _graph(each, settings.quality_min) for name, each in candidates.items()}
    visited = {name: torch.nonzero(mask.any(1))[:, 0] for name, (_, _, mask) in padded.items()}
    width = max((mask.shape[1] for _, _, mask in padded.values()), default=1)
    R, score, mask = (
        pad_sequence([_widen(padded[name][part], width)[visited[name]] for name in padded], batch_first=True)
        for part in range(3)
    )
    time = pad_sequence([time_s[visited[name]] for name in padded], batch_first=True)
    # Padding repeats no instant: a step of one second keeps the division finite, and the mask keeps it out.
    real = torch.arange(time.shape[1]) < torch.tensor([len(rows) for rows in visited.values()])[:, None]
    time = torch.where(real, time, time_s[-1] + torch.arange(1, time.shape[1] + 1, dtype=time.dtype))
    if time.shape[1] == 0:
        return {name: _path(candidates[name], padded[name], visited[name][:0], time_s, settings) for name in padded}
    best = shortest_path(edge_costs(R, score, time), mask).choice
    return {
        name: _path(candidates[name], padded[name], best[row, : len(visited[name])], time_s, settings)
        for row, name in enumerate(padded)
    }


def assemble_path(candidates: Candidates, time_s: Tensor, settings: AssembleSettings) -> Path:
    """Choose one candidate a frame for a single camera; as `assemble_paths`."""
    return assemble_paths({"": candidates}, time_s, settings)[""]


Graph = Sequence[Tensor]  # R (N, C, 3, 3), score (N, C), mask (N, C)


def _graph(candidates: Candidates, quality_min: float) -> Graph:
    R, score, mask = candidates.padded()
    return R, score, mask & (score >= quality_min)


def _widen(part: Tensor, width: int) -> Tensor:
    """Add empty places to the candidates' axis, (N, C, ...) to (N, width, ...)."""
    missing = part.new_zeros(len(part), width - part.shape[1], *part.shape[2:])
    return torch.cat([part, missing], dim=1)


def _path(candidates: Candidates, graph: Graph, choice: Tensor, time_s: Tensor, settings: AssembleSettings) -> Path:
    """Read the chosen orientations, their links, spikes and segments."""
    R_all, score_all, mask = graph
    frames = torch.nonzero(mask.any(1))[:, 0]
    count = len(candidates)
    R = torch.full((count, 3, 3), torch.nan, dtype=R_all.dtype)
    score = torch.full((count,), torch.nan, dtype=R_all.dtype)
    chosen = torch.full((count,), -1, dtype=torch.int64)
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
        score: (N,), T.
        time_s: (N,).
    """
    frame = torch.nonzero(torch.isfinite(score))[:, 0]
    xi = torch.full_like(score, torch.nan)
    turn = torch.full_like(score, torch.nan)
    R, T, time = R_lab_body[frame], score[frame], time_s[frame]
    turn[frame[1:]] = so3.geodesic_distance(R[:-1], R[1:])
    xi[frame[1:]] = turn[frame[1:]] * (2 - T[:-1] - T[1:]) / time.diff()
    return xi, turn
