"""Check whether two movies are synchronised: the gap of the lines of sight at each offset in frames."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sphereorient.cameras import Camera
from sphereorient.preflight.cameras import GOOD_PX, gaps_between, sample_gaps
from sphereorient.preflight.finding import Finding, fault, ok, warning
from sphereorient.preflight.sample import MovieSample, pair_starts

REACH = 8  # frames by which a movie may be late
STRETCH = 20  # consecutive frames in one stretch
STRETCHES = 2
MOVES_PX = 0.3  # least motion per frame across the lines of sight that shows an offset
MEET = 0.3  # lines of sight meet if the gap is less than this share of the motion per frame
CLEARLY = 2.0  # an offset is reported as a fault if it reduces the gap by this factor
IN_STEP = 0.25  # frames; a larger part of a frame is a warning
FEW = 8  # frames with a ball in both cameras


@dataclass(frozen=True, kw_only=True, eq=False)
class OffsetScan:
    """The gap at each offset between two movies; made by `scan_offsets`, drawn by the figure."""

    offset: Tensor  # (2 REACH + 1,), frames by which the second movie is late
    gap_px: Tensor  # of each offset: root mean square of the gap, px; NaN: unknown
    varying_px: Tensor  # likewise without the constant part of the gap, which is an error of the cameras
    moved_px: float  # typical motion across the lines of sight in one frame, px
    best: float  # the offset of the least gap, to parts of a frame; NaN: unknown
    names: tuple[str, str]

    @property
    def shift(self) -> int:
        """Delay of the second movie, whole frames; 0 if unknown."""
        return 0 if math.isnan(self.best) else round(self.best)

    @property
    def in_step_px(self) -> float:
        """Gap at that shift, px."""
        return float(self.gap_px[REACH + self.shift])


def liveliest_stretches(samples: Sequence[MovieSample]) -> list[range]:
    """Choose stretches of consecutive frames with much motion, then different: a late movie's gap varies."""
    count = len(samples[0].stream)
    starts = pair_starts(count)
    if not starts:
        return []
    gaps = sample_gaps(samples)
    across_px = (gaps.position_lab_mm * gaps.across_lab).sum(-1) * gaps.per_mm_px
    index = np.searchsorted(samples[0].frame, starts)  # the next frame is the next one of the sample
    moved = torch.nan_to_num(across_px[index + 1] - across_px[index])
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


def scan_offsets(
    names: Sequence[str], cameras: Sequence[Camera], stretches: Sequence[tuple[Tensor, Tensor]]
) -> OffsetScan:
    """Measure the gap at each offset; stretches hold both cameras' centres (L, 2), px, NaN: no ball."""
    moved = [torch.zeros(0, dtype=torch.float64)]
    for centres in stretches:
        gaps = gaps_between(cameras, centres)
        moved.append((gaps.position_lab_mm.diff(dim=0) * gaps.across_lab[1:]).sum(-1) * gaps.per_mm_px[1:])
    motion = torch.cat(moved)
    motion = motion[torch.isfinite(motion)]
    moved_px = float(motion.square().mean().sqrt()) if len(motion) else 0.0
    offsets = range(-REACH, REACH + 1)
    rows = [_gap_at(cameras, stretches, offset) for offset in offsets]
    gap, varying = (torch.tensor(column, dtype=torch.float64) for column in zip(*rows, strict=True))
    best, least_px = _least(gap)
    meet_px = max(GOOD_PX, MEET * moved_px)
    if not least_px <= meet_px:
        # Moved cameras leave a constant gap at any offset: use the varying part, if the motion varies.
        best, least_px = _least(varying)
        varies_px = float(motion.std()) if len(motion) > 1 else 0.0
        best = best if varies_px > MOVES_PX and least_px <= meet_px else math.nan
    return OffsetScan(
        offset=torch.tensor(list(offsets), dtype=torch.float64),
        gap_px=gap,
        varying_px=varying,
        moved_px=moved_px,
        best=best if moved_px > MOVES_PX else math.nan,
        names=(names[0], names[1]),
    )


def _gap_at(cameras: Sequence[Camera], stretches: Sequence[tuple[Tensor, Tensor]], offset: int) -> tuple[float, float]:
    """Return the rms gap of frames k and k + offset, px, with and without its constant part."""
    parts = [torch.zeros(0, dtype=torch.float64)]
    for first, second in stretches:
        length = len(first) - abs(offset)
        if length > 0:
            a, b = first[max(0, -offset) :][:length], second[max(0, offset) :][:length]
            parts.append(gaps_between(cameras, [a, b]).signed_px)
    signed = torch.cat(parts)
    signed = signed[torch.isfinite(signed)]
    if len(signed) < FEW:
        return math.nan, math.nan
    return _trimmed_rms(signed), _trimmed_rms(signed - signed.median())


def _trimmed_rms(values: Tensor) -> float:
    """Return the rms without the largest tenth, possibly wrong outlines."""
    kept = values.abs().sort().values[: math.ceil(0.9 * len(values))]
    return float(kept.square().mean().sqrt())


def _least(gap_px: Tensor) -> tuple[float, float]:
    """Return the offset of the least gap, by a parabola, and that gap; NaN at the ends of the range."""
    square = gap_px.square()
    k = int(square.argmin())
    if not torch.isfinite(square).all() or k in (0, 2 * REACH):
        return math.nan, math.nan
    before, here, after = square[k - 1 : k + 2].tolist()
    bend = before - 2 * here + after
    if bend <= 0:
        return float(k - REACH), math.sqrt(here)
    return k - REACH + 0.5 * (before - after) / bend, math.sqrt(max(0.0, here - (before - after) ** 2 / (8 * bend)))


def in_step(scan: OffsetScan, start: Mapping[str, int]) -> Finding:
    """Judge whether the movies are synchronised; `start` is that of the experiment."""
    title, (first, second) = "movies in step", scan.names
    if scan.moved_px <= MOVES_PX:
        return ok(title, f"unknown: the ball moves {scan.moved_px:.2f} px a frame across the lines of sight")
    if math.isnan(scan.best):
        measured = f"unknown: within {REACH} frames no shift makes the lines of sight meet"
        return warning(title, measured, "correct the findings on ball and lines of sight first, then check again")
    now, best = float(scan.gap_px[REACH]), float(scan.gap_px.min())
    measured = (
        f"{second} shows the same instant {abs(scan.best):.2f} frames {'later' if scan.best > 0 else 'earlier'} "
        f"(the ball moves {scan.moved_px:.1f} px a frame across the lines of sight)"
    )
    if scan.shift == 0:
        if abs(scan.best) <= IN_STEP:
            return ok(title, measured)
        advice = "trigger both cameras by one signal: start: cannot correct a part of a frame"
        return warning(title, measured, advice)
    measured += f"; the gap falls from {now:.2f} to {best:.2f} px"
    if now < CLEARLY * best:
        return warning(title, measured, "look at one event in both movies: this evidence is weak")
    begins = starts_in_step(start, scan)
    return fault(title, measured, f"write start: {{{first}: {begins[0]}, {second}: {begins[1]}}}")


def starts_in_step(start: Mapping[str, int], scan: OffsetScan) -> tuple[int, int]:
    """Return the values of `start:`, not negative, that synchronise the movies of the two cameras."""
    first, second = (start.get(name, 0) for name in scan.names)
    second += scan.shift
    return first + max(0, -second), max(0, second)
