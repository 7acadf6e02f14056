"""Crops of the sphere from every frame, so that movies are read once; normalised disks, to compare without a map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from sphereorient import locate
from sphereorient.cameras import R_cam_view, perspective_centre_lab_mm
from sphereorient.cameras.checks import camera_error
from sphereorient.errors import PaintError, Reason, refusal
from sphereorient.experiment.recording import CameraStream, Recording, given_scene
from sphereorient.files.threads import Progress, counted, side_by_side, silent
from sphereorient.follow.initialise import GAP_SHARE
from sphereorient.locate import (
    CameraScene,
    Found,
    Frame,
    LocateSettings,
    Positions,
    Sightings,
    find_ball,
    find_positions,
    sightings_of,
    smoothed,
)
from sphereorient.locate.outline import window_about
from sphereorient.locate.scene import CHECK_POSE, fixed_ball, wander_px
from sphereorient.mapping.settings import MapSettings
from sphereorient.pose.camera_view import CameraView
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.pixels import Pixels, stacked
from sphereorient.search.normalisation import Blur, crop_disk, rim_share
from sphereorient.sphere.view import perspective_view

Picture = NDArray[Any]
REACH = 1.35  # half the side of a crop, in radii of the disk
SHOWN_MIN = 0.99  # least visible share of a disk's pixel
FOLLOWED = 3000  # first frames of a movie, enough to show all sides
PLACES = 2  # per radius: independent places of the paint
BY_INSTANT = ("layers", "R_lab_view", "distance_radii", "seen", "shown")  # of `Disks`
DEEPEST = 1e6  # radii: beyond, a perspective view is orthographic


@dataclass(frozen=True, kw_only=True, eq=False)
class Crop:
    """A part of a picture."""

    grey: Picture
    top: int
    left: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Crops:
    """The sphere's surroundings in N frames of C cameras."""

    views: Sequence[CameraView]
    crops: Sequence[Sequence[Crop | None]]  # C times N; None where the ball was not found
    position_lab_mm: Tensor  # (N, 3) float64, NaN where unknown
    seen: Tensor  # (N, C) bool, frames with a position and a picture
    radius_mm: float
    fixed: bool  # whether all positions are the same

    def __len__(self) -> int:
        return len(self.position_lab_mm)

    def picture(self, frame: int, camera: int) -> Picture:
        """Return a whole picture: the crop pasted on the background."""
        crop, scene = self.crops[camera][frame], self.views[camera].background.mean
        whole: Picture = scene.astype(np.float32)
        if crop is not None:
            there = np.s_[max(0, crop.top) :, max(0, crop.left) :]
            part = crop.grey[max(0, -crop.top) :, max(0, -crop.left) :]
            height, width = (min(sides) for sides in zip(part.shape, whole[there].shape, strict=True))
            whole[there][:height, :width] = part[:height, :width]
        return whole

    def pictures(self, frames: Tensor) -> list[list[Picture]]:
        """Return all cameras' whole pictures of some frames (M,)."""
        return [[self.picture(k, c) for c in range(len(self.views))] for k in frames.tolist()]

    def holding(self, rows: Sequence[Sequence[Crop]], use: Tensor, position_lab_mm: Tensor | None = None) -> "Crops":
        """Return a record with N rows of crops of all cameras, used (N, C), at positions (N, 3) (None: fixed)."""
        X = self.position_lab_mm[:1].expand(len(rows), 3) if position_lab_mm is None else position_lab_mm
        return replace(self, crops=list(zip(*rows, strict=True)), position_lab_mm=X, seen=use)

    @property
    def usual(self) -> Tensor:
        """The median of the positions, (3,)."""
        # torch gives wrong medians of expanded rows.
        X: Tensor = self.place(0) if self.fixed else self.position_lab_mm.contiguous().nanmedian(0).values
        return X

    def place(self, frame: int) -> Tensor:
        """Return the position (3,) in a frame; of a fixed ball the first."""
        X: Tensor = self.position_lab_mm[0 if self.fixed else frame]
        return X

    def where(self, rows: Tensor) -> "Crops":
        """Return some frames (M,) int64."""
        crops = [[row[k] for k in rows.tolist()] for row in self.crops]
        return replace(self, crops=crops, position_lab_mm=self.position_lab_mm[rows], seen=self.seen[rows])

    def frames_with_ball(self) -> Tensor:
        """Return the frames (M,) int64 in which a camera sees the sphere; raise PaintError if fewer than two."""
        frames = torch.nonzero(self.seen.any(1))[:, 0]
        if len(frames) < 2:
            raise too_few(len(frames))
        return frames


def too_few(count: int) -> PaintError:
    """Return the error for a movie of one frame."""
    do = "use a movie in which the ball rotates"
    return PaintError(refusal("movies", expected="the ball in at least 2 frames", got=f"{count}", do=do))


def take_crops(recording: Recording, settings: MapSettings, locating: LocateSettings, progress: Progress) -> Crops:
    """Crop the sphere in every frame; raise ExperimentError if it is not found, PaintError if cameras disagree."""
    experiment, views, sightings = recording.experiment, list[CameraView](), dict[str, Sightings]()
    rows: list[list[Crop | None]] = []
    for stream in recording.streams:
        scene, found = _scene(recording, stream, settings, locating), list[Found]()
        rows.append([])
        for k, shot in enumerate(locate.screened_frames(stream, scene.background)):
            found.append(_outline(scene, locating, shot))
            ball, _ = found[-1]
            rows[-1].append(None if ball is None else cut_crop(shot.picture, *ball.circle))
            progress(f"{stream.name}: ball", k + 1, 0)
        views.append(CameraView.of(stream.name, stream.camera, scene))
        seen = sightings_of(found)
        sightings[stream.name] = seen if scene.outline else locate.fill_gaps(seen, locating)
    positions = _positions(sightings, recording)
    X = positions.position_lab_mm
    if experiment.fixed:
        X = X.nanmedian(0).values.expand(len(X), 3).clone()
    elif len(views) > 1:
        gap = positions.gap_mm[torch.isfinite(positions.gap_mm)]
        if len(gap) and float(gap.median()) > GAP_SHARE * experiment.radius_mm:
            got = f"lines of sight with a median distance of {float(gap.median()):.3g} mm"
            do = "check the cameras, or use one of them"
            raise PaintError(refusal("movies", expected="one ball in both movies", got=got, do=do))
    seen_by = torch.tensor([[crop is not None for crop in row] for row in rows]).T & torch.isfinite(X).all(1)[:, None]
    radius_mm, fixed = experiment.radius_mm, experiment.fixed
    return Crops(views=views, crops=rows, position_lab_mm=X, seen=seen_by, radius_mm=radius_mm, fixed=fixed)


def _positions(sightings: Mapping[str, Sightings], recording: Recording) -> Positions:
    """Return the positions of a ball, NaN where a camera cannot see them. Raises CameraError: most of them."""
    locate.check_seen(sightings)
    found = find_positions(sightings, recording.cameras, recording.experiment.diameter_mm)
    X = found.position_lab_mm
    known = X.isfinite().all(-1)
    for name, camera in recording.cameras.items():
        beyond = known & ~camera.project(X).isfinite().all(-1)
        if 2 * int(beyond.sum()) > int(known.sum()):
            got, do = f"one out of its sight in {int(beyond.sum())} of {int(known.sum())} frames", CHECK_POSE
            raise camera_error(f"camera {name}", "a ball that it sees", got, do)
        X = torch.where(beyond[:, None], torch.nan, X)
    return replace(found, position_lab_mm=X)


def _scene(recording: Recording, stream: CameraStream, settings: MapSettings, locating: LocateSettings) -> CameraScene:
    """Return the scene of a single ball, of a fixed one (the changing part of the pictures) with its outline. Raises
    PaintError: outlines of a fixed ball scatter far more in position than in size.
    """
    if not recording.experiment.fixed:
        (scene,) = locate.find_scenes(recording, stream, settings.background_frames, locating).values()
        return scene
    circle = recording.experiment.circles.get(stream.name)
    pictures = stream.spread((1 if circle else 4) * settings.background_frames)
    empty = given_scene(recording.experiment, stream.name, stream.movie.frame_shape)
    outline, background = fixed_ball(pictures, locating, empty, stream.shown, circle)
    scene = CameraScene(
        background=background, diameter_px=2 * outline.radius_px, response=stream.response, outline=outline
    )
    wander = 0.0 if circle else wander_px(pictures, scene, locating)
    if wander:
        got, do = f"one that moves by {wander:.1f} px in {stream.name}", "set `fixed: sways`"
        raise PaintError(refusal("sphere.fixed", expected="a fixed ball", got=got, do=do))
    return scene


def held_place(
    recording: Recording,
    settings: MapSettings,
    locating: LocateSettings,
    progress: Progress = silent,
    frames_max: int = FOLLOWED,
) -> Crops:
    """Return an empty record with views and positions of a ball: (1, 3) of a fixed ball, else (N, 3) of the first
    frames, at most `frames_max`, with the cameras that see it, (N, C). Raises as `take_crops`.
    """
    experiment, views, sightings = recording.experiment, list[CameraView](), dict[str, Sightings]()
    for stream in recording.streams:
        scene = _scene(recording, stream, settings, locating)
        if scene.outline:
            seen = sightings_of([(scene.outline, Reason.OK)])
        else:
            count = min(frames_max, len(recording.timeline))
            frames = locate.screened_frames(stream, scene.background, 0, count)
            found = side_by_side(partial(_outline, scene, locating), frames)
            seen = smoothed(sightings_of(counted(f"{stream.name}: ball", found, count, progress)), locating)
        views.append(CameraView.of(stream.name, stream.camera, scene))
        sightings[stream.name] = seen
    X = _positions(sightings, recording).position_lab_mm
    use = torch.stack([one.placed for one in sightings.values()], 1) & torch.isfinite(X).all(1)[:, None]
    radius_mm, fixed = experiment.radius_mm, experiment.fixed
    return Crops(views=views, crops=[[] for _ in views], position_lab_mm=X, seen=use, radius_mm=radius_mm, fixed=fixed)


def _outline(scene: CameraScene, locating: LocateSettings, shot: Frame) -> Found:
    if scene.outline or not shot.usable:
        return scene.outline if shot.usable else None, shot.reason
    return find_ball(shot.picture, scene.background, scene.diameter_px, locating)


def evenly_spread(rows: Tensor, count: int) -> Tensor:
    """Return at most `count` of the rows, evenly spread, ends included."""
    return rows[torch.linspace(0, len(rows) - 1, min(count, len(rows))).round().long()]


def cut_crop(picture: Picture, u_px: float, v_px: float, radius_px: float) -> Crop:
    """Cut a disk and its surroundings out of a picture."""
    reach = int(np.ceil(REACH * radius_px)) + 3
    rows, columns = window_about(round(u_px), round(v_px), reach)
    return Crop(grey=picture[rows, columns].copy(), top=rows.start, left=columns.start)


def cut_out(place: Crops, pictures: Sequence[Picture], position_lab_mm: Tensor | None = None) -> list[Crop]:
    """Cut a ball at its position, or at one (3,) near it, out of a picture of each camera: parts of equal size."""
    usual, found = place.usual, []
    X = usual if position_lab_mm is None else position_lab_mm
    for view, picture in zip(place.views, pictures, strict=True):
        u, v = view.camera.project(X).tolist()
        radius_px = float(view.radius_px(usual, place.radius_mm))
        cut = cut_crop if position_lab_mm is None else _whole_crop
        found.append(cut(picture, u, v, radius_px))
    return found


def _whole_crop(picture: Picture, u_px: float, v_px: float, radius_px: float) -> Crop:
    """Cut out as `cut_crop`, black beyond the picture, so that all have equal size."""
    reach = int(np.ceil(REACH * radius_px)) + 3
    top, left = round(v_px) - reach, round(u_px) - reach
    grey = np.zeros((2 * reach + 1, 2 * reach + 1), picture.dtype)
    part = picture[window_about(round(u_px), round(v_px), reach)]
    grey[max(0, -top) :, max(0, -left) :][: part.shape[0], : part.shape[1]] = part
    return Crop(grey=grey, top=top, left=left)


def pixels_of(crops: Crops, fitter: Fitter, frames: Tensor, wanted: int, extra_px: float = 0.0) -> Pixels:
    """Return about `wanted` pixels of each disk, after a blur of the picture by `extra_px`."""
    level, X = replace(fitter.optics.fine, extra_px=extra_px), crops.position_lab_mm[frames]
    radius_px = float(fitter.disks_px(X).largest_px.max())
    each = zip(torch.split(frames, 1), torch.split(X, 1), strict=True)
    wholes = (fitter.pixels(crops.pictures(frame), place, level, radius_px) for frame, place in each)
    return stacked([whole.thinned(max(1, round(whole.grey.shape[1] / wanted))) for whole in wholes])


@dataclass(frozen=True, kw_only=True, eq=False)
class Disks:
    """Normalised disks (S, S), limb at the edges, of N instants, C cameras; view: x right, y down, z to the sphere."""

    layers: Tensor  # (N, C, 3, S, S) float32: normalised grey, its slope to the right and down, per radius
    share: Tensor  # (S, S), weight of a pixel, 0 at the limb .. 1
    R_lab_view: Tensor  # (N, C, 3, 3) float32
    distance_radii: Tensor  # (N, C), of the camera from the centre
    seen: Tensor  # (N, C) bool
    shown: Tensor  # (N, C, S, S) float32, 0 where something hides the ball .. 1

    def __len__(self) -> int:
        return len(self.layers)

    def where(self, rows: Tensor | slice, cameras: slice = slice(None)) -> "Disks":
        """Select instants and cameras."""
        return replace(self, **{name: getattr(self, name)[rows, cameras] for name in BY_INSTANT})

    def weight(self, rows: Tensor | slice, camera: int) -> Tensor:
        """Return pixel weights (R, S * S) of some disks: 0 where not seen or hidden."""
        return self.seen[rows, camera][:, None] * self.shown[rows, camera].flatten(1)

    def sampled(
        self, rows: Tensor | slice, camera: int, every: int = 1, slant_power: int = 1
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return each n-th (`every`) pixel of disks (R,): view directions (3, P), grey (R, P), weight (R, P).
        Weights are multiplied by the slant's cosine to the power `slant_power`.
        """
        far, size = self.distance_radii[:, camera].median(), self.size_px
        view = perspective_view(size, float(far))
        pixel = torch.nonzero(view.inside.reshape(-1))[:, 0]
        chosen = (pixel // size + pixel % size) % every == 0
        normal, share = view.normal_view.T.float()[:, chosen].contiguous(), self.share[view.inside][chosen]
        place, _, depth = disk_places(normal, far)
        at = ((place + 1) * (size / 2) - 0.5).round().long()
        cell = at[1] * size + at[0]
        grey = self.layers[rows, camera, 0].flatten(1)[:, cell]
        weight = (share * depth.clamp_min(0) ** slant_power)[None] * self.weight(rows, camera)[:, cell]
        return normal, grey, weight

    @property
    def size_px(self) -> int:
        """Side of the pictures, px."""
        return self.layers.shape[-1]

    def sight_cosines(self, R_lab_body: Tensor, rows: Tensor) -> Tensor:
        """Return the cosine between the nearest lines of sight in the body for all pairs of instants (K,), (K, K)."""
        in_body = (R_lab_body[rows].mT[:, None] @ -self.R_lab_view[rows][..., 2, None].double())[..., 0]
        cosine = torch.einsum("acx,bdx->abcd", in_body, in_body)
        both = self.seen[rows][:, None, :, None] & self.seen[rows][None, :, None, :]
        return torch.where(both, cosine, -1.0).flatten(2).amax(2)


def disks_of(crops: Crops, frames: Tensor, settings: MapSettings) -> Disks:
    """Cut and normalise the disks of some frames (M,)."""
    size, count, cameras = settings.disk_px, len(frames), len(crops.views)
    pictures, shown = torch.zeros(count, cameras, size, size), torch.ones(count, cameras, size, size)
    R, far = torch.empty(count, cameras, 3, 3).double(), torch.empty(count, cameras).double()
    X = crops.position_lab_mm[frames]
    for c, view in enumerate(crops.views):
        camera = view.camera
        in_camera = (X - perspective_centre_lab_mm(camera, X)) @ camera.R_cam_lab.mT
        far[:, c] = in_camera.norm(dim=-1) / crops.radius_mm
        R[:, c] = camera.R_cam_lab.mT @ R_cam_view(in_camera)
        # The limb lies slightly before the great circle of `radius_px`.
        limb = view.radius_px(X, crops.radius_mm) / (1 - far[:, c] ** -2).clamp_min(1e-3).sqrt()
        middle = camera.project(X)
        for k, frame in enumerate(frames.tolist()):
            crop = crops.crops[c][frame]
            if crop is None or not bool(crops.seen[frame, c]):
                continue
            u, v, radius_px = float(middle[k, 0]), float(middle[k, 1]), float(limb[k])
            pictures[k, c] = torch.from_numpy(crop_disk(crop.grey, u - crop.left, v - crop.top, radius_px, size))
            if view.background.shown is not None:
                visible = crop_disk(view.background.shown.astype(np.uint8), u, v, radius_px, size)
                shown[k, c] = torch.from_numpy(visible) > SHOWN_MIN
    return normalised_disks(pictures, R, far, crops.seen[frames], settings, shown)


def normalised_disks(
    pictures: Tensor,
    R_lab_view: Tensor,
    distance_radii: Tensor,
    seen: Tensor,
    settings: MapSettings,
    shown: Tensor | None = None,
) -> Disks:
    """Return disks of pictures (N, C, S, S), any finite grey: difference from the local mean over the local deviation.
    R_lab_view (N, C, 3, 3), distance_radii (N, C) above 1, seen (N, C) bool, shown (N, C, S, S) 0 hidden .. 1, None: 1.
    """
    size = pictures.shape[-1]
    share = rim_share(size)
    fine, wide = Blur(size, settings.detail), Blur(size, settings.window)
    flat, shown = pictures.reshape(-1, size, size).float(), torch.ones(pictures.shape) if shown is None else shown
    if bool((shown < 1).any()):  # fill hidden pixels with the ball's mean grey
        part = shown.reshape(-1, size, size)
        total = (part * share).sum((1, 2), keepdim=True).clamp_min(1e-6)
        usual = (flat * (part * share)).sum((1, 2), keepdim=True) / total
        flat = usual + (flat - usual) * part
    rough = fine(flat) - wide(flat)
    whole = (rough.square() * share).sum((1, 2), keepdim=True) / share.sum()
    # Add half of the disk's deviation: in uniform texture the local one amplifies noise.
    local = (wide(rough.square()) + 0.25 * whole).sqrt().clamp_min(1e-12)
    even = (rough / local).clamp(-3.0, 3.0) * seen.reshape(-1, 1, 1)
    return Disks(
        layers=_with_slopes(even.reshape(pictures.shape)),
        share=share,
        R_lab_view=R_lab_view.float(),
        distance_radii=distance_radii.float().clamp(1.01, DEEPEST),
        seen=seen,
        shown=shown,
    )


def _with_slopes(grey: Tensor) -> Tensor:
    """Stack pictures (N, C, S, S) with their slopes to the right and down, per radius, (N, C, 3, S, S)."""
    size = grey.shape[-1]
    padded = F.pad(grey, (1, 1, 1, 1), mode="replicate")
    right = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) * (size / 4)
    down = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) * (size / 4)
    return torch.stack([grey, right, down], dim=2)


def without_static(disks: Disks, R_lab_body: Tensor) -> Disks:
    """Remove what is static in the camera (shading, sensor pattern), at rough orientations (N, 3, 3): each pixel's mean
    over the places of the ball that it has shown, except the part that paint explains, as a mean of n places keeps 1/n
    of the paint's power. Unchanged if paint explains all.
    """
    side, found = 2 * PLACES + 1, False
    grey = disks.layers[:, :, 0].flatten(2).clone()
    for c in range(grey.shape[1]):
        view = perspective_view(disks.size_px, float(disks.distance_radii[:, c].median()))
        inside, normal = view.inside.reshape(-1), view.normal_view.float()
        sums = torch.zeros(3, len(normal), side**3)
        for k, R in enumerate(R_lab_body.float()):
            x, y, z = ((PLACES * (normal @ disks.R_lab_view[k, c].mT @ R)).round().long() + PLACES).unbind(1)
            value, weight = grey[k, c, inside], disks.weight(slice(k, k + 1), c)[0, inside]
            products = torch.stack([weight, weight * value, weight * value.square()])
            sums[:, torch.arange(len(normal)), (side * x + y) * side + z] += products
        count = (sums[0] > 0).sum(1).clamp_min(1)
        mean, power = (sums[1:] / sums[0].clamp_min(1e-6)).sum(2) / count
        share = float(1 - (power / count).sum() / mean.square().sum().clamp_min(1e-9))
        if share > 0:
            grey[:, c, inside] -= share * mean
            found = True
    return replace(disks, layers=_with_slopes(grey.reshape(disks.layers[:, :, 0].shape))) if found else disks


def reduced(disks: Disks, factor: int) -> Disks:
    """Return the disks with pictures reduced by a whole factor."""
    layers, shown = _with_slopes(F.avg_pool2d(disks.layers[:, :, 0], factor)), F.avg_pool2d(disks.shown, factor)
    return replace(disks, layers=layers, share=rim_share(disks.size_px // factor), shown=shown)


def disk_places(normal_view: Tensor, distance_radii: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return places (..., 2, P), radii, of directions (..., 3, P), view, on a disk seen from a distance (...), radii.
    Return also their derivative by x and y (..., 1, P) and the slant's cosine (..., P), not positive where invisible.
    """
    D = distance_radii[..., None, None]
    x_y, z = normal_view[..., :2, :], normal_view[..., 2:, :]
    scale = (D.square() - 1).sqrt() / (D + z)
    # Visible if the normal points at the camera, D away along -z.
    depth = (-z - 1 / D) / (1 - 1 / D)
    return x_y * scale, scale, depth[..., 0, :]
