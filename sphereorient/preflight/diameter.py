"""Is the ball as large in the pictures as its diameter and the cameras say."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from sphereorient.cameras import Camera
from sphereorient.preflight.finding import Finding, Severity
from sphereorient.preflight.gap import gaps_between
from sphereorient.preflight.look import Look

AROUND = 72  # points of the expected outline
OUTLINE_PX = 0.4  # by which an outline may be too large or small: blur, and light that the rim lacks
GOOD, BAD = 0.01, 0.04  # relative error of the size
VOLUME = 0.4  # by which nearer and farther balls differ from the middle one's size: what the tracker accepts


def expected_outline_px(camera: Camera, position_lab_mm: Tensor, radius_mm: float) -> Tensor:
    """Return where a camera shows the outline of a sphere, (..., AROUND, 2), px.

    Args:
        camera: any model, also behind a port.
        position_lab_mm: (..., 3), the sphere's centre.
        radius_mm: of the sphere.

    The outline lies before the great circle by asin(radius / distance). The distance is taken as in air without a
    port: its error moves the outline by the square of a small angle's error only.
    """
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


def size_ratios(looks: Sequence[Look], diameter_mm: float) -> dict[str, Tensor]:
    """Return measured over expected radius, (n,) for each of two cameras; NaN where either does not see the ball.

    Args:
        looks: of two cameras, the same n frames.
        diameter_mm: of the sphere.
    """
    gaps = gaps_between([look.camera for look in looks], [look.sightings.centre_px for look in looks])
    ratios = {}
    for look in looks:
        outline = expected_outline_px(look.camera, gaps.position_lab_mm, diameter_mm / 2)
        expected = (outline - outline.mean(-2, keepdim=True)).norm(dim=-1).mean(-1)
        ratios[look.name] = look.sightings.radius_px / expected
    return ratios


def size(ratios: Mapping[str, Tensor], radius_px: Mapping[str, float], diameter_mm: float) -> Finding:
    """Judge the size of the ball in the pictures of two cameras.

    Args:
        ratios: measured over expected radius by camera.
        radius_px: typical radius of the outline by camera.
        diameter_mm: of the sphere.
    """
    title = "size of the ball"
    middle = {name: float(ratio.nanmedian()) for name, ratio in ratios.items()}
    if any(math.isnan(ratio) for ratio in middle.values()):
        measured = "cannot tell: no frame in which both cameras see the ball"
        return Finding(title=title, severity=Severity.WARNING, measured=measured, advice="see what is said of the ball")
    told = ", ".join(f"{name} {ratio:.3f} +- {_spread(ratios[name]):.3f}" for name, ratio in middle.items())
    measured = f"measured over expected: {told}"
    mean = sum(middle.values()) / len(middle)
    tolerance = OUTLINE_PX / min(radius_px.values())
    apart = max(middle.values()) - min(middle.values())
    off = abs(mean - 1)
    if max(apart, off) <= GOOD + tolerance:
        return Finding(title=title, severity=Severity.OK, measured=measured)
    severity = Severity.FAULT if max(apart, off) > BAD + tolerance else Severity.WARNING
    if apart > GOOD + tolerance:
        name = max(middle, key=lambda one: abs(middle[one] - 1))
        advice = f"check f, pixel_pitch and T of {name} in cameras.yaml: the cameras do not agree on the size"
    else:
        advice = (
            f"measure the ball: sphere.diameter {diameter_mm * mean:.4g} mm would fit; if it is {diameter_mm:g} mm, "
            f"the lengths of the calibration are off (pitch of the plate)"
        )
    return Finding(title=title, severity=severity, measured=measured, advice=advice)


def _spread(ratio: Tensor) -> float:
    """Return the robust standard deviation of values, NaN left out."""
    return 1.4826 * float((ratio - ratio.nanmedian()).abs().nanmedian())


def size_of_one(look: Look) -> Finding:
    """Tell the size of the ball in one camera's pictures, which proves little: nearer and larger look alike."""
    title = f"size of the ball, {look.name}"
    radius = look.sightings.radius_px
    seen = 2 * radius[torch.isfinite(radius)]
    if not len(seen):
        measured, advice = "cannot tell: no ball was found", "see what is said of the ball"
        return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)
    usual = float(seen.median())
    measured = f"{usual:.1f} px across ({float(seen.min()):.1f} .. {float(seen.max()):.1f})"
    if look.expected_px is None:
        advice = f"set locate.diameter_px to {usual:.0f} (--set, or in the settings file)"
        return Finding(title=title, severity=Severity.WARNING, measured=measured + "; none expected", advice=advice)
    measured += f"; {look.expected_px:.1f} px expected in the middle of the volume"
    if look.diameter_px == look.expected_px or abs(usual / look.expected_px - 1) < VOLUME:
        return Finding(title=title, severity=Severity.OK, measured=measured)
    advice = f"check sphere.diameter and the camera, or set locate.diameter_px to {usual:.0f}"
    return Finding(title=title, severity=Severity.FAULT, measured=measured, advice=advice)
