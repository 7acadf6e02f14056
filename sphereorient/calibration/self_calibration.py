"""Check and repair of cameras that moved after their calibration, with the tracked sphere; reports of the results."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.comparison import GAP_PX, TURN_DEG, Limits, Seen
from sphereorient.calibration.contradictions import majority
from sphereorient.calibration.solve import inverse_information, least_squares, slopes_along
from sphereorient.cameras import Camera, ParameterCovariance, R_lab_view, Rays, load_cameras
from sphereorient.cameras.checks import camera_error, check_known
from sphereorient.cameras.parameters import ROTATION, TRANSLATION, with_parameters
from sphereorient.errors import Reason, TrackError
from sphereorient.trajectory import Tracks, Trajectory

OBSERVED = (str(Reason.OK), str(Reason.CONTRADICTS))
PARTS = ("centre_px", "orientation")  # of a camera in a track
MOVED = (*ROTATION, *TRANSLATION)
PRIOR = torch.tensor([0.1] * 3 + [2.0] * 3, dtype=torch.float64)  # sigma of a camera's displacement, rad and mm
BIAS_RAD = float(np.deg2rad(0.08))  # constant rotation error of one camera alone, as a dark rim shifts its centre
SHARED = 12  # consecutive frames with a common error of the centre, due to the same light
HELD_SHARE = 0.5  # of the prior's sigma: a parameter with a larger sigma after the fit is not determined
FRAMES_MIN = 20  # fewer do not separate a displacement from the scatter
OUTLIER = 5.0  # robust standard deviations beyond which a frame is left out
CONTRARY_SHARE = 0.5  # of the frames of both cameras; a reflection affects a few, a moved camera nearly all


@dataclass(frozen=True, kw_only=True, eq=False)
class Repaired:
    """Repaired cameras, consistent with each other."""

    cameras: Mapping[str, Camera]
    moved: Mapping[str, Tensor]  # camera -> (6,) rotation (rad, camera frame) and T (mm), as in `with_parameters`
    sigma: Mapping[str, Tensor]  # camera -> (6,)
    held: tuple[str, ...]  # parameters not determined by the sphere; the prior keeps them near their old values
    gap_before_mm: float  # rms distance between the lines of sight to the sphere's centre
    gap_after_mm: float
    frames: int  # with the sphere's orientation by two or more cameras


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraCheck:
    """Consistency of two cameras over a movie."""

    names: tuple[str, str]
    gap_mm: NDArray[np.float64]  # (n,), distance between the lines of sight to the sphere's centre
    miss_px: NDArray[np.float64]  # (n,), distance from each centre to the projected midpoint, the larger of the two

    def percentile(self, share: float) -> tuple[float, float]:
        """Return a percentile of both measures, mm and px."""
        return float(np.percentile(self.gap_mm, share)), float(np.percentile(self.miss_px, share))


def observations_of(tracks: Iterable[Trajectory], cameras: Mapping[str, Camera]) -> Seen:
    """Return the measurements of spheres by each camera alone, track after track; TrackError for an unknown camera."""
    parts = []
    for track in tracks:
        check_known(cameras, track.cameras, "track, camera", TrackError)
        each = [track.cameras[name] for name in cameras]
        missing = torch.from_numpy(~np.stack([np.isin(one.reason, OBSERVED) for one in each], 1))
        centre_px, R = (torch.from_numpy(np.stack([getattr(one, part) for one in each], 1)) for part in PARTS)
        centre_px[missing], R[missing] = torch.nan, torch.nan
        parts.append((centre_px, R))
    centre_px, R = (torch.cat(part) for part in zip(*parts, strict=True))
    return Seen(cameras=cameras, centre_px=centre_px, radius_px=centre_px[..., 0] * torch.nan, R_lab_body=R)


def check_cameras(cameras: Mapping[str, Camera], track: Trajectory) -> list[CameraCheck]:
    """Measure the distance between the lines of sight to the sphere's centre, for every pair of cameras."""
    seen, checks = observations_of([track], cameras), []
    for pair in seen.pairs:
        gaps = seen.gaps(pair)
        both = torch.isfinite(gaps.signed_mm)
        if bool(both.any()):
            one, other = (list(cameras)[k] for k in pair)
            there = torch.stack([cameras[name].project(gaps.position_lab_mm[both]) for name in (one, other)], 1)
            miss_px = (there - seen.centre_px[both][:, pair]).norm(dim=-1).amax(1).numpy()
            checks.append(CameraCheck(names=(one, other), gap_mm=gaps.signed_mm[both].abs().numpy(), miss_px=miss_px))
    return checks


def refine_with_track(cameras_path: Path | str, track_path: Path | str) -> Repaired:
    """Repair cameras (cameras.yaml) that moved after their calibration, with all spheres of a track.h5 made with them.
    CameraError for unreadable cameras or too few common frames; TrackError for a track of other cameras.
    """
    cameras, tracks = load_cameras(cameras_path), list(Tracks.load(track_path).values())
    used = {name: camera for name, camera in cameras.items() if name in tracks[0].cameras} or cameras
    return self_calibrate(observations_of(tracks, used))


def self_calibrate(seen: Seen) -> Repaired:
    """Rotate and shift two or more cameras until they see the sphere in one position and one orientation.
    One camera is fixed, since a common motion is not observable: the first one, or the first of a majority that agrees.
    The others are fitted one by one, each to all before it. Orientations may differ by a small constant rotation. A
    prior limits motions that change only the apparent size: distance, and motion in the common plane of the lines of
    sight. CameraError for one camera, or too few common frames.
    """
    names = list(seen.cameras)
    if len(names) < 2:
        do = "give the track of both cameras"
        raise camera_error("cameras", "two or more that saw the ball", f"{len(names)}", do)
    agree = majority(seen, Limits(gap_px=GAP_PX, turn_deg=TURN_DEG, size=1.0))
    first, *others = [*agree, *(k for k in range(len(names)) if k not in agree)]
    repaired, R_lab_body = dict(seen.cameras), seen.R_lab_body.clone()
    moved, sigma, held = {}, {}, [f"{names[first]}: all (the lab frame)"]
    before, after, frames = [], [], []
    for place, k in enumerate(others):
        name, camera = names[k], seen.cameras[names[k]]
        pair = _Pair(replace(seen, cameras=repaired, R_lab_body=R_lab_body), [first, *others[:place]], k)
        moved[name], sigma[name] = change, spread = pair.solved()
        repaired[name] = with_parameters(camera, MOVED, change)
        # The picture, interpreted with the repaired camera.
        R_view_body = R_lab_view(camera, seen.centre_px[:, k]).mT @ R_lab_body[:, k]
        R_lab_body[:, k] = R_lab_view(repaired[name], seen.centre_px[:, k]) @ R_view_body
        held += [f"{name}.{part}" for part, loose in zip(MOVED, spread > HELD_SHARE * PRIOR, strict=True) if loose]
        before.append(pair.gaps(torch.zeros(6, dtype=torch.float64)))
        after.append(pair.gaps(change))
        frames.append(pair.frames)
        if camera.covariance is not None:
            repaired[name] = _with_spread(repaired[name], camera.covariance, spread)
    return Repaired(
        cameras=repaired,
        moved=moved,
        sigma=sigma,
        held=tuple(held),
        gap_before_mm=float(torch.cat(before).square().mean().sqrt()),
        gap_after_mm=float(torch.cat(after).square().mean().sqrt()),
        frames=int(torch.stack(frames).any(0).sum()),
    )


class _Pair:
    """Residuals of one camera against others; unknowns (9,): its motion (6,) and a constant rotation bias."""

    def __init__(self, seen: Seen, still: Sequence[int], loose: int) -> None:
        cameras, pixels = list(seen.cameras.values()), seen.centre_px
        known = torch.isfinite(pixels).all(-1) & torch.isfinite(seen.R_lab_body).flatten(2).all(-1)
        each = {k: known[:, k] & known[:, loose] for k in still}
        self.frames = torch.stack([*each.values()]).any(0)  # (N,) bool, of the track
        if (count := int(self.frames.sum())) < FRAMES_MIN:
            both = f"{list(seen.cameras)[loose]} and another camera"
            expected = f"{FRAMES_MIN} frames or more in which {both} measure the ball's orientation"
            do = "pass a longer track, made with both cameras"
            raise camera_error("track", expected, f"{count}", do)
        self.loose = cameras[loose]
        rays = [cameras[k].rays(pixels[both, k]) for k, both in each.items()]
        names = ("origin_lab_mm", "direction_lab")
        self.ray = Rays(**{name: torch.cat([getattr(ray, name) for ray in rays]) for name in names})
        self.centre_px = torch.cat([pixels[both, loose] for both in each.values()])
        self.R_still = torch.cat([seen.R_lab_body[both, k] for k, both in each.items()])
        # The body's orientation relative to the camera, independent of the camera's pose in the lab.
        R_loose = torch.cat([seen.R_lab_body[both, loose] for both in each.values()])
        self.R_view_body = R_lab_view(self.loose, self.centre_px).mT @ R_loose

    def gaps(self, change: Tensor) -> Tensor:
        """Signed distances (N,) between the two lines of sight, mm."""
        ray = with_parameters(self.loose, MOVED, change).rays(self.centre_px)
        across = torch.linalg.cross(self.ray.direction_lab, ray.direction_lab)
        apart: Tensor = ((ray.origin_lab_mm - self.ray.origin_lab_mm) * across).sum(-1) / across.norm(dim=-1)
        return apart

    def rotations(self, change: Tensor) -> Tensor:
        """Rotation vectors (N, 3), rad, lab, from the loose camera's orientation of the body to the still one's."""
        camera = with_parameters(self.loose, MOVED, change)
        return so3.log(self.R_still @ (R_lab_view(camera, self.centre_px) @ self.R_view_body).mT)

    def solved(self) -> tuple[Tensor, Tensor]:
        """Return the motion (6,) and its sigmas from the scatter of frames at the solution."""
        at = torch.zeros(9, dtype=torch.float64)
        for _ in range(4):  # update scatter and inliers
            known = dict(zip(("spread", "kept"), self._scatter(at[:6]), strict=True))
            at = least_squares(partial(self._residuals, **known), partial(self._slopes, **known), at)
        slopes = self._slopes(at, *self._scatter(at[:6]))
        return at[:6], inverse_information(slopes.mT @ slopes).diagonal()[:6].sqrt()

    def _scatter(self, change: Tensor) -> tuple[Tensor, Tensor]:
        """Return the robust spread (4,) of gap (mm) and rotations (rad), and the inlier frames (N,)."""
        found = torch.cat([self.gaps(change)[:, None], self.rotations(change)], dim=-1)
        away = found - found.median(dim=0).values
        spread = (1.4826 * away.abs().median(dim=0).values).clamp_min(1e-6)
        # Reject frames: a soft loss would weaken the prior too, and mirrored orientations would still count.
        return spread, (away.abs() <= OUTLIER * spread).all(-1)

    def _residuals(self, at: Tensor, spread: Tensor, kept: Tensor) -> Tensor:
        scale = spread * SHARED**0.5
        gap = self.gaps(at[:6])[kept] / scale[0]
        rotation = (self.rotations(at[:6]) - at[6:])[kept] / scale[1:]
        return torch.cat([gap, rotation.reshape(-1), at[:6] / PRIOR, at[6:] / BIAS_RAD])

    def _slopes(self, at: Tensor, spread: Tensor, kept: Tensor) -> Tensor:
        return slopes_along(lambda x: self._residuals(x, spread, kept), at, torch.eye(9, dtype=torch.float64))


def _with_spread(camera: Camera, known: ParameterCovariance, spread: Tensor) -> Camera:
    """Replace the variances of the pose; its correlations with the lens are set to 0."""
    matrix = known.matrix.clone()
    for part, sigma in zip(MOVED, spread.tolist(), strict=True):
        if part in known.names:
            k = known.names.index(part)
            matrix[k], matrix[:, k], matrix[k, k] = 0.0, 0.0, sigma**2
    return cast(Camera, replace(cast(Any, camera), covariance=replace(known, matrix=matrix)))


def repair_lines(result: Repaired) -> list[str]:
    """Return the changes of a self-calibration."""
    gaps = f"{result.gap_before_mm:.4f} mm rms, now {result.gap_after_mm:.4f} mm ({result.frames} frames)"
    lines = [f"distance between the lines of sight to the sphere: {gaps}"]
    for name, change in result.moved.items():
        turn, move = math.degrees(float(change[:3].norm())), float(change[3:].norm())
        lines.append(f"{name}: rotated by {turn:.3f} degrees, T changed by {move:.2f} mm")
        for part, value, sigma in zip(MOVED, change.tolist(), result.sigma[name].tolist(), strict=True):
            lines.append(f"  {part}: {value:+.3g} (sigma {sigma:.2g})")
    return [*lines, f"not determined by the sphere, kept: {', '.join(result.held)}"]


def check_lines(checks: Sequence[CameraCheck]) -> list[str]:
    """Return how well each pair of cameras agrees."""
    each = ((check, *check.percentile(50), *check.percentile(95)) for check in checks)
    return [
        f"{' and '.join(check.names)}: lines of sight miss each other by {gap:.4f} mm (median), {gap95:.4f} mm (95 %); "
        f"pictures by {miss:.3f} px, {miss95:.3f} px; {len(check.gap_mm)} frames"
        for check, gap, miss, gap95, miss95 in each
    ]


def contradiction_lines(track: Trajectory) -> list[str]:
    """Return advice if the cameras disagree on the sphere's position in most of a movie; else an empty list."""
    reasons = [camera.reason for camera in track.cameras.values()]
    seen = [frame for frame in zip(*reasons, strict=True) if sum(why in OBSERVED for why in frame) > 1]
    contrary = sum(Reason.CONTRADICTS in frame for frame in seen)
    if contrary <= CONTRARY_SHARE * len(seen):
        return []
    both = "both" if len(reasons) == 2 else "two or more"
    return [
        f"The cameras contradict each other in {contrary} of the {len(seen)} frames in which {both} see the sphere: "
        "one has moved since its calibration, cameras.yaml is of another set-up, or a movie lost or doubled frames.",
        "Find out: sphereorient check EXPERIMENT reports movies that are out of step. If they are not, repair the "
        "cameras: sphereorient calibrate CAMERAS.yaml --refine-with TRACK.h5 --out REPAIRED.yaml, name REPAIRED.yaml "
        "in experiment.yaml, and track again. If that does not help, take new pictures of the plate.",
    ]
