"""Film hostile cases, track them, and count frames that are wrong, valid and unmarked; none is allowed.

    scripts/silent_wrong.py [--only NAME ...] [--keep DIR] [--frames 30]

A frame is wrong if its orientation is off by more than 1 degree, or its pose by more than 5 sigma (Mahalanobis distance
of rotation or position). A frame is marked if it is not valid, or has flag 16 (ambiguous), 32 (doubtful fit) or 512
(contradiction). Right frames of measurable cases should be valid and unmarked.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from sphereorient import so3
from sphereorient.bench.score import mahalanobis
from sphereorient.cameras import Camera, TsaiCamera, save_cameras
from sphereorient.errors import SphereOrientError
from sphereorient.files.picture import write_picture
from sphereorient.run import MemoryStore, Request, run
from sphereorient.synth import SynthSettings, make_scene, random_texture
from sphereorient.synth.motion import Motion6D
from sphereorient.synth.scene import RenderedScene, digitise, expose, seeded
from sphereorient.synth.write import default_cameras, experiment_document, frame_times_s, motion_of, write_truth
from sphereorient.trajectory import Flag, Trajectory

Floats = NDArray[np.float64]
Grey = NDArray[Any]
Cameras = dict[str, Camera]
LEAD_S, FINE = 0.1, 48  # s of motion before the first and after the last frame; poses a frame
WRONG_DEG, WRONG_SIGMAS = 1.0, 5.0
MARKS = Flag.AMBIGUOUS | Flag.DOUBTFUL_FIT | Flag.CONTRADICTION
SIZE = (330, 330)  # px of the pictures, unless a case says otherwise
SHARED = {"image_size": SIZE, "volume_mm": 14.0, "velocity_rms": 0.12, "frames": 30}


@dataclass(frozen=True, kw_only=True)
class Moment:
    """What a case may change about one picture before the camera's noise."""

    lit: NDArray[np.float32]  # (H, W), grey levels
    cover: NDArray[np.float32]  # (H, W), share of the pixel that the ball fills
    camera: int
    frame: int
    time_s: float
    centre_px: Floats
    radius_px: float
    film: Callable[[float], tuple[NDArray[np.float32], NDArray[np.float32]]]  # the ball at another time, s


@dataclass(frozen=True, kw_only=True)
class Case:
    """One movie and what is wrong with it."""

    name: str
    what: str
    measurable: bool = True  # nothing contradicts: right frames should stay unmarked
    scene: Mapping[str, Any] = field(default_factory=dict)  # of `SynthSettings`
    move: Callable[[Motion6D], Motion6D] | None = None
    picture: Callable[[Moment], NDArray[np.float32]] | None = None
    movie: Callable[[NDArray[np.uint8], int], Grey] | None = None  # frames (N, H, W) of a camera
    reported: Callable[[Cameras], Cameras] | None = None
    document: Callable[[dict[str, Any]], None] | None = None
    texture: Callable[[Tensor], Tensor] | None = None  # the filmed paint of the map (H, 2 H)
    edit: Callable[[Path], None] | None = None  # of the folder's files


# What is wrong with a picture


def shifted(picture: NDArray[np.float32], right: float, down: float) -> NDArray[np.float32]:
    return np.asarray(cv2.warpAffine(picture, np.float32([[1, 0, right], [0, 1, down]]), picture.shape[::-1]))


def second_ball(right: float, down: float, later_s: float, faint: float = 1.0) -> Callable[[Moment], Any]:
    """Add another ball with the same paint, some px away, in the attitude of another time."""

    def change(at: Moment) -> NDArray[np.float32]:
        lit, cover = (shifted(part, right, down) for part in at.film(at.time_s + later_s))
        other = faint * lit + (1 - faint) * 15.0
        return at.lit * (1 - cover) + other * cover

    return change


def plain_ball(at: Moment) -> NDArray[np.float32]:
    """Add a white ball without paint beside the painted one."""
    cover = shifted(at.cover, 95, -60)
    return at.lit * (1 - cover) + 120 * cover


def rod(at: Moment) -> NDArray[np.float32]:
    """Add a grey rod that holds the ball from above, in front of it."""
    picture = at.lit.copy()
    x, y = at.centre_px
    cv2.line(
        picture, (round(x), 0), (round(x), round(y - 0.55 * at.radius_px)), 90.0, max(2, round(0.2 * at.radius_px))
    )
    return picture


def flicker(depth: float, hertz: float, side: bool) -> Callable[[Moment], Any]:
    def change(at: Moment) -> NDArray[np.float32]:
        bright = 1 + depth * np.sin(2 * np.pi * hertz * at.time_s)
        if not side:
            return np.asarray(at.lit * bright, np.float32)
        across = (np.arange(at.lit.shape[1]) - at.centre_px[0]) / at.radius_px
        weight = np.clip(0.5 + 0.5 * across, 0, 1)
        return np.asarray(at.lit * (1 + (bright - 1) * weight), np.float32)

    return change


def rolling(rows_s: float, bands: int = 11) -> Callable[[Moment], Any]:
    """Rows are exposed one after the other, the ball's centre at the frame's time."""

    def change(at: Moment) -> NDArray[np.float32]:
        row = np.arange(len(at.lit)) - at.centre_px[1]
        reach = 1.3 * at.radius_px
        edges = np.linspace(-reach, reach, bands + 1)
        picture = at.lit.copy()
        for low, high in pairwise(edges):
            band = (row >= low) & (row < high)
            picture[band] = at.film(at.time_s + rows_s * 0.5 * (low + high))[0][band]
        return picture

    return change


def interlaced(at: Moment) -> NDArray[np.float32]:
    """Odd rows half a frame later; both fields are half a half frame from the frame's time."""
    half = 0.25 / 600
    early, late = at.film(at.time_s - half)[0], at.film(at.time_s + half)[0]
    early[1::2] = late[1::2]
    return early


def reflection(at: Moment) -> NDArray[np.float32]:
    """Add a mirrored, dimmer picture of the ball in a wall."""
    cover = shifted(at.cover[:, ::-1].copy(), 20, 90)
    lit = shifted(at.lit[:, ::-1].copy(), 20, 90)
    return np.asarray(at.lit + 0.35 * cover * lit, np.float32)


def half_dark(at: Moment) -> NDArray[np.float32]:
    across = (np.arange(at.lit.shape[1]) - at.centre_px[0]) / at.radius_px
    return np.asarray(at.lit * np.where(across < 0, 0.12, 1.0) + 1.8, np.float32)


def glare(at: Moment) -> NDArray[np.float32]:
    v, u = np.indices(at.lit.shape)
    x, y = at.centre_px + 0.3 * at.radius_px
    return np.asarray(at.lit + 300 * np.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / (0.25 * at.radius_px) ** 2))


def blurred(sigma_px: float) -> Callable[[Moment], Any]:
    return lambda at: np.asarray(cv2.GaussianBlur(at.lit, (0, 0), sigma_px))


def only(camera: int, change: Callable[[Moment], Any]) -> Callable[[Moment], Any]:
    return lambda at: change(at) if at.camera == camera else at.lit


# What is wrong with a movie


def late(frames: int) -> Callable[[Grey, int], Grey]:
    """The second camera began some frames early."""
    return lambda movie, camera: movie[:-frames] if camera else movie[frames:]


def recoded(crf: int) -> Callable[[Grey, int], Grey]:
    def change(movie: Grey, camera: int) -> Grey:
        import av

        with tempfile.TemporaryDirectory() as folder:
            path = f"{folder}/movie.mp4"
            with av.open(path, "w") as file:
                stream = file.add_stream("libx264", rate=30, options={"crf": str(crf)})
                stream.height, stream.width, stream.pix_fmt = *movie.shape[1:], "yuv420p"
                for one in movie:
                    file.mux(stream.encode(av.VideoFrame.from_ndarray(one, format="gray")))
                file.mux(stream.encode())
            with av.open(path) as file:
                return np.stack([frame.to_ndarray(format="gray") for frame in file.decode(video=0)])

    return change


def lost(share: float) -> Callable[[Grey, int], Grey]:
    """Lost frames are black."""

    def change(movie: Grey, camera: int) -> Grey:
        gone = np.random.default_rng([5, camera]).random(len(movie)) < share
        return np.where(gone[:, None, None], 0, movie).astype(np.uint8)

    return change


def repeated(movie: Grey, camera: int) -> Grey:
    return movie[np.maximum.accumulate(np.where(np.arange(len(movie)) % 5 == 3, 0, np.arange(len(movie))))]


def gamma(movie: Grey, camera: int) -> Grey:
    return np.rint(255 * (movie / 255.0) ** 0.6).astype(np.uint8)


def twelve_bits(movie: Grey, camera: int) -> Grey:
    return (movie.astype(np.uint16) * 16).clip(0, 4095)


def swapped(document: dict[str, Any]) -> None:
    document["movies"] = {"cam1": "cam2.npy", "cam2": "cam1.npy"}
    document.pop("backgrounds", None)


def sphere(**keys: Any) -> Callable[[dict[str, Any]], None]:
    return lambda document: document["sphere"].update(keys)


def flipped(camera: str, how: str) -> Callable[[dict[str, Any]], None]:
    return lambda document: document.update(flip={camera: how})


# What is wrong with the cameras


def turned(name: str, deg: float, axis: int = 0) -> Callable[[Cameras], Cameras]:
    """Rotate a reported camera about its own centre."""

    def change(cameras: Cameras) -> Cameras:
        one = cameras[name]
        w = torch.zeros(3, dtype=torch.float64)
        w[axis] = np.radians(deg)
        turn = so3.exp(w)
        return cameras | {
            name: replace(one, R_cam_lab=turn @ one.R_cam_lab, T_cam_lab_mm=turn @ one.T_cam_lab_mm)  # type: ignore[type-var]
        }

    return change


def wide_pixels(share: float, names: tuple[str, ...] = ("cam1", "cam2")) -> Callable[[Cameras], Cameras]:
    """Report square pixels for pixels that are wider than high."""

    def change(cameras: Cameras) -> Cameras:
        found = dict(cameras)
        for name in names:
            one = cameras[name]
            assert isinstance(one, TsaiCamera)
            found[name] = replace(one, sx=one.sx * (1 + share))
        return found

    return change


def moved(name: str, mm: tuple[float, float, float]) -> Callable[[Cameras], Cameras]:
    def change(cameras: Cameras) -> Cameras:
        one = cameras[name]
        return cameras | {name: replace(one, T_cam_lab_mm=one.T_cam_lab_mm + torch.tensor(mm).double())}  # type: ignore[type-var]

    return change


# What is wrong with the map


def unseen(folder: Path) -> None:
    """The northern sixth of the map was never seen: it is grey in the file, with texture_seen.png beside it."""
    grey = cv2.imread(str(folder / "texture.png"), cv2.IMREAD_GRAYSCALE)
    seen = np.full(grey.shape, 255, np.uint8)
    rows = round(0.38 * len(grey))
    grey[:rows], seen[:rows] = 128, 0
    write_picture(folder / "texture.png", grey)
    write_picture(folder / "texture_seen.png", seen)


def map_of(change: Callable[[Grey], Grey]) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        grey = cv2.imread(str(folder / "texture.png"), cv2.IMREAD_GRAYSCALE)
        write_picture(folder / "texture.png", np.ascontiguousarray(change(grey)))

    return edit


def warped(grey: Grey) -> Grey:
    """Shift latitudes by up to 3 degrees, as in a map painted by hand; one wave only would rotate the body frame."""
    height, width = grey.shape
    v, u = np.indices(grey.shape, dtype=np.float32)
    off = 3 / 180 * height * np.sin(4 * np.pi * u / width).astype(np.float32)
    return np.asarray(cv2.remap(grey, u, v + off, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def two_fold(texture: Tensor) -> Tensor:
    half = texture[:, : texture.shape[1] // 2]
    return torch.cat([half, half], 1)


# How the ball moves


def spinning(deg: float) -> Callable[[Motion6D], Motion6D]:
    """Add a constant rotation from frame to frame about one axis to the motion."""

    def change(motion: Motion6D) -> Motion6D:
        turns = motion.time_s * 600 * np.radians(deg)
        axis = torch.tensor([0.48, 0.6, 0.64], dtype=torch.float64)
        return replace(motion, R_lab_body=motion.R_lab_body @ so3.exp(turns[:, None] * axis))

    return change


def passing(mm: float) -> Callable[[Motion6D], Motion6D]:
    """The ball crosses the field along x."""

    def change(motion: Motion6D) -> Motion6D:
        along = (motion.time_s - motion.time_s.max() / 2) * (600 / 15) * mm  # 30 frames from -mm to mm
        position = motion.position_lab_mm.clone()
        position[:, 0] += along
        return replace(motion, position_lab_mm=position)

    return change


def resting(motion: Motion6D) -> Motion6D:
    return replace(
        motion,
        position_lab_mm=motion.position_lab_mm[:1].expand_as(motion.position_lab_mm),
        R_lab_body=motion.R_lab_body[:1].expand_as(motion.R_lab_body),
    )


def big(px: float, frame: int) -> dict[str, Any]:
    return {"diameter_px": px, "image_size": (frame, frame), "volume_mm": 5.0, "velocity_rms": 0.05, "frames": 12}


CASES = (
    Case(name="clean", what="nothing is wrong"),
    Case(name="clean_12", what="another paint and motion", scene={"seed": 12}),
    Case(name="clean_patches", what="another kind of paint", scene={"texture": "patches", "seed": 3}),
    Case(name="clean_dots", what="dots as paint", scene={"texture": "dots", "seed": 4}),
    Case(name="swapped", what="the two movies swapped", measurable=False, document=swapped),
    Case(
        name="second_ball",
        what="a second ball with the same paint",
        measurable=False,
        picture=second_ball(110, 60, 0.05),
    ),
    Case(
        name="second_ball_one",
        what="the same in one camera",
        measurable=False,
        picture=only(1, second_ball(-105, 70, 0.08)),
    ),
    Case(
        name="second_ball_dim", what="a dimmer second ball", measurable=False, picture=second_ball(110, -60, 0.03, 0.6)
    ),
    Case(name="plain_ball", what="a white ball beside", picture=plain_ball),
    Case(name="reflection", what="a dim mirror image of the ball", picture=reflection),
    Case(name="diameter_5", what="diameter 5 % too large", measurable=False, document=sphere(diameter=18.9)),
    Case(name="diameter_-5", what="diameter 5 % too small", measurable=False, document=sphere(diameter=17.1)),
    Case(name="diameter_2", what="diameter 2 % too large", measurable=False, document=sphere(diameter=18.36)),
    Case(
        name="turned_cam2_1.5",
        what="the second camera turned by 1.5 degrees",
        measurable=False,
        reported=turned("cam2", 1.5),
    ),
    Case(
        name="turned_cam1_1.5",
        what="the first camera turned by 1.5 degrees",
        measurable=False,
        reported=turned("cam1", 1.5, 1),
    ),
    Case(
        name="turned_cam1_5",
        what="the first camera turned by 5 degrees",
        measurable=False,
        reported=turned("cam1", 5.0),
    ),
    Case(
        name="turned_cam2_0.3",
        what="the second camera turned by 0.3 degrees",
        measurable=False,
        reported=turned("cam2", 0.3, 1),
    ),
    Case(
        name="rolled_cam2_1.5",
        what="the second camera rotated about its axis",
        measurable=False,
        reported=turned("cam2", 1.5, 2),
    ),
    Case(
        name="moved_cam2",
        what="the second camera moved by 4 mm",
        measurable=False,
        reported=moved("cam2", (4.0, 0.0, 0.0)),
    ),
    Case(name="wide_pixels_3", what="pixels 3 % wider than high", measurable=False, reported=wide_pixels(0.03)),
    Case(
        name="wide_pixels_one", what="the same in one camera", measurable=False, reported=wide_pixels(0.03, ("cam2",))
    ),
    Case(name="small_16", what="a ball of 16 px", scene={"diameter_px": 16.0, "image_size": (120, 120)}),
    Case(name="small_24", what="a ball of 24 px", scene={"diameter_px": 24.0, "image_size": (160, 160)}),
    Case(name="small_32", what="a ball of 32 px", scene={"diameter_px": 32.0, "image_size": (200, 200)}),
    Case(name="big_250", what="a ball of 250 px", scene=big(250.0, 600)),
    Case(name="big_400", what="a ball of 400 px", scene=big(400.0, 900)),
    Case(name="frames_2000", what="pictures of 2000 px", scene={"image_size": (2000, 2000), "frames": 10}),
    Case(name="unseen", what="part of the map never seen", edit=unseen),
    Case(name="warped_map", what="a map warped by up to 3 degrees", measurable=False, edit=map_of(warped)),
    Case(name="mirrored_map", what="a mirrored map", measurable=False, edit=map_of(lambda grey: grey[:, ::-1])),
    Case(name="upside_down", what="a map upside down", measurable=False, edit=map_of(lambda grey: grey[::-1])),
    Case(name="inverted_map", what="black and white exchanged", measurable=False, edit=map_of(lambda grey: 255 - grey)),
    Case(
        name="other_map",
        what="a map of another ball",
        measurable=False,
        edit=map_of(lambda g: np.roll(g[::-1, ::-1], 200, 0)),
    ),
    Case(name="two_fold", what="two-fold paint; pictures cannot decide", measurable=False, texture=two_fold),
    Case(
        name="mirrored_cam1", what="the first movie mirrored", measurable=False, document=flipped("cam1", "horizontal")
    ),
    Case(
        name="turned_movie",
        what="the second movie turned by half a turn",
        measurable=False,
        document=flipped("cam2", "both"),
    ),
    Case(name="late_2", what="the second movie 2 frames late", measurable=False, movie=late(2)),
    Case(name="late_1", what="the second movie 1 frame late", measurable=False, movie=late(1)),
    Case(name="late_7", what="the second movie 7 frames late", measurable=False, movie=late(7)),
    Case(name="bits_12", what="12 bits in 16", movie=twelve_bits),
    Case(name="gamma", what="gamma 0.6", movie=gamma),
    Case(name="crf_28", what="compressed with crf 28", movie=recoded(28)),
    Case(name="lost_half", what="half of all frames lost", movie=lost(0.5)),
    Case(name="repeated", what="each fifth frame repeated", movie=repeated),
    Case(name="interlaced", what="interlaced rows", picture=interlaced),
    Case(name="rolling", what="rolling shutter, 12 ms a ball", measurable=False, picture=rolling(2e-5)),
    Case(name="flicker_30", what="flicker of 30 %", picture=flicker(0.3, 130, False)),
    Case(name="flicker_side", what="one side flickers at 100 Hz", picture=flicker(0.3, 100, True)),
    Case(name="rod", what="a rod holds the ball", measurable=False, picture=rod),
    Case(name="half_dark", what="half of each view is nearly black", measurable=False, picture=half_dark),
    Case(name="glare", what="a saturated spot of 1/4 radius", picture=glare),
    Case(name="glare_one", what="the same in one camera", picture=only(0, glare)),
    Case(name="blur_3", what="defocus of 3 px", picture=blurred(3.0)),
    Case(
        name="blur_one",
        what="one camera defocused: the map explains the other alone",
        measurable=False,
        picture=only(1, blurred(2.5)),
    ),
    Case(name="low_contrast", what="paint from 40 to 62", scene={"black": 40.0, "white": 62.0}),
    Case(name="passing", what="the ball enters and leaves", move=passing(48.0)),
    Case(name="resting", what="the ball rests", move=resting),
    Case(name="spin_60", what="60 degrees a frame", move=spinning(60), scene={"exposure_samples": 1}),
    Case(name="spin_110", what="110 degrees a frame", move=spinning(110), scene={"exposure_samples": 1}),
    Case(name="spin_170", what="170 degrees a frame", move=spinning(170), scene={"exposure_samples": 1}),
    Case(name="frames_2", what="2 frames", scene={"frames": 2}),
    Case(name="frames_5", what="5 frames", scene={"frames": 5}),
    Case(name="frames_10", what="10 frames", scene={"frames": 10}),
)


def film(folder: Path, case: Case) -> Path:
    """Make the experiment of a case."""
    settings = SynthSettings(**SHARED | {"name": case.name} | dict(case.scene))
    cameras, times_s = default_cameras(settings), frame_times_s(settings)
    grey = np.rint(random_texture(settings.texture, settings.seed).numpy() * 255).astype(np.uint8)
    texture = torch.from_numpy(grey / np.float32(255))
    if case.texture is not None:
        texture = case.texture(texture)
        grey = np.rint(texture.numpy() * 255).astype(np.uint8)
    write_picture(folder / "texture.png", grey)
    scene, motion = make_scene(texture, settings), motion_of(settings)

    def at(times: Tensor) -> Motion6D:
        found = motion.at(times)
        return found if case.move is None else case.move(found)

    # One fine clock for all pictures, from before the first exposure to after the last.
    step_s = 1 / (settings.frame_rate * FINE)
    whole = at(torch.arange(0, 2 * LEAD_S + float(times_s[-1]), step_s, dtype=torch.float64))

    def poses(now_s: Tensor) -> tuple[Tensor, Tensor]:
        index = ((now_s + LEAD_S) / step_s).round().long()
        return whole.position_lab_mm[index], whole.R_lab_body[index]

    for index, (name, camera) in enumerate(cameras.items()):
        rng = seeded(settings.seed, index)
        frames = np.stack(list(pictures(case, scene, camera, index, times_s, poses, rng)))
        if case.movie is not None:
            frames = case.movie(frames, index)
        np.save(folder / f"{name}.npy", frames)
        empty = np.full(frames.shape[1:], settings.background * (16 if frames.dtype == np.uint16 else 1))
        if case.movie is gamma:
            empty = 255 * (empty / 255) ** 0.6
        write_picture(folder / f"empty_{name}.png", np.rint(empty).astype(frames.dtype))
    save_cameras(folder / "cameras.yaml", case.reported(cameras) if case.reported else cameras, comment="of a case")
    X, R = poses(times_s)
    truth = replace(motion.at(times_s), position_lab_mm=X, R_lab_body=R)
    write_truth(folder / "truth.h5", {"": truth}, cameras)
    document = experiment_document(settings, cameras, ".npy")
    if case.document:
        case.document(document)
    if case.edit:
        case.edit(folder)
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
    return path


def pictures(
    case: Case,
    scene: RenderedScene,
    camera: Camera,
    index: int,
    times_s: Tensor,
    poses: Callable[[Tensor], tuple[Tensor, Tensor]],
    rng: torch.Generator,
) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames (H, W) of one camera."""
    settings = scene.settings
    count = settings.exposure_samples
    within = ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5) * settings.exposure

    def filmed(time_s: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        X, R = poses(time_s + within)
        exposure = expose([scene], camera, X[None], R[None])
        return exposure.before(settings.background), exposure.covered

    for k, time_s in enumerate(times_s.tolist()):
        lit, cover = filmed(time_s)
        if case.picture is not None:
            X = poses(torch.tensor([time_s]).double())[0][0]
            right = camera.R_cam_lab[0] * settings.diameter_mm / 2
            centre, rim = camera.project(torch.stack([X, X + right])).numpy()
            lit = case.picture(
                Moment(
                    lit=lit,
                    cover=cover,
                    camera=index,
                    frame=k,
                    time_s=time_s,
                    centre_px=centre,
                    radius_px=float(np.linalg.norm(rim - centre)),
                    film=filmed,
                )
            )
        yield digitise(lit.astype(np.float32), settings, rng)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Counts of frames of a case's track."""

    name: str
    refused: str = ""
    frames: int = 0
    valid: int = 0
    silent: int = 0  # valid, wrong, unmarked
    right_marked: int = 0  # right but marked or not valid, of a measurable case
    right: int = 0
    error_deg: float = float("nan")  # median of valid frames
    error_mm: float = float("nan")
    over_sigma: float = float("nan")  # rms error over the stated one, the larger of rotation and position
    flags: int = 0  # of all valid frames together
    seconds: float = 0.0


def judge(track: Trajectory, folder: Path, late_frames: int = 0) -> dict[str, Any]:
    """Compare a track with the truth."""
    import h5py

    with h5py.File(folder / "truth.h5") as file:
        R_true, X_true = file["orientation"][...], file["position"][...]
    count = len(track.time)
    R_true, X_true = R_true[late_frames : late_frames + count], X_true[late_frames : late_frames + count]
    with np.errstate(invalid="ignore"):
        turn = np.full((count, 3), np.nan)
        there = np.isfinite(track.orientation).all((1, 2))
        turn[there] = Rotation.from_matrix(track.orientation[there] @ R_true[there].transpose(0, 2, 1)).as_rotvec()
    off = track.position - X_true
    distances = [mahalanobis(e, C) for e, C in ((turn, track.orientation_cov), (off, track.position_cov))]
    sigmas = np.maximum(*distances)
    deg = np.degrees(np.linalg.norm(turn, axis=1))
    wrong = (deg > WRONG_DEG) | (sigmas > WRONG_SIGMAS)
    marked = ~track.valid | ((track.flags & int(MARKS)) > 0)
    shown = track.valid
    return {
        "frames": count,
        "valid": int(shown.sum()),
        "silent": int((shown & wrong & ~marked).sum()),
        "right": int((there & ~wrong).sum()),
        "right_marked": int((there & ~wrong & marked).sum()),
        "error_deg": float(np.median(deg[shown])) if shown.any() else float("nan"),
        "error_mm": float(np.median(np.linalg.norm(off[shown], axis=1))) if shown.any() else float("nan"),
        "over_sigma": max(float(np.sqrt(np.mean(d[shown] ** 2) / 3)) for d in distances) if shown.any() else np.nan,
        "flags": int(np.bitwise_or.reduce(track.flags[shown])) if shown.any() else 0,
    }


def tried(name: str, folder: Path) -> Verdict:
    """Film and track one case."""
    torch.set_num_threads(1)
    case = next(case for case in CASES if case.name == name)
    place = folder / name
    if not (place / "experiment.yaml").exists():
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        film(place, case)
    begin = time.perf_counter()
    try:
        track = run(Request(experiment=place / "experiment.yaml"), MemoryStore())
    except SphereOrientError as error:
        return Verdict(name=name, refused=str(error), seconds=time.perf_counter() - begin)
    early = int(name.removeprefix("late_")) if name.startswith("late_") else 0
    return Verdict(name=name, seconds=time.perf_counter() - begin, **judge(track, place, early))


def main() -> int:
    """Try the cases and print the table; return 1 if a frame is silently wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", help="names of cases")
    parser.add_argument("--keep", type=Path, help="folder for the movies, used again by the next call")
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    names = given.only or [case.name for case in CASES]
    folder = given.keep or Path(tempfile.mkdtemp(prefix="silent_wrong_"))
    silent = right = marked = 0
    print(f"{'case':18} valid  silent  right but marked   error deg     mm   over sigma  flags")
    with ProcessPoolExecutor(given.jobs) as pool:
        for one in pool.map(tried, names, [folder] * len(names)):
            case = next(case for case in CASES if case.name == one.name)
            if one.refused:
                print(f"{one.name:18} refused: {one.refused[:150]}", flush=True)
                continue
            silent += one.silent
            if case.measurable:
                right, marked = right + one.right, marked + one.right_marked
            print(
                f"{one.name:18} {one.valid:3}/{one.frames:<3} {one.silent:4} {one.right_marked:7}/{one.right:<9}"
                f" {one.error_deg:10.3f} {one.error_mm:8.3f} {one.over_sigma:12.2f} {one.flags:6}  {one.seconds:.0f} s",
                flush=True,
            )
    print(f"silently wrong: {silent}; right frames of measurable cases that are marked: {marked} of {right}")
    if given.keep is None:
        shutil.rmtree(folder, ignore_errors=True)
    return int(silent > 0)


if __name__ == "__main__":
    sys.exit(main())
