"""The pose of a single frame without history: outlines, search over all rotations, fits from coarse to fine."""

import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import R_cam_view
from sphereorient.errors import Reason
from sphereorient.locate import Found, Frame, LocateSettings, Positions, ball_at, find_positions, sightings_of
from sphereorient.locate.outline import Blob, Outline, find_blobs, fit_outline
from sphereorient.pose.camera_view import CameraView, Picture
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.poses import FittedPoses, Poses, PoseStart, no_pose, poses_of
from sphereorient.search.candidates import Proposer
from sphereorient.search.normalisation import crop_disk

Place = TypeVar("Place", Blob, Outline)

UNPROVEN = -1.0  # score of no pose
DISTINCT_RAD = 0.12  # fits nearer than this are the same orientation; basin of the widest fit
PLACE_SHARE = 0.03  # of the radius: largest error of an outline's centre, with dark rims
DEPTH_SHARE = 0.08  # of the distance: its largest error from the size of one outline
NARROWER = (0.15, 0.06)  # allowed deviations from the usual diameter in repeated searches
CLEARLY_LESS = 0.1  # of a picture's variance: a pose that explains less than another by this is wrong
SURE_NLL = 20.0  # difference of nll of a clearly less likely pose
GAP_SHARE = 0.3  # of the radius: lines of sight with a larger gap show different objects
STEP, REACH = 0.2, 2  # of `relocalise`: step, radii, and steps to each side of the blob
RIVAL_BLOB, RIVAL_SCORE = 0.3, 0.8  # of the best blob's merit, of the best score: from these it may be the sphere too
FAINT = 0.3  # of the merit of the faintest blob proven to be the sphere: fainter ones are ignored
LOOSE = 0.15  # of the radius: error of a position without an outline


@dataclass(frozen=True, kw_only=True, eq=False)
class Initialiser:
    """Finds poses in frames without history."""

    fitter: Fitter  # of C views
    proposers: Mapping[str, Proposer]  # by name of view
    locating: LocateSettings
    candidates: int  # fitted proposals of each camera
    score_min: float = 0.0  # if no picture reaches it, other outlines are tried
    finalists: int = 2  # poses fitted to full detail
    least: float | None = None  # score of proposals; None: by the proposer's settings
    # Results for earlier pictures, by id, whatever the fitter; None: not kept.
    known: dict[tuple[int, Hashable], tuple[Picture, Any]] | None = None

    def all_poses(self, frames: Sequence[Sequence[Frame]]) -> list[Poses]:
        """Find the poses of n frames of C pictures; see `poses`."""
        with ThreadPoolExecutor(2) as pool:  # outlines and matrix products release the GIL
            return list(pool.map(self.poses, frames))

    def poses(self, frames: Sequence[Frame]) -> Poses:
        """Find all poses consistent with the C pictures of one instant; unusable pictures are left out.
        If black paint hides half of a rim, a smaller circle fits the remaining arcs too: if no picture is explained
        well, outlines nearer the usual size are tried, and the texture locates the disk. If neither outline nor texture
        is found, there is no ball.
        """
        if self.known is None:
            return replace(self, known={}).poses(frames)
        frames = [self._looked_at(shot, view) for shot, view in zip(frames, self.fitter.views, strict=True)]
        if not any(shot.usable for shot in frames):
            return no_pose(len(frames), [shot.reason for shot in frames])
        poses = self._with_outlines(frames, self.locating)
        if _best_score(poses) >= self.score_min:
            return poses
        textured = self._found(frames, self.relocalise)
        if not any(outline for outline, _ in [*textured, *self._found(frames, self.outline)]):
            return poses
        for tolerance in NARROWER:
            tolerance = min(tolerance, self.locating.diameter_tolerance)
            narrower = self.locating.model_copy(update={"diameter_tolerance": tolerance})
            poses = max(poses, self._with_outlines(frames, narrower), key=_best_score)
            if _best_score(poses) >= self.score_min:
                return poses
        return max(poses, self._search(frames, textured), key=_best_score)

    def _looked_at(self, shot: Frame, view: CameraView) -> Frame:
        """Return a frame, marked unusable if it shows no blob like the sphere's."""
        if not shot.usable or view.merit_min == 0.0 or self._blobs(shot.picture, view):
            return shot
        return Frame(shown=shot.shown, read=Reason.NOT_FOUND)

    def merit(self, picture: Picture, view: CameraView) -> float:
        """Return the merit of the best blob of a picture; 0 without one."""
        return max((blob.merit for blob in self._blobs(picture, view)), default=0.0)

    def _blobs(self, picture: Picture, view: CameraView) -> list[Blob]:
        """Return the blobs of a picture that may be the sphere, best first."""
        scene, size = view.background, view.diameter_px

        def find() -> list[Blob]:
            return find_blobs(scene.difference(picture), scene.noise, size, self.locating)

        blobs: list[Blob] = self._once(picture, ("blobs", view.name, size), find)
        return [blob for blob in blobs if blob.merit >= view.merit_min]

    def _with_outlines(self, frames: Sequence[Frame], locating: LocateSettings) -> Poses:
        found = self._found(frames, replace(self, locating=locating).outline)
        seeing = [k for k, (outline, _) in enumerate(found) if outline is not None]
        if len(seeing) < 2 or self._meet(found):
            return self._search(frames, found)
        # The cameras see different objects: take those with meeting lines of sight and the best scores.
        for some in by_decreasing_size(seeing):
            each = [[one if k in kept else (None, Reason.OUTLINE) for k, one in enumerate(found)] for kept in some]
            if meeting := [one for one in each if self._meet(one)]:
                break
        return max((self._search(frames, one) for one in meeting), key=_best_score)

    def _meet(self, found: Sequence[Found]) -> bool:
        """Return whether the lines of sight meet; true for one camera."""
        return not float(self._placed(found).gap_mm[0]) > GAP_SHARE * self.fitter.radius_mm

    def glanced(self, frames: Sequence[Frame], place: Tensor | None = None) -> Poses:
        """Return the likeliest pose by blobs of the usual size alone, or with the ball at `place` (3,), lab, mm; or no
        pose. It is right to some degrees and pixels, and takes a quarter of the time of `poses`.
        """
        fitter, views = self.fitter, self.fitter.views
        if place is None:
            found = self._found(frames, self._glimpse)
        else:
            found = [
                (_usual_disk(view.camera.project(place).tolist(), float(view.radius_px(place, fitter.radius_mm))), why)
                if (why := shot.reason) is Reason.OK
                else (None, why)
                for view, shot in zip(views, frames, strict=True)
            ]
        reason = [why for _, why in found]
        use = torch.tensor([disk is not None for disk, _ in found])
        if not bool(use.any()):
            return no_pose(len(views), reason)
        glimpses = [
            self._glimpsed(view, shot.picture, disk)
            for view, shot, (disk, _) in zip(views, frames, found, strict=True)
            if disk is not None
        ]
        R, X_k, precisions = (torch.cat(parts) for parts in zip(*glimpses, strict=True))
        precision = precisions.sum(0)
        X = torch.linalg.solve(precision, (precisions @ X_k[..., None]).sum(0)).mT if place is None else place[None]
        level, count = fitter.optics.coarse, len(R)
        pixels = fitter.pixels([[shot.picture for shot in frames]], X, level).thinned(4)
        begin = PoseStart(X.expand(count, 3), R, use.expand(count, -1), precision.expand(count, 3, 3))
        fit = fitter.fit(pixels.where(torch.arange(len(pixels)).repeat(count)), begin, level, 4)
        chosen = distinct_indices(fit.R_lab_body, explaining_first(fit, use), 1)
        return poses_of(fit, chosen, use, reason)

    def _glimpse(self, picture: Picture, view: CameraView) -> Found:
        """Return a disk of usual radius about the best blob."""
        blobs = self._blobs(picture, view)
        if not blobs:
            return None, Reason.NOT_FOUND
        return _usual_disk((blobs[0].u_px, blobs[0].v_px), view.diameter_px / 2), Reason.OK

    def _glimpsed(self, view: CameraView, picture: Picture, disk: Outline) -> tuple[Tensor, Tensor, Tensor]:
        """Return rotations (M, 3, 3), lab, in which a disk may show the ball, right to some degrees; and the ball's
        position by its size (1, 3), mm, with its precision (1, 3, 3), 1/mm^2.
        """
        proposer, camera, radius_mm = self.proposers[view.name], view.camera, self.fitter.radius_mm
        near = proposer.rough(torch.from_numpy(crop_disk(picture, *disk.circle, proposer.size_px))[None]).R_view_body
        sight = view.sight.of_size(np.array([disk.circle[:2]]), radius_mm / disk.radius_px)
        ray, X, distance = (torch.from_numpy(part) for part in sight)
        along = ray.mT @ ray
        across, depth = LOOSE * radius_mm, LOOSE * radius_mm + DEPTH_SHARE * distance
        precision = (torch.eye(3).double() - along) / across**2 + along / depth**2
        R_lab_view = camera.R_cam_lab.mT @ R_cam_view(camera.R_cam_lab @ ray[0])
        return R_lab_view @ near, X, precision[None]

    def outline(self, picture: Picture, view: CameraView) -> Found:
        """Return the outline of the sphere in a camera's picture, or None and the reason; see `find_ball`."""
        key = ("outline", view.name, view.diameter_px, self.locating)
        scene, size = view.background, view.diameter_px

        def find() -> Found:
            return ball_at(self._blobs(picture, view), scene.difference(picture), picture, scene, size, self.locating)

        found: Found = self._once(picture, key, find)
        return found

    def disks(self, frames: Sequence[Frame]) -> list[Outline | None]:
        """Return the outline of a painted sphere in each of C pictures; None without one."""
        return [one if one is not None and one.painted else None for one, _ in self._found(frames, self.outline)]

    def relocalise(self, picture: Picture, view: CameraView) -> Found:
        """Return the outline of usual radius where the texture map explains the disk best, or None and the reason."""
        key = (view.name, view.diameter_px, self.locating)
        found: Found = self._once(picture, key, lambda: self._relocalised(picture, view))
        return found

    def _relocalised(self, picture: Picture, view: CameraView) -> Found:
        proposer, radius, blobs = self.proposers[view.name], view.diameter_px / 2, self._blobs(picture, view)
        if self.outline(picture, view)[0] is None:
            # A ball without an outline has as much merit as a proven one, or is cut by the picture's border.
            clear, size = view.merit_min / FAINT, torch.tensor(radius)
            blobs = [
                one
                for one in blobs
                if one.merit >= clear or not view.shows_whole(torch.tensor([one.u_px, one.v_px]), size)
            ]
        places = [(blob.u_px, blob.v_px) for blob in blobs]
        if not places:
            return None, Reason.NOT_FOUND
        steps = [STEP * radius * k for k in range(-REACH, REACH + 1)]
        for around in ([0.0], steps):  # the likeliest blob, then the likeliest place near it
            places = [(u + right, v + down) for u, v in places for down in around for right in around]
            disks = [torch.from_numpy(crop_disk(picture, u, v, radius, proposer.size_px)) for u, v in places]
            places = [places[int(proposer.likeness(torch.stack(disks)).argmax())]]
        ((u, v),) = places
        disk = _usual_disk((u, v), radius)
        R, _ = self._proposed(self.fitter.views.index(view), picture, disk)
        return (disk, Reason.OK) if len(R) else (None, Reason.LOW_SCORE)

    def claimants(self, frames: Sequence[Frame]) -> int:
        """Return how many disks fit the texture map about equally well, in the camera with most of them."""
        pairs = zip(self.fitter.views, frames, strict=True)
        return max((self._claimants(shot.picture, view) for view, shot in pairs if shot.usable), default=0)

    def _claimants(self, picture: Picture, view: CameraView) -> int:
        blobs, scene, settings = self._blobs(picture, view), view.background, self.locating
        blobs = _distinct_places(
            [blob for blob in blobs if blob.merit > RIVAL_BLOB * blobs[0].merit], view.diameter_px / 2
        )
        if len(blobs) < 2:
            return 1
        difference = scene.difference(picture)
        fits = (
            fit_outline(difference, scene.typical_noise, blob, view.diameter_px, settings, scene.shown)
            for blob in blobs
        )
        round_ones = [one for one in fits if one is not None and one.painted and one.coverage >= settings.coverage_min]
        outlines = _distinct_places(round_ones, view.diameter_px / 2)
        if len(outlines) < 2:
            return 1
        proposer = self.proposers[view.name]
        disks = [crop_disk(picture, *one.circle, proposer.size_px) for one in outlines]
        best = proposer.propose(torch.from_numpy(np.stack(disks))).best_score
        return int((best > RIVAL_SCORE * best.max()).sum())

    def _once(self, picture: Picture, key: Hashable, find: Callable[[], Any]) -> Any:
        """Return the result of `find`, or the earlier one for the same picture and key."""
        if self.known is None:
            return find()
        place = id(picture), key
        if place not in self.known:
            self.known[place] = picture, find()  # keep the picture, so that no other gets its id
        return self.known[place][1]

    def _found(self, frames: Sequence[Frame], find: Callable[[Picture, CameraView], Found]) -> list[Found]:
        return [
            find(shot.picture, view) if shot.usable else (None, shot.reason)
            for view, shot in zip(self.fitter.views, frames, strict=True)
        ]

    def _placed(self, found: Sequence[Found]) -> Positions:
        seen = {view.name: sightings_of([one]) for view, one in zip(self.fitter.views, found, strict=True)}
        cameras = {view.name: view.camera for view in self.fitter.views}
        return find_positions(seen, cameras, 2 * self.fitter.radius_mm)

    def proposals(self, disks: Sequence[tuple[int, Picture, Outline]]) -> list[tuple[Tensor, Tensor]]:
        """Return rotations (M, 3, 3), lab, in which each disk of a camera's picture may show the ball, and their scores
        (M,), best first. Disks of one proposer are processed together.
        """
        crops: dict[int, list[Tensor]] = {}
        for k, picture, disk in disks:
            one = self.proposers[self.fitter.views[k].name]
            crop = crop_disk(picture, *disk.circle, one.size_px)
            crops.setdefault(id(one), []).append(torch.from_numpy(crop))
        proposers = {id(one): one for one in self.proposers.values()}
        found = {
            each: iter(proposers[each].propose(torch.stack(some), self.least).each()) for each, some in crops.items()
        }
        rows = []
        for k, _, disk in disks:
            view = self.fitter.views[k]
            own = next(found[id(self.proposers[view.name])])
            ray = view.camera.rays(torch.tensor([disk.u_px, disk.v_px], dtype=torch.float64)).direction_lab
            R_lab_view = view.camera.R_cam_lab.mT @ R_cam_view(view.camera.R_cam_lab @ ray)
            rows.append((R_lab_view @ own.R_view_body[: self.candidates], own.score[: self.candidates]))
        return rows

    def _search(self, frames: Sequence[Frame], found: Sequence[Found]) -> Poses:
        seen = [(k, shot.picture, one) for k, (shot, (one, _)) in enumerate(zip(frames, found, strict=True)) if one]
        none = torch.zeros(0, 3, 3, dtype=torch.float64)
        return self.fitted(frames, found, torch.cat([none, *(self._proposed(*one)[0] for one in seen)]))

    def _proposed(self, k: int, picture: Picture, disk: Outline) -> tuple[Tensor, Tensor]:
        """Return the proposals of one disk of camera `k` alone: rounding depends on the size of a batch."""
        key, look = (self.fitter.views[k].name, disk), partial(self.proposals, [(k, picture, disk)])
        ((R, score),) = self._once(picture, key, look)
        return R, score

    def fitted(self, frames: Sequence[Frame], found: Sequence[Found], R: Tensor) -> Poses:
        """Return the poses in C pictures of a ball with these outlines, fitted from rotations R (M, 3, 3)."""
        fitter, views, reason = self.fitter, self.fitter.views, [why for _, why in found]
        use = torch.tensor([outline is not None for outline, _ in found])
        if not use.any() or not len(R):
            return no_pose(len(views), reason)
        placed = self._placed(found)
        slack = torch.nan_to_num(placed.covariance_mm2[0])
        slack = slack + (PLACE_SHARE * fitter.radius_mm) ** 2 * torch.eye(3).double()
        if int(use.sum()) == 1:
            # A smaller circle fits the arcs of a partly dark rim with no greater residual.
            (seeing,) = (view for view, used in zip(views, use.tolist(), strict=True) if used)
            sight = seeing.camera.rays(seeing.camera.project(placed.position_lab_mm))
            along = placed.position_lab_mm[0] - sight.origin_lab_mm[0]
            slack = slack + DEPTH_SHARE**2 * along[:, None] * along
        place, precision, pictures = placed.position_lab_mm, torch.linalg.inv(slack), [shot.picture for shot in frames]
        optics, X = fitter.optics, place.expand(len(R), 3)
        # (level, every n-th pixel, iterations, poses kept): coarse levels need few pixels, the last fit all.
        steps = (
            (optics.coarse, 1, 4, self.finalists + 1),
            (optics.middle, 3, 3, self.finalists),
            (optics.fine, 4, 2, self.finalists),
            (optics.fine, 1, 1, self.finalists),
        )
        for level, every, iterations, keep in steps:
            held = None if level is optics.fine else precision.expand(len(R), 3, 3)
            # All starts of a level use the same pixels: those about the position of the outlines.
            one = fitter.pixels([pictures], place, level).thinned(every)
            if level is optics.fine and every == 1 and fitter.light.known:
                one = fitter.unoccluded(one, X[:1], R[:1])  # by the likeliest pose; all use the same pixels
            pixels = one.where(torch.arange(len(one)).repeat(len(R)))
            fit = fitter.fit(pixels, PoseStart(X, R, use.expand(len(R), -1), held), level, iterations)
            fit = replace(fit, nll=explaining_first(fit, use))
            chosen = distinct_indices(fit.R_lab_body, fit.nll, keep)
            if not len(chosen):
                return no_pose(len(use), reason)
            X, R = fit.position_lab_mm[chosen], fit.R_lab_body[chosen]
            place = X[:1]
        hidden = [bool(used) and bool(fitter.shows_unknown(k, X[:1], R[:1]).any()) for k, used in enumerate(use)]
        shown = use & ~torch.tensor(hidden)
        if not bool(shown.any()):  # all cameras are equal
            return poses_of(fit, chosen, use, reason)
        reason = [Reason.UNSEEN if unknown else why for unknown, why in zip(hidden, reason, strict=True)]
        return poses_of(fit, chosen, shown, reason)


def _usual_disk(centre_px: Sequence[float], radius_px: float) -> Outline:
    """Return a disk of usual size at a place without a proven outline."""
    u, v = centre_px
    return Outline(u_px=u, v_px=v, radius_px=radius_px, rms_px=LOOSE * radius_px, coverage=0.0)


def _distinct_places(places: Sequence[Place], radius_px: float) -> list[Place]:
    """Return the places, best first, more than a radius from all better ones."""
    kept: list[Place] = []
    for one in places:
        if all(math.hypot(one.u_px - other.u_px, one.v_px - other.v_px) > radius_px for other in kept):
            kept.append(one)
    return kept


def _best_score(poses: Poses) -> float:
    return float(poses.score[0, poses.use].max()) if len(poses) else UNPROVEN


def by_decreasing_size(cameras: Sequence[int]) -> Iterator[list[tuple[int, ...]]]:
    """Yield all subsets, size by size, from all but one camera down to single ones."""
    for size in range(len(cameras) - 1, 0, -1):
        yield list(combinations(cameras, size))


def explaining_first(fit: FittedPoses, use: Tensor) -> Tensor:
    """Return nll (M,), with poses of clearly lower score in the cameras of `use` (C,) bool put behind the others:
    likelihood tolerates wide scatter. A disk of unknown paint has no score.
    """
    nll, known = fit.nll, use & (fit.score != 0)
    score = torch.where(known, fit.score, 0.0).sum(-1) / known.sum(-1)
    score = torch.where(known.any(-1), score, -1.0)
    behind = score < score.nan_to_num(-1.0).max() - CLEARLY_LESS
    if not bool((~behind & torch.isfinite(nll)).any()):
        return nll
    last = nll[~behind & torch.isfinite(nll)].max()
    return torch.where(behind, nll.maximum(last + SURE_NLL), nll)


def distinct_indices(R: Tensor, nll: Tensor, count: int) -> Tensor:
    """Return the indices of at most `count` rotations (M, 3, 3), likeliest first, none near a likelier one."""
    near = so3.geodesic_distance(R[:, None], R[None]) < DISTINCT_RAD
    left = torch.isfinite(nll)
    chosen: list[int] = []
    for k in nll.argsort(stable=True).tolist():
        if left[k] and len(chosen) < count:
            chosen.append(k)
            left = left & ~near[k]
    return torch.tensor(chosen, dtype=torch.int64)
