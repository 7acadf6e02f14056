"""Checks of two cameras against each other: lines of sight, and size of the ball."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.cameras import Camera, triangulate
from sphereorient.preflight.finding import Finding, fault, ok, warning
from sphereorient.preflight.sample import MovieSample

# Median px between lines of sight: 0.2 to 0.5 for exact cameras; from 1.5 the tracker assumes a moved camera.
GOOD_PX, BAD_PX = 0.7, 1.5
CLEARLY = 0.2  # swapped or mirrored movies are reported if they leave this share of the gap
ENOUGH = 3  # frames with a ball in both cameras
AROUND = 72  # points of the expected outline
OUTLINE_PX = 0.4  # error of an outline's radius, by blur and a dark rim
GOOD, BAD = 0.01, 0.04  # relative error of the size
VOLUME = 0.4  # relative difference of nearer and farther balls from the middle one: what the tracker accepts
SEE_BALL = "see the finding on the ball"


@dataclass(frozen=True, kw_only=True, eq=False)
class Gaps:
    """Distances between the lines of sight to n points; made by `gaps_between`."""

    signed_mm: Tensor  # (n,), along the common perpendicular; NaN where a point is missing
    per_mm_px: Tensor  # (n,), px of the first camera for a millimetre along it
    position_lab_mm: Tensor  # (n, 3), the middle of the shortest segment
    across_lab: Tensor  # (n, 3), unit, the common perpendicular

    @property
    def signed_px(self) -> Tensor:
        """The gaps in px of the first camera, (n,): the epipolar residual."""
        return self.signed_mm * self.per_mm_px


def gaps_between(cameras: Sequence[Camera], centre_px: Sequence[Tensor]) -> Gaps:
    """Return the gaps (common perpendiculars) of two cameras' lines of sight to centres (n, 2), px; NaN: no ball."""
    a, b = (camera.rays(uv) for camera, uv in zip(cameras, centre_px, strict=True))
    position, _ = triangulate(a, b)
    across = torch.linalg.cross(a.direction_lab, b.direction_lab)
    across = across / across.norm(dim=-1, keepdim=True)
    signed = ((b.origin_lab_mm - a.origin_lab_mm) * across).sum(-1)
    half = 0.5 * across
    seen = cameras[0].project(torch.cat([position - half, position + half])).chunk(2)
    return Gaps(
        signed_mm=torch.where(torch.isfinite(position).all(-1), signed, torch.nan),
        per_mm_px=(seen[1] - seen[0]).norm(dim=-1),
        position_lab_mm=position,
        across_lab=across,
    )


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
    if gap_px <= GOOD_PX:
        return ok(title, measured)
    if gap_px <= BAD_PX:
        advice = "run sphereorient check-cameras, and calibrate --refine-with: a camera may have been bumped"
        return warning(title, measured, advice)
    limit = min(CLEARLY * gap_px, GOOD_PX)
    # At right angles, several of these can fit: all are reported.
    better = ", or ".join(advice for gap, advice in sorted(_other_readings(samples)) if gap < limit)
    advice = "calibrate again: a camera was moved or bumped, or cameras.yaml is of another set-up"
    return fault(title, measured, better or advice)


def _median_size(values: Tensor) -> float:
    finite = values[torch.isfinite(values)].abs()
    return float(finite.median()) if len(finite) else math.nan


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
    sight = camera.rays(camera.project(position_lab_mm)).direction_lab
    side = torch.linalg.cross(sight, camera.R_cam_lab[1].expand_as(sight))
    side = side / side.norm(dim=-1, keepdim=True)
    up = torch.linalg.cross(sight, side)
    distance = (position_lab_mm @ camera.R_cam_lab.mT + camera.T_cam_lab_mm).norm(dim=-1)
    sine = (radius_mm / distance).clamp_max(0.99)[..., None, None]
    angle = torch.arange(AROUND, dtype=sight.dtype) * (2 * math.pi / AROUND)
    rim = angle.cos()[:, None] * side[..., None, :] + angle.sin()[:, None] * up[..., None, :]
    toward = (1 - sine.square()).sqrt() * rim - sine * sight[..., None, :]
    return camera.project(position_lab_mm[..., None, :] + radius_mm * toward)


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
    if error <= GOOD + tolerance:
        return ok(title, measured)
    if apart > GOOD + tolerance:
        name = max(middle, key=lambda one: abs(middle[one] - 1))
        advice = f"check f, pixel_pitch and T of {name} in cameras.yaml: the cameras do not agree on the size"
    else:
        advice = (
            f"measure the ball: sphere.diameter {diameter_mm * mean:.4g} mm would fit; if it is {diameter_mm:g} mm, "
            f"the lengths of the calibration are wrong (pitch of the plate)"
        )
    return (fault if error > BAD + tolerance else warning)(title, measured, advice)


def ball_size_px(sample: MovieSample) -> Finding:
    """Report the size of the ball in one camera, which does not separate distance from size."""
    title, radius = f"size of the ball, {sample.name}", sample.sightings.radius_px
    seen = 2 * radius[torch.isfinite(radius)]
    if not len(seen):
        return warning(title, "unknown: no ball was found", SEE_BALL)
    usual = float(seen.median())
    measured = f"{usual:.1f} px across ({float(seen.min()):.1f} .. {float(seen.max()):.1f})"
    if sample.expected_px is None:
        advice = f"set locate.diameter_px to {usual:.0f} (--set, or in the settings file)"
        return warning(title, measured + "; none expected", advice)
    measured += f"; {sample.expected_px:.1f} px expected in the middle of the volume"
    if sample.diameter_px == sample.expected_px or abs(usual / sample.expected_px - 1) < VOLUME:
        return ok(title, measured)
    return fault(title, measured, f"check sphere.diameter and the camera, or set locate.diameter_px to {usual:.0f}")
