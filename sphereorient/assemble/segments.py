"""Where a track cannot be trusted to be one motion: spikes of xi, and the segments between them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sphereorient.assemble.settings import AssembleSettings

DEVIATIONS_PER_MAD = 1.4826  # of a normal distribution


def moving(values: Tensor, window: int) -> Tensor:
    """Return windows centred on each of (N,) values, (N, window); NaN beyond the ends. Even windows grow by one."""
    half = window // 2
    if not len(values):
        return values.new_zeros(0, 2 * half + 1)
    padded = torch.nn.functional.pad(values, (half, half), value=torch.nan)
    return padded.unfold(0, 2 * half + 1, 1)


def find_spikes(xi: Tensor, turn: Tensor, settings: AssembleSettings) -> Tensor:
    """Find links that stand out: an orientation that cannot follow from the one before.

    A link is a spike where its xi is many robust deviations above the moving median of xi about it, and its turn
    larger than what the grid's steps can feign. Median and MAD, not mean and variance: spikes must not raise what they
    are measured against. The deviation and not a multiple of the median: a fast sphere has a large median, which a
    wrong orientation need not exceed many times.

    Args:
        xi: (N,), rad/s, cost of the link that enters each frame; NaN where none does.
        turn: (N,), rad, angle of that link.
        settings: window, factor, least turn.

    Returns:
        (N,) bool; False where no link enters.

    Source: the paper's assembly of III (spikes of xi); the numbers are ours, as it gives none.
    """
    windows = moving(xi, settings.spike_window_frames)
    usual = windows.nanmedian(-1, keepdim=True).values
    deviation = DEVIATIONS_PER_MAD * (windows - usual).abs().nanmedian(-1).values
    outstanding = xi > usual[:, 0] + settings.spike_factor * deviation
    return outstanding & (turn > math.radians(settings.spike_min_deg))


def number_segments(present: Tensor, spike: Tensor, gap_frames_max: int) -> Tensor:
    """Number the stretches of frames that are one motion.

    A wrong frame by itself has a spike into it and one out of it, and so is a segment of one frame.

    Args:
        present: (N,) bool, frames with an orientation.
        spike: (N,) bool, frames that a spike enters.
        gap_frames_max: longest hole inside a segment, frames.

    Returns:
        (N,) int64, from 0; -1 outside. Holes inside a segment belong to it.
    """
    frame = torch.nonzero(present)[:, 0]
    number = torch.full(present.shape, -1, dtype=torch.int64, device=present.device)
    if not len(frame):
        return number
    breaks = (frame.diff() > gap_frames_max + 1) | spike[frame[1:]]
    of_frame = torch.nn.functional.pad(breaks.cumsum(0), (1, 0))
    # A hole takes its segment's number where the same segment is on both sides.
    every = torch.arange(len(present), device=present.device)
    before = torch.searchsorted(frame, every, right=True) - 1
    after = torch.searchsorted(frame, every)
    inside = (before >= 0) & (after < len(frame))
    left, right = of_frame[before.clamp_min(0)], of_frame[after.clamp_max(len(frame) - 1)]
    return torch.where(inside & (left == right), left, number)
