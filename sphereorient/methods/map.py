"""The method of `sphereorient map`: learn the texture maps from movies in which the spheres rotate."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from torch import Tensor

from sphereorient.errors import ExperimentError, refusal
from sphereorient.experiment import Experiment, input_files
from sphereorient.experiment.recording import Progress, Recording, open_recording, silent
from sphereorient.files.provenance import provenance
from sphereorient.mapping import LearntMap, fit_map, take_crops
from sphereorient.mapping.alike import corrected, shared_maps
from sphereorient.mapping.balls import take_crops_of_all
from sphereorient.mapping.compare import MapComparison
from sphereorient.methods.method import one_thread
from sphereorient.methods.results import map_track
from sphereorient.methods.settings import Settings, check_settings, settings_yaml
from sphereorient.sphere import load_texture
from sphereorient.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True, eq=False)
class MapResult:
    """The result of `learn_map`."""

    experiment: Experiment
    learnt: LearntMap
    track: Trajectory  # the orientations of all frames
    remarks: tuple[str, ...]  # on the inputs
    comparison: MapComparison | None = None  # with the old map, where one was given
    kept_share: float = 0.0  # of the sphere with the old map's texture, because it was never seen
    paint_of: str = ""  # of several balls: the name of the first one that wears this paint

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

    Of several spheres (key `spheres`) the result is a MapResult for each, by name. Nothing but size and place tells
    them apart: names of spheres of one size are given by chance. Those that wear one paint share one map.

    Args:
        experiment: as loaded, or the path of its experiment.yaml.
        settings: the branches `paint` and `locate` are used; None: the defaults.
        init: an old map (H, 2 H) or its file: gives the body frame, and the texture of what is never seen. Of one
            sphere.
        cameras: names of the cameras to use; None: all.
        progress: called with stage, steps done, and all steps.
        kept: file of an unfinished map, from which an interrupted run goes on; of several spheres each has its own
            beside it.
        command: recorded in the track's provenance.

    Raises:
        SphereOrientError: missing, unreadable or inconsistent inputs, or movies from which no map can be learnt.
    """
    settings = settings or Settings()
    check_settings(settings, "map")
    old = load_texture(Path(init)) if isinstance(init, str | Path) else init
    with open_recording(experiment, cameras, textured=False) as recording, one_thread():
        opened = recording.experiment
        if len(opened.spheres) == 1:
            crops = take_crops(recording, settings.paint, settings.locate, progress)
            learnt = fit_map(crops, settings.paint, progress, kept, old)
            if old is None:
                return _result(recording, learnt, settings, command)
            learnt, comparison, kept_share = corrected(learnt, old)
            result = _result(recording, learnt, settings, command)
            return replace(result, comparison=comparison, kept_share=kept_share)
        if old is not None:
            got, do = f"{len(opened.spheres)}", "leave --init out"
            raise ExperimentError(refusal("init", expected="an experiment of one ball", got=got, do=do))
        each = take_crops_of_all(recording, settings.paint, settings.locate, progress)

        def of(name: str) -> LearntMap:
            own = None if kept is None else kept.with_name(f"{kept.stem}-{name}{kept.suffix}")
            return fit_map(each[name], settings.paint, partial(_of_ball, progress, name), own)

        maps = {name: of(name) for name in opened.names}
        progress("balls of one paint", 0, 1)
        shared = shared_maps(maps)
        progress("balls of one paint", 1, 1)
        return {
            name: replace(_result(recording.of(name), one.learnt, settings, command), paint_of=one.first)
            for name, one in shared.items()
        }


def _of_ball(progress: Progress, name: str, stage: str, done: int, total: int) -> None:
    progress(f"{name}: {stage}", done, total)


def _result(recording: Recording, learnt: LearntMap, settings: Settings, command: str) -> MapResult:
    opened = recording.experiment
    untextured = opened.with_sphere(texture_path=None)  # the file that it names may be the one to be written
    origin = provenance(input_files(untextured, list(recording.cameras)), opened.folder, command)
    return MapResult(
        experiment=opened,
        learnt=learnt,
        track=map_track(opened, recording.clock, learnt, settings_yaml(settings), origin),
        remarks=recording.remarks,
    )
