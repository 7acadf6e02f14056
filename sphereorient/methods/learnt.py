"""The appearance and motion that a run learnt, in a file: another run uses it to measure the same to the last bit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

from sphereorient.errors import TrackError, refusal
from sphereorient.experiment.recording import Recording
from sphereorient.files.hdf5 import whole_hdf5
from sphereorient.follow import Appearance
from sphereorient.locate import Background, CameraScene
from sphereorient.motion import Prior, ProcessNoise, ProcessPrior
from sphereorient.pose import CameraView, Fitter, Light, Optics, base_table

SCHEMA = "sphereorient-learnt/1"
NUMBERS = ("blur_px", "widest_px", "score_min", "right_score", "usual_apart_rad")


@dataclass(frozen=True, kw_only=True, eq=False)
class Learnt:
    """Everything that the precise method learns from the movies, before and after tracking; made by the pipeline."""

    backgrounds: Mapping[str, Background]  # by camera, in the order of the fit
    diameter_px: Mapping[str, float]
    light: Light
    blur_px: float
    widest_px: float
    score_min: float
    right_score: float
    usual_apart_rad: float
    together: bool
    process: ProcessNoise | None = None  # None: no track yet, or too short a one
    acceleration_rad_s2: float | None = None  # that the path was chosen with

    @classmethod
    def of(cls, study: Appearance) -> Learnt:
        """Return what was learnt before the first frame was measured."""
        fitter = study.fitter
        return cls(
            backgrounds={view.name: view.background for view in fitter.views},
            diameter_px={view.name: view.diameter_px for view in fitter.views},
            light=fitter.light,
            blur_px=fitter.optics.blur_px,
            widest_px=fitter.widest_px,
            score_min=study.score_min,
            right_score=study.right_score,
            usual_apart_rad=study.usual_apart_rad,
            together=study.together,
        )

    def appearance(self, recording: Recording) -> Appearance:
        """Return the estimated appearance; raise TrackError for other cameras or another picture size."""
        views = []
        for stream in recording.streams:
            background = self.backgrounds.get(stream.name)
            if background is None or background.mean.shape != stream.movie.frame_shape:
                got = ", ".join(f"{name} {one.mean.shape}" for name, one in self.backgrounds.items())
                expected = f"what was learnt of {stream.name}, {stream.movie.frame_shape}"
                raise TrackError(refusal("learnt", expected=expected, got=got, do="pass that of the same cameras"))
            scene = CameraScene(background=background, diameter_px=self.diameter_px[stream.name])
            views.append(CameraView.of(stream.name, stream.camera, scene))
        order = list(self.backgrounds)
        if [view.name for view in views] != order:
            expected, got = ", ".join(order), ", ".join(view.name for view in views)
            raise TrackError(refusal("learnt", expected=expected, got=got, do="use the same cameras"))
        widest = max(self.diameter_px.values())
        optics = Optics(base_table(recording.texture, widest), self.blur_px, widest)
        fitter = Fitter(
            views=views, radius_mm=recording.radius_mm, optics=optics, light=self.light, widest_px=self.widest_px
        )
        return Appearance(
            fitter=fitter,
            score_min=self.score_min,
            right_score=self.right_score,
            usual_apart_rad=self.usual_apart_rad,
            together=self.together,
        )

    def save(self, path: Path) -> None:
        """Write everything as HDF5, atomically; raise OutputError if the file cannot be written."""
        with whole_hdf5(path) as file:
            _write(self, file)

    @classmethod
    def load(cls, path: Path) -> Learnt:
        """Read what `save` wrote; raise TrackError if the file is missing, damaged or of another schema."""
        do = "write one with `sphereorient track --save-learnt FILE`"
        if not path.is_file():
            raise TrackError(refusal(str(path), expected="a file of what was learnt", got="no such file", do=do))
        try:
            with h5py.File(path, "r") as file:
                schema = file.attrs.get("schema")
                if schema != SCHEMA:
                    raise TrackError(refusal(f"{path}: schema", expected=SCHEMA, got=str(schema), do=do))
                return _read(file)
        except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
            got = f"'{str(error).splitlines()[0]}'"
            raise TrackError(refusal(str(path), expected="a whole file of what was learnt", got=got, do=do)) from error


def _write(learnt: Learnt, file: h5py.File) -> None:
    file.attrs["schema"] = SCHEMA
    for name in NUMBERS:
        file.attrs[name] = getattr(learnt, name)
    file.attrs["together"] = learnt.together
    if learnt.acceleration_rad_s2 is not None:
        file.attrs["acceleration_rad_s2"] = learnt.acceleration_rad_s2
    file.attrs["cameras"] = list(learnt.backgrounds)
    for name, background in learnt.backgrounds.items():
        group = file.create_group(f"cameras/{name}")
        group.attrs["full_scale"], group.attrs["diameter_px"] = background.full_scale, learnt.diameter_px[name]
        for part in ("mean", "noise", "shown"):
            if getattr(background, part) is not None:
                group.create_dataset(part, data=getattr(background, part), track_times=False)
    light = file.create_group("light")
    light.attrs["known"] = learnt.light.known
    for part in ("difference", "black", "noise"):
        light.create_dataset(part, data=getattr(learnt.light, part).cpu().numpy(), track_times=False)
    if learnt.process is not None:
        group = file.create_group("process")
        group.attrs["frame_s"] = learnt.process.frame_s
        for part in ("place", "turn"):
            motion: ProcessPrior | None = getattr(learnt.process, part)
            if motion is not None:
                group.attrs[part] = np.array([motion.prior.pole, motion.prior.deviation, motion.scale])


def _read(file: h5py.File) -> Learnt:
    names = [str(name) for name in file.attrs["cameras"]]
    groups: dict[str, Any] = {name: file[f"cameras/{name}"] for name in names}
    backgrounds = {
        name: Background(
            mean=np.asarray(group["mean"][()], np.float32),
            noise=np.asarray(group["noise"][()], np.float32),
            full_scale=float(group.attrs["full_scale"]),
            shown=np.asarray(group["shown"][()], bool) if "shown" in group else None,
        )
        for name, group in groups.items()
    }
    light = file["light"]
    parts = {part: torch.from_numpy(light[part][()]) for part in ("difference", "black", "noise")}
    acceleration = file.attrs.get("acceleration_rad_s2")
    return Learnt(
        backgrounds=backgrounds,
        diameter_px={name: float(group.attrs["diameter_px"]) for name, group in groups.items()},
        light=Light(known=bool(light.attrs["known"]), **parts),
        together=bool(file.attrs["together"]),
        process=_process(file["process"]) if "process" in file else None,
        acceleration_rad_s2=None if acceleration is None else float(acceleration),
        **{name: float(file.attrs[name]) for name in NUMBERS},
    )


def _process(group: h5py.Group) -> ProcessNoise:
    def motion(part: str) -> ProcessPrior | None:
        if part not in group.attrs:
            return None
        pole, deviation, scale = (float(value) for value in group.attrs[part])
        return ProcessPrior(prior=Prior(pole=pole, deviation=deviation), scale=scale)

    return ProcessNoise(place=motion("place"), turn=motion("turn"), frame_s=float(group.attrs["frame_s"]))


def with_motion(learnt: Learnt, process: ProcessNoise, acceleration_rad_s2: float) -> Learnt:
    """Return the same with the motion statistics of the finished track."""
    told = acceleration_rad_s2 if np.isfinite(acceleration_rad_s2) else None
    return replace(learnt, process=process, acceleration_rad_s2=told)
