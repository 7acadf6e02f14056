"""Orientations of a fixed ball without prior knowledge, frame by frame, by a map that grows with each."""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import CoarserCamera
from sphereorient.errors import PaintError, Reason, refusal
from sphereorient.experiment.recording import Recording
from sphereorient.files.threads import Progress, counted, silent
from sphereorient.follow.chunk import LEAST_CHANGE
from sphereorient.locate import Background, Frame, screened_frames
from sphereorient.locate.outline import coarser
from sphereorient.mapping.adjustment import Adjustment, adjusted, cells_of, place_metric, within_limb
from sphereorient.mapping.disks import FOLLOWED, Crop, Crops, cut_out, evenly_spread
from sphereorient.mapping.paint_cells import BallView
from sphereorient.pose.camera_view import FIRST_BLUR_PX, CameraView, Optics
from sphereorient.pose.fit import NEAR_RAD
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.lights.disk import DiskLight
from sphereorient.pose.poses import FittedPoses, Poses, PoseStart, no_pose, poses_of, supported

Picture = NDArray[Any]
LEAST_RADIUS_PX = 45.0  # of pictures with coarser pixels
GREY = 128.0  # mean of even pictures; also the scene around the ball, so that the limb has no contrast
CONTRAST = 50.0  # their standard deviation
WINDOW = 0.35  # half side, radii, of the neighbourhood over which light counts as even
EVENER = 0.25  # share of the whole disk's power added to that of the neighbourhood
REACH = 1.2  # of the radius: half side of a crop
CELL_PX = 0.75  # of the map, at the disk's centre
NOISE = 10.0  # grey levels, of even pictures
LEAST_SCORE = 0.3  # of a picture explained by the map
USUAL_OF = 200  # frames for the usual score
SURE_SHARE = 0.7  # of it, in a search over all orientations: the best wrong one scores less
OUTLINE_ERROR, ADJUSTED_ERROR = 0.01, 5e-4  # of the position, radii in pictures: by an outline, by all pictures
HELD = 1e12  # 1/radius^2, precision that fixes the centre in fits
STEP_DEG, REACH_DEG = 8.0, 40.0  # of the grid of rotations about the expectation, tried if that fails
WHOLE_STEP_DEG = 12.0  # of the grid of all orientations, tried if these fail
TURNED_RAD = math.radians(20.0)  # least rotation of the ball
BEGIN = 300  # first frames, for the first adjustment of position and map
MAPPED = 80  # frames of an adjustment, at most twice as many
APART_RAD = 0.025  # least rotation between these
LEAST_FOUND = 0.5  # least share of frames explained
TRIED_EVERY, TRIED_STEPS, TRIED_BEST = 16, 2, 4  # each n-th pixel, iterations and number of fits in a search


@dataclass(frozen=True, kw_only=True, eq=False)
class CoarserPictures:
    """Pictures of a large ball in coarser pixels, sufficient for a first pass."""

    place: Crops  # in coarser pixels
    whole: Sequence[CameraView]  # the views as filmed
    factor: int

    @classmethod
    def of(cls, place: Crops) -> "CoarserPictures":
        """Return those of a ball at a position."""
        X = place.usual
        radius_px = min(float(view.radius_px(X, place.radius_mm)) for view in place.views)
        factor = max(1, int(radius_px / LEAST_RADIUS_PX))
        coarse = replace(place, views=[_coarser_view(view, factor) for view in place.views])
        return cls(place=coarse, whole=place.views, factor=factor)

    def frames(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Return the frames of all cameras in coarser pixels."""
        if self.factor == 1:
            return frames
        # Unusable pictures are not read.
        return [Frame(shown=coarser(shot.picture.astype(np.float32), self.factor), read=shot.reason) for shot in frames]


def _coarser_view(view: CameraView, factor: int) -> CameraView:
    if factor == 1:
        return view
    scene, shown = view.background, view.background.shown
    mean, noise = (coarser(part, factor) for part in (scene.mean, scene.noise))
    shown = None if shown is None else coarser(shown.astype(np.float32), factor) == 1.0
    background = Background(mean=mean, noise=noise / np.float32(factor), full_scale=scene.full_scale, shown=shown)
    diameter_px = view.diameter_px / factor
    coarse = replace(view.scene, background=background, diameter_px=diameter_px)
    return CameraView.of(view.name, CoarserCamera(camera=view.camera, factor=factor), coarse)


class EvenLight:
    """Evens pictures of one camera: grey minus the local mean, over the local deviation."""

    def __init__(self, view: CameraView, position_lab_mm: Tensor, radius_mm: float) -> None:
        u, v = view.camera.project(position_lab_mm).tolist()
        radius_px = float(view.radius_px(position_lab_mm, radius_mm))
        width, height = view.camera.image_size
        reach = int(REACH * radius_px) + 2
        # At least one pixel, also of a ball beside the picture.
        self.left, self.top = min(max(0, round(u) - reach), width - 1), min(max(0, round(v) - reach), height - 1)
        right, down = min(width, round(u) + reach + 1), min(height, round(v) + reach + 1)
        self._there = np.s_[self.top : max(down, self.top + 1), self.left : max(right, self.left + 1)]
        within = within_limb(view, position_lab_mm, radius_mm, self._there)
        self.counts = torch.from_numpy(within)
        self._within = within.astype(np.float32)
        self._window = (2 * int(WINDOW * radius_px) + 1,) * 2
        self._share = np.asarray(1 / np.maximum(self._mean(self._within), 1e-3), np.float32)
        self._number = max(float(self._within.sum()), 1.0)  # 0: hidden by the mask

    def _mean(self, picture: NDArray[np.float32]) -> NDArray[np.float32]:
        for _ in range(2):  # nearly a Gaussian
            picture = np.asarray(cv2.boxFilter(picture, -1, self._window, borderType=cv2.BORDER_CONSTANT), np.float32)
        return picture

    def __call__(self, picture: Picture) -> NDArray[np.float32]:
        """Return the even crop of a picture (H, W)."""
        grey = picture[self._there].astype(np.float32) * self._within
        away = (grey - self._mean(grey) * self._share) * self._within
        square = away * away
        power = self._mean(square) * self._share + EVENER * float(square.sum()) / self._number
        even: NDArray[np.float32] = GREY + CONTRAST * away / np.sqrt(power + 1e-6)
        return even

    def framed(self, even: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return a whole picture (H, W) with an even part."""
        whole = np.full(shape, GREY, np.float32)
        whole[self._there] = even
        return whole


class FirstPass:
    """Tracks a fixed ball by the map of earlier frames; the body frame is the lab at the first frame."""

    def __init__(self, place: Crops, error: float = OUTLINE_ERROR) -> None:
        """`place`: empty crops with the position; `error`: its error, radii in pictures. A moving ball's position comes
        with each frame, and is adjusted within this error unless only outlines give it.
        """
        radius_mm = place.radius_mm
        self._place_covariance = torch.linalg.inv(place_metric(place)) * (error * radius_mm) ** 2  # mm^2
        self._ball = place
        self._go_to(place.usual)
        self._views = self._views_at(place.usual)  # of a fixed ball
        known = place.position_lab_mm[torch.isfinite(place.position_lab_mm).all(1)]
        sizes = [view.radius_px(known, radius_mm).max() for view in place.views]
        diameter_px = 2 * max(map(float, sizes))
        self.cells = cells_of(place, CELL_PX)
        noise = torch.tensor([[NOISE**2, 0.0, 0.0, 0.0]] * len(place.views))
        self._fitter = Fitter(
            views=[replace(view, background=_even_scene(view), response=None) for view in place.views],
            radius_mm=radius_mm,
            optics=Optics(self.cells.table, FIRST_BLUR_PX, diameter_px),
            light=replace(DiskLight.unknown(len(place.views), noise), known=True),
            widest_px=diameter_px / 2,
        )
        held = HELD / radius_mm**2 * torch.eye(3, dtype=torch.float64)
        free = error < OUTLINE_ERROR and not place.fixed
        self._precision = torch.linalg.inv(self._place_covariance) if free else held
        self._near = so3.local_grid(math.radians(STEP_DEG), math.radians(REACH_DEG))
        self._before: tuple[float, Tensor] | None = None  # time, s, and R_lab_body (3, 3)
        self._rate, self._change = torch.zeros(2, 3, dtype=torch.float64)  # rad/s, and its last change
        self._lost = 0  # unexplained frames in a row
        self._usual, self._count = 0.0, 1  # score of explained frames, and their number

    def _go_to(self, position_lab_mm: Tensor) -> None:
        """Use a position (3,) from now on."""
        self._X = position_lab_mm
        self._even = [EvenLight(view, self._X, self._ball.radius_mm) for view in self._ball.views]

    def next(
        self, time_s: float, frames: Sequence[Frame], there: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Poses, bool]:
        """Return the pose of a frame (none if the map does not explain it), and whether it was searched for; the map
        grows by the frame. `there`: the position (3,) of a moving ball, and the cameras (C,) that see it.
        """
        use = torch.tensor([shot.usable for shot in frames])
        reason = [shot.reason for shot in frames]
        if there is not None:
            reason = [why if sees else Reason.NOT_FOUND for why, sees in zip(reason, there[1].tolist(), strict=True)]
            use = use & there[1]
        if not bool(use.any()):
            return no_pose(len(frames), reason), False
        if there is not None:
            self._go_to(there[0])
        even = [light(shot.picture) for light, shot in zip(self._even, frames, strict=True)]
        if self._before is None:
            R = torch.eye(3, dtype=torch.float64)
            self._grow(even, use, R, self._X)  # the map is this frame
            self._before = time_s, R
            return self._placed(self._settled([even], R[None], use), use, reason), True
        step_s, before = time_s - self._before[0], self._before[1]
        fit, searched = self._fitted(max(step_s, 0.0), before, even, use)
        if fit is None:
            self._lost, self._rate, self._change = self._lost + 1, *torch.zeros(2, 3, dtype=torch.float64)
            return no_pose(len(frames), reason, use), True
        R = fit.R_lab_body[0]
        rate = so3.log(R @ before.mT) / step_s if step_s > 0 else torch.zeros(3, dtype=torch.float64)
        rate = rate * (not searched)
        self._change = rate - self._rate if bool(self._rate.any()) else self._change
        self._rate, self._before, self._lost = rate, (time_s, R), 0
        score = float(_mean_score(fit, use)) / int(use.sum())
        self._usual += (score - self._usual) / min(self._count, USUAL_OF)
        self._count += 1
        self._grow(even, use, R, fit.position_lab_mm[0])
        return self._placed(fit, use, reason), searched

    def _placed(self, fit: FittedPoses, use: Tensor, reason: Sequence[Reason]) -> Poses:
        poses = poses_of(fit, slice(0, 1), use, reason)
        if self._ball.fixed:
            poses.covariance[:, 3:, 3:] = self._place_covariance
        return poses

    def shown(self, crops: Crops, R_lab_body: Tensor) -> "FirstPass":
        """Return this pass after its map has grown by crops (N) at known orientations (N, 3, 3)."""
        for k, use in enumerate(crops.seen):
            pictures, X = crops.pictures(torch.tensor([k]))[0], crops.place(k)
            if not crops.fixed:
                self._go_to(X)
            even = [light(one) for light, one in zip(self._even, pictures, strict=True)]
            self._grow(even, use, R_lab_body[k], X)
        return self

    def begin(self, time_s: float, R_lab_body: Tensor) -> None:
        """Begin at a time near an orientation (3, 3)."""
        self._before = time_s, R_lab_body

    def follow(self, before: "FirstPass", correction: Tensor) -> None:
        """Continue another pass, with its orientation times a correction (3, 3), in the lab."""
        assert before._before is not None
        self._before = before._before[0], correction @ before._before[1]
        self._rate, self._change, self._lost = before._rate, before._change, before._lost
        self._usual, self._count = before._usual, before._count

    def _grow(self, even: Sequence[NDArray[np.float32]], use: Tensor, R_lab_body: Tensor, X: Tensor) -> None:
        views = self._views if self._ball.fixed else self._views_at(X)
        for view, light, one, seen in zip(views, self._even, even, use.tolist(), strict=True):
            if seen:
                self.cells.add(view, torch.from_numpy(one), light.counts, (light.left, light.top), R_lab_body)

    def _views_at(self, X: Tensor) -> list[BallView]:
        return [BallView.of(view.camera, X, self._ball.radius_mm) for view in self._ball.views]

    def _fitted(
        self, step_s: float, R: Tensor, even: Sequence[NDArray[np.float32]], use: Tensor
    ) -> tuple[FittedPoses | None, bool]:
        """Fit near the expected orientation, else near any within reach, else near any at all; return also whether the
        frame was searched for. None: unexplained at all orientations.
        """
        expected = so3.exp(step_s * (self._rate + LEAST_CHANGE * self._change)) @ R
        fit = self._settled([even], expected[None], use)
        if bool(self._explained(fit, use)[0]):
            return fit, False
        fit = self._searched(even, use, self._near @ R)
        if not bool(self._explained(fit, use)[0]) and self._lost & (self._lost - 1) == 0:  # frames 0, 1, 2, 4, 8 ..
            fit = self._searched(even, use, so3.lattman_grid(math.radians(WHOLE_STEP_DEG)))
            if float(_mean_score(fit, use)) < SURE_SHARE * self._usual * int(use.sum()):
                return None, True
        return (fit if bool(self._explained(fit, use)[0]) else None), True

    def _searched(self, even: Sequence[NDArray[np.float32]], use: Tensor, R: Tensor) -> FittedPoses:
        """Return the best of the fits that start at orientations (M, 3, 3)."""
        frames, begin = self._start([even], R, use)
        level = self._fitter.optics.fine
        one = self._fitter.pixels(frames, self._X[None], level).thinned(TRIED_EVERY)
        tried = self._fitter.fit(one.where(torch.arange(len(use)).repeat(len(R))), begin, level, TRIED_STEPS)
        best = _mean_score(tried, use).topk(TRIED_BEST).indices
        fit = self._settled([even] * TRIED_BEST, tried.R_lab_body[best], use)
        return fit.of(_mean_score(fit, use).argmax()[None])

    def _start(
        self, even: Sequence[Sequence[NDArray[np.float32]]], R: Tensor, use: Tensor
    ) -> tuple[list[list[NDArray[np.float32]]], PoseStart]:
        """Return whole pictures, and the start of fits at orientations (B, 3, 3)."""
        shapes = [view.camera.image_size[::-1] for view in self._fitter.views]
        lights = list(zip(self._even, shapes, strict=True))
        frames = [[light.framed(one, shape) for (light, shape), one in zip(lights, row, strict=True)] for row in even]
        many = self._X.expand(len(R), 3), R, use.expand(len(R), -1), self._precision.expand(len(R), 3, 3)
        return frames, PoseStart(*many, held=True)

    def _settled(self, even: Sequence[Sequence[NDArray[np.float32]]], R: Tensor, use: Tensor) -> FittedPoses:
        return self._fitter.settled(*self._start(even, R, use))

    def _explained(self, fit: FittedPoses, use: Tensor) -> Tensor:
        """Return which fits (B,) have converged and explain all pictures in use."""
        arrived: Tensor = fit.step[:, :3].norm(dim=1) < NEAR_RAD
        return arrived & ((fit.score > LEAST_SCORE) | ~use).all(1)


def _even_scene(view: CameraView) -> Background:
    flat = np.full(view.background.mean.shape, GREY, np.float32)
    return Background(mean=flat, noise=np.full_like(flat, NOISE), full_scale=math.inf, shown=view.background.shown)


def _mean_score(fit: FittedPoses, use: Tensor) -> Tensor:
    score: Tensor = (fit.score * use).sum(1)
    return score


@dataclass(eq=False)
class _Kept:
    crops: list[Crop]  # of each camera
    use: Tensor  # (C,) bool
    R_lab_body: Tensor  # (3, 3)
    X: Tensor  # (3,)


class KeptFrames:
    """The frames for adjustments, at least a rotation apart that doubles whenever there are too many."""

    def __init__(self, place: Crops) -> None:
        self.count = 0  # of kept frames, removed ones included
        self._place, self._apart_rad = place, APART_RAD
        self._rows: list[_Kept] = []

    @property
    def turned_rad(self) -> float:
        """The largest rotation from the first frame to another."""
        turns = [so3.geodesic_distance(self._rows[0].R_lab_body, one.R_lab_body) for one in self._rows]
        return max(map(float, turns), default=0.0)

    @property
    def path_rad(self) -> float:
        """The sum of the rotations from each frame to the next."""
        R = [one.R_lab_body for one in self._rows]
        return sum(float(so3.geodesic_distance(a, b)) for a, b in pairwise(R))

    def add(self, frames: Sequence[Frame], poses: Poses) -> None:
        """Keep a frame with a pose if the ball has rotated since the last kept one."""
        R = poses.R_lab_body[0]
        if self._rows and float(so3.geodesic_distance(self._rows[-1].R_lab_body, R)) < self._apart_rad:
            return
        self.count += 1
        X = poses.position_lab_mm[0]
        crops = cut_out(self._place, [shot.picture for shot in frames], None if self._place.fixed else X)
        self._rows.append(_Kept(crops, poses.use, R, X))
        if len(self._rows) == 2 * MAPPED:
            self._rows, self._apart_rad = self._rows[::2], 2 * self._apart_rad

    def arrays(self) -> tuple[list[list[Crop]], NDArray[np.bool_], NDArray[np.float64]]:
        """Return all crops, use (N, C) and orientations (N, 3, 3), without tensors, for another process."""
        crops, use, R, _ = self._parts(self._rows)
        return crops, use.numpy(), R.numpy()

    def so_far(self) -> "KeptFrames":
        """Return a snapshot of these frames."""
        same = copy(self)
        same._rows = list(self._rows)
        return same

    def corrected(self, done: "KeptFrames", R_lab_body: Tensor) -> tuple[Tensor, "KeptFrames"]:
        """Take orientations (N, 3, 3) of an adjustment of earlier frames, and continue the later ones from there: a
        wrong position scales all rotations alike. Return the correction (3, 3), lab, of the last frame, and the later
        frames.
        """
        since, before = self.so_far(), set(map(id, done._rows))
        since._rows = [one for one in self._rows if id(one) not in before]
        was = torch.stack([one.R_lab_body for one in done._rows])
        steps, right = (so3.log(R[1:] @ R[:-1].mT) for R in (was, R_lab_body))
        share = float((steps * right).sum() / steps.square().sum().clamp_min(1e-12))
        old, new = was[-1], R_lab_body[-1]
        for one in since._rows:
            R = so3.exp(share * so3.log(one.R_lab_body @ old.mT)) @ new
            old, new, one.R_lab_body = one.R_lab_body, R, R
        for one, R in zip(done._rows, R_lab_body, strict=True):
            one.R_lab_body = R
        return new @ old.mT, since

    def adjusted(self, progress: Progress = silent) -> Adjustment:
        """Adjust position, orientations and map. Raises PaintError: the ball has not rotated."""
        if self.turned_rad < TURNED_RAD:
            got = f"{math.degrees(self.turned_rad):.2g} degrees in all frames together"
            do = "use a movie in which the ball rotates"
            raise PaintError(refusal("movies", expected="a ball that rotates", got=got, do=do))
        return adjusted(*self.crops(), progress)

    def crops(self, most: int = 2 * MAPPED) -> tuple[Crops, Tensor]:
        """Return the frames, evenly spread if there are more, and their orientations (N, 3, 3)."""
        some = evenly_spread(torch.arange(len(self._rows)), most).tolist() if self._rows else []
        crops, use, R, X = self._parts([self._rows[k] for k in some])
        return self._place.holding(crops, use, None if self._place.fixed else X), R

    def _parts(self, rows: Sequence[_Kept]) -> tuple[list[list[Crop]], Tensor, Tensor, Tensor]:
        use = torch.zeros(len(rows), len(self._place.views), dtype=torch.bool)
        R, X = torch.zeros(len(rows), 3, 3, dtype=torch.float64), torch.zeros(len(rows), 3, dtype=torch.float64)
        for n, one in enumerate(rows):
            use[n], R[n], X[n] = one.use, one.R_lab_body, one.X
        return [one.crops for one in rows], use, R, X


def first_adjustment(recording: Recording, place: Crops, progress: Progress) -> Adjustment:
    """Adjust the first frames of a ball near a position, see `held_place`; the body frame is the lab at the first frame
    with the ball. A few frames give position and map; by these, more are tracked and adjusted again. Raises PaintError:
    the ball does not rotate, or the map explains hardly any frame.
    """
    coarse, count = CoarserPictures.of(place), min(FOLLOWED, len(recording.timeline))
    found, kept = swept(recording, coarse, FirstPass(coarse.place), min(count, BEGIN), progress)
    if kept.turned_rad < TURNED_RAD and count > BEGIN:  # the ball rests at first
        found, kept = swept(recording, coarse, FirstPass(coarse.place), count, progress)
    adjustment = kept.adjusted(progress)
    if count > len(found):
        found, kept = swept(recording, *_after(adjustment, coarse, recording), count, progress)
        adjustment = kept.adjusted(progress)
    seen, shown = sum(map(supported, found)), count if place.fixed else int(place.seen[:count].any(1).sum())
    if seen < LEAST_FOUND * shown:
        got, do = f"{seen} of {shown} frames fit the map of earlier ones", "learn the map with `sphereorient map`"
        raise PaintError(refusal("movies", expected="a ball whose paint is seen again", got=got, do=do))
    return adjustment


def followed_by(adjustment: Adjustment, recording: Recording, place: Crops, progress: Progress) -> list[Poses]:
    """Return the poses of all frames by position and map of an adjustment, `place` as given to it."""
    after = _after(adjustment, CoarserPictures.of(place), recording)
    return swept(recording, *after, len(recording.timeline), progress)[0]


def _after(adjustment: Adjustment, coarse: CoarserPictures, recording: Recording) -> tuple[CoarserPictures, FirstPass]:
    """Return the pictures with the adjusted position, and a pass with the map."""
    follower = FirstPass(adjustment.crops, ADJUSTED_ERROR).shown(adjustment.crops, adjustment.R_lab_body)
    follower.begin(float(recording.timeline.time_s[0]), adjustment.R_lab_body[0])
    X = coarse.place.position_lab_mm + adjustment.moved_mm
    return replace(coarse, place=replace(coarse.place, position_lab_mm=X)), follower


def swept(
    recording: Recording, coarse: CoarserPictures, follower: FirstPass, count: int, progress: Progress
) -> tuple[list[Poses], KeptFrames]:
    """Track the first `count` frames; return their poses and the kept frames."""
    pairs = zip(recording.streams, coarse.whole, strict=True)
    rows = zip(*(screened_frames(stream, view.background, 0, count) for stream, view in pairs), strict=True)
    kept, found = KeptFrames(coarse.place), list[Poses]()
    for k, row in enumerate(counted("first pass", rows, count, progress)):
        frames = coarse.frames(row)
        there = None if coarse.place.fixed else (coarse.place.position_lab_mm[k], coarse.place.seen[k])
        poses, _ = follower.next(float(recording.timeline.time_s[k]), frames, there)
        found.append(poses)
        if supported(poses):
            kept.add(frames, poses)
    return found, kept
