"""The method of `sphereorient map`: learn the texture maps from movies in which the spheres rotate."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from torch import Tensor

from sphereorient.errors import ExperimentError, refusal
from sphereorient.experiment import Experiment, input_files
from sphereorient.experiment.recording import Progress, Recording, open_recording, silent
from sphereorient.files.provenance import provenance
from sphereorient.mapping import LearntMap, fit_map, take_crops
from sphereorient.mapping.balls import take_crops_of_all
from sphereorient.mapping.compare import MapComparison
from sphereorient.mapping.disks import Crops
from sphereorient.mapping.old_map import corrected
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
    comparison: MapComparison | None  # with the old map, where one was given
    kept_share: float  # of the sphere with the old map's texture, because it was never seen
    remarks: tuple[str, ...]  # on the inputs

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
    them apart: names of spheres of one size are given by chance.

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
            return _learnt(recording, crops, settings, old, progress, kept, command)
        if old is not None:
            got, do = f"{len(opened.spheres)}", "leave --init out"
            raise ExperimentError(refusal("init", expected="an experiment of one ball", got=got, do=do))
        each = take_crops_of_all(recording, settings.paint, settings.locate, progress)

        def of(name: str) -> MapResult:
            own = None if kept is None else kept.with_name(f"{kept.stem}-{name}{kept.suffix}")
            return _learnt(
                recording.of(name), each[name], settings, None, partial(_of_ball, progress, name), own, command
            )

        return {name: of(name) for name in opened.names}


def _of_ball(progress: Progress, name: str, stage: str, done: int, total: int) -> None:
    progress(f"{name}: {stage}", done, total)


def _learnt(
    recording: Recording,
    crops: Crops,
    settings: Settings,
    old: Tensor | None,
    progress: Progress,
    kept: Path | None,
    command: str,
) -> MapResult:
    comparison, kept_share = None, 0.0
    learnt = fit_map(crops, settings.paint, progress, kept, old)
    if old is not None:
        learnt, comparison, kept_share = corrected(learnt, old)
    opened = recording.experiment
    untextured = opened.with_sphere(texture_path=None)  # the file that it names may be the one to be written
    origin = provenance(input_files(untextured, list(recording.cameras)), opened.folder, command)
    return MapResult(
        experiment=opened,
        learnt=learnt,
        track=map_track(opened, recording.clock, learnt, settings_yaml(settings), origin),
        comparison=comparison,
        kept_share=kept_share,
        remarks=recording.remarks,
    )
