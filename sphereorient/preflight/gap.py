"""Do the cameras see one ball in one place: by how much their lines of sight miss each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.cameras import Camera, triangulate
from sphereorient.preflight.finding import Finding, Severity
from sphereorient.preflight.look import Look

# px between lines of sight, typically. Exact cameras leave 0.2 to 0.5, by the outlines; the tracker takes cameras for
# bumped at 1.5.
GOOD_PX, BAD_PX = 0.7, 1.5
CLEARLY = 0.2  # another reading of the cameras is named where it leaves this share of the gap, and a good one
ENOUGH = 3  # frames with a ball in both cameras


@dataclass(frozen=True, kw_only=True, eq=False)
class Gaps:
    """How lines of sight to n places miss each other; made by `gaps_between`."""

    signed_mm: Tensor  # (n,), along the common perpendicular; NaN where a place is missing
    per_mm_px: Tensor  # (n,), px of the first camera for a millimetre along it
    position_lab_mm: Tensor  # (n, 3), the middle of the shortest segment
    across_lab: Tensor  # (n, 3), unit, the common perpendicular

    @property
    def signed_px(self) -> Tensor:
        """The gaps as the first camera sees them, (n,), px: how far the ball is from the other's line of sight."""
        return self.signed_mm * self.per_mm_px


def gaps_between(cameras: Sequence[Camera], centre_px: Sequence[Tensor]) -> Gaps:
    """Compare the lines of sight of two cameras.

    Args:
        cameras: two.
        centre_px: of each, (n, 2), px; NaN where there is no ball.

    Source: the common perpendicular of two skew lines (textbook); the epipolar residual in px.
    """
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


def typical(values: Tensor) -> float:
    """Return the median of the absolute values that are numbers; NaN of none."""
    there = values[torch.isfinite(values)].abs()
    return float(there.median()) if len(there) else math.nan


def lines_of_sight(looks: Sequence[Look], in_step_px: float | None) -> Finding:
    """Judge by how much the lines of sight of two cameras miss each other.

    Args:
        looks: of two cameras, the same frames.
        in_step_px: the gap that is left once the movies are shifted into step, px; None where they are in step.
    """
    title = "lines of sight"
    cameras, centres = [look.camera for look in looks], [look.sightings.centre_px for look in looks]
    gaps = gaps_between(cameras, centres)
    count = int(torch.isfinite(gaps.signed_mm).sum())
    if count < ENOUGH:
        measured = f"the ball is seen by both cameras in {count} of {len(gaps.signed_mm)} frames looked at"
        advice = "see what is said of the ball, and check start: that the movies show the same time"
        return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)
    gap_px = typical(gaps.signed_px)
    measured = f"they miss each other by {typical(gaps.signed_mm):.3f} mm, {gap_px:.2f} px (median of {count} frames)"
    if in_step_px is not None:
        measured += f"; {in_step_px:.2f} px once the movies are in step"
        gap_px = in_step_px
    if gap_px <= GOOD_PX:
        return Finding(title=title, severity=Severity.OK, measured=measured)
    if gap_px <= BAD_PX:
        advice = "run sphereorient check-cameras, and calibrate --refine-with: a camera may have been bumped"
        return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)
    advice = "a camera was moved or bumped, or cameras.yaml is of another set-up: calibrate again"
    better = other_reading(cameras, centres, [look.name for look in looks], gap_px)
    return Finding(title=title, severity=Severity.FAULT, measured=measured, advice=better or advice)


def other_reading(cameras: Sequence[Camera], centres: Sequence[Tensor], names: Sequence[str], gap_px: float) -> str:
    """Return what to write where the gap nearly vanishes with the movies swapped or one seen in a mirror; else none.

    Cameras that stand alike, at right angles say, do not tell which one of them sees in a mirror: both are named.
    """
    limit = min(CLEARLY * gap_px, GOOD_PX)
    return ", or ".join(advice for gap, advice in sorted(_readings(cameras, centres, names)) if gap < limit)


def _readings(cameras: Sequence[Camera], centres: Sequence[Tensor], names: Sequence[str]) -> list[tuple[float, str]]:
    """Return gap, px, and advice for each other way to read the pictures."""
    first, second = names
    readings = []
    if cameras[0].image_size == cameras[1].image_size:
        gap = typical(gaps_between(cameras, centres[::-1]).signed_px)
        readings.append((gap, f"swap {first} and {second} in movies: (then it is {gap:.2f} px)"))
    for k, name in enumerate(names):
        for how, axes in (("horizontal", (0,)), ("vertical", (1,)), ("both", (0, 1))):
            turned = [mirrored(uv, cameras[k], axes) if j == k else uv for j, uv in enumerate(centres)]
            gap = typical(gaps_between(cameras, turned).signed_px)
            readings.append((gap, f"write flip: {{{name}: {how}}} (then it is {gap:.2f} px)"))
    return readings


def mirrored(uv_px: Tensor, camera: Camera, axes: Sequence[int]) -> Tensor:
    """Return where pixels (n, 2) are in a picture that is mirrored along axes, 0 left to right, 1 up and down."""
    out = uv_px.clone()
    for axis in axes:
        out[:, axis] = camera.image_size[axis] - 1 - out[:, axis]
    return out
