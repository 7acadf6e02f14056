import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble.settings import AssembleSettings
from sphereorient.assemble.trellis import shortest_path, taken, visited_before
from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.search import Candidates

PAIRS_AT_ONCE = 1 << 16  # candidate pairs whose 3 x 3 products are held at once, 5 MB
DEVIATIONS_PER_MAD = 1.4826  # of a normal distribution
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
        return Track(
            R_lab_body=self.R_lab_body.index_copy(0, frames, other.R_lab_body),
            score=self.score.index_copy(0, frames, other.score),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Path(Track):
    """Chosen orientations of one camera in N frames; xi and spike of a link stand at the frame that it enters."""

    choice: Tensor  # (N,) int64, row within the frame's candidates; -1 without any
    xi: Tensor  # (N,), rad/s, angle over time of the link that enters the frame; NaN without a link
    spike: Tensor  # (N,) bool, that link is a spike
    segment: Tensor  # (N,) int64, -1 outside any


def assemble_paths(candidates: Mapping[str, Candidates], time_s: Tensor, settings: AssembleSettings) -> dict[str, Path]:
    """Choose one candidate of each frame for each camera, by the least cost over the whole movie; time_s (N,)
    increases.
    Frames without candidates of `quality_min` are skipped: the cost of the link over them is divided by its time.
    Source: the paper's assembly of III (directed graph between direct neighbours); docs/errata.md A6.

    Raises:
        ShapeError: a camera has another number of frames than there are times.
    """
    for name, each in candidates.items():
        if len(each) != len(time_s):
            do = "give every camera the experiment's frames"
            expected, got = f"{len(time_s)} frames", f"{len(each)}"
            raise ShapeError(refusal(f"candidates of {name!r}", expected=expected, got=got, do=do))
    return {name: _path(graph_of(each, settings.quality_min), time_s, settings) for name, each in candidates.items()}


def assemble_path(candidates: Candidates, time_s: Tensor, settings: AssembleSettings) -> Path:
    """Choose one candidate per frame for a single camera; as `assemble_paths`."""
    return assemble_paths({"": candidates}, time_s, settings)[""]


def graph_of(candidates: Candidates, quality_min: float) -> Graph:
    """Return the candidates of one camera that may be chosen: R (N, C, 3, 3), score (N, C) and mask (N, C)."""
    R, score, mask = candidates.padded()
    return R, score, mask & (score >= quality_min)


def _path(graph: Graph, time_s: Tensor, settings: AssembleSettings) -> Path:
    R_all, score_all, mask = graph
    choice = shortest_path(edge_costs(R_all, score_all, time_s, mask), mask).choice
    there = choice >= 0
    R = torch.full((len(choice), 3, 3), torch.nan).to(R_all)
    score = torch.full((len(choice),), torch.nan).to(score_all)
    R[there], score[there] = R_all[there, choice[there]], score_all[there, choice[there]]
    xi, turn = links(R, time_s)
    spike = find_spikes(xi, turn, settings)
    segment = number_segments(there, spike, settings.gap_frames_max)
    return Path(choice=choice, R_lab_body=R, score=score, xi=xi, spike=spike, segment=segment)


def links(R_lab_body: Tensor, time_s: Tensor) -> tuple[Tensor, Tensor]:
    """Return xi (rad/s), the angle over the time, and the angle (rad) of the link that enters each frame, (N,) each.
    R_lab_body (N, 3, 3) is NaN in frames that are skipped; xi and angle are NaN without a link. time_s (N,) increases.
    Source: the paper's assembly of III, direct neighbour distance.
    """
    frame = torch.nonzero(torch.isfinite(R_lab_body[:, 0, 0]))[:, 0]
    R, turn = R_lab_body[frame], torch.full_like(R_lab_body[:, 0, 0], torch.nan)
    xi = turn.clone()
    turn[frame[1:]] = so3.geodesic_distance(R[:-1], R[1:])
    # The times' difference in their own precision: single precision cannot separate late times.
    xi[frame[1:]] = turn[frame[1:]] / time_s[frame].diff().to(R)
    return xi, turn


def edge_costs(R_lab_body: Tensor, score: Tensor, time_s: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the paper's cost d(A, B) (2 - T_A - T_B) / dt, rad/s, from each candidate (row) to each of the next step.
    Shapes: R_lab_body (..., N, C, 3, 3), score T (..., N, C), increasing time_s (..., N), result (..., N - 1, C, C).
    With a mask (..., N, C), each edge comes from the last step before it with candidates.
    Source: the paper's assembly of III; a standstill costs nothing (docs/errata.md A6).

    Raises:
        ShapeError: the inputs differ in steps or candidates.
    """
    check_tail("R_lab_body", R_lab_body, 3, 3)
    check_tail("score", score, *R_lab_body.shape[-4:-2])
    check_tail("time_s", time_s, *score.shape[-2:-1])
    mask = torch.ones_like(score, dtype=torch.bool) if mask is None else mask
    last, time_s = visited_before(mask)[..., 1:], time_s.expand(score.shape[:-1])
    dt = time_s[..., 1:] - taken(time_s, last, 0)  # in this order: single precision cannot separate late times
    turn = turns_over_gaps(R_lab_body, mask)
    doubt = 2 - taken(score, last, 1)[..., :, None] - score[..., 1:, None, :]
    return turn * doubt / dt.to(turn)[..., None, None]


def turns_over_gaps(R_lab_body: Tensor, mask: Tensor) -> Tensor:
    """Return the angles (..., N - 1, C, C), rad, between candidates (..., N, C, 3, 3) and those of the next step.
    Each comes from the last step before it with candidates in the mask (..., N, C).
    """
    last, width = visited_before(mask)[..., 1:], mask.shape[-1]
    before, after = (R.flatten(0, -4) for R in (taken(R_lab_body, last, 3), R_lab_body[..., 1:, :, :, :]))
    chunk = max(1, PAIRS_AT_ONCE // max(width, 1) ** 2)
    parts = [
        so3.geodesic_distance(a[:, :, None], b[:, None])
        for a, b in zip(torch.split(before, chunk), torch.split(after, chunk), strict=True)
    ]
    return torch.cat(parts).reshape(*last.shape, width, width)


def moving(values: Tensor, window: int) -> Tensor:
    """Return windows centred on each of (N,) values, (N, window); NaN beyond the ends. Even windows grow by one."""
    half = window // 2
    if not len(values):
        return values.new_zeros(0, 2 * half + 1)
    padded = torch.nn.functional.pad(values, (half, half), value=torch.nan)
    return padded.unfold(0, 2 * half + 1, 1)


def find_spikes(xi: Tensor, turn: Tensor, settings: AssembleSettings) -> Tensor:
    """Return the links (N,) bool with xi many robust deviations (MAD) above the moving median, and a large angle.
    xi (N,), rad/s, and turn (N,), rad, belong to the link that enters each frame; xi is NaN without a link.
    Source: the paper's assembly of III (spikes of xi), which gives no numbers.
    """
    windows = moving(xi, settings.spike_window_frames)
    usual = windows.nanmedian(-1, keepdim=True).values
    deviation = DEVIATIONS_PER_MAD * (windows - usual).abs().nanmedian(-1).values
    outstanding = xi > usual[:, 0] + settings.spike_factor * deviation
    return outstanding & (turn > math.radians(settings.spike_min_deg))


def number_segments(present: Tensor, spike: Tensor, gap_frames_max: int) -> Tensor:
    """Number the segments of one motion, (N,) int64 from 0, -1 outside; gaps up to `gap_frames_max` belong to them.
    `present` (N,) marks frames with an orientation, `spike` (N,) frames that a spike enters.
    """
    frame = torch.nonzero(present)[:, 0]
    number = torch.full(present.shape, -1, dtype=torch.int64, device=present.device)
    if not len(frame):
        return number
    breaks = (frame.diff() > gap_frames_max + 1) | spike[frame[1:]]
    of_frame = torch.nn.functional.pad(breaks.cumsum(0), (1, 0))
    every = torch.arange(len(present), device=present.device)
    before = torch.searchsorted(frame, every, right=True) - 1
    after = torch.searchsorted(frame, every)
    inside = (before >= 0) & (after < len(frame))
    left, right = of_frame[before.clamp_min(0)], of_frame[after.clamp_max(len(frame) - 1)]
    return torch.where(inside & (left == right), left, number)
