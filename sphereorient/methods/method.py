"""The interface between `run` and a method: job, stages, learnt and measured results, with their files.

By the learnt results of another run, a run measures the same to the last bit.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

from sphereorient.cameras.response import Response
from sphereorient.errors import Reason, TrackError, error_words, refusal
from sphereorient.experiment.recording import CameraStream, Recording
from sphereorient.files.hdf5 import DAMAGE, SPHERES, ball_group, ball_groups, digest, whole_hdf5
from sphereorient.files.threads import Progress
from sphereorient.follow import Appearance
from sphereorient.follow.follower import Follower
from sphereorient.locate import Background, CameraScene
from sphereorient.methods.proposers import finest_table
from sphereorient.methods.settings import Settings
from sphereorient.motion import Prior, ProcessNoise, ProcessPrior
from sphereorient.pose import CameraView, Fitter, Optics
from sphereorient.pose.lasting import Lasting
from sphereorient.pose.lights.kinds import light_of
from sphereorient.pose.model import Light
from sphereorient.pose.poses import POSE_PARTS, Poses
from sphereorient.pose.worn import without
from sphereorient.trajectory import Trajectory

SCHEMA, SCHEMA_OF_SEVERAL = "sphereorient-learnt/3", "sphereorient-learnt/4"
SCHEMA_OF_POSES = "sphereorient-poses/1"
SCORES, WHETHER = ("score_min", "right_score", "usual_apart_rad"), ("together", "second_ball", "sharper")
OF_APPEARANCE = (*SCORES, *WHETHER, "majority", "worn", "map_log_odds")  # fields common to both
BLURS = ("blur_px", "limb_blur_px", "still_blur_px", "still_limb_blur_px")
# Fields stored as attributes of the file, and their types; tensors are datasets.
KINDS: dict[str, Callable[[Any], Any]] = {
    **dict.fromkeys((*SCORES, *BLURS, "most_hidden", "widest_px", "acceleration_rad_s2", "map_log_odds"), float),
    **dict.fromkeys(WHETHER, bool),
    "instants": int,
    "majority": lambda cameras: tuple(map(int, cameras)),
}
TENSORS = ("limb_px", "worn")
LASTING = ("covariance", "own_rad2", "alone")
NO_ROTATION = 1e-6  # deviation of an entry of R R^T from the unit matrix, at which R is no rotation


@dataclass(frozen=True, kw_only=True, eq=False)
class Learnt:
    """All that the precise method learns from the movies, before and after tracking; made by the pipeline."""

    scenes: Mapping[str, CameraScene]  # by camera, in the order of the fit
    light: Light
    lasting: Lasting
    blur_px: float  # of the paint
    limb_blur_px: float
    still_blur_px: float  # of frames of unknown motion
    still_limb_blur_px: float
    widest_px: float
    score_min: float
    right_score: float
    usual_apart_rad: float
    limb_px: torch.Tensor | None = None  # (C,), see `SphereModel`
    instants: int = 1  # of the exposure that fits render
    most_hidden: float = 0.0  # share of a disk that occluders may cover
    together: bool = False
    majority: tuple[int, ...] = ()  # see `Appearance`
    second_ball: bool = False
    sharper: bool = False
    worn: torch.Tensor | None = None  # see `Appearance`
    map_log_odds: float | None = None  # see `Appearance`
    process: ProcessNoise | None = None  # None: no track yet, or too short a one
    acceleration_rad_s2: float | None = None  # used for the choice of the path

    @classmethod
    def of(
        cls, appearance: Appearance, process: ProcessNoise | None = None, acceleration_rad_s2: float | None = None
    ) -> "Learnt":
        """Return the appearance, and the motion of the finished track."""
        fitter = appearance.fitter
        finite = acceleration_rad_s2 is not None and np.isfinite(acceleration_rad_s2)
        return cls(
            scenes={view.name: view.scene for view in fitter.views},
            light=fitter.light,
            limb_px=fitter.limb_px,
            lasting=appearance.lasting,
            blur_px=fitter.optics.blur_px,
            limb_blur_px=fitter.optics.limb_blur_px,
            still_blur_px=appearance.still.optics.blur_px,
            still_limb_blur_px=appearance.still.optics.limb_blur_px,
            instants=fitter.instants,
            most_hidden=fitter.most_hidden,
            widest_px=fitter.widest_px,
            **{name: getattr(appearance, name) for name in OF_APPEARANCE},
            process=process,
            acceleration_rad_s2=acceleration_rad_s2 if finite else None,
        )

    def appearance(self, recording: Recording) -> Appearance:
        """Return the estimated appearance. Raises TrackError: other cameras, another picture size or response."""
        used = {stream.name: stream.movie.frame_shape for stream in recording.streams}
        known = {name: scene.background.mean.shape for name, scene in self.scenes.items()}
        if list(used.items()) != list(known.items()):
            other = {name: shape for name, shape in used.items() if known.get(name) != shape} or used
            expected, got = (", ".join(f"{name} {shape}" for name, shape in each.items()) for each in (other, known))
            do = "pass a file of the same cameras"
            raise TrackError(refusal("learnt", expected=f"learnt results of {expected}", got=got, do=do))
        views = [CameraView.of(one.name, one.camera, _shown(self.scenes[one.name], one)) for one in recording.streams]
        widest = max(scene.diameter_px for scene in self.scenes.values())
        base = finest_table(recording.texture, widest, recording.unseen)
        paint = base if self.worn is None else without(base, self.worn)
        fitter = still = Fitter(
            views=views,
            radius_mm=recording.experiment.radius_mm,
            optics=Optics(paint, self.still_blur_px, widest, self.still_limb_blur_px),
            light=self.light,
            widest_px=self.widest_px,
            limb_px=self.limb_px,
            most_hidden=self.most_hidden,
        )
        if self.instants > 1:
            optics = Optics(paint, self.blur_px, widest, self.limb_blur_px)
            fitter = replace(still, optics=optics, instants=self.instants)
        shared = {name: getattr(self, name) for name in OF_APPEARANCE}
        return Appearance(fitter=fitter, still=still, lasting=self.lasting, **shared)


def _shown(scene: CameraScene, stream: CameraStream) -> CameraScene:
    """Return a learnt scene with the mask of the experiment. Raises TrackError: the responses differ."""
    if stream.response not in (None, scene.response):
        got, do = str(scene.response or "an unknown one"), "learn anew: leave --learnt out"
        name = f"learnt, response of {stream.name}"
        raise TrackError(refusal(name, expected=str(stream.response), got=got, do=do))
    return replace(scene, background=replace(scene.background, shown=stream.shown))


def save_learnt(learnt: Mapping[str, Learnt], path: Path) -> None:
    """Write the learnt results of each ball, by name, as HDF5, atomically; may raise OutputError."""
    with whole_hdf5(path) as file:
        _write_scenes(next(iter(learnt.values())), file)
        for name, one in learnt.items():
            _write(one, ball_group(file, name))
        file.attrs["schema"] = SCHEMA_OF_SEVERAL if SPHERES in file else SCHEMA
        file.attrs["sha256"] = digest(file)


def load_learnt(path: Path) -> dict[str, Learnt]:
    """Read a file of `save_learnt`. Raises TrackError: missing, damaged, or another schema."""
    do = "write one with `sphereorient track --save-learnt FILE`"
    if not path.is_file():
        raise TrackError(refusal(str(path), expected="a file of learnt results", got="no such file", do=do))
    try:
        with h5py.File(path, "r") as file:
            schema = file.attrs.get("schema")
            if schema not in (SCHEMA, SCHEMA_OF_SEVERAL):
                raise TrackError(refusal(f"{path}: schema", expected=SCHEMA, got=str(schema), do=do))
            if file.attrs.get("sha256") != digest(file):
                raise ValueError("a checksum that does not fit")
            scenes = _read_scenes(file)
            return {name: _read(group, scenes) for name, group in ball_groups(file).items()}
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        expected, got = "a whole file of learnt results", error_words(error)
        raise TrackError(refusal(str(path), expected=expected, got=got, do=do)) from error


@dataclass(frozen=True, kw_only=True, eq=False)
class Job:
    """An experiment opened for a method; made by `run.opened`, read by the methods."""

    recording: Recording
    settings: Settings
    device: torch.device
    given: Mapping[str, Learnt] | None = None  # learnt by another run, by ball

    def of(self, name: str) -> "Job":
        """Return the job of one ball. Raises ExperimentError: unknown name."""
        given = None if self.given is None else {name: self.given[name]}
        return replace(self, recording=self.recording.of(name), given=given)


Followed = Mapping[str, list[Poses]]  # by ball: poses in the frames of a batch
Joined = tuple[Trajectory, Learnt | None]  # of one ball


@dataclass(frozen=True, kw_only=True, eq=False)
class Method:
    """The stages of a method, in order; without a follower, `join` does all (paper)."""

    learn: Callable[[Job, Progress], Follower | None]
    # Instead of `learn`, with learnt results of each ball; None: the method learns nothing.
    resume: Callable[[Job, Mapping[str, Learnt]], Follower] | None
    join: Callable[[Job, Follower | None, Iterable[Followed], Progress], dict[str, Joined]]


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch to one thread: tensors here are small, and waiting threads slow down decoding."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _write_scenes(learnt: Learnt, file: h5py.File) -> None:
    file.attrs["cameras"] = list(learnt.scenes)
    for name, scene in learnt.scenes.items():
        group, background = file.create_group(f"cameras/{name}"), scene.background
        group.attrs["full_scale"], group.attrs["diameter_px"] = background.full_scale, scene.diameter_px
        group.attrs["merit_min"] = scene.merit_min
        for part in ("mean", "noise", "shown"):
            if getattr(background, part) is not None:
                group.create_dataset(part, data=getattr(background, part), track_times=False)


def _write(learnt: Learnt, file: h5py.Group) -> None:
    file.attrs["schema"] = SCHEMA
    for name in KINDS:
        if (value := getattr(learnt, name)) not in (None, ()):
            file.attrs[name] = value
    file.attrs["diameter_px"] = [scene.diameter_px for scene in learnt.scenes.values()]
    responses = [scene.response for scene in learnt.scenes.values()]
    file.attrs["response"] = [json.dumps(None if one is None else asdict(one)) for one in responses]
    light = file.create_group("light")
    light.attrs["known"] = learnt.light.known
    for part, values in learnt.light.parts().items():
        light.create_dataset(part, data=values.numpy(), track_times=False)
    tensors = {name: getattr(learnt, name) for name in TENSORS}
    tensors |= {f"lasting/{part}": getattr(learnt.lasting, part) for part in LASTING}
    for name, tensor in tensors.items():
        if tensor is not None:
            file.create_dataset(name, data=tensor.numpy(), track_times=False)
    if learnt.process is not None:
        group = file.create_group("process")
        group.attrs["frame_s"] = learnt.process.frame_s
        for part in ("place", "turn"):
            motion: ProcessPrior | None = getattr(learnt.process, part)
            if motion is not None:
                group.attrs[part] = np.array([motion.prior.pole, motion.prior.deviation, motion.scale])


def _read_scenes(file: h5py.File) -> dict[str, CameraScene]:
    scenes = {}
    for name in map(str, file.attrs["cameras"]):
        group: Any = file[f"cameras/{name}"]
        background = Background(
            mean=np.asarray(group["mean"][()], np.float32),
            noise=np.asarray(group["noise"][()], np.float32),
            full_scale=float(group.attrs["full_scale"]),
            shown=np.asarray(group["shown"][()], bool) if "shown" in group else None,
        )
        diameter_px, merit_min = (float(group.attrs[part]) for part in ("diameter_px", "merit_min"))
        scenes[name] = CameraScene(background=background, diameter_px=diameter_px, merit_min=merit_min)
    return scenes


def _read(file: h5py.Group, scenes: Mapping[str, CameraScene]) -> Learnt:
    """Read the learnt results of one ball; each of several has its own diameters and camera responses."""
    responses = map(json.loads, file.attrs["response"])
    known = [one and Response(**one | {"table": tuple(map(tuple, one["table"]))}) for one in responses]
    own = zip(scenes.items(), file.attrs["diameter_px"], known, strict=True)
    scenes = {name: replace(scene, diameter_px=float(px), response=one) for (name, scene), px, one in own}
    light = file["light"]
    parts = {part: torch.from_numpy(light[part][()]) for part in light}
    lasting = Lasting(**{part: torch.from_numpy(file[f"lasting/{part}"][()]) for part in LASTING})
    found = {name: kind(file.attrs[name]) for name, kind in KINDS.items() if name in file.attrs}
    found |= {name: torch.from_numpy(file[name][()]) for name in TENSORS if name in file}
    process = _process(file["process"]) if "process" in file else None
    return Learnt(
        scenes=scenes, light=light_of(parts, bool(light.attrs["known"])), lasting=lasting, process=process, **found
    )


def _process(group: h5py.Group) -> ProcessNoise:
    def motion(part: str) -> ProcessPrior | None:
        if part not in group.attrs:
            return None
        pole, deviation, scale = (float(value) for value in group.attrs[part])
        return ProcessPrior(prior=Prior(pole=pole, deviation=deviation), scale=scale)

    return ProcessNoise(place=motion("place"), turn=motion("turn"), frame_s=float(group.attrs["frame_s"]))


def write_poses(poses: Followed, path: Path) -> None:
    """Write the poses of each ball in one batch as HDF5, atomically; may raise OutputError."""
    with whole_hdf5(path, "check the space left, then run again with --resume") as file:
        file.attrs["schema"] = SCHEMA_OF_POSES
        for ball, of_ball in poses.items():
            group = ball_group(file, ball)
            group["count"] = np.array([len(one) for one in of_ball])
            group["use"] = np.stack([one.use.numpy() for one in of_ball])
            group["reason"] = np.array([[str(why) for why in one.reason] for one in of_ball], "S16")
            for name in POSE_PARTS:
                group[name] = torch.cat([getattr(one, name) for one in of_ball]).numpy()
        file.attrs["sha256"] = digest(file)


def read_poses(path: Path) -> Followed | None:
    """Return the poses of `write_poses`; None if the file is damaged."""
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("schema") != SCHEMA_OF_POSES or file.attrs.get("sha256") != digest(file):
                return None
            return {name: _read_poses(group) for name, group in ball_groups(file).items()}
    except MemoryError:
        raise
    except DAMAGE:
        return None


def _read_poses(group: h5py.Group) -> list[Poses]:
    R = torch.from_numpy(group["R_lab_body"][()])
    if not bool(((R @ R.mT - torch.eye(3)).abs() < NO_ROTATION).all() and (torch.linalg.det(R) > 0).all()):
        raise ValueError("no rotations")
    count, use = group["count"][()].tolist(), torch.from_numpy(group["use"][()])
    reason = [[Reason(why.decode()) for why in row] for row in group["reason"][()].tolist()]
    parts = {name: torch.split(torch.from_numpy(group[name][()]), count) for name in POSE_PARTS}
    return [
        # Copy: a row would keep the whole array in memory.
        Poses(**{name: parts[name][k].clone() for name in POSE_PARTS}, use=use[k].clone(), reason=tuple(reason[k]))
        for k in range(len(count))
    ]
