"""Synchronisation of the movies: gap between the lines of sight by offset, in stretches with much motion."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median_low

import numpy as np
import torch
from torch import Tensor

from sphereorient.calibration.comparison import LATEST, gaps_between
from sphereorient.cameras import Camera
from sphereorient.preflight.finding import FAULT, WARNING, Finding, judged, warning
from sphereorient.preflight.sample import MovieSample

STRETCH, STRETCHES = 20, 2  # consecutive frames in one stretch, and number of stretches
MOVES_PX = 0.3  # least motion per frame across the lines of sight that shows an offset
MEET, MEET_PX = 0.3, 0.7  # lines of sight meet if the gap is less than this share of the motion per frame, or px
CLEARLY = 2.0  # an offset is reported as a fault if it reduces the gap by this factor
IN_STEP = 0.25  # frames; a larger part of a frame is a warning
FEW = 8  # frames with a ball in both cameras


@dataclass(frozen=True, kw_only=True, eq=False)
class OffsetScan:
    """The gap at each offset between two movies; made by `scan_offsets`, drawn by the figure."""

    gap_px: Tensor  # (2 LATEST + 1,) of each offset: root mean square of the gap, px; NaN: unknown
    varying_px: Tensor  # likewise without the constant part of the gap, which is an error of the cameras
    moved_px: float  # typical motion across the lines of sight in one frame, px
    best: float  # the offset of the least gap, to parts of a frame; NaN: unknown
    names: tuple[str, str]

    @property
    def offset(self) -> range:
        """Frames by which the second movie is late."""
        return range(-LATEST, LATEST + 1)

    @property
    def shift(self) -> int:
        """Delay of the second movie, whole frames; 0 if unknown."""
        return 0 if math.isnan(self.best) else round(self.best)

    @property
    def in_step_px(self) -> float:
        """Gap at that shift, px."""
        return float(self.gap_px[LATEST + self.shift])


def liveliest_stretches(samples: Sequence[MovieSample]) -> list[range]:
    """Choose stretches of consecutive frames with much, and different, motion: a late movie's gap varies."""
    count = len(samples[0].stream)
    frame = samples[0].frame
    starts = frame[:-1][np.diff(frame) == 1].tolist()  # the next frame follows in the sample
    if not starts:
        return []
    first, second = samples[:2]
    gaps = gaps_between((first.camera, second.camera), (first.sightings.centre_px, second.sightings.centre_px))
    across_px = (gaps.position_lab_mm * gaps.across_lab).sum(-1) * gaps.per_mm_px
    index = np.searchsorted(frame, starts)
    moved = torch.nan_to_num(across_px[index + 1] - across_px[index])
    liveliest = int(moved.abs().argmax())
    order = (moved - moved[liveliest]).abs().argsort(descending=True).tolist()
    stretches: list[range] = []
    for k in [liveliest, *order]:
        begin = min(max(0, starts[k] - STRETCH // 2), max(0, count - STRETCH))
        one = range(begin, min(begin + STRETCH, count))
        if not any({*one} & {*other} for other in stretches):
            stretches.append(one)
    return stretches[:STRETCHES]


def scan_offsets(
    names: Sequence[str], cameras: Sequence[Camera], stretches: Sequence[tuple[Tensor, Tensor]]
) -> OffsetScan:
    """Measure the gap at each offset; stretches hold both cameras' centres (L, 2), px, NaN: no ball."""
    moved = []
    for gaps in (gaps_between(cameras, centres) for centres in stretches):
        moved.append((gaps.position_lab_mm.diff(dim=0) * gaps.across_lab[1:]).sum(-1) * gaps.per_mm_px[1:])
    motion = _finite(moved)
    moved_px = float(motion.square().mean().sqrt()) if len(motion) else 0.0
    rows = [_gap_at(cameras, stretches, offset) for offset in range(-LATEST, LATEST + 1)]
    gap, varying = (torch.tensor(column, dtype=torch.float64) for column in zip(*rows, strict=True))
    best, least_px = _least(gap)
    meet_px = max(MEET_PX, MEET * moved_px)
    if not least_px <= meet_px:
        # Moved cameras leave a constant gap at any offset: use the varying part, if the motion varies.
        best, least_px = _least(varying)
        varies = len(motion) > 1 and float(motion.std()) > MOVES_PX
        best = best if varies and least_px <= meet_px else math.nan
    return OffsetScan(
        gap_px=gap,
        varying_px=varying,
        moved_px=moved_px,
        best=best if moved_px > MOVES_PX else math.nan,
        names=(names[0], names[1]),
    )


def _gap_at(cameras: Sequence[Camera], stretches: Sequence[tuple[Tensor, Tensor]], offset: int) -> tuple[float, float]:
    """Return the rms gap of frames k and k + offset, px, with and without its constant part."""
    parts = []
    for first, second in stretches:
        length = len(first) - abs(offset)
        if length > 0:
            a, b = first[max(0, -offset) :][:length], second[max(0, offset) :][:length]
            parts.append(gaps_between(cameras, [a, b]).signed_px)
    signed = _finite(parts)
    if len(signed) < FEW:
        return math.nan, math.nan
    return _trimmed_rms(signed), _trimmed_rms(signed - signed.median())


def _finite(parts: Sequence[Tensor]) -> Tensor:
    whole = torch.cat([torch.zeros(0, dtype=torch.float64), *parts])
    return whole[torch.isfinite(whole)]


def _trimmed_rms(values: Tensor) -> float:
    kept = values.abs().sort().values[: math.ceil(0.9 * len(values))]
    return float(kept.square().mean().sqrt())


def _least(gap_px: Tensor) -> tuple[float, float]:
    """Return the offset of the least gap, by a parabola, and that gap; NaN at the ends of the range."""
    square = gap_px.square()
    k = int(square.argmin())
    if not torch.isfinite(square).all() or k in (0, 2 * LATEST):
        return math.nan, math.nan
    before, here, after = square[k - 1 : k + 2].tolist()
    bend = before - 2 * here + after
    if bend <= 0:
        return float(k - LATEST), math.sqrt(here)
    return k - LATEST + 0.5 * (before - after) / bend, math.sqrt(max(0.0, here - (before - after) ** 2 / (8 * bend)))


def in_step(scans: Sequence[OffsetScan], start: Mapping[str, int]) -> Finding:
    """Judge whether the movies are synchronised, from scans against the first one; `start`: of the experiment."""
    title, moved_px = "movies in step", max(scan.moved_px for scan in scans)
    if moved_px <= MOVES_PX:
        return judged(title, f"unknown: the ball moves {moved_px:.2f} px a frame across the lines of sight")
    unknown = [scan.names[1] for scan in scans if scan.moved_px <= MOVES_PX]
    scans = [scan for scan in scans if scan.moved_px > MOVES_PX]
    late = {scans[0].names[0]: 0.0} | {scan.names[1]: scan.best for scan in scans}
    # Two movies: late against the first; more: against the majority.
    usual = median_low(value for value in late.values() if not math.isnan(value)) if len(scans) > 1 else 0.0
    late = {name: value - usual for name, value in late.items()}
    if any(math.isnan(value) for value in late.values()):
        measured = f"unknown: within {LATEST} frames no shift makes the lines of sight meet"
        return warning(title, measured, "correct the findings on ball and lines of sight first, then check again")
    name = max(list(late)[1:] if len(scans) == 1 else late, key=lambda one: abs(late[one]))
    measured = f"{name} shows the same instant {abs(late[name]):.2f} frames "
    measured += "later" if late[name] > 0 else "earlier"
    measured += f" (the ball moves {moved_px:.1f} px a frame across the lines of sight)"
    measured += f"; {', '.join(unknown)}: unknown" if unknown else ""
    shifted = [scan for scan in scans if scan.shift]
    if not shifted:
        which = "both" if len(scans) == 1 else "all"
        advice = f"trigger {which} cameras by one signal: start: cannot correct part of a frame"
        return judged(title, measured, (abs(late[name]) > IN_STEP, WARNING, advice))
    now = max(float(scan.gap_px[LATEST]) for scan in shifted)
    best = max(float(scan.gap_px.min()) for scan in shifted)
    measured += f"; the gap falls from {now:.2f} to {best:.2f} px"
    late |= dict.fromkeys(unknown, late[scans[0].names[0]])  # they stay in step with the first movie
    begins = ", ".join(f"{one}: {first}" for one, first in starts_in_step(start, late).items())
    weak = (now < CLEARLY * best, WARNING, "look at one event in both movies: this evidence is weak")
    return judged(title, measured, weak, (True, FAULT, f"set start: {{{begins}}}"))


def starts_in_step(start: Mapping[str, int], late: Mapping[str, float]) -> dict[str, int]:
    """Return the values of `start:`, not negative, that synchronise movies that are late by some frames."""
    begins = {name: start.get(name, 0) + round(frames) for name, frames in late.items()}
    before = min(0, *begins.values())
    return {name: begin - before for name, begin in begins.items()}
