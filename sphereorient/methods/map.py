"""The method of `sphereorient map`: learn texture maps from movies of rotating spheres."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from torch import Tensor

from sphereorient.cameras import PinholeCamera, field_of_focal
from sphereorient.errors import ExperimentError, refusal
from sphereorient.experiment import Experiment, input_files
from sphereorient.experiment.recording import Recording, TextureMap, open_recording
from sphereorient.files.hdf5 import UNNAMED
from sphereorient.files.provenance import provenance
from sphereorient.files.threads import Progress, silent
from sphereorient.mapping import LearntMap, fit_map
from sphereorient.mapping.adjustment import focal_ratio
from sphereorient.mapping.balls import SharedMap, corrected, crops_of_balls, shared_maps
from sphereorient.mapping.disks import held_place
from sphereorient.mapping.first_pass import first_adjustment
from sphereorient.methods.method import one_thread
from sphereorient.methods.results import map_track
from sphereorient.methods.settings import Settings, check_settings, settings_yaml
from sphereorient.sphere import load_known
from sphereorient.sphere.compare import MapComparison
from sphereorient.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True, eq=False)
class MapResult:
    """The result of `learn_map`."""

    experiment: Experiment
    learnt: LearntMap
    track: Trajectory  # the orientations of all frames
    remarks: tuple[str, ...]  # on the inputs
    comparison: MapComparison | None = None  # with the old map, if given
    kept_share: float = 0.0  # of the sphere, unseen, with the old map's texture
    paint_of: str  # name of the first ball with this paint

    @property
    def texture(self) -> Tensor:
        """The texture map, (H, 2 H) float32, 0 black .. 1 white; NaN where unknown."""
        return self.learnt.texture

    @property
    def seen(self) -> Tensor:
        """Number of pictures that show each texel, (H, 2 H) int64."""
        return self.learnt.seen


def learn_map(
    experiment: Experiment | str | Path,
    settings: Settings | None = None,
    *,
    init: Tensor | str | Path | None = None,
    cameras: Sequence[str] | None = None,
    progress: Progress = silent,
    kept: Path | None = None,
    command: str = "sphereorient.learn_map",
) -> MapResult | dict[str, MapResult]:
    """Learn the texture map and the orientations of a sphere from movies or photographs, without a known map.

    Several spheres (key `spheres`) give a MapResult each, by name. Only size and position distinguish them: spheres of
    one size get names at random. Spheres of the same paint share a map.

    Args:
        experiment: as loaded, or the path of its experiment.yaml.
        settings: uses the branches `paint` and `locate`; None: the defaults.
        init: an old map (H, 2 H) of one sphere, NaN where unknown, or its file: defines the body frame, and fills
            unseen paint.
        cameras: names of the cameras to use; None: all.
        progress: called with stage, steps done, and all steps.
        kept: file of an unfinished map, from which an interrupted run continues; `spheres` have one each beside it.
        command: recorded in the track's provenance.

    Raises SphereOrientError: missing, unreadable or inconsistent inputs, or movies from which no map can be learnt.
    """
    settings = settings or Settings()
    check_settings(settings, "map")
    old = load_known(Path(init)) if isinstance(init, str | Path) else init
    with open_recording(experiment, cameras, textured=False) as recording, one_thread():
        names = recording.experiment.names
        if old is not None and not recording.experiment.alone:
            do = "leave --init out"
            raise ExperimentError(refusal("init", expected="an experiment of one ball", got=f"{len(names)}", do=do))
        maps = {
            name: fit_map(crops, settings.paint, partial(_of_ball, progress, name), _own(kept, name), old)
            for name, crops in crops_of_balls(recording, settings.paint, settings.locate, progress).items()
        }
        results = {
            name: _result(recording.of(name), one, old, settings, command)
            for name, one in shared_maps(maps, progress).items()
        }
    return results.get(UNNAMED, results)


def first_map_of(
    experiment: Experiment, settings: Settings, cameras: Sequence[str] | None, progress: Progress
) -> tuple[TextureMap, list[str]]:
    """Return a first map of a ball, and remarks on contradictions; see `first_adjustment`, also for errors."""
    with open_recording(experiment, cameras, textured=False) as recording, one_thread():
        if recording.photograph:
            got, do = "a photograph and no map", "learn the map from several with `sphereorient map --photographs`"
            raise ExperimentError(refusal("movies", expected="a movie, or a map", got=got, do=do))
        progress("place", 0, 1)
        place = held_place(recording, settings.paint, settings.locate, progress)
        found, remarks = first_adjustment(recording, place, progress), list[str]()
        (name, camera), *others = recording.cameras.items()
        if isinstance(camera, PinholeCamera) and not others and place.fixed:
            ratio, height = focal_ratio(found), camera.image_size[1]
            given, seen = (field_of_focal(height, float(camera.f_px) * one) for one in (1.0, ratio))
            if ratio != 1.0:
                wrong = f"the pictures fit a vertical field of view of about {seen:.3g} degrees, not {given:.3g}"
                remarks.append(f"{name}: {wrong}: this biases rotations and heading; correct vfov_deg, and learn again")
        return found.texture(), remarks


def _own(kept: Path | None, name: str) -> Path | None:
    return kept.with_name(f"{kept.stem}-{name}{kept.suffix}") if kept and name else kept


def _of_ball(progress: Progress, name: str, stage: str, done: int, total: int) -> None:
    progress(f"{name}: {stage}" if name else stage, done, total)


def _result(recording: Recording, one: SharedMap, old: Tensor | None, settings: Settings, command: str) -> MapResult:
    opened = recording.experiment
    untextured = opened.with_sphere(texture_path=None)  # its file may be the one to write
    origin = provenance(input_files(untextured, list(recording.cameras)), opened.folder, command)
    learnt, comparison, kept_share = (one.learnt, None, 0.0) if old is None else corrected(one.learnt, old)
    return MapResult(
        experiment=opened,
        learnt=learnt,
        track=map_track(opened, recording.clock, learnt, settings_yaml(settings), origin),
        remarks=recording.remarks,
        comparison=comparison,
        kept_share=kept_share,
        paint_of=one.first,
    )
