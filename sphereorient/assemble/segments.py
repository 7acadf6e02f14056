"""Where a track cannot be trusted to be one motion: spikes of xi, and the segments between them."""

from __future__ import annotations

import torch
from torch import Tensor

from sphereorient.assemble.settings import AssembleSettings


def moving(values: Tensor, window: int) -> Tensor:
    """Return windows centred on each of (N,) values, (N, window); NaN beyond the ends. Even windows grow by one."""
    half = window // 2
    padded = torch.nn.functional.pad(values, (half, half), value=torch.nan)
    return padded.unfold(0, 2 * half + 1, 1)


def find_spikes(xi: Tensor, turn: Tensor, settings: AssembleSettings) -> Tensor:
    """Find links that stand out: an orientation that cannot follow from the one before.

    A link is a spike where its xi is many times the moving median of xi about it, and its turn larger than what the
    grid's steps can feign. The median, not the mean: spikes must not raise what they are measured against.

    Args:
        xi: (N,), rad/s, cost of the link that enters each frame; NaN where none does.
        turn: (N,), rad, angle of that link.
        settings: window, factor, least turn.

    Returns:
        (N,) bool.

    Source: paper section III D (spikes of xi); the numbers are ours, as it gives none.
    """
    usual = moving(xi, settings.spike_window_frames).nanmedian(-1).values
    large = turn > torch.deg2rad(torch.tensor(settings.spike_min_deg, dtype=turn.dtype))
    return (xi > settings.spike_factor * usual) & large


def number_segments(present: Tensor, spike: Tensor, gap_frames_max: int) -> Tensor:
    """Number the stretches of frames that are one motion.

    Args:
        present: (N,) bool, frames with an orientation.
        spike: (N,) bool, frames that a spike enters.
        gap_frames_max: longest hole inside a segment, frames.

    Returns:
        (N,) int64, from 0; -1 outside. Holes inside a segment belong to it.
    """
    frame = torch.nonzero(present)[:, 0]
    number = torch.full(present.shape, -1, dtype=torch.int64)
    if not len(frame):
        return number
    breaks = (frame.diff() > gap_frames_max + 1) | spike[frame[1:]]
    of_frame = torch.nn.functional.pad(breaks.cumsum(0), (1, 0))
    number[frame] = of_frame
    # A hole takes its segment's number where the same segment is on both sides.
    before = torch.searchsorted(frame, torch.arange(len(present)), right=True) - 1
    after = torch.searchsorted(frame, torch.arange(len(present)))
    inside = (before >= 0) & (after < len(frame))
    left, right = of_frame[before.clamp_min(0)], of_frame[after.clamp_max(len(frame) - 1)]
    return torch.where(inside & (left == right), left, number)
