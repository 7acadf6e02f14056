"""What size of disk to look for, and at what size to compare it."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from sphereorient.cameras import Camera, triangulate
from sphereorient.errors import ExperimentError, SettingsError, refusal
from sphereorient.locate.sightings import Sightings


def expected_diameter_px(name: str, cameras: Mapping[str, Camera], diameter_mm: float | None) -> float:
    """Return the diameter of the sphere's picture in the middle of the volume.

    The middle is where the lines of sight of two pictures' middles pass nearest, and the lab's origin, which the
    surveyed plate puts into the volume, for one camera.

    Args:
        name: of the camera.
        cameras: all that are used.
        diameter_mm: of the sphere; None: unknown.

    Raises:
        SettingsError: the diameter is unknown, or the one camera stands in the lab's origin (not calibrated).
    """
    camera = cameras[name]
    do = "set locate.diameter_px to the diameter of the ball in the picture"
    if diameter_mm is None:
        raise SettingsError(refusal("sphere.diameter", expected="a number of mm", got="null", do=do))
    middle = torch.zeros(3, dtype=torch.float64)
    if len(cameras) == 2:
        axes = [each.rays((torch.tensor(each.image_size, dtype=torch.float64) - 1) / 2) for each in cameras.values()]
        middle, _ = triangulate(axes[0], axes[1])
    # Two points half a diameter to the sides, at right angles to the camera's axis.
    right_lab = camera.R_cam_lab[0] * diameter_mm / 2
    rim = camera.project(torch.stack([middle - right_lab, middle + right_lab]))
    diameter_px = float((rim[1] - rim[0]).norm())
    if not 4 < diameter_px < max(camera.image_size):
        got = f"a sphere of {diameter_px:.3g} px in the middle of the volume"
        raise SettingsError(refusal(f"camera {name}", expected="a sphere that fits the picture", got=got, do=do))
    return diameter_px


def check_seen(sightings: Mapping[str, Sightings]) -> None:
    """Refuse an experiment in which no camera found the sphere in any frame.

    Raises:
        ExperimentError: with the reasons that the frames gave.
    """
    if any(bool(seen.placed.any()) for seen in sightings.values()):
        return
    reasons = ", ".join(sorted({str(why) for seen in sightings.values() for why in seen.reason}))
    do = "check sphere.diameter and the cameras, or set locate.diameter_px"
    raise ExperimentError(refusal("movies", expected="the sphere in some frame", got=f"none ({reasons})", do=do))


def size_of(sightings: Sightings, size_px: int | None) -> int:
    """Return the side of the disks' pictures: as set, or the movie's median diameter, whole px.

    Args:
        sightings: of one camera, with at least one frame in which it has the sphere.
        size_px: the setting, or None.
    """
    if size_px is not None:
        return size_px
    return max(16, round(2 * float(sightings.radius_px[sightings.placed].median())))
