"""Checks of two cameras against each other: lines of sight, size of the ball, offset of the movies."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sphereorient.calibration.consistency import Gaps, gaps_between
from sphereorient.cameras import Camera
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


def lines_of_sight(samples: Sequence[MovieSample], in_step_px: float | None) -> Finding:
    """Judge the distance between the lines of sight; `in_step_px`: the gap after synchronising the movies."""
    title, gaps = "lines of sight", sample_gaps(samples)
    count = int(torch.isfinite(gaps.signed_mm).sum())
    if count < ENOUGH:
        measured = f"both cameras see the ball in {count} of {len(gaps.signed_mm)} frames sampled"
        return warning(title, measured, f"{SEE_BALL}, and check start: the movies must show the same time")
    gap_px = _median_size(gaps.signed_px)
    measured = f"they miss each other by {_median_size(gaps.signed_mm):.3f} mm, {gap_px:.2f} px"
    measured += f" (median of {count} frames)"
    if in_step_px is not None:
        measured += f"; {in_step_px:.2f} px once the movies are in step"
        gap_px = in_step_px
    limit = min(CLEARER * gap_px, GOOD_PX)
    # At right angles, several of these can fit: all are reported.
    better = ", or ".join(advice for gap, advice in sorted(_other_readings(samples)) if gap < limit)
    moved = "calibrate again: a camera was moved or bumped, or cameras.yaml is of another set-up"
    bumped = "run sphereorient check-cameras, and calibrate --refine-with: a camera may have been bumped"
    complaints = (gap_px > BAD_PX, FAULT, better or moved), (gap_px > GOOD_PX, WARNING, bumped)
    return judged(title, measured, *complaints)


def _median_size(values: Tensor) -> float:
    return float(values.abs().nanmedian())


def _other_readings(samples: Sequence[MovieSample]) -> list[tuple[float, str]]:
    """Return gap, px, and advice with the movies swapped, and with one of them mirrored."""
    cameras, centres = [one.camera for one in samples], [one.sightings.centre_px for one in samples]
    readings = []
    if cameras[0].image_size == cameras[1].image_size:
        gap = _median_size(gaps_between(cameras, centres[::-1]).signed_px)
        first, second = (one.name for one in samples)
        readings.append((gap, f"swap {first} and {second} in movies: (then it is {gap:.2f} px)"))
    for k, sample in enumerate(samples):
        for how, axes in (("horizontal", (0,)), ("vertical", (1,)), ("both", (0, 1))):
            flipped = centres[k].clone()
            for axis in axes:
                flipped[:, axis] = cameras[k].image_size[axis] - 1 - flipped[:, axis]
            pair = [flipped if j == k else uv for j, uv in enumerate(centres)]
            gap = _median_size(gaps_between(cameras, pair).signed_px)
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
    """Compare the size of the ball in the pictures of two cameras with the expected size."""
    title, position, ratios = "size of the ball", sample_gaps(samples).position_lab_mm, {}
    for sample in samples:
        outline = expected_outline_px(sample.camera, position, diameter_mm / 2)
        expected = (outline - outline.mean(-2, keepdim=True)).norm(dim=-1).mean(-1)
        ratios[sample.name] = sample.sightings.radius_px / expected
    middle = {name: float(ratio.nanmedian()) for name, ratio in ratios.items()}
    if any(math.isnan(ratio) for ratio in middle.values()):
        return warning(title, "unknown: no frame shows the ball to both cameras", SEE_BALL)
    spread = {name: 1.4826 * float((ratio - ratio.nanmedian()).abs().nanmedian()) for name, ratio in ratios.items()}
    words = ", ".join(f"{name} {ratio:.3f} +- {spread[name]:.3f}" for name, ratio in middle.items())
    measured = f"measured over expected: {words}"
    mean = sum(middle.values()) / len(middle)
    tolerance = OUTLINE_PX / min(float(sample.sightings.radius_px.nanmedian()) for sample in samples)
    apart = max(middle.values()) - min(middle.values())
    error = max(apart, abs(mean - 1))
    if apart > GOOD + tolerance:
        name = max(middle, key=lambda one: abs(middle[one] - 1))
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
        return judged(title, f"unknown: the ball moves {scan.moved_px:.2f} px a frame across the lines of sight")
    if math.isnan(scan.best):
        measured = f"unknown: within {REACH} frames no shift makes the lines of sight meet"
        return warning(title, measured, "correct the findings on ball and lines of sight first, then check again")
    now, best = float(scan.gap_px[REACH]), float(scan.gap_px.min())
    measured = (
        f"{second} shows the same instant {abs(scan.best):.2f} frames {'later' if scan.best > 0 else 'earlier'} "
        f"(the ball moves {scan.moved_px:.1f} px a frame across the lines of sight)"
    )
    if scan.shift == 0:
        advice = "trigger both cameras by one signal: start: cannot correct a part of a frame"
        return judged(title, measured, (abs(scan.best) > IN_STEP, WARNING, advice))
    measured += f"; the gap falls from {now:.2f} to {best:.2f} px"
    begins = starts_in_step(start, scan)
    advice = f"write start: {{{first}: {begins[0]}, {second}: {begins[1]}}}"
    weak = (now < CLEARLY * best, WARNING, "look at one event in both movies: this evidence is weak")
    return judged(title, measured, weak, (True, FAULT, advice))


def starts_in_step(start: Mapping[str, int], scan: OffsetScan) -> tuple[int, int]:
    """Return the values of `start:`, not negative, that synchronise the movies of the two cameras."""
    first, second = (start.get(name, 0) for name in scan.names)
    second += scan.shift
    return first + max(0, -second), max(0, second)
