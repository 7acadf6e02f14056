"""Checks of cameras against each other: lines of sight, size of the ball, offset of the movies."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import median, median_low

import numpy as np
import torch
from torch import Tensor

from sphereorient.calibration.consistency import Gaps, gaps_between, majority_by_outlines
from sphereorient.cameras import Camera, nearest_point
from sphereorient.preflight.finding import FAULT, WARNING, Finding, judged, warning
from sphereorient.preflight.sample import MovieSample, pair_starts
from sphereorient.sphere.renderer import rim_directions

# Median px between lines of sight: 0.2 to 0.5 for exact cameras; from 1.5 the tracker assumes a moved camera.
GOOD_PX, BAD_PX = 0.7, 1.5
CLEARER = 0.2  # swapped or mirrored movies are reported if they leave this share of the gap
ENOUGH = 3  # frames with a ball in both cameras
AROUND = 72  # points of the expected outline
OUTLINE_PX = 0.4  # error of an outline's radius, by blur and a dark rim
GOOD, BAD = 0.01, 0.04  # relative error of the size
VOLUME = 0.4  # relative difference of nearer and farther balls from the middle one: what the tracker accepts
REACH = 8  # frames by which a movie may be late
STRETCH = 20  # consecutive frames in one stretch
STRETCHES = 2
MOVES_PX = 0.3  # least motion per frame across the lines of sight that shows an offset
MEET = 0.3  # lines of sight meet if the gap is less than this share of the motion per frame
CLEARLY = 2.0  # an offset is reported as a fault if it reduces the gap by this factor
IN_STEP = 0.25  # frames; a larger part of a frame is a warning
FEW = 8  # frames with a ball in both cameras
SEE_BALL = "see the finding on the ball"


def sample_gaps(samples: Sequence[MovieSample]) -> Gaps:
    """Return the gaps between the lines of sight of two cameras in the same sampled frames."""
    return gaps_between([one.camera for one in samples], [one.sightings.centre_px for one in samples])


def sample_positions(samples: Sequence[MovieSample]) -> Tensor:
    """Return the positions (n, 3), lab, mm, of the ball in the frames sampled by two cameras or more."""
    return nearest_point([one.camera.rays(one.sightings.centre_px) for one in samples])[0]


def outvoted(samples: Sequence[MovieSample]) -> list[str]:
    """Return the cameras whose lines of sight miss those of a majority that meet; none of two cameras."""
    centre_px = torch.stack([one.sightings.centre_px for one in samples], 1)
    radius_px = torch.stack([one.sightings.radius_px for one in samples], 1)
    agree = majority_by_outlines({one.name: one.camera for one in samples}, centre_px, radius_px)
    return [one.name for k, one in enumerate(samples) if agree and k not in agree]


def lines_of_sight(samples: Sequence[MovieSample], in_step_px: float | None) -> Finding:
    """Judge the distance between the lines of sight; `in_step_px`: the gap after synchronising the movies."""
    title, pairs = "lines of sight", {two: sample_gaps(two) for two in combinations(samples, 2)}
    counts = {two: int(torch.isfinite(gaps.signed_mm).sum()) for two, gaps in pairs.items()}
    fewest = min(counts, key=lambda two: counts[two])
    if (count := counts[fewest]) < ENOUGH:
        who = "both cameras see" if len(samples) == 2 else f"{fewest[0].name} and {fewest[1].name} see"
        measured = f"{who} the ball in {count} of {len(samples[0].frame)} frames sampled"
        return warning(title, measured, f"{SEE_BALL}, and check start: the movies must show the same time")
    by_pair = {two: _median_size(gaps.signed_px) for two, gaps in pairs.items()}
    worst = max(by_pair, key=lambda two: by_pair[two])
    gap_px, gap_mm = by_pair[worst], _median_size(pairs[worst].signed_mm)
    who = "they miss" if len(samples) == 2 else f"those of {worst[0].name} and {worst[1].name} miss"
    measured = f"{who} each other by {gap_mm:.3f} mm, {gap_px:.2f} px (median of {counts[worst]} frames)"
    wrong = outvoted(samples) if gap_px > BAD_PX else []
    if wrong:
        others = max((gap for two, gap in by_pair.items() if not {one.name for one in two} & {*wrong}))
        measured += f"; without {' and '.join(wrong)} they meet to {others:.2f} px"
    if in_step_px is not None:
        measured += f"; {in_step_px:.2f} px once the movies are in step"
        gap_px = in_step_px
    limit = min(CLEARER * gap_px, GOOD_PX)
    # At right angles, several of these can fit: all are reported.
    better = ", or ".join(advice for gap, advice in sorted(_other_readings(samples)) if gap < limit)
    who = f"{' and '.join(wrong)} contradicts the others and" if wrong else "a camera"
    moved = f"calibrate again: {who} was moved or bumped, or cameras.yaml is of another set-up"
    bumped = "run sphereorient check-cameras, and calibrate --refine-with: a camera may have been bumped"
    complaints = (gap_px > BAD_PX, FAULT, better or moved), (gap_px > GOOD_PX, WARNING, bumped)
    return judged(title, measured, *complaints)


def _median_size(values: Tensor) -> float:
    return float(values.abs().nanmedian())


def _other_readings(samples: Sequence[MovieSample]) -> list[tuple[float, str]]:
    """Return largest gap, px, and advice with two movies swapped, and with one of them mirrored."""
    cameras, centres = [one.camera for one in samples], [one.sightings.centre_px for one in samples]

    def largest(seen: Sequence[Tensor]) -> float:
        two = combinations(range(len(samples)), 2)
        gaps = (gaps_between((cameras[k], cameras[m]), (seen[k], seen[m])) for k, m in two)
        return max(_median_size(one.signed_px) for one in gaps)

    readings = []
    for k, m in combinations(range(len(samples)), 2):
        if cameras[k].image_size == cameras[m].image_size:
            swapped = [*centres]
            swapped[k], swapped[m] = centres[m], centres[k]
            gap = largest(swapped)
            advice = f"swap {samples[k].name} and {samples[m].name} in movies: (then it is {gap:.2f} px)"
            readings.append((gap, advice))
    for k, sample in enumerate(samples):
        for how, axes in (("horizontal", (0,)), ("vertical", (1,)), ("both", (0, 1))):
            flipped = centres[k].clone()
            for axis in axes:
                flipped[:, axis] = cameras[k].image_size[axis] - 1 - flipped[:, axis]
            gap = largest([flipped if j == k else uv for j, uv in enumerate(centres)])
            readings.append((gap, f"write flip: {{{sample.name}: {how}}} (then it is {gap:.2f} px)"))
    return readings


def expected_outline_px(camera: Camera, position_lab_mm: Tensor, radius_mm: float) -> Tensor:
    """Return the outline (..., AROUND, 2), px, of a sphere at (..., 3), mm, lab; a port's effect is negligible."""
    rim, sight = rim_directions(camera, position_lab_mm, AROUND)
    distance = (position_lab_mm @ camera.R_cam_lab.mT + camera.T_cam_lab_mm).norm(dim=-1)
    sine = (radius_mm / distance).clamp_max(0.99)[..., None, None]
    toward = (1 - sine.square()).sqrt() * rim - sine * sight[..., None, :]
    return camera.project(position_lab_mm[..., None, :] + radius_mm * toward)


def outline_stretch(sample: MovieSample, position_lab_mm: Tensor, radius_mm: float) -> Tensor:
    """Return by how much wider the outlines (n,) are than those of a sphere at positions (n, 3), mm, relative."""
    measured = [math.nan if outline is None else outline.stretch for outline, _ in sample.found]
    rim = expected_outline_px(sample.camera, position_lab_mm, radius_mm)
    width, height = (rim - rim.mean(-2, keepdim=True)).square().mean(-2).sqrt().unbind(-1)
    return torch.tensor(measured, dtype=torch.float64) - (width / height - 1)


def ball_size(samples: Sequence[MovieSample], diameter_mm: float) -> Finding:
    """Compare the size of the ball in the pictures of two cameras or more with the expected size."""
    title, position, ratios = "size of the ball", sample_positions(samples), {}
    for sample in samples:
        outline = expected_outline_px(sample.camera, position, diameter_mm / 2)
        expected = (outline - outline.mean(-2, keepdim=True)).norm(dim=-1).mean(-1)
        ratios[sample.name] = sample.sightings.radius_px / expected
    middle = {name: float(ratio.nanmedian()) for name, ratio in ratios.items()}
    if any(math.isnan(ratio) for ratio in middle.values()):
        both = "both" if len(samples) == 2 else "all"
        return warning(title, f"unknown: no frame shows the ball to {both} cameras", SEE_BALL)
    spread = {name: 1.4826 * float((ratio - ratio.nanmedian()).abs().nanmedian()) for name, ratio in ratios.items()}
    words = ", ".join(f"{name} {ratio:.3f} +- {spread[name]:.3f}" for name, ratio in middle.items())
    measured = f"measured over expected: {words}"
    mean = sum(middle.values()) / len(middle)
    tolerance = OUTLINE_PX / min(float(sample.sightings.radius_px.nanmedian()) for sample in samples)
    apart = max(middle.values()) - min(middle.values())
    error = max(apart, abs(mean - 1))
    if apart > GOOD + tolerance:
        usual = 1.0 if len(samples) == 2 else median(middle.values())
        name = max(middle, key=lambda one: abs(middle[one] - usual))
        advice = f"check f, pixel_pitch and T of {name} in cameras.yaml: the cameras do not agree on the size"
    else:
        advice = (
            f"measure the ball: sphere.diameter {diameter_mm * mean:.4g} mm would fit; if it is {diameter_mm:g} mm, "
            f"the lengths of the calibration are wrong (pitch of the plate)"
        )
    complaints = (error > BAD + tolerance, FAULT, advice), (error > GOOD + tolerance, WARNING, advice)
    return judged(title, measured, *complaints)


def ball_size_px(sample: MovieSample) -> Finding:
    """Report the size of the ball in one camera, which does not separate distance from size."""
    title, radius = f"size of the ball, {sample.name}", sample.sightings.radius_px
    seen = 2 * radius[torch.isfinite(radius)]
    if not len(seen):
        return warning(title, "unknown: no ball was found", SEE_BALL)
    least, usual, most = (float(size) for size in (seen.min(), seen.median(), seen.max()))
    measured = f"{usual:.1f} px across ({least:.1f} .. {most:.1f})"
    if sample.expected_px is None:
        advice = f"set locate.diameter_px to {usual:.0f} (--set, or in the settings file)"
        return warning(title, measured + "; none expected", advice)
    measured += f"; {sample.expected_px:.1f} px expected in the middle of the volume"
    wrong = sample.diameter_px != sample.expected_px and abs(usual / sample.expected_px - 1) >= VOLUME
    advice = f"check sphere.diameter and the camera, or set locate.diameter_px to {usual:.0f}"
    return judged(title, measured, (wrong, FAULT, advice))


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
    gaps = sample_gaps(samples[:2])
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


def shifts_of(scans: Sequence[OffsetScan]) -> dict[str, float]:
    """Return by how many frames each movie is late, NaN: unknown: of two against the first, of more against most."""
    late = {scans[0].names[0]: 0.0} | {scan.names[1]: scan.best for scan in scans}
    known = [value for value in late.values() if not math.isnan(value)]
    usual = median_low(known) if len(scans) > 1 else 0.0
    return {name: value - usual for name, value in late.items()}


def in_step(scans: Sequence[OffsetScan], start: Mapping[str, int]) -> Finding:
    """Judge whether the movies are synchronised, from scans of each other one against the first; `start` is that of
    the experiment.
    """
    title, late = "movies in step", shifts_of(scans)
    moved_px = min(scan.moved_px for scan in scans)
    if moved_px <= MOVES_PX:
        return judged(title, f"unknown: the ball moves {moved_px:.2f} px a frame across the lines of sight")
    if any(math.isnan(value) for value in late.values()):
        measured = f"unknown: within {REACH} frames no shift makes the lines of sight meet"
        return warning(title, measured, "correct the findings on ball and lines of sight first, then check again")
    name = max(list(late)[1:] if len(scans) == 1 else late, key=lambda one: abs(late[one]))
    measured = (
        f"{name} shows the same instant {abs(late[name]):.2f} frames {'later' if late[name] > 0 else 'earlier'} "
        f"(the ball moves {moved_px:.1f} px a frame across the lines of sight)"
    )
    shifted = [scan for scan in scans if scan.shift]
    if not shifted:
        advice = "trigger both cameras by one signal: start: cannot correct a part of a frame"
        advice = advice if len(scans) == 1 else advice.replace("both", "all")
        return judged(title, measured, (abs(late[name]) > IN_STEP, WARNING, advice))
    now = max(float(scan.gap_px[REACH]) for scan in shifted)
    best = max(float(scan.gap_px.min()) for scan in shifted)
    measured += f"; the gap falls from {now:.2f} to {best:.2f} px"
    begins = ", ".join(f"{one}: {first}" for one, first in starts_in_step(start, late).items())
    weak = (now < CLEARLY * best, WARNING, "look at one event in both movies: this evidence is weak")
    return judged(title, measured, weak, (True, FAULT, f"write start: {{{begins}}}"))


def starts_in_step(start: Mapping[str, int], late: Mapping[str, float]) -> dict[str, int]:
    """Return the values of `start:`, not negative, that synchronise movies that are late by some frames."""
    begins = {name: start.get(name, 0) + round(frames) for name, frames in late.items()}
    before = min(0, *begins.values())
    return {name: begin - before for name, begin in begins.items()}
