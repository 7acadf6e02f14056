"""Orientations of a ball in its place, frame by frame, by a map that grows with each: nothing is known before."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import PaintError, Reason, refusal
from sphereorient.experiment.recording import Recording, TextureMap, spread_frames
from sphereorient.files.threads import Progress, counted
from sphereorient.follow.chunk import LEAST_CHANGE
from sphereorient.locate import Background, Frame, screened_frames
from sphereorient.mapping.adjustment import adjusted, cells_of
from sphereorient.mapping.disks import Crops, cut_out
from sphereorient.mapping.paint_cells import BallView
from sphereorient.pose.camera_view import FIRST_BLUR_PX, CameraView, Optics
from sphereorient.pose.fit import NEAR_RAD
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.lights.disk import DiskLight
from sphereorient.pose.poses import FittedPoses, Poses, PoseStart, no_pose, poses_of, supported

Picture = NDArray[Any]
GREY = 128.0  # of even pictures: their mean; as the scene about the ball, so that its limb does not show
CONTRAST = 50.0  # of these, the deviation from it
WINDOW = 0.35  # half side, radii, of the neighbourhood over which light is taken as even
EVENER = 0.25  # share of the whole disk's power that is added to that of the neighbourhood
WITHIN = 0.98  # of the radius: pixels that count
REACH = 1.2  # of the radius: half side of what is cut out
CELL_PX = 0.75  # of the map, in the disk's middle
NOISE = 10.0  # grey levels, of even pictures
LEAST_SCORE = 0.3  # of a picture that the map explains
HELD = 1e12  # 1/radius^2, precision of the centre at which fits are held
STEP_DEG, REACH_DEG = 8.0, 40.0  # of the grid of turns that are tried where the ball is not where it is expected
TURNED = math.radians(20.0)  # the ball turns by more
MOST_FRAMES = 3000  # of a movie that are followed: by then the ball has shown its sides
MAPPED = 150  # of them, evenly spread, that place and map are adjusted by
LEAST_FOUND = 0.5  # share of the frames
TRIED_EVERY, TRIED_STEPS, TRIED_BEST = 16, 2, 4  # pixels and iterations of these, and how many are fitted


class EvenLight:
    """Makes pictures of one camera even: grey less the mean of its neighbourhood, over the deviation there."""

    def __init__(self, view: CameraView, position_lab_mm: Tensor, radius_mm: float) -> None:
        u, v = view.camera.project(position_lab_mm).tolist()
        radius_px = float(view.radius_px(position_lab_mm, radius_mm))
        width, height = view.camera.image_size
        reach = int(REACH * radius_px) + 2
        self.left, self.top = max(0, round(u) - reach), max(0, round(v) - reach)
        self._there = np.s_[self.top : min(height, round(v) + reach + 1), self.left : min(width, round(u) + reach + 1)]
        y, x = np.mgrid[self._there]
        within = np.hypot(x - u, y - v) < WITHIN * radius_px
        if view.background.shown is not None:
            within &= view.background.shown[self._there]
        self.counts = torch.from_numpy(within)
        self._within = within.astype(np.float32)
        self._window = (2 * int(WINDOW * radius_px) + 1,) * 2
        self._share = 1 / np.maximum(self._mean(self._within), 1e-3)
        self._number = float(self._within.sum())

    def _mean(self, picture: NDArray[np.float32]) -> NDArray[np.float32]:
        for _ in range(2):  # nearly a Gaussian
            picture = np.asarray(cv2.boxFilter(picture, -1, self._window, borderType=cv2.BORDER_CONSTANT), np.float32)
        return picture

    def __call__(self, picture: Picture) -> NDArray[np.float32]:
        """Return what is cut out of a picture (H, W), even."""
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
    """Follows a ball in its place by the map of the frames before: the body frame is the lab at the first one."""

    def __init__(self, place: Crops) -> None:
        X, radius_mm = place.position_lab_mm[0], place.radius_mm
        self._X, self._even = X, [EvenLight(view, X, radius_mm) for view in place.views]
        self._views = [BallView.of(view.camera, X, radius_mm) for view in place.views]
        diameter_px = 2 * max(float(view.radius_px(X, radius_mm)) for view in place.views)
        self.cells = cells_of(place, CELL_PX)
        noise = torch.tensor([[NOISE**2, 0.0, 0.0, 0.0]] * len(place.views))
        self._fitter = Fitter(
            views=[replace(view, background=_even_scene(view), response=None) for view in place.views],
            radius_mm=radius_mm,
            optics=Optics(self.cells.table, FIRST_BLUR_PX, diameter_px),
            light=replace(DiskLight.unknown(len(place.views), noise), known=True),
            widest_px=diameter_px / 2,
        )
        self._precision = HELD / radius_mm**2 * torch.eye(3, dtype=torch.float64)
        self._grid = so3.local_grid(math.radians(STEP_DEG), math.radians(REACH_DEG))
        self._before: tuple[float, Tensor] | None = None  # time, s, and R_lab_body (3, 3)
        self._rate, self._change = torch.zeros(2, 3, dtype=torch.float64)  # rad/s, and its last change

    def next(self, time_s: float, shots: Sequence[Frame]) -> Poses:
        """Return the pose of the frame of a time, none where the map does not explain it; the map grows by it."""
        use = torch.tensor([shot.usable for shot in shots])
        reason = [shot.reason for shot in shots]
        if not bool(use.any()):
            return no_pose(len(shots), reason)
        even = [light(shot.picture) for light, shot in zip(self._even, shots, strict=True)]
        if self._before is None:
            R = torch.eye(3, dtype=torch.float64)
            self._grow(even, use, R)  # the map is this frame
            self._before = time_s, R
            return poses_of(self._settled([even], R[None], use), slice(0, 1), use, reason)
        step_s, before = time_s - self._before[0], self._before[1]
        fit = self._fitted(max(step_s, 0.0), before, even, use)
        if fit is None:
            self._rate, self._change = torch.zeros(2, 3, dtype=torch.float64)
            return no_pose(len(shots), [Reason.LOW_SCORE if why is Reason.OK else why for why in reason], use)
        R = fit.R_lab_body[0]
        rate = so3.log(R @ before.mT) / step_s if step_s > 0 else torch.zeros(3, dtype=torch.float64)
        self._change = rate - self._rate if bool(self._rate.any()) else self._change
        self._rate, self._before = rate, (time_s, R)
        self._grow(even, use, R)
        return poses_of(fit, slice(0, 1), use, reason)

    def _grow(self, even: Sequence[NDArray[np.float32]], use: Tensor, R_lab_body: Tensor) -> None:
        for view, light, one, seen in zip(self._views, self._even, even, use.tolist(), strict=True):
            if seen:
                self.cells.add(view, torch.from_numpy(one), light.counts, (light.left, light.top), R_lab_body)

    def _fitted(self, step_s: float, R: Tensor, even: Sequence[NDArray[np.float32]], use: Tensor) -> FittedPoses | None:
        """Fit near the expected orientation, else near any within reach; None: the map explains the frame nowhere."""
        expected = so3.exp(step_s * (self._rate + LEAST_CHANGE * self._change)) @ R
        fit = self._settled([even], expected[None], use)
        if bool(self._explained(fit, use)[0]):
            return fit
        frames, begin = self._start([even], self._grid @ R, use)
        level, count = self._fitter.optics.fine, len(self._grid)
        one = self._fitter.pixels(frames, self._X[None], level).thinned(TRIED_EVERY)
        tried = self._fitter.fit(one.where(torch.arange(len(use)).repeat(count)), begin, level, TRIED_STEPS)
        best = _mean_score(tried, use).topk(TRIED_BEST).indices
        fit = self._settled([even] * TRIED_BEST, tried.R_lab_body[best], use)
        rows = _mean_score(fit, use).argmax()[None]
        return fit.of(rows) if bool(self._explained(fit, use)[rows]) else None

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
        """Return which fits (B,) have arrived, and explain all pictures in use."""
        arrived: Tensor = fit.step[:, :3].norm(dim=1) < NEAR_RAD
        return arrived & ((fit.score > LEAST_SCORE) | ~use).all(1)


def _even_scene(view: CameraView) -> Background:
    flat = np.full(view.background.mean.shape, GREY, np.float32)
    return Background(mean=flat, noise=np.full_like(flat, NOISE), full_scale=math.inf, shown=view.background.shown)


def _mean_score(fit: FittedPoses, use: Tensor) -> Tensor:
    score: Tensor = (fit.score * use).sum(1)
    return score


def first_pass_map(recording: Recording, place: Crops, progress: Progress) -> TextureMap:
    """Return the map of a ball near a place, see `fixed_place`, from the first frames of its movies; the body frame is
    the lab at the first frame that shows it.
    Raises PaintError: the ball does not turn, or the map explains hardly a frame.
    """
    count = min(MOST_FRAMES, len(recording.timeline))
    kept = set(spread_frames(range(count), MAPPED))
    pairs = zip(recording.streams, place.views, strict=True)
    shots = zip(*(screened_frames(stream, view.background, 0, count) for stream, view in pairs), strict=True)
    follower, crops, turns, used = FirstPass(place), [], [], []
    first: Tensor | None = None
    turned, found = 0.0, 0
    for k, row in enumerate(counted("first pass", shots, count, progress)):
        poses = follower.next(float(recording.timeline.time_s[k]), row)
        if not supported(poses):
            continue
        R = poses.R_lab_body[0]
        first = R if first is None else first
        found, turned = found + 1, max(turned, float(so3.geodesic_distance(first, R)))
        if k in kept or found == 1:
            crops.append(cut_out(place, [shot.picture for shot in row]))
            turns.append(R)
            used.append(poses.use)
    if turned < TURNED:
        got, do = f"{math.degrees(turned):.2g} degrees in all frames together", "use a movie in which the ball turns"
        raise PaintError(refusal("movies", expected="a ball that turns", got=got, do=do))
    if found < LEAST_FOUND * count:
        got, do = f"{found} of {count} frames that a growing map explains", "learn the map with `sphereorient map`"
        raise PaintError(refusal("movies", expected="a ball whose paint is seen again", got=got, do=do))
    return adjusted(place.holding(crops, torch.stack(used)), torch.stack(turns), progress).texture()
