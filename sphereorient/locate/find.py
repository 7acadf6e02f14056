from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.locate.background import Background
from sphereorient.locate.outline import Blob, Outline, find_blobs, fit_outline
from sphereorient.locate.settings import LocateSettings
from sphereorient.locate.sightings import Sightings
from sphereorient.trajectory import Reason

Found = tuple[Outline | None, Reason]


def find_ball(
    frame: NDArray[np.generic], background: Background, diameter_px: float, settings: LocateSettings
) -> Found:
    """Return the outline in a frame (H, W) and `OK`, or None and `NOT_FOUND`, `OUTLINE`, `DARK` or `SATURATED`.

    Source: paper section III A.
    """
    difference = background.difference(frame)
    blobs = find_blobs(difference, background.noise, diameter_px, settings)
    best: Outline | None = None
    likeliest = (False, 0.0)  # painted and supported ones first, then by coverage
    for blob in blobs:
        outline = fit_outline(difference, background.typical_noise, blob, diameter_px, settings, background.shown)
        if outline is not None:
            likely = (outline.painted and outline.coverage >= settings.coverage_min, outline.coverage)
            if best is None or likely > likeliest:
                best, likeliest = outline, likely
        # Usually the first blob; others are tried only if its rim is incomplete.
        if best is not None and best.painted and best.coverage >= max(settings.coverage_min, 0.5):
            break
    if best is None or best.coverage < settings.coverage_min:
        return None, _why_not(difference, diameter_px, background, blobs, settings)
    reason = _why_unreadable(frame, difference, background, best, settings)
    return (best, Reason.OK) if reason is Reason.OK else (None, reason)


def _why_not(
    difference: NDArray[np.float32],
    diameter_px: float,
    background: Background,
    blobs: list[Blob],
    settings: LocateSettings,
) -> Reason:
    if not blobs or blobs[0].merit <= 0:
        return Reason.NOT_FOUND
    u, v, half = int(blobs[0].u_px), int(blobs[0].v_px), int(0.5 * diameter_px)
    contrast = np.percentile(difference[max(0, v - half) : v + half + 1, max(0, u - half) : u + half + 1], 90)
    return Reason.DARK if contrast < settings.contrast_min * background.full_scale / 255 else Reason.OUTLINE


def _why_unreadable(
    frame: NDArray[np.generic],
    difference: NDArray[np.float32],
    background: Background,
    outline: Outline,
    settings: LocateSettings,
) -> Reason:
    half = int(0.7 * outline.radius_px)  # square inside the disk
    height, width = frame.shape
    u, v = min(max(round(outline.u_px), 0), width - 1), min(max(round(outline.v_px), 0), height - 1)
    inside = np.s_[max(0, v - half) : v + half + 1, max(0, u - half) : u + half + 1]
    if np.percentile(difference[inside], 90) < settings.contrast_min * background.full_scale / 255:
        return Reason.DARK
    if np.mean(frame[inside] >= background.full_scale) > settings.saturated_share:  # type: ignore[operator]
        return Reason.SATURATED
    return Reason.OK


def sightings_of(found: Iterable[Found]) -> Sightings:
    """Collect the results of `find_ball` in consecutive frames."""
    rows = list(found)
    table = torch.full((len(rows), 5), torch.nan, dtype=torch.float64)
    for k, (outline, _) in enumerate(rows):
        if outline is not None:
            values = (outline.u_px, outline.v_px, outline.radius_px, outline.rms_px, outline.coverage)
            table[k] = torch.tensor(values, dtype=torch.float64)
    return Sightings(
        centre_px=table[:, :2],
        radius_px=table[:, 2],
        outline_rms_px=table[:, 3],
        coverage=table[:, 4],
        flags=torch.zeros(len(rows), dtype=torch.int64),
        reason=tuple(reason for _, reason in rows),
    )
