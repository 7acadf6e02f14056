"""Are the movies in step: the gap of the lines of sight against the number of frames that one movie is late."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.cameras import Camera
from sphereorient.preflight.finding import Finding, Severity
from sphereorient.preflight.gap import GOOD_PX, gaps_between
from sphereorient.preflight.look import Look, pair_starts

REACH = 8  # frames by which a movie may be late
STRETCH = 20  # consecutive frames in one stretch
STRETCHES = 2
MOVES_PX = 0.3  # a ball that moves less across the lines of sight in a frame does not tell
MEET = 0.3  # lines of sight meet where they miss each other by less than this share of the motion in a frame
CLEARLY = 2.0  # a shift is told where it makes the gap so many times smaller
IN_STEP = 0.25  # frames; a part of a frame beyond it is worth a word
FEW = 8  # frames with a ball in both cameras


@dataclass(frozen=True, kw_only=True, eq=False)
class Steps:
    """The gap against the shift between two movies; made by `gap_by_offset`, drawn by the figure."""

    offset: Tensor  # (2 REACH + 1,), frames that the second movie is late
    gap_px: Tensor  # of each offset: root mean square of the gap, px; NaN where none is known
    varying_px: Tensor  # of each offset: the same without what is constant in the gap, which is the cameras' own
    moved_px: float  # typical motion across the lines of sight in one frame, px
    best: float  # the offset of the least gap, between whole frames by a parabola; NaN where it cannot be told
    names: tuple[str, str]

    @property
    def shift(self) -> int:
        """By how many whole frames the second movie is late; 0 where that cannot be told."""
        return 0 if math.isnan(self.best) else round(self.best)

    @property
    def in_step_px(self) -> float:
        """Typical gap once that is mended, px."""
        return float(self.gap_px[REACH + self.shift])


def liveliest_stretches(looks: Sequence[Look], count: int) -> list[range]:
    """Choose stretches of consecutive frames in which the ball moves most across the lines of sight.

    The second moves as differently from the first as can be: a camera that is turned shifts the gap alike in both, a
    movie that is late does not.

    Args:
        looks: of two cameras at `sample_frames(count)`.
        count: frames of the experiment.
    """
    starts = pair_starts(count)
    moved = torch.nan_to_num(_across(looks, [k + 1 for k in starts]) - _across(looks, starts))
    if not len(starts):
        return []
    liveliest = int(moved.abs().argmax())
    order = (moved - moved[liveliest]).abs().argsort(descending=True).tolist()
    stretches: list[range] = []
    for k in [liveliest, *order]:
        begin = min(max(0, starts[k] - STRETCH // 2), max(0, count - STRETCH))
        one = range(begin, min(begin + STRETCH, count))
        if all(one.start >= other.stop or one.stop <= other.start for other in stretches):
            stretches.append(one)
        if len(stretches) == STRETCHES:
            break
    return stretches


def _across(looks: Sequence[Look], frames: Sequence[int]) -> Tensor:
    """Place of the ball along the common perpendicular of the lines of sight, (n,), px of the first camera."""
    some = [look.at(frames) for look in looks]
    gaps = gaps_between([look.camera for look in some], [look.sightings.centre_px for look in some])
    return (gaps.position_lab_mm * gaps.across_lab).sum(-1) * gaps.per_mm_px


def gap_by_offset(names: Sequence[str], cameras: Sequence[Camera], stretches: Sequence[tuple[Tensor, Tensor]]) -> Steps:
    """Measure the gap for each shift between two movies.

    Args:
        names: of two cameras.
        cameras: the same.
        stretches: centres (L, 2) of both in L consecutive frames, px; NaN where there is no ball.
    """
    moved = []
    for centres in stretches:
        gaps = gaps_between(cameras, centres)
        moved.append((gaps.position_lab_mm.diff(dim=0) * gaps.across_lab[1:]).sum(-1) * gaps.per_mm_px[1:])
    motion = torch.cat([*moved, torch.zeros(0, dtype=torch.float64)])
    motion = motion[torch.isfinite(motion)]
    moved_px = float(motion.square().mean().sqrt()) if len(motion) else 0.0
    offsets = range(-REACH, REACH + 1)
    rows = [_gap_at(cameras, stretches, offset) for offset in offsets]
    gap, varying = (torch.tensor(column, dtype=torch.float64) for column in zip(*rows, strict=True))
    best, left_px = _least(gap)
    meet_px = max(GOOD_PX, MEET * moved_px)
    if not left_px <= meet_px:
        # Cameras that were bumped leave a gap of their own at any shift; a motion that varies tells beside it.
        best, left_px = _least(varying)
        varies_px = float(motion.std()) if len(motion) > 1 else 0.0
        best = best if varies_px > MOVES_PX and left_px <= meet_px else math.nan
    return Steps(
        offset=torch.tensor(list(offsets), dtype=torch.float64),
        gap_px=gap,
        varying_px=varying,
        moved_px=moved_px,
        best=best if moved_px > MOVES_PX else math.nan,
        names=(names[0], names[1]),
    )


def _gap_at(cameras: Sequence[Camera], stretches: Sequence[tuple[Tensor, Tensor]], offset: int) -> tuple[float, float]:
    """Root mean square gap, px, with and without its constant part; frame k of one movie beside k + offset."""
    parts = [torch.zeros(0, dtype=torch.float64)]
    for first, second in stretches:
        length = len(first) - abs(offset)
        if length <= 0:
            continue
        a, b = first[max(0, -offset) :][:length], second[max(0, offset) :][:length]
        parts.append(gaps_between(cameras, [a, b]).signed_px)
    signed = torch.cat(parts)
    signed = signed[torch.isfinite(signed)]
    if len(signed) < FEW:
        return math.nan, math.nan
    return _trimmed_rms(signed), _trimmed_rms(signed - signed.median())


def _trimmed_rms(values: Tensor) -> float:
    """Root mean square without the largest tenth: one wrong outline must not decide."""
    kept = values.abs().sort().values[: math.ceil(0.9 * len(values))]
    return float(kept.square().mean().sqrt())


def _least(gap_px: Tensor) -> tuple[float, float]:
    """Return the offset of the least gap and that gap; NaN where it lies at the end of those tried."""
    square = gap_px.square()
    if not torch.isfinite(square).all():
        return math.nan, math.nan
    k = int(square.argmin())
    if k in (0, 2 * REACH):
        return math.nan, math.nan
    before, here, after = square[k - 1 : k + 2].tolist()
    bend = before - 2 * here + after
    if bend <= 0:
        return float(k - REACH), math.sqrt(here)
    return k - REACH + 0.5 * (before - after) / bend, math.sqrt(max(0.0, here - (before - after) ** 2 / (8 * bend)))


def step(steps: Steps, start: Mapping[str, int]) -> Finding:
    """Judge whether the movies are in step.

    Args:
        steps: the gap by offset.
        start: of the experiment, frames by camera.
    """
    title, (first, second) = "movies in step", steps.names
    if steps.moved_px <= MOVES_PX:
        measured = f"cannot tell: the ball moves {steps.moved_px:.2f} px a frame across the lines of sight"
        advice = "make sure that one trigger starts both cameras"
        return Finding(title=title, severity=Severity.OK, measured=measured, advice=advice)
    if math.isnan(steps.best):
        measured = f"cannot tell: within {REACH} frames no shift makes the lines of sight meet"
        advice = "mend what is said of the ball and of the lines of sight first, then check again"
        return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)
    now, best = float(steps.gap_px[REACH]), float(steps.gap_px.min())
    measured = (
        f"{second} shows the same instant {abs(steps.best):.2f} frames {'later' if steps.best > 0 else 'earlier'} "
        f"(the ball moves {steps.moved_px:.1f} px a frame across the lines of sight)"
    )
    if steps.shift == 0:
        if abs(steps.best) <= IN_STEP:
            return Finding(title=title, severity=Severity.OK, measured=measured)
        advice = "trigger both cameras by one signal: part of a frame cannot be mended by start:"
        return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)
    measured += f"; the gap falls from {now:.2f} to {best:.2f} px"
    if now < CLEARLY * best:
        advice = "look at one event in both movies: this is not clear enough to go by"
        return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)
    advice = f"write start: {{{first}: {started(start, steps)[0]}, {second}: {started(start, steps)[1]}}}"
    return Finding(title=title, severity=Severity.FAULT, measured=measured, advice=advice)


def started(start: Mapping[str, int], steps: Steps) -> tuple[int, int]:
    """Return what `start:` must say for the two cameras so that the movies are in step; not below 0."""
    first, second = (start.get(name, 0) for name in steps.names)
    second += steps.shift
    return first + max(0, -second), max(0, second)
