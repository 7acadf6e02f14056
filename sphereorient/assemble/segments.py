"""xi, its spikes, and the segments between them."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble.settings import AssembleSettings
from sphereorient.errors import Flag


def links(R_lab_body: Tensor, time_s: Tensor) -> tuple[Tensor, Tensor]:
    """Return xi (rad/s), the angle over the time, and the angle (rad) of the link that enters each frame, (N,) each.
    R_lab_body (N, 3, 3) is NaN in skipped frames; xi and angle are NaN without a link. time_s (N,) increases.
    Source: the paper's assembly of III, direct neighbour distance.
    """
    frame = torch.nonzero(torch.isfinite(R_lab_body[:, 0, 0]))[:, 0]
    R, turn = R_lab_body[frame], torch.full_like(R_lab_body[:, 0, 0], torch.nan)
    xi = turn.clone()
    turn[frame[1:]] = so3.geodesic_distance(R[:-1], R[1:])
    # Difference in the times' own precision, as single precision cannot separate late times.
    xi[frame[1:]] = turn[frame[1:]] / time_s[frame].diff().to(R)
    return xi, turn


def moving(values: Tensor, window: int) -> Tensor:
    """Return windows centred on each of (N,) values, (N, window); NaN beyond the ends. Even windows grow by one."""
    half = window // 2  # padded by one more than needed, for N = 0
    padded = torch.nn.functional.pad(values, (half, half + 1), value=torch.nan)
    return padded.unfold(0, 2 * half + 1, 1)[: len(values)]


def find_spikes(xi: Tensor, turn: Tensor, settings: AssembleSettings) -> Tensor:
    """Return the links (N,) bool with xi many robust deviations (MAD) above the moving median, and a large angle.
    xi (N,), rad/s, and turn (N,), rad, are of the link that enters each frame; xi is NaN without a link.
    Source: the paper's assembly of III (spikes of xi), which gives no numbers.
    """
    windows = moving(xi, settings.spike_window_frames)
    usual = windows.nanmedian(-1, keepdim=True).values
    deviation = 1.4826 * (windows - usual).abs().nanmedian(-1).values  # of a normal distribution
    outstanding = xi > usual[:, 0] + settings.spike_factor * deviation
    return outstanding & (turn > math.radians(settings.spike_min_deg))


def flags_where(bits: Mapping[Flag, Tensor]) -> Tensor:
    """Return the flags (N,) int64 of frames, from a mask (N,) bool for each flag."""
    return torch.stack([int(flag) * where.long() for flag, where in bits.items()]).sum(0)


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
